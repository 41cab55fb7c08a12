"""Scenarios: a file each, named with `-` for `_`, that has a `SCENARIO`. A new scenario is a new file.

Other packages add theirs by an entry point of the group `swarmdrive.scenarios`.
"""

from dataclasses import replace
from importlib import import_module
from importlib.metadata import entry_points
from pkgutil import iter_modules

from harness.core.errors import unknown
from harness.world.scenario import Parameters, Scenario

GROUP = "swarmdrive.scenarios"
DEFAULT = "occluded-intersection"  # where none is named


def names() -> tuple[str, ...]:
    """Every scenario, in alphabetical order."""
    return tuple(sorted({*_files(), *entry_points(group=GROUP).names}))


def get(name: str) -> Scenario:
    """The scenario of that name. Raises UserError if there is none."""
    if is_here(name):
        scenario: Scenario = import_module(f"{__name__}.{name.replace('-', '_')}").SCENARIO
        return scenario
    for plugin in entry_points(group=GROUP, name=name):
        scenario = plugin.load()
        return scenario
    raise unknown("scenario", name, names())


def is_here(name: str) -> bool:
    """Whether a scenario is one of this package."""
    return name in _files()


def restore(name: str, parameters: Parameters) -> Scenario:
    """A scenario that came from another process."""
    return replace(get(name), parameters=parameters)


def _files() -> set[str]:
    return {module.name.replace("_", "-") for module in iter_modules(__path__)}
