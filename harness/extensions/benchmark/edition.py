"""Read editions of a benchmark: all that a score is of, under one digest.

`editions/NAME.toml` states datasets, prompts, conditions, channel seeds and the figures that count.
"""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct, structs

from harness.core.config import Count, convert, toml
from harness.core.errors import UserError, printable, unknown
from harness.core.figures import amount
from harness.core.files import digest
from harness.core.resources import find, names
from harness.core.statistics import Estimate
from harness.dataset import load
from harness.dataset.verify import read_manifest
from harness.evaluate import resolve
from harness.evaluate.agent import Agent
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.of_run import card_here
from harness.evaluate.spec import Spec
from harness.evaluate.stated_times import asked_card
from harness.prompts import versions
from harness.runs import formats, pinned
from harness.runs.folder import Run
from harness.runs.headline import PAIRED
from harness.runs.metrics import METRICS
from harness.runs.records import FrozenScenes, Manifest, Score
from harness.runs.settings import FrozenSettings, Settings, deciding, parse_seeds
from harness.runs.success import Pairs, is_gain, mean_difference

KIND = "editions"

Names = Annotated[tuple[str, ...], Meta(min_length=1, description="a list of names, one or more")]
Digests = Annotated[dict[str, str], Meta(min_length=1, description="a table of digests by name")]


