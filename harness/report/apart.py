"""Give packages copies of what they read, so that they change nothing that others read."""

from collections.abc import Callable, Iterable
from copy import copy, deepcopy
from dataclasses import replace
from typing import Any, TypeVar, cast

from harness.core.plugins import Plugins, texts
from harness.report.runs import Runs
from harness.runs.folder import Run
from harness.runs.records import Manifest
from harness.runs.suite import SuiteRun

T = TypeVar("T", bound=Manifest | Run | SuiteRun | Runs)


def apart(thing: T, built_in: bool) -> T:
    """Return a copy of a run or manifest for a package's code, which cannot change the original.

    With `built_in`, for code of the harness, it is `thing` itself. The copy's records are shared
    with nobody. Tables cannot be changed at all, and a copy has those of the original, so that none
    is read again.
    """
    copied: Any = thing
    if built_in:
        return thing
    if isinstance(thing, Manifest):
        copied = deepcopy(thing)
    elif isinstance(thing, Run):
        copied = copy(thing)
        object.__setattr__(copied, "manifest", deepcopy(thing.manifest))
    elif isinstance(thing, SuiteRun):
        copied = replace(thing, runs={name: apart(run, False) for name, run in thing.runs.items()})
    else:
        copied = replace(thing, runs=tuple(apart(run, False) for run in thing.runs))
    return cast(T, copied)


def said_of(
    registry: Plugins[Callable[[Any], Iterable[str]]], name: str, thing: Manifest | Run | SuiteRun
) -> list[str]:
    """Return the sentences that one plug-in has to say about a run, suite or manifest.

    `registry` has functions by name, which take such a `thing` and return texts; `name` is the one
    to call. A package's function gets a copy, so that it can change nothing. A suite is a run on
    each of several scenarios, a manifest the settings and origin of a run. Raises UserError if the
    function fails, or returns anything but texts.
    """
    copied = apart(thing, registry.is_ours(name))
    return registry.ask(name, lambda of: texts(of(copied)))
