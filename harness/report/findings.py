"""Gather every sentence about a run, in the order in which all that shows a run says them.

A new sentence is a function of a run and its line in `OF_RUNS`. What shows runs chooses by the kind.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

from harness.report import caveats
from harness.report.constancy import ignores_input
from harness.runs.contradictions import unchecked
from harness.runs.folder import Run
from harness.runs.suite import SuiteRun

Runs = Mapping[str, Run]  # by the name that each is shown by


class Kind(StrEnum):
    """What a sentence is for, in the order in which they stand."""

    VOID = "void"  # why the numbers are no result
    CAVEAT = "caveat"  # who decided, and how that is known
    LIMIT = "limit"  # how far the numbers carry


FIRST = (Kind.VOID, Kind.CAVEAT, Kind.LIMIT)  # what a reader must know before the numbers


@dataclass(frozen=True)
class Finding:
    """A sentence about a run, or about some of several."""

    kind: Kind
    sentence: str


def each(of: Callable[[Run], Iterable[str]]) -> Callable[[Runs], list[str]]:
    """Return what says of several runs what `of` says of each."""
    return partial(_merged, of)


def _merged(of: Callable[[Run], Iterable[str]], runs: Runs) -> list[str]:
    """Return each sentence once, with the names of the runs that it is about if not of all."""
    about: dict[str, list[str]] = {}
    for name, run in runs.items():
        for sentence in dict.fromkeys(of(run)):
            about.setdefault(sentence, []).append(name)
    return [
        sentence if len(names) == len(runs) else f"{', '.join(names)}: {sentence}"
        for sentence, names in about.items()
    ]


OF_RUNS: Mapping[Kind, Sequence[Callable[[Runs], Iterable[str]]]] = {
    Kind.VOID: [*map(each, (caveats.unanswered, caveats.unread))],
    Kind.CAVEAT: [
        caveats.no_prompt,
        *map(each, (
            caveats.of_extensions,
            caveats.moved_system,
            caveats.by_letter,
            caveats.beyond_sources,
            caveats.on_device,
            caveats.looked_at,
            ignores_input,
            unchecked,
        )),
    ],
    Kind.LIMIT: [*map(each, (
        caveats.causes,
        caveats.few,
        caveats.saturated,
        caveats.earlier_gains,
        caveats.sampled,
        caveats.divided,
        caveats.flipped,
        caveats.lost_messages,
        caveats.retried,
        caveats.controls,
        caveats.unheard,
        caveats.lost_at_once,
        caveats.lagging,
        caveats.unmeasured,
    ))],
}  # fmt: skip


def findings(run: Run | SuiteRun, *kinds: Kind) -> list[Finding]:
    """Return what is said of a run or of a suite's runs, all of it or only of these kinds."""
    return of_runs(run.runs if isinstance(run, SuiteRun) else {"": run}, *kinds)


def of_runs(runs: Runs, *kinds: Kind) -> list[Finding]:
    """Return what is said of runs that stand side by side, all of it or only of these kinds."""
    return [
        Finding(kind, sentence)
        for kind, sources in OF_RUNS.items() if kind in (kinds or Kind)
        for of in sources
        for sentence in of(runs)
    ]  # fmt: skip
