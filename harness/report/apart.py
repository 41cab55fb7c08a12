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
    """Return a copy of `thing` for a package to read: its records are shared with nobody.

    With `built_in`, for code of the harness, it is the thing itself. The tables of a copy cannot be
    changed, and are those of the thing, so that none is read again.
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
    """Return the sentences that a plug-in of a registry has on a thing, which it cannot change.

    Raises UserError if the plug-in fails, or they are no texts.
    """
    copied = apart(thing, registry.is_ours(name))
    return registry.ask(name, lambda of: texts(of(copied)))
