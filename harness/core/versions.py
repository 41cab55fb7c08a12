"""Versions of the software that a result may depend on, here and on other nodes."""

import platform
from collections.abc import Sequence
from functools import cache
from importlib import metadata
from typing import Any

from harness import __version__
from harness.core.kept import code_sha256

# Versions of what turns answers into decisions. tests/conformance/test_answer_versions.py pins
# their results and asks for a new version when one moves. Work that was stopped under another
# version is not resumed.
PARSER, DECISIONS = 2, 1
FIGURES = 2  # of what summary.csv has of decisions and answers; runs that state none are of 1
PACKAGES = ("numpy", "scipy", "jinja2", "highway-env", "torch", "transformers", "llama-cpp-python")


_version = cache(metadata.version)


def versions(packages: Sequence[str] = PACKAGES) -> Any:
    """Return, by name, the versions of the harness, Python, the platform and installed packages.

    `parser`, `decisions` and `figures` are versions of the harness's own results.
    """
    installed = {
        "harness": __version__,
        "parser": str(PARSER),
        "decisions": str(DECISIONS),
        "figures": str(FIGURES),
        "python": platform.python_version(),
        "platform": platform.platform(),
    }
    for name in packages:
        try:
            installed[name] = _version(name)
        except metadata.PackageNotFoundError:
            continue
    return installed


@cache
def node_versions() -> dict[str, str]:
    """Return the versions that all nodes of one job must share, and a digest of the source."""
    required: dict[str, str] = versions(
        (*PACKAGES, "pyarrow", "shapely", "gymnasium", "msgspec", "pillow")
    )
    del required["platform"]  # it names the kernel, which may differ
    return {**required, "source of harness": code_sha256("**/*.py")[:12]}


def differing(wanted: dict[str, str]) -> str | None:
    """Describe the first version that differs here from `wanted`; None if none does.

    `wanted` are versions by package, such as those of `node_versions`.
    """
    here = node_versions()
    for name in {**wanted, **here}:
        if here.get(name) != wanted.get(name):
            return f"{name} {here.get(name, 'missing')}, not {wanted.get(name, 'missing')}"
    return None
