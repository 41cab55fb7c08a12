"""The runs of a suite: a folder with a run of each family of scenes, and the means over families."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec

from harness.core.errors import UserError, printable
from harness.core.files import write_whole
from harness.core.formats import SUITE
from harness.core.statistics import mean_of
from harness.runs import folder
from harness.runs.folder import Run, csv_text
from harness.runs.listing import own_name
from harness.runs.records import Manifest, Score, Variant

FORMAT = "swarmdrive-suite/1"
SUMMARY = "summary.csv"  # the means


class Contents(msgspec.Struct, frozen=True, kw_only=True):
    """What `suite.json` says: the suite, and the run's folder of each family, in the order of tables."""

    format: str
    name: str
    description: str
    families: dict[str, str]

    def __post_init__(self) -> None:
        if not self.families or not all(map(own_name, self.families.values())):
            raise ValueError("families: none, or one outside this folder")


@dataclass(frozen=True)
class SuiteRun:
    """Finished runs of one model, one a family, under the same conditions and seeds.

    Attributes:
        path: the folder that theirs lie in.
        name: the suite's.
        description: what the suite is for.
        runs: by family, which is the scenario's name.
    """

    path: Path
    name: str
    description: str
    runs: Mapping[str, Run]

    @property
    def manifest(self) -> Manifest:
        """The first run's with all runs' counts, and no times: others have other worlds, or prompts."""
        every = [run.manifest for run in self.runs.values()]
        counts = ("cached_answers", "engine_errors", "retries")
        totals = {name: sum(getattr(m, name) for m in every) for name in counts}
        latency = msgspec.structs.replace(every[0].latency, sample={})
        return msgspec.structs.replace(every[0], latency=latency, answer_times={}, **totals)

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the operating points."""
        return next(iter(self.runs.values())).conditions

    @property
    def source(self) -> str:
        """The source of its episodes, for people."""
        return f"suite {self.name}"

    @property
    def variant(self) -> Variant:
        """Who answered, and how they were asked, with the prompts of all families."""
        prompts = dict.fromkeys(run.manifest.variant.prompt for run in self.runs.values())
        first = self.manifest.variant
        return Variant(first.model, " and ".join(prompts), first.answer)

    @cached_property
    def scores(self) -> tuple[Score, ...]:
        """Means over families of every metric that has an interval over episodes, or of answers."""
        return tuple(self._means())

    def _means(self) -> Iterator[Score]:
        first, *others = self.runs.values()
        of_others = [{(s.condition, s.metric, s.interval): s for s in run.scores} for run in others]
        for s in first.scores:
            key = s.condition, s.metric, s.interval
            if s.interval != "seed means" and all(key in of for of in of_others):
                yield mean([s, *(of[key] for of in of_others)])

    def score(self, condition: str, metric: str) -> Score | None:
        """A metric's mean over families; None where one of them has no value."""
        return next(
            (
                s
                for s in self.scores
                if (s.condition, s.metric) == (condition, metric) and s.value is not None
            ),
            None,
        )


def mean(scores: Sequence[Score]) -> Score:
    """The mean of one metric's scores over families."""
    first = scores[0]
    return Score.of(first.condition, first.metric, mean_of([s.estimate for s in scores]), first.interval)


def contents_of(path: Path) -> Contents:
    """What a suite's folder says that it holds. Raises UserError if it is none."""
    contents = folder.whole(path / SUITE, lambda file: msgspec.json.decode(file.read_bytes(), type=Contents))
    if contents.format != FORMAT:
        raise UserError(f"{printable(path / SUITE)} is of another version; make the runs again")
    return contents


def read(path: Path) -> SuiteRun:
    """Read a suite's folder.

    Raises:
        UserError: it is none, or one of its runs is no finished one or was made under other conditions.
    """
    contents = contents_of(path)
    runs = {family: folder.read(path / name) for family, name in contents.families.items()}
    first, *others = runs.values()
    for other in others:
        if _common(other) != _common(first):
            raise UserError(
                f"{printable(other.path)} has another model, other conditions or seeds than "
                f"{printable(first.path)}; make the runs of the suite again"
            )
    return SuiteRun(path, contents.name, contents.description, runs)


def _common(run: Run) -> Any:
    m = run.manifest
    return m.model, m.answer, m.conditions, m.seeds


def write(suite: SuiteRun) -> None:
    """Write the means, and last what makes the folder a suite's."""
    write_whole(suite.path / SUMMARY, csv_text(Score, suite.scores, suite.variant))
    families = {family: run.path.name for family, run in suite.runs.items()}
    contents = Contents(format=FORMAT, name=suite.name, description=suite.description, families=families)
    write_whole(suite.path / SUITE, msgspec.json.format(msgspec.json.encode(contents), indent=1) + b"\n")
