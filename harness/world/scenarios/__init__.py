"""Registry of scenarios. Each file here has a `SCENARIO`,
whose name is the file's with `-` for `_`.

Other packages add theirs by an entry point of the group `swarmdrive.scenarios`;
extensions add families of them (`harness.world.families`).
"""

import copyreg
from collections.abc import Collection, Mapping
from dataclasses import fields, replace
from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

from harness.core.config import convert, value_of
from harness.core.errors import UserError, printable, unknown
from harness.core.files import canonical_json
from harness.core.plugins import Plugins
from harness.world.families import family_of
from harness.world.parameters import SCENES, SUITES, Parameters
from harness.world.scenario import KNOWN_ACTIONS, Scenario

FURTHER = ("LANE_LEFT", "LANE_RIGHT")  # actions that the simulator knows beside those of drivers


class PackagesScenarios(Plugins[Scenario]):
    """Hold the scenarios of installed packages by name; each is checked when it is loaded."""

    def check(self, name: str, plugin: Scenario) -> None:
        """Raise ValueError if a package's scenario is inconsistent, such as in its actions.

        `plugin` is the scenario, and `name` that of the entry point, which must be the scenario's
        own, too.
        """
        if plugin.name != name:
            raise ValueError(f"its name is {printable(repr(plugin.name))}")
        if not isinstance(plugin.parameters, Parameters):
            raise ValueError("its parameters are no Parameters")
        if not isinstance(plugin.description, str) or not plugin.description.strip():
            raise ValueError("its description is no text")
        if not all(isinstance(text, str) for text in plugin.words.values()):
            raise ValueError("its words hold what is no text")
        if not isinstance(plugin.one_sided, str | None):
            raise ValueError("one_sided is no text, and not None")
        if plugin.world is not None:
            raise ValueError("it has a world of its own; make an environment of highway-env of it")
        actions = plugin.actions
        if not isinstance(actions, tuple) or len(set(actions)) < len(actions):
            raise ValueError("its actions are no tuple, or one is there twice")
        needed = KNOWN_ACTIONS
        if not {*needed} <= {*actions} <= {*needed, *FURTHER}:
            allowed = f"{', '.join(needed)}, with or without {' and '.join(FURTHER)}"
            raise ValueError(f"its actions are {printable(repr(actions))}, and not {allowed}")
        for dial in plugin.dials:
            if not hasattr(plugin.parameters, dial):
                raise ValueError(f"its dial {printable(repr(dial))} is no parameter")


PLUG_INS = PackagesScenarios("swarmdrive.scenarios", Scenario, {})
DEFAULT = "occluded-intersection"  # taken if none is named


def names() -> tuple[str, ...]:
    """Return the names of all scenarios, built in or of a package, in alphabetical order."""
    return tuple(sorted({*_files(), *PLUG_INS}))


def witnessed() -> tuple[str, ...]:
    """Return the built-in scenarios whose layouts can have a declared number of witnesses, sorted.

    A layout is the start situation of an episode, and a witness a helper that has the danger in
    sight at the first decision.
    """
    return tuple(name for name in sorted(_files()) if "witnesses" in get(name).dials)


def get(text: str) -> Scenario:
    """Return a scenario by name, with other settings if given: `blind-merge:ambient=fog`.

    `text` is as a user types it; several settings have commas between them. Raises UserError if
    there is no such scenario or setting, or a value is not allowed.
    """
    name, settings = split(text)
    scenario = _named(name)
    if settings is None:
        return scenario
    changed: dict[str, Any] = dict(_setting(scenario, part) for part in settings.split(","))
    return replace(scenario, parameters=replace(scenario.parameters, **changed))


def split(text: str) -> tuple[str, str | None]:
    """Split a scenario as a user types it, `NAME:key=value`, into its name and its settings.

    The settings are one text, such as `key=value,other=3`; None without any.
    """
    if family := family_of(text):
        return family.split(text)
    name, colon, settings = text.partition(":")
    return name, settings if colon else None


def argument(scenario: Scenario) -> str:
    """Return the text that names a scenario with its settings, such as `blind-merge:ambient=fog`.

    `get` finds the same scenario by it, even if its defaults change later. It spells out the
    settings that differ from the defaults, and those in which suites (sets of datasets, one for
    each scenario) differ.
    """
    return _spelled(scenario, {*_changed(scenario), *_of_suites(scenario)})


