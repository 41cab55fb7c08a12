"""What is here to run with: versions, machine, models and what they lack, completion cache."""

import os
import subprocess
from shutil import which
from typing import Any, get_args

from harness.backends import cards
from harness.backends.cache import default_file
from harness.backends.cards import Card, Engine
from harness.backends.registry import missing, missing_package
from harness.backends.transformers.engine import gpus
from harness.core.errors import UserError, printable
from harness.evaluate.spec import versions

PACKAGES = (
    "numpy", "scipy", "pandas", "jinja2", "highway-env", "matplotlib", "tokenizers", "torch", "transformers",
    "llama-cpp-python",
)  # fmt: skip
SMI_S = 1.0  # most seconds that nvidia-smi is waited for
GIB = 2**30


def look(gpu: bool = False) -> dict[str, Any]:
    """What `harness doctor --json` prints.

    Args:
        gpu: ask torch for GPUs too, which takes seconds to load.
    """
    models: list[dict[str, Any]] = []
    for name in cards.names():
        try:
            models += map(_model, cards.each_engine(name))
        except UserError as error:  # a card with a mistake is what one asks a doctor about
            models.append({"name": name, "engine": None, "missing": "a sound card", "remedy": str(error)})
    cache = default_file()
    return {
        "versions": versions(PACKAGES),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gib": _memory_gib(),
        "gpu": gpus() if gpu else _smi_gpus(),
        "engines": {engine: _package_remedy(engine) for engine in get_args(Engine)},
        "models": models,
        "cache": {"file": str(cache), "bytes": cache.stat().st_size if cache.is_file() else 0},
    }


def _model(card: Card) -> dict[str, Any]:
    lack = missing(card)
    return {"name": card.name, "engine": card.engine, "missing": lack, "remedy": _remedy(card, lack)}


def _remedy(card: Card, lack: str | None) -> str | None:
    """What to do about what is missing; what else the card needs, which was not tried."""
    if card.server:
        return f"needs a server at {printable(card.server.base_url)} (not tried)"
    if lack is None:
        return None
    if lack != "weights":
        return _package_remedy(card.engine)
    gated = " (accept its licence on the hub first)" if card.gated else ""
    return f"harness model pull {printable(card.name)}{gated}"


def _package_remedy(engine: Engine) -> str | None:
    return f"pip install 'swarmdrive-harness[{engine}]'" if missing_package(engine) else None


def _memory_gib() -> float | None:
    """Memory of the machine; None where the system does not tell."""
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GIB, 1)
    except (AttributeError, ValueError, OSError):
        return None


def _smi_gpus() -> list[str]:
    program = which("nvidia-smi")
    if program is None:
        return []
    asked = [program, "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]
    try:
        done = subprocess.run(asked, capture_output=True, text=True, timeout=SMI_S, check=True)
    except (OSError, ValueError, subprocess.SubprocessError):
        return []
    return done.stdout.splitlines()
