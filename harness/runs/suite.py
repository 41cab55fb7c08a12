"""Read and write a suite's folder: a run of each family of scenes, and the means over families."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
from msgspec import structs

from harness.core.errors import UserError, printable
from harness.core.files import text_of, write_whole
from harness.core.formats import SUITE
from harness.core.statistics import mean_of
from harness.runs import folder
from harness.runs.alike import setup
from harness.runs.folder import Run
from harness.runs.headline import BALANCED, PAIRED
from harness.runs.listing import own_name
from harness.runs.metric_names import BASELINE, GAINS
from harness.runs.records import Cost, Manifest, Score, Variant
from harness.runs.settings import FrozenSettings, deciding
from harness.runs.success import Plays, by_condition, is_gain, shares_cluster
from harness.runs.writer import csv_text

FORMAT = "swarmdrive-suite/1"
SUMMARY = "summary.csv"  # the means over families


class Contents(msgspec.Struct, frozen=True, kw_only=True):
    """Hold the content of `suite.json`: the suite's name, and the folder of each family's run.

    A suite is a run on each of several families, a family the scenes of one scenario.
    """

    format: str  # the format of the file, such as `swarmdrive-suite/1`
    name: str  # the suite's name
    description: str  # the suite's purpose
    families: dict[str, str]  # by family, the name of the folder of its run

    def __post_init__(self) -> None:
        if not self.families or not all(map(own_name, self.families.values())):
            raise ValueError("families: none, or one outside this folder")


@dataclass(frozen=True)
class SuiteRun:
    """Hold the finished runs of one model on all families of a suite.

    A family is the scenes of one scenario, as one dataset; `runs` has a run by its name, and `path`
    is the folder that holds the runs' folders. The runs have the same conditions and seeds. A
    condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages.
    """

    path: Path  # the folder that holds the runs' folders
    name: str  # the suite's name
    description: str  # the suite's purpose
    runs: Mapping[str, Run]  # the runs by family, which is the scenario's name

    @property
    def manifest(self) -> Manifest:
        """Return the first run's manifest with counts and cost summed over all runs.

        Measured answer times are left out, since they differ by run.
        """
        manifests = [run.manifest for run in self.runs.values()]
        counts = ("cached_answers", "engine_errors", "retries")
        totals = {}
        for name in counts:
            totals[name] = sum(getattr(manifest, name) for manifest in manifests)
        latency = msgspec.structs.replace(manifests[0].latency, sample={})
        cost = Cost.joined(manifests) or msgspec.UNSET
        return msgspec.structs.replace(
            manifests[0], latency=latency, answer_times={}, cost=cost, **totals
        )

    @property
    def conditions(self) -> tuple[str, ...]:
        return next(iter(self.runs.values())).conditions

    @property
    def source(self) -> str:
        return f"suite {self.name}"

    @property
    def variant(self) -> Variant:
        """Return model, prompts (of all families) and answer mode, as names for tables.

        A family is the scenes of one scenario; each may have a prompt of its own.
        """
        variants = [run.manifest.variant for run in self.runs.values()]
        prompts = dict.fromkeys(variant.prompt for variant in variants)
        helpers = dict.fromkeys(variant.helpers for variant in variants)
        first = variants[0]
        return Variant(first.model, " and ".join(prompts), first.answer, " and ".join(helpers))

    @cached_property
    def scores(self) -> tuple[Score, ...]:
        """Return the means over families of scores with intervals over episodes or answers.

        A family is the scenes of one scenario.
        """
        return tuple(self._means())

    @cached_property
    def stated_scores(self) -> tuple[Score, ...]:
        """Return the means that the suite's `summary.csv` states, to compare with those computed.

        A mean is that of a metric over the suite's runs. Raises UserError if the file is missing or
        broken.
        """
        return folder.whole(self.path / SUMMARY, folder.scores_of)

    def _means(self) -> Iterator[Score]:
        first, *rest = self.runs.values()
        others_by_key = []
        for run in rest:
            others_by_key.append({s.key: s for s in run.scores})
        together = self.shares_cluster
        for s in first.scores:
            if s.interval != "seed means" and all(s.key in scores for scores in others_by_key):
                of_families = [s, *(scores[s.key] for scores in others_by_key)]
                yield self._gain(s) if is_gain(s, self.conditions) else mean(of_families, together)

    @cached_property
    def shares_cluster(self) -> bool:
        """Return whether layouts of two families are cut from one thing, such as a recording."""
        return shares_cluster([run.cluster_names for run in self.runs.values()])

    @cached_property
    def _plays(self) -> Plays[str]:
        return plays(self.runs.values(), BALANCED)

    def _gain(self, score: Score) -> Score:
        """Return a gain over the condition without V2V;
        the layouts of all families are taken together.
        """
        plays = self._plays if score.metric == GAINS[BALANCED] else self._plays.plain
        gain = plays.difference(score.condition, BASELINE)
        return Score.of(score.condition, score.metric, gain, PAIRED)

    def score(self, condition: str, metric: str) -> Score | None:
        """Return a metric's mean over families in a condition; None if a family has no value.

        A family is the scenes of one scenario; condition and metric are names. A condition is a
        named set of settings of the radio, of asking helpers and of fusing their messages.
        """
        of_metric = (s for s in self.scores if (s.condition, s.metric) == (condition, metric))
        return next((s for s in of_metric if s.value is not None), None)


def plays(runs: Iterable[Run], headline_metric: str) -> Plays[str]:
    """Return the success of episodes by condition in runs that are each on another scenario.

    The scenes of one scenario are a family. `headline_metric` is the name of the metric by which
    the runs are read: that of plain success or of balanced. A condition is a named set of settings
    of the radio, of asking helpers and of fusing their messages.
    """
    return Plays([by_condition(run.grid, run.episodes, headline_metric) for run in runs])


def mean(scores: Sequence[Score], together: bool) -> Score:
    """Return the mean of one metric's scores over several families of scenes, with its interval.

    A family is the scenes of one scenario; `scores` has one score of each. `together` is for
    families that share a cluster, such as one recording: they are not independent.
    """
    first, estimates = scores[0], [score.estimate for score in scores]
    return Score.of(first.condition, first.metric, mean_of(estimates, together), first.interval)


def contents_of(path: Path) -> Contents:
    """Return the content of a suite folder's `suite.json`.

    A suite is a run on each of several scenarios. Raises UserError if there is none, or it is
    broken or of another version.
    """
    contents = folder.whole(
        path / SUITE, lambda file: msgspec.json.decode(text_of(file, "record"), type=Contents)
    )
    if contents.format != FORMAT:
        raise UserError(f"{printable(path / SUITE)} is of another version; make the runs again")
    return contents


def read(path: Path) -> SuiteRun:
    """Read a suite's folder and return its runs.

    A suite is a run on each of several scenarios. Raises UserError if the folder holds no suite, or
    a run is not finished or has another model, other conditions (sets of settings) or other seeds
    than the first.
    """
    contents = contents_of(path)
    runs = {family: folder.read(path / name) for family, name in contents.families.items()}
    first, *rest = runs.values()
    for run in rest:
        if _shared_settings(run) != _shared_settings(first):
            raise UserError(
                f"{printable(run.path)} has another model, other conditions, seeds or settings "
                f"than {printable(first.path)}; make the runs of the suite again"
            )
    return SuiteRun(path, contents.name, contents.description, runs)


def _shared_settings(run: Run) -> Any:
    """Return what all runs of a suite have; scenes, prompts and measured times are each run's."""
    manifest = run.manifest
    world = manifest.settings.world
    if isinstance(world, FrozenSettings):
        world = structs.replace(world, dataset="")
    settings = structs.replace(deciding(manifest.settings), world=world, prompt="", latency=None)
    return (
        {**setup(run), "prompt": ""},
        manifest.conditions,
        manifest.seeds,
        settings,
    )


def write(suite: SuiteRun) -> None:
    """Write the table of means over a suite's runs, `summary.csv`, and then its `suite.json`.

    A suite is a run on each of several scenarios; the second file marks it as finished.
    """
    write_whole(suite.path / SUMMARY, csv_text(Score, suite.scores, suite.variant))
    families = {family: run.path.name for family, run in suite.runs.items()}
    contents = Contents(
        format=FORMAT, name=suite.name, description=suite.description, families=families
    )
    write_whole(
        suite.path / SUITE, msgspec.json.format(msgspec.json.encode(contents), indent=1) + b"\n"
    )
