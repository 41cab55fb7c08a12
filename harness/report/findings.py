"""Gather every sentence about a run, in the order in which all that shows a run says them.

A new sentence is a function and its line in a table below. What shows runs chooses by the kind.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import TypeVar

from harness.report import caveats, notes, words
from harness.report.constancy import ignores_input, in_a_line
from harness.runs.contradictions import unchecked
from harness.runs.folder import Run
from harness.runs.suite import SuiteRun

T = TypeVar("T")
Source = Callable[[T], Iterable[str]]
Runs = Mapping[str, Run]  # by the name that each is shown by


class Kind(StrEnum):
    """What a sentence is for, in the order in which they stand."""

    VOID = "void"  # why the numbers are no result
    CAVEAT = "caveat"  # who decided, and how that is known
    LIMIT = "limit"  # how far the numbers carry
    FIGURE = "figure"  # what else they come to
    PACE = "pace"  # how fast the answers came
    ORIGIN = "origin"  # where the numbers come from


FIRST = (Kind.VOID, Kind.CAVEAT, Kind.LIMIT)  # what a reader must know before the numbers
LAST = (Kind.PACE, Kind.ORIGIN)  # what stands below them


@dataclass(frozen=True)
class Finding:
    """A sentence about a run, or about some of several."""

    kind: Kind
    sentence: str


def each(of: Source[Run]) -> Source[Runs]:
    """Return what says of several runs what `of` says of each."""
    return partial(_merged, of)


def _merged(of: Source[Run], runs: Runs) -> list[str]:
    """Return each sentence once, with the names of the runs that it is about if not of all."""
    about: dict[str, list[str]] = {}
    for name, run in runs.items():
        for sentence in dict.fromkeys(of(run)):
            about.setdefault(sentence, []).append(name)
    return [
        sentence if len(names) == len(runs) else f"{', '.join(names)}: {sentence}"
        for sentence, names in about.items()
    ]


OF_RUNS: Mapping[Kind, Sequence[Source[Runs]]] = {
    Kind.VOID: [*map(each, (caveats.unanswered, caveats.unread))],
    Kind.CAVEAT: [
        caveats.no_prompt,
        *map(
            each,
            (
                caveats.of_extensions,
                caveats.moved_system,
                caveats.by_letter,
                caveats.beyond_sources,
                caveats.on_device,
                caveats.looked_at,
                ignores_input,
                unchecked,
                caveats.lost_messages,
                caveats.retried,
            ),
        ),
    ],
    Kind.LIMIT: [
        *map(
            each,
            (
                caveats.causes,
                caveats.few,
                caveats.saturated,
                caveats.earlier_gains,
                caveats.sampled,
                caveats.divided,
                caveats.flipped,
                caveats.controls,
                caveats.unheard,
                caveats.lost_at_once,
                caveats.lagging,
                caveats.unmeasured,
            ),
        )
    ],
    Kind.FIGURE: [*map(each, (words.adjusted_lines, in_a_line))],
}
# Of a run, or of a suite as a whole.
OF_ONE: Mapping[Kind, Sequence[Source[Run | SuiteRun]]] = {
    Kind.PACE: [notes.pace],
    Kind.ORIGIN: [
        notes.latency,
        notes.energy,
        notes.answer_times,
        notes.cost,
        notes.cached,
        notes.readings,
    ],
}


def findings(run: Run | SuiteRun, *kinds: Kind) -> list[Finding]:
    """Return what is said of a run, or of a suite and its runs,
    all of it or only of these kinds.
    """
    runs = run.runs if isinstance(run, SuiteRun) else {"": run}
    return [*of_runs(runs, *kinds), *_said(OF_ONE, run, kinds)]


def of_runs(runs: Runs, *kinds: Kind) -> list[Finding]:
    """Return what is said of runs that stand side by side, all of it or only of these kinds."""
    return _said(OF_RUNS, runs, kinds)


def _said(table: Mapping[Kind, Sequence[Source[T]]], of: T, kinds: Sequence[Kind]) -> list[Finding]:
    return [
        Finding(kind, sentence)
        for kind, sources in table.items()
        if kind in (kinds or Kind)
        for source in sources
        for sentence in source(of)
    ]
