"""Scenarios: a module each, named by its file with `-` for `_`. A new scenario is a new file."""

from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType

from harness.core.errors import unknown


def names() -> tuple[str, ...]:
    """Every scenario, in alphabetical order."""
    return tuple(sorted(module.name.replace("_", "-") for module in iter_modules(__path__)))


def get(name: str) -> ModuleType:
    """The scenario's module: `NAME`, `ACTIONS`, `Parameters` and `layout`. Raises UserError if unknown."""
    if name not in names():
        raise unknown("scenario", name, names())
    return import_module(f"{__name__}.{name.replace('-', '_')}")
