"""Versions of what a result may depend on, here and on other nodes."""

import platform
from collections.abc import Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from harness import __version__
from harness.core.kept import code_sha256

PACKAGES = ("numpy", "scipy", "jinja2", "highway-env", "torch", "transformers", "llama-cpp-python")


def versions(packages: Sequence[str] = PACKAGES) -> Any:
    """Versions of the installed packages that a result may depend on."""
    installed = {"harness": __version__, "python": platform.python_version(), "platform": platform.platform()}
    for name in packages:
        try:
            installed[name] = version(name)
        except PackageNotFoundError:
            continue
    return installed


@cache
def of_node() -> dict[str, str]:
    """What has to be the same on all machines that work on one thing, the harness's own source among it."""
    found: dict[str, str] = versions((*PACKAGES, "pyarrow", "shapely", "gymnasium", "msgspec", "pillow"))
    del found["platform"]  # of which the kernel is a part
    return {**found, "source of harness": code_sha256("**/*.py")[:12]}


def differing(wanted: dict[str, str]) -> str | None:
    """The first thing that is another here, with both versions; None if nothing is."""
    here = of_node()
    for name in {**wanted, **here}:
        if here.get(name) != wanted.get(name):
            return f"{name} {here.get(name, 'missing')}, not {wanted.get(name, 'missing')}"
    return None
