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
    """List the kinds of sentences about a run, in the order in which they are shown."""

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
    """Hold one sentence that pages and the terminal show about one or several runs.

    `kind`, such as a warning, says where it is shown; `sentence` is plain text.
    """

    kind: Kind  # says where pages and the terminal show it
    sentence: str  # plain text


def each(source: Source[Run]) -> Source[Runs]:
    """Turn a function that yields sentences about one run into one for several runs by name.

    `source` takes a run; the new function takes runs by the name that each is shown by. Of a
    sentence that is not true of all runs, the names of those it is true of come first.
    """
    return partial(_merged, source)


def _merged(source: Source[Run], runs: Runs) -> list[str]:
    """Return each sentence once, with the names of the runs that it is about if not of all."""
    names_of: dict[str, list[str]] = {}  # by sentence
    for name, run in runs.items():
        for sentence in dict.fromkeys(source(run)):
            names_of.setdefault(sentence, []).append(name)
    sentences = []
    for sentence, names in names_of.items():
        of_all = len(names) == len(runs)
        sentences.append(sentence if of_all else f"{', '.join(names)}: {sentence}")
    return sentences


OF_RUNS: Mapping[Kind, Sequence[Source[Runs]]] = {
    Kind.VOID: [each(caveats.unanswered), each(caveats.unread)],
    Kind.CAVEAT: [
        each(caveats.stated_elsewhere),
        each(caveats.of_extensions),
        caveats.of_one_name,
        each(caveats.moved_system),
        each(caveats.by_letter),
        each(caveats.picked),
        each(caveats.beyond_sources),
        each(caveats.stopped),
        each(ignores_input),
        each(unchecked),
        each(caveats.lost_messages),
        each(caveats.retried),
    ],
    Kind.LIMIT: [
        each(caveats.causes),
        each(caveats.few),
        each(caveats.clustered),
        each(caveats.saturated),
        each(caveats.earlier_gains),
        each(caveats.sampled),
        each(caveats.divided),
        each(caveats.flipped),
        each(caveats.controls),
        each(caveats.unheard),
        each(caveats.lost_at_once),
        each(caveats.lagging),
        each(caveats.unmeasured),
        caveats.no_prompt,
    ],
    Kind.FIGURE: [each(words.adjusted_lines), each(in_a_line)],
}
# Of a run, or of a suite as a whole.
OF_ONE: Mapping[Kind, Sequence[Source[Run | SuiteRun]]] = {
    Kind.PACE: [notes.pace],
    Kind.ORIGIN: [
        notes.latency,
        notes.of_extensions,
        notes.answer_times,
        notes.cost,
        notes.cached,
        notes.readings,
    ],
}


def findings(run: Run | SuiteRun, *kinds: Kind) -> list[Finding]:
    """Return all sentences about a run, or about a suite and its runs; only of `kinds` if given.

    A suite is a run on each of several scenarios. The sentences are in the order of the kinds.
    """
    runs = run.runs if isinstance(run, SuiteRun) else {"": run}
    return [*of_runs(runs, *kinds), *_findings(OF_ONE, run, kinds)]


def of_runs(runs: Runs, *kinds: Kind) -> list[Finding]:
    """Return the sentences that a page shows about several runs; only of `kinds` if given.

    `runs` are by the name that each is shown by. A sentence that is not true of all begins with the
    names of those it is true of.
    """
    return _findings(OF_RUNS, runs, kinds)


def _findings(
    table: Mapping[Kind, Sequence[Source[T]]], subject: T, kinds: Sequence[Kind]
) -> list[Finding]:
    findings = []
    for kind, sources in table.items():
        if kind in (kinds or Kind):
            for source in sources:
                findings += [Finding(kind, sentence) for sentence in source(subject)]
    return findings
