"""Compute the runs in a file of results again from their answers alone,
and say which figures differ.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory

from msgspec.structs import astuple

from harness.core.errors import Unanswered, UserError, printable, sayable, unknown
from harness.core.figures import amount
from harness.core.files import sha256_file
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.recompute import computed
from harness.extensions.benchmark import edition as editions
from harness.extensions.benchmark.edition import Edition
from harness.extensions.benchmark.results import Contents, contents_of, unpack
from harness.runs import digests
from harness.runs.folder import Run, read
from harness.runs.records import Episode, Score
from harness.runs.suite import SuiteRun

DIGITS = 12  # in which figures are equal, and the tables of episodes in all
TOLERANCE = 10.0**-DIGITS


@dataclass(frozen=True)
class Rescored:
    """Hold a file of results whose figures were computed again here from the answers in it.

    The file packs one entry of a benchmark: a run on each dataset of an edition (a release of the
    benchmark), with the model's answers and the figures that its maker states. `contents` is its
    `results.json`, and `suite` has the runs as computed here. `differences` names, by dataset, what
    the file states otherwise, of the `compared` figures. `golden` is true of the file that pins how
    the edition's figures are computed, which is no entry.
    """

    contents: Contents  # the file's own `results.json`
    edition: Edition  # the edition that the file names
    suite: SuiteRun  # the runs as they were computed here, by family (the scenario's name)
    # what differs from the figures in the file, by dataset, in words; none where all are equal
    differences: Mapping[str, Sequence[str]]
    compared: int  # number of figures that were compared
    # whether the file is the one that pins the edition, of a few layouts, and no entry
    golden: bool = False
    file: str = ""  # the file's name and its folder's; empty if it was made by hand


class Here:
    """Represent this installation: it reads each dataset once, and checks how it computes figures.

    Make one, and share it among all files of results that are computed again in a process.
    """

    def __init__(self) -> None:
        self._sources: dict[tuple[str, str], FrozenSource] = {}
        self._checked: set[str] = set()  # digests of editions

    def source(self, edition: Edition, name: str) -> FrozenSource:
        """Return the scenes of an edition's dataset by its name; each is read once and kept.

        An edition is a release of the benchmark. Raises UserError if the dataset here has another
        digest than the edition states.
        """
        key = edition.digest, name
        if key not in self._sources:
            self._sources[key] = edition.source(name)
        return self._sources[key]

    def check(self, edition: Edition) -> None:
        """Raise UserError unless this installation computes an edition's figures as it pins them.

        An edition, a release of the benchmark, pins them by a file of results, whose figures are
        computed again; an edition without such a file passes. Each edition is checked once.
        """
        if edition.golden is None or edition.digest in self._checked:
            return
        file = edition.golden_file
        if not file.is_file() or edition.layouts(sha256_file(file, "record")) is None:
            raise UserError(
                f"{printable(file)} is not the file that {edition.name} pins; restore it"
            )
        with TemporaryDirectory(prefix="harness-") as folder:
            done = rescored(file, Path(folder), lambda count: None, self)
        wrong = []
        for name, differences in done.differences.items():
            wrong += [f"{name}: {figure}" for figure in differences]
        if wrong:
            raise UserError(
                f"this installation computes {len(wrong)} figures of {edition.name} otherwise than "
                f"it pins, such as {printable(wrong[0])}; install a release that has that edition "
                "as it was"
            )
        self._checked.add(edition.digest)


def rescored(file: Path, folder: Path, progress: Callable[[int], None], here: Here) -> Rescored:
    """Compute a results file's runs again from its answers, under the edition that it names.

    Only what the models wrote is used of the file. Rules are asked again here, no other model is,
    and nothing in the file is run.

    Args:
        file: the file of results.
        folder: an empty folder, where the runs are unpacked and computed.
        progress: called with the number of answers that were read again.
        here: this installation, which several files share.

    Raises UserError if the file is broken, too large or of another edition than the one here, if it
    lacks the answer to a question, or has one to another question; or if this installation computes
    the figures that the edition pins otherwise.
    """
    sayable("file", file.name)
    contents, stated_folder = contents_of(file), folder / "stated"
    with _about(file, stated_folder):
        edition = editions.named(contents.edition)
        limit = edition.layouts(sha256_file(file, "record"))
        if contents.digest != edition.digest and limit is None:
            raise UserError(
                f"{printable(edition.name)} has digest {edition.digest} here, and the file is of "
                f"{printable(contents.digest)}; install the release that has that edition"
            )
        if strange := [name for name in contents.runs if name not in edition.datasets]:
            raise unknown(f"dataset of {printable(edition.name)}", strange[0], edition.datasets)
    unpack(file, contents, stated_folder)
    with _about(file, stated_folder):
        if limit is None:
            here.check(edition)
        runs, differences, compared = dict[str, Run](), dict[str, list[str]](), 0
        stated_runs = [read(stated_folder / name) for name in contents.runs]
        for name, run in edition.entry(stated_runs, limit).items():
            source = here.source(edition, name) if limit is None else edition.source(name, limit)
            place = folder / "computed" / name
            spec = edition.spec(run, source)
            computed_run, other_answers = computed(run, spec, place, progress)
            runs[source.scenario.name] = computed_run
            differences[name] = [*differing(run, computed_run, edition), *digests.otherwise(run)]
            if other_answers:
                answers = amount(other_answers, "answer")
                differences[name].append(f"{answers} of a rule that is here")
            compared += len(edition.figures(computed_run))
    suite = SuiteRun(folder / "computed", edition.name, edition.description, runs)
    name = "/".join(file.parts[-2:])
    return Rescored(contents, edition, suite, differences, compared, limit is not None, name)


@contextmanager
def _about(file: Path, folder: Path) -> Iterator[None]:
    """Have errors name the file, and leave out the folder that it is unpacked to."""
    try:
        yield
    except (UserError, Unanswered, OverflowError) as error:
        raise UserError(f"{printable(file)}: {str(error).replace(f'{folder}/', '')}") from None


def _is_equal(one: Score | None, other: Score | None) -> bool:
    """Return whether two figures are equal, but for what another library of quantiles rounds."""
    if one is None or other is None:
        return False
    pairs = zip(astuple(one), astuple(other), strict=True)
    for a, b in pairs:
        if isinstance(a, float) and isinstance(b, float):
            if not math.isclose(a, b, rel_tol=TOLERANCE, abs_tol=TOLERANCE):
                return False
        elif a != b:
            return False
    return True


def differing(stated_run: Run, computed_run: Run, edition: Edition) -> Iterator[str]:
    """Yield in words what differs between a run as a file states it and as it is computed here.

    First come the condition (settings of radio, asking and fusion) and name of each of the
    edition's figures that differs; an edition is a release of the benchmark. Then comes each column
    of the table of episodes, with the number of episodes that differ. Figures are compared to
    `DIGITS`, rows to the last digit. A column that is empty in the stated run is not compared,
    since a release that wrote the run may not have had it.
    """
    stated_scores = {score.key: score for score in edition.figures(stated_run)}
    computed_scores = {score.key: score for score in edition.figures(computed_run)}
    for key in stated_scores | computed_scores:
        if not _is_equal(stated_scores.get(key), computed_scores.get(key)):
            yield " ".join(key)
    for name in Episode.__struct_fields__:
        stated_values = [getattr(episode, name) for episode in stated_run.episodes]
        computed_values = [getattr(episode, name) for episode in computed_run.episodes]
        if any(value is not None for value in stated_values):
            wrong = sum(a != b for a, b in zip_longest(stated_values, computed_values))
            if wrong:
                yield f"{name} of {wrong} episodes"
