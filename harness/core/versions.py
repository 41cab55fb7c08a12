"""Versions of the software that a result may depend on, here and on other nodes."""

import platform
from collections.abc import Sequence
from functools import cache
from importlib import metadata
from typing import Any

from harness import __version__
from harness.core.kept import code_sha256
from harness.core.plugins import package_versions

# Versions of what turns answers into decisions. tests/conformance/test_answer_versions.py pins
# their results and asks for a new version when one moves. Work that was stopped under another
# version is not resumed.
PARSER, DECISIONS = 2, 2
FIGURES = 2  # of what summary.csv has of decisions and answers; runs that state none are of 1
PACKAGES = ("numpy", "jinja2", "highway-env", "torch", "transformers", "llama-cpp-python")


_version = cache(metadata.version)


def versions(packages: Sequence[str] = PACKAGES) -> Any:
    """Return a dict of versions, as texts: of the harness, Python, the platform and packages.

    `packages` are names of distributions; one that is not installed is left out. Packages that add
    plug-ins are always there. `parser`, `decisions` and `figures` count changes of the harness's
    own results.
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
    for name, version in package_versions().items():
        installed.setdefault(name, version)
    return installed


@cache
def node_versions() -> dict[str, str]:
    """Return the versions, by name, that all nodes of one job must share.

    They are those of packages that results depend on, and a digest of the harness's source.
    """
    required: dict[str, str] = versions(
        (*PACKAGES, "pyarrow", "shapely", "gymnasium", "msgspec", "pillow")
    )
    del required["platform"]  # it names the kernel, which may differ
    return {**required, "source of harness": code_sha256("**/*.py")[:12]}


def differing(wanted: dict[str, str]) -> str | None:
    """Return a phrase on the first version that differs here from `wanted`; None if none does.

    `wanted` has versions by name, as `node_versions` gives them on another node of a job.
    """
    here = node_versions()
    for name in {**wanted, **here}:
        if here.get(name) != wanted.get(name):
            return f"{name} {here.get(name, 'missing')}, not {wanted.get(name, 'missing')}"
    return None
