"""Models on a suite's families, for benchmarks that compare runs."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from pages import harness

from harness.core.arrays import Floats
from harness.core.figures import interval_of
from harness.core.statistics import Estimate, known_mean, mean_of, paired_difference
from harness.dataset import suites
from harness.dataset.load import find, load
from harness.runs import folder, suite
from harness.runs.folder import Run
from harness.runs.headline import BALANCED
from harness.runs.metric_names import ALL, BASELINE, GAINS
from harness.runs.metric_values import by_episode
from harness.runs.metrics import METRICS, entry
from harness.runs.success import by_condition, mean_difference
from harness.world import scenarios


class Row(NamedTuple):
    """A model, how it is asked, and on which scenes."""

    model: str
    prompt: str
    answer: str
    dataset: str = "suite:v2v-safety-2"
    limit: int | None = None  # layouts of each family; None for all

    def __str__(self) -> str:
        return f"{self.model} · {self.prompt} · {self.answer}"

    @property
    def name(self) -> str:
        """Its folder."""
        return f"{self.model}-{self.prompt}-{self.answer}"

    @property
    def who(self) -> tuple[str, ...]:
        """The options that name it."""
        return "--model", self.model, "--prompt", self.prompt, "--answer", self.answer

    def asked(self, layouts: int | None = None, dataset: str | None = None) -> "Row":
        """Return it on so many layouts of each family, or on other scenes,
        where these are given.
        """
        return self._replace(limit=layouts or self.limit, dataset=dataset or self.dataset)

    def evaluate(self, out: Path, *options: str) -> None:
        """Evaluate it on frozen scenes, unless that is done."""
        if not finished(out):
            few = () if self.limit is None else ("--limit", str(self.limit))
            words = (*self.who, "--dataset", self.dataset, *few, *options)
            harness("eval", *words, "--out", str(out), "--quiet")

    def drive(self, out: Path, *options: str) -> None:
        """Drive the layouts of each of its datasets, to a folder in `out` of the dataset's name,
        unless that is done.
        """
        for name in suites.datasets(self.dataset):
            dataset, place = load(find(name)), out / name
            if not (place / "run.json").exists():
                layouts = min(self.limit or len(dataset.episodes), len(dataset.episodes))
                where = ("--episodes", str(layouts), "--first-seed", str(dataset.seeds[0]))
                scenario = ("--scenario", scenarios.argument(dataset.scenario))
                words = (*self.who, *scenario, *where, *options)
                harness("drive", *words, "--out", str(place), "--quiet")


def finished(out: Path) -> bool:
    """Return whether a folder has a finished run or suite."""
    return any((out / name).exists() for name in ("suite.json", "run.json"))


class Families(NamedTuple):
    """A model's runs by family."""

    runs: Mapping[str, Run]

    @classmethod
    def read(cls, path: Path) -> "Families | None":
        """Read the run or the suite of a folder; None if it has no finished one."""
        if (path / "suite.json").exists():
            return cls(suite.read(path).runs)
        return cls({"": folder.read(path)}) if (path / "run.json").exists() else None

    def estimate(self, condition: str, metric: str) -> Estimate | None:
        """Return a metric's mean over families, of episodes or answers;
        None if a family has no value.
        """
        if metric == GAINS[BALANCED]:
            return self.difference(condition, BASELINE)
        over = "answers" if condition == ALL else "episodes"
        wanted = condition, metric, over
        scores = [
            next((s for s in run.scores if (s.condition, s.metric, s.interval) == wanted), None)
            for run in self.runs.values()
        ]
        found = [score.estimate for score in scores if score]
        return mean_of(found) if len(found) == len(scores) else None

    def difference(self, condition: str, other: str) -> Estimate:
        """Return balanced success in a condition less that in another one, paired by episode."""
        families = [by_condition(run.grid, run.episodes) for run in self.runs.values()]
        return mean_difference([(how, of[condition], of[other]) for how, of in families])

    def shown(self, condition: str, metric: str, sign: str = "") -> str:
        """Return the same in percent with its interval; empty if a family has no value."""
        estimate = self.estimate(condition, metric)
        return interval_of(estimate, sign=sign) if estimate else ""

    def over(self, other: "Families", condition: str) -> Estimate:
        """Return balanced success less that of other runs in the same condition,
        paired by episode.
        """
        differences = []
        for family in self.runs:
            mine, theirs = (_halves(each.runs[family], condition) for each in (self, other))
            differences += [known_mean(mine[half] - theirs[half], 0) for half in mine]
        return paired_difference(differences)

    @property
    def counted(self) -> str:
        """Layouts of all families, and seeds, in words."""
        runs = list(self.runs.values())
        return (
            f"{sum(len(r.grid.episodes) for r in runs)} layouts × {len(runs[0].grid.seeds)} seeds"
        )


def _halves(run: Run, condition: str) -> dict[str, Floats]:
    """Return success with and without a danger, (S, E) each."""
    metrics = [METRICS[name] for name in entry(BALANCED).halves]
    values = by_episode(metrics, run.grid, run.decisions, run.episodes)
    return {name: each[run.conditions.index(condition)] for name, each in values.items()}