def title(scenario: Scenario) -> str:
    """Return a scenario's name for people, with its settings that differ from the defaults.

    If its settings are those of a suite (a set of datasets, in `SUITES`), it ends with
    `, scenes of` and the suite's name instead of these.
    """
    scenes = _of_suites(scenario)
    suites = [suite for suite, of in SUITES.items() if of == scenes]
    return (
        f"{_spelled(scenario, _changed(scenario) - scenes.keys())}, scenes of {suites[0]}"
        if suites
        else argument(scenario)
    )


def _changed(scenario: Scenario) -> set[str]:
    """Return the settings that differ from the scenario's usual ones."""
    usual, p = get(scenario.name).parameters, scenario.parameters
    return {dial for dial in scenario.dials if getattr(p, dial) != getattr(usual, dial)}


def _of_suites(scenario: Scenario) -> dict[str, object]:
    """Return what the scenes of suites differ in; nothing of a scenario that is in none."""
    if "witnesses" not in scenario.dials:
        return {}
    return {key: getattr(scenario.parameters, key) for key in SCENES}


def _spelled(scenario: Scenario, stated_dials: Collection[str]) -> str:
    """Return a scenario's name with those of its settings that are in `stated_dials`."""
    settings = []
    for dial in scenario.dials:
        if dial in stated_dials:
            value = getattr(scenario.parameters, dial)
            text = value if isinstance(value, str) else canonical_json(value)
            settings.append(f"{dial}={text}")
    if family := family_of(scenario.name):
        return family.joined(scenario.name, settings)
    return ":".join([scenario.name, *([",".join(settings)] if settings else [])])


def _setting(scenario: Scenario, text: str) -> tuple[str, object]:
    """Read a setting such as `ambient=fog`. Raises UserError if it is unknown or not allowed."""
    key, _, value = text.partition("=")
    scenario_name = printable(scenario.name)
    if key not in scenario.dials:
        example = f"; as in {scenario_name}:perfect_knowledge=true"
        raise unknown(f"setting of scenario {scenario_name}", key, scenario.dials, example)
    usual = getattr(scenario.parameters, key)
    setting = value_of(usual, value)
    if isinstance(setting, str) and not isinstance(usual, str):
        allowed = "true or false" if isinstance(usual, bool) else "a number"
        raise UserError(f"scenario {scenario_name}: {key} is {printable(value)!r}; give {allowed}")
    return key, setting


def _named(name: str) -> Scenario:
    if family := family_of(name):
        return family.scenario(name)
    if is_here(name):
        scenario: Scenario = import_module(f"{__name__}.{name.replace('-', '_')}").SCENARIO
        return scenario
    if name in PLUG_INS:
        return PLUG_INS[name]
    raise unknown("scenario", name, names())


def is_here(name: str) -> bool:
    """Return whether a scenario of this name is built in, rather than another package's."""
    return name in _files()


def of_manifest(name: str, parameters: Mapping[str, Any]) -> Scenario:
    """Return the scenario `name` with the parameters that a dataset's or run's manifest states.

    `parameters` has values by the name of the parameter. One that was added to the harness later
    and is not stated takes the value under which all is as before it was added
    (`Parameters.later`). Raises UserError if one is unknown here, of another type or out of bounds.
    """
    scenario = get(name)
    names = [field.name for field in fields(scenario.parameters)]
    here = {name: getattr(scenario.parameters, name) for name in names}
    where = f"scenario {printable(scenario.name, 80)}"
    if extra := [key for key in parameters if key not in here]:
        raise UserError(
            f"{where} has other parameters here (not {printable(extra[0])}); "
            "use the version that its manifest names"
        )
    earlier = {key: value for key, value in scenario.parameters.later if key in here}
    values = here | earlier
    for key, value in parameters.items():
        # Numbers in a manifest are decoded as floats.
        is_whole = isinstance(value, float) and value.is_integer()
        values[key] = int(value) if is_whole and type(here[key]) is int else value
    return replace(scenario, parameters=convert(values, type(scenario.parameters), where))


def restore(name: str, parameters: Parameters, layout_seed: int | None = None) -> Scenario:
    """Return the scenario that was pickled as this name and these parameters.

    Pickle calls it, since a scenario's functions cannot be pickled. `layout_seed` is that of the
    layout whose road it has; None if all layouts have one road.
    """
    scenario = replace(get(name), parameters=parameters)
    return scenario if layout_seed is None else scenario.at(layout_seed)


def _pickled(scenario: Scenario) -> tuple[Any, tuple[Any, ...]]:
    return restore, (scenario.name, scenario.parameters, scenario.layout_seed)


copyreg.pickle(Scenario, _pickled)


@cache  # called for every answer of the proxy
def _files() -> frozenset[str]:
    return frozenset(module.name.replace("_", "-") for module in iter_modules(__path__))