class Golden(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Describe `editions/NAME.golden.zip`, a file of results that pins how figures are computed.

    An edition is a release of the benchmark; an installation must compute the very figures that
    this file of it states.
    """

    sha256: str  # hex digest of the file
    layouts: Count  # number of start situations of each dataset that it has, from the first


class Edition(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Describe an edition: a release of the benchmark that never changes.

    It has all that a score depends on, beside the model: datasets, prompts, settings and metrics.
    Operating points are named settings of radio, asking and fusion.
    """

    name: str  # name of its file, without .toml
    digest: str  # hex SHA-256 of its file's tables
    description: str  # its purpose
    # hex SHA-256 of the datasets' manifests, by name, in the order of tables
    datasets: Digests
    # hex SHA-256 of the prompts that an entry may choose from, by version
    prompts: Digests
    condition: Names  # the operating points that are scored, such as `6g`
    ranked_by: str  # the one of them by which entries are ranked
    # keys of the channel's random draws, written as for `--seeds`, such as `0:5`
    seeds: str
    # how long every answer takes, written as for `--latency`
    latency: str
    # which of equally likely actions is taken, written as for `--ties`: drawn, or the first
    ties: str
    metrics: Names  # the figures that a file of results states
    # how the intervals of gains in success are made: of all layouts (start situations) taken
    # together (`paired episodes`), or combined from those with a danger and those without
    # (`episodes`)
    gains: Literal["paired episodes", "episodes"] = "episodes"
    golden: Golden | None = None  # None in a project's own edition that pins nothing
    sealed: str | None = None  # what earlier editions of a project may state; nothing reads it

    @property
    def golden_file(self) -> Path:
        return find(KIND, f"{self.name}.golden.zip")

    def layouts(self, file_sha256: str) -> int | None:
        """Return how many layouts (start situations) of each dataset a file of results is of.

        An edition is a release of the benchmark. `file_sha256` is the file's hex digest. None means
        all: only the edition's golden file has fewer.
        """
        return self.golden.layouts if self.golden and self.golden.sha256 == file_sha256 else None

    def figures(self, run: Run) -> list[Score]:
        """Return the scores of a run that a file of results of this edition states.

        An edition is a release of the benchmark. A score is the estimate of one metric under one
        condition (settings of radio, asking and fusion), with its interval. These are the run's
        scores of the edition's `metrics`, whose gains have the edition's kind of interval.
        """
        scores = [score for score in run.scores if score.metric in self.metrics]
        if self.gains == PAIRED:
            return scores
        return [
            pinned.gain(run, score) if is_gain(score, run.conditions) else score for score in scores
        ]

    def difference(self, pairs: Pairs) -> Estimate:
        """Return the mean success of model a less that of model b over families, with an interval.

        `pairs` has a tuple for each family (the scenes of one scenario): how success counts there,
        plainly or balanced over episodes with a danger and without; then the success of a and of b,
        1 or 0, both (S, E) by S channel seeds and E episodes. The interval is of the kind that
        `gains` names.
        """
        return mean_difference(pairs) if self.gains == PAIRED else pinned.mean_difference(pairs)

    def settings(self, dataset: str, **further: Any) -> Settings:
        """Return the settings of an evaluation on one of the edition's datasets, by its name.

        An edition is a release of the benchmark, which fixes all settings but the model's.
        `further` are those that it leaves open, by their names: `model`, `prompt`, `answer` (`json`
        and so on) and others of the class `Settings`.
        """
        return Settings(
            world=FrozenSettings(dataset=dataset),
            seeds=self.seeds,
            condition=self.condition,
            latency=self.latency,
            ties=self.ties,
            **further,
        )

    def source(self, dataset: str, limit: int | None = None) -> FrozenSource:
        """Read one of the edition's datasets by its name, as scenes on which a model is evaluated.

        An edition is a release of the benchmark. A dataset has layouts, drawn start situations of a
        scenario, each with every scene that actions can lead to. With `limit`, only that many
        layouts are taken, from the first. Raises UserError if the dataset here is missing, or has
        another digest than the edition states.
        """
        source = FrozenSource(load.load(load.find(dataset), limit), limit)
        if source.dataset.sha256 != self.datasets[dataset]:
            raise self._differs(
                f"dataset {printable(dataset)}", source.dataset.sha256, self.datasets[dataset]
            )
        return source

    def entry(self, runs: Sequence[Run], limit: int | None = None) -> dict[str, Run]:
        """Return the runs of one entry by the name of their dataset, in the edition's order.

        An edition is a release of the benchmark, and an entry one model's results on it. `limit` is
        how many layouts (start situations) of each dataset they must be of; None for all. Raises
        UserError unless each run has this edition's settings, each dataset has one run, no two
        are of one scenario, and all are of one agent: one model with one prompt and so on.
        """
        self.refuse_two_of_a_family()
        by_dataset: dict[str, Run] = {}
        for run in runs:
            mistakes = self._mistakes(run.manifest, limit, by_dataset, _agent(runs[0].manifest))
            if wrong := next(mistakes, None):
                raise UserError(
                    f"{printable(run.path)} is no run of {printable(self.name)}: {wrong}; make one "
                    f"with `harness benchmark run {printable(self.name)}`"
                )
            by_dataset[str(getattr(run.manifest.world, "name", ""))] = run
        if missing := [name for name in self.datasets if name not in by_dataset]:
            raise UserError(
                f"{printable(self.name)} has dataset {printable(missing[0])}; add a run of it"
            )
        return {name: by_dataset[name] for name in self.datasets}

    def refuse_two_of_a_family(self) -> None:
        """Raise UserError if two of the edition's datasets are of one scenario.

        Means are over families, the scenes of one scenario each, and a family has one run.
        """
        dataset_of: dict[str, str] = {}
        for name in self.datasets:
            manifest, _ = read_manifest(load.find(name))
            first = dataset_of.setdefault(manifest.scenario, name)
            if first != name:
                raise UserError(
                    f"edition {printable(self.name)} has {printable(manifest.scenario)} twice, as "
                    f"datasets {printable(first)} and {printable(name)}; give each family one"
                )

    def _mistakes(
        self, m: Manifest, limit: int | None, others: Collection[str], agent: dict[str, Any]
    ) -> Iterator[str]:
        world = m.world
        if not isinstance(world, FrozenScenes) or self.datasets.get(world.name) != world.sha256:
            yield (
                f"its scenes are {printable(getattr(world, 'name', 'driven'), 40)}, none of its "
                "datasets"
            )
        elif world.limit != limit or world.selection:
            yield f"it has {amount(world.episodes, 'layout')} that were selected, and all count"
        elif world.name in others:
            yield f"another is of {printable(world.name, 40)}, too"
        answerers = m.answerers
        if answerers.helpers is None or answerers.temperature is None:
            yield "its answers are replayed, and it does not state how they were asked"
        if answerers.helpers:
            yield "its helpers are of other models, and one model answers for all"
        if changed := [key for key, value in _agent(m).items() if value != agent[key]]:
            yield (
                f"its {changed[0]} is another than that of {printable(next(iter(others), ''), 40)}"
            )
        version, sha256 = str(m.prompt["version"]), m.prompt["sha256"]
        if self.prompts.get(version) != sha256:
            yield f"its prompt is {printable(version, 40)}, none of its prompts"
        conditions = tuple(str(condition["name"]) for condition in m.conditions)
        settings: tuple[tuple[str, object, object], ...] = (
            ("conditions", conditions, self.condition),
            ("seeds", m.seeds, parse_seeds(self.seeds)),
            ("latency", m.settings.latency, self.latency),
            ("ties", m.settings.ties, self.ties),
            ("timer of answers", m.latency.source if m.latency.speeds else None, None),
            ("sums", m.sums, "refuse"),
            ("image", m.image, "own"),
            ("flip", m.flip, False),
            ("temperature", answerers.temperature, 0.0),
            ("sampling seed", m.settings.sampling_seed, 0),
        )
        for what, value, wanted in settings:
            if value != wanted:
                yield f"its {what}: {printable(value)}, not {printable(wanted)}"

    def spec(self, run: Run, source: FrozenSource) -> Spec:
        """Return the evaluation that computes a benchmark run again, on the scenes of `source`.

        It has the settings of this edition, a release of the benchmark, as they are here, and the
        run's agent (its model, prompt and answer mode). Raises UserError if the prompt of that name
        here has another digest than the edition states.
        """
        m = run.manifest
        prompt = versions.load(str(m.prompt["version"]))
        if prompt.sha256 != self.prompts[prompt.version]:
            raise self._differs(
                f"prompt {prompt.version}", prompt.sha256, self.prompts[prompt.version]
            )
        card = card_here(asked_card(run))
        how: Any = (m.answer, m.thinking, m.image, m.letters, m.sums, m.flip)
        ego, points = Agent(card, prompt, *how), resolve.points(self.condition)
        decision_settings = deciding(m.settings)
        settings = structs.replace(decision_settings, latency=self.latency, ties=self.ties)
        return Spec(ego, source, points, parse_seeds(self.seeds), settings=settings)

    def _differs(self, what: str, here: str, digest: str) -> UserError:
        return UserError(
            f"{what} has digest {here}, and {printable(self.name)} is of {printable(digest)}; "
            "restore it, or install the release that has it"
        )


def _agent(m: Manifest) -> dict[str, Any]:
    """Return who answered, and how; prompts may differ by family."""
    answerers = m.answerers
    agent = {**m.agent(0), "model": answerers.model, "temperature": answerers.temperature}
    agent["identity"] = formats.identity(answerers.identity)
    return {key: value for key, value in agent.items() if key != "prompt"}


def named(name: str) -> Edition:
    """Return the edition of a name, such as `v2v-safety-1.1`: one that ships, or the project's own.

    An edition is a release of the benchmark that never changes. Raises UserError if there is none,
    or its file is wrong.
    """
    if name not in names(KIND):
        raise unknown("edition", name, names(KIND))
    return of_file(find(KIND, f"{name}.toml"))


def of_file(file: Path) -> Edition:
    """Read an edition, a release of the benchmark, from its TOML file.

    Its name is the file's, and its digest that of the file's tables, however they are laid out.
    Raises UserError if the file is wrong.
    """
    where = f"edition {printable(file)}"
    tables = toml(file, where)
    try:
        sha256 = digest(tables)  # it does not depend on how the tables are laid out
    except (ValueError, TypeError) as error:  # a date, or a number without an end
        raise UserError(f"{where}: {printable(error)}; give texts and whole numbers") from None
    edition = convert(tables, Edition, where, name=file.stem, digest=sha256)
    for metric in edition.metrics:
        if metric not in METRICS:
            raise unknown(f"metric of {where}", metric, METRICS)
    if edition.ranked_by not in edition.condition:
        raise unknown(f"ranked_by of {where}", edition.ranked_by, edition.condition)
    parse_seeds(edition.seeds)
    resolve.points(edition.condition)
    return edition
