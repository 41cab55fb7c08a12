"""`harness model doctor`: versions, machine, models and what they lack, completion cache."""

import os
import subprocess
from shutil import which
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.terminal import WIDTH, echo_json
from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from harness.backends.card import Card

MARGIN = 10
PACKAGES = (
    "numpy",
    "pandas",
    "jinja2",
    "highway-env",
    "matplotlib",
    "tokenizers",
    "torch",
    "transformers",
    "llama-cpp-python",
)
SMI_S = 1.0  # most seconds that nvidia-smi is waited for
GIB = 2**30


def command(
    gpu: bool = typer.Option(
        False, "--gpu", help="Also ask torch for GPUs, which takes a few seconds."
    ),
    engines: bool = typer.Option(
        False,
        "--engines",
        help="Also time the engines of each small model that has several; takes a minute.",
    ),
    as_json: options.Json = False,
) -> None:
    """Show what can run here: versions, machine, models, cache.

    For models that cannot run, it says what to install or fetch.
    """
    facts = look(gpu) | {"paces": {}}
    if engines:
        from harness.backends import cards
        from harness.extensions.checkups.pace import advice, by_card

        stems = cards.names()
        with bar("timing engines", len(stems), as_json) as progress:
            facts["paces"] = by_card(stems, progress)
    if as_json:
        echo_json(facts)
        return
    versions = dict(facts["versions"])
    _line(
        "harness",
        f"{versions.pop('harness')}, Python {versions.pop('python')}, {versions.pop('platform')}",
    )
    _line("packages", ", ".join(f"{name} {version}" for name, version in versions.items()))
    memory = "unknown" if facts["memory_gib"] is None else f"{facts['memory_gib']:g} GiB"
    _line("machine", f"{facts['cores']} cores, {memory} of memory")
    _line(
        "GPU",
        "; ".join(map(printable, facts["gpu"]))
        or f"none that {'torch' if gpu else 'nvidia-smi'} sees",
    )
    size = f"{facts['cache']['bytes'] / 1e6:.1f} MB" if facts["cache"]["bytes"] else "empty"
    _line("meters", ", ".join(facts["meters"]) or "none of energy that can be read")
    _line("cache", f"{printable(facts['cache']['file'], 1000)}, {size}")
    _line("engines", ", ".join(engine for engine, lack in facts["engines"].items() if lack is None))
    _lacking([(engine, lack) for engine, lack in facts["engines"].items() if lack is not None])
    able = [model for model in facts["models"] if model["missing"] is None]
    _line("models", ", ".join(model["name"] for model in able))
    _lacking([(model["name"], model["remedy"]) for model in facts["models"] if model["missing"]])
    _lacking([(model["name"], model["remedy"]) for model in able if model["remedy"]])
    for n, (name, paces) in enumerate(facts["paces"].items()):
        _line("" if n else "paces", f"{name}: {advice(paces)}")


def _line(head: str, text: str) -> None:
    for n, line in enumerate(wrap(text, WIDTH - MARGIN, break_on_hyphens=False) or ["none"]):
        typer.echo(f"{'' if n else head:<{MARGIN}}{printable(line, 1000)}")


def _lacking(remedies: list[tuple[str, str]]) -> None:
    for name, remedy in remedies:
        _line("", f"{printable(name)}: {remedy}")


def look(gpu: bool) -> dict[str, Any]:
    """Return the facts that `harness model doctor --json` prints, as plain values by name.

    They are `versions` of packages, `cores`, `memory_gib`, `gpu` (a text for each), names of energy
    `meters`, `engines` with what to do about one that cannot run (else None), `models` with what
    each is `missing`, and the `cache` of answers: its file and bytes. With `gpu`, torch is asked
    for GPUs, which takes seconds to load; without, the program nvidia-smi.
    """
    from harness.backends import cards, registry
    from harness.backends.cache import default_file
    from harness.backends.counters import counters
    from harness.backends.transformers.engine import gpus
    from harness.core.cores import usable
    from harness.core.versions import versions

    models: list[dict[str, Any]] = []
    for name in cards.names():
        try:
            models += map(_model, cards.each_engine(name))
        except UserError as error:  # a card with a mistake is what one asks a doctor about
            models.append(
                {"name": name, "engine": None, "missing": "a sound card", "remedy": str(error)}
            )
    cache = default_file()
    return {
        "versions": versions(PACKAGES),
        "cores": usable(),
        "memory_gib": _memory_gib(),
        "gpu": gpus() if gpu else _smi_gpus(),
        "meters": [meter.name for meter in counters()],
        "engines": {engine: _package_remedy(engine) for engine in registry.ENGINES},
        "models": models,
        "cache": {"file": str(cache), "bytes": cache.stat().st_size if cache.is_file() else 0},
    }


def _model(card: "Card") -> dict[str, Any]:
    from harness.backends.registry import missing

    lack = missing(card)
    return {
        "name": card.name,
        "engine": card.engine,
        "missing": lack,
        "remedy": remedy(card, lack),
    }


def remedy(card: "Card", lack: str | None) -> str | None:
    """Return what to do about what is missing; what else the card needs, which was not tried."""
    if card.server:
        return f"needs a server at {printable(' or '.join(card.server.urls))} (not tried)"
    if lack is None:
        return None
    if lack != "weights":
        return _package_remedy(card.engine)
    gated = " (accept its licence on the hub first)" if card.gated else ""
    return f"harness model pull {printable(card.name)}{gated}"


def _package_remedy(engine: str) -> str | None:
    from harness.backends.registry import missing_package, registration

    try:
        return registration(engine).install if missing_package(engine) else None
    except UserError as error:  # a plug-in that does not load
        return str(error)


def _memory_gib() -> float | None:
    """Return the machine's memory; None where the system does not tell."""
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GIB, 1)
    except (AttributeError, ValueError, OSError):
        return None


def _smi_gpus() -> list[str]:
    program = which("nvidia-smi")
    if program is None:
        return []
    command = [program, "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=SMI_S, check=True)
    except (OSError, ValueError, subprocess.SubprocessError):
        return []
    return done.stdout.splitlines()
