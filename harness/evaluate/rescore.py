"""Compute the runs in a file of results again from their answers alone, and say which figures differ."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import zip_longest
from pathlib import Path

from msgspec import structs

from harness.backends.replay import Kept
from harness.core import work
from harness.core.errors import Unanswered, UserError, printable
from harness.evaluate import edition as editions
from harness.evaluate.edition import Edition
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.run import evaluate
from harness.evaluate.spec import Spec
from harness.runs.folder import Run, read
from harness.runs.records import Episode
from harness.runs.results import Contents, figures, unpack
from harness.runs.suite import SuiteRun


@dataclass(frozen=True)
class Rescored:
    """A file of results, computed again here."""

    contents: Contents  # what the file says of itself
    edition: Edition  # the one that it names
    suite: SuiteRun  # the runs as they were computed here, by family
    # what differs from the figures in the file, by dataset, in words; none where all are equal
    differences: Mapping[str, Sequence[str]]
    compared: int  # how many figures were


def rescored(
    file: Path, folder: Path, progress: Callable[[int], None], sources: Callable[[Edition, str], FrozenSource]
) -> Rescored:
    """Compute a file's runs again under the edition that it names, in an empty folder.

    Of the file, only what the models wrote is used. No model is asked, and nothing of the file is run.

    Args:
        file: the file of results.
        folder: where the runs are unpacked and computed.
        progress: called with the number of answers that were read again.
        sources: the datasets of an edition by name, which several files share (`sources_once`).

    Raises UserError if the file is broken, too large or of another edition than the one here, or has not the
    answer to every question, or one to another question.
    """
    try:
        contents, stated = unpack(file, folder / "stated")
        edition = editions.named(contents.edition)
        if contents.digest != edition.digest:
            raise UserError(
                f"{printable(edition.name)} has digest {edition.digest[:12]}… here, and the file is of "
                f"{printable(contents.digest, 13)}; install the release that has that edition"
            )
        runs, differences, compared = dict[str, Run](), dict[str, Sequence[str]](), 0
        for name, run in edition.entry(stated).items():
            source = sources(edition, name)
            ours = _computed(run, edition.spec(run, source), folder / "computed" / name, progress)
            runs[source.scenario.name] = ours
            differences[name] = [*differing(run, ours, edition.metrics)]
            compared += len(figures(ours, edition.metrics))
    except (UserError, Unanswered, OverflowError) as error:
        where = f"{folder / 'stated'}/"
        raise UserError(f"{printable(file)}: {str(error).replace(where, '')}") from None
    suite = SuiteRun(folder / "computed", edition.name, edition.description, runs)
    return Rescored(contents, edition, suite, differences, compared)


def sources_once() -> Callable[[Edition, str], FrozenSource]:
    """Return what reads each dataset of an edition once."""
    read_dataset = cache(lambda digest, edition, name: edition().source(name))
    return lambda edition, name: read_dataset(edition.digest, lambda: edition, name)


def _computed(stated: Run, spec: Spec, out: Path, progress: Callable[[int], None]) -> Run:
    evaluate(spec, out, progress, opens=lambda card, **options: Kept(stated))
    work.tidy(out)
    return read(out)


def differing(stated: Run, computed: Run, metrics: Sequence[str]) -> Iterator[str]:
    """Yield what differs between the figures of two runs in some metrics, and between their episodes.

    Numbers are compared as they are written, to the last digit; but not a column of episodes that the stated
    run, which may be older, lacks.
    """
    theirs, ours = (
        {(s.condition, s.metric, s.interval): s for s in figures(run, metrics)} for run in (stated, computed)
    )
    for key in {**theirs, **ours}:
        if theirs.get(key) != ours.get(key):
            yield " ".join(key)
    rows = [[structs.astuple(episode) for episode in run.episodes] for run in (stated, computed)]
    columns = (zip(*each, strict=True) for each in rows)
    for name, *values in zip(Episode.__struct_fields__, *columns, strict=True):
        if any(value is not None for value in values[0]):
            wrong = sum(a != b for a, b in zip_longest(*values))
            if wrong:
                yield f"{name} of {wrong} episodes"
