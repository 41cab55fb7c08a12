"""Read a run's folder; one reader serves every world, and `writer.py` is the one writer.

`answers.jsonl` has one answer a line, `decisions.parquet` one decision a row. `episodes.csv` and
`summary.csv` follow from both. `run.json` records the run's settings and origin, and is written
last.
"""

import csv
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
from msgspec import Struct

from harness.core import work
from harness.core.arrays import Ints
from harness.core.config import LONGEST_S
from harness.core.depth import shallow
from harness.core.errors import UserError, printable, sayable
from harness.core.figures import amount
from harness.core.files import BROKEN, bytes_of, text_of
from harness.core.formats import CONFIG, SUITE, WORK
from harness.core.memory import uncollected
from harness.core.statistics import cluster_numbers
from harness.runs import formats
from harness.runs.answerers import REPLAY
from harness.runs.answers import Answered, Answers
from harness.runs.decisions import Decisions, arrow_file, refuse_impossible
from harness.runs.difficulty import FILE as DIFFICULTY
from harness.runs.difficulty import Layout
from harness.runs.grid import Grid
from harness.runs.headline import ANY_TIME, PAIRED
from harness.runs.metric import World
from harness.runs.records import (
    Answer,
    ClosedLoop,
    Episode,
    FrozenScenes,
    Manifest,
    Score,
    is_helper,
)
from harness.world.parameters import MOST_DECISIONS
from harness.world.seats import agent_share

T = TypeVar("T")
Record = TypeVar("Record", bound=Struct)
# Arrow raises NotImplementedError for a column of another type.
_BROKEN = (*BROKEN, NotImplementedError, csv.Error)
OF_LAYOUT = ("layout_seed", "danger", "cluster")  # columns that are the same in all rows of one
BLOCK = 1 << 22  # bytes of a table's file that are read at a time
PARSED = pacsv.ParseOptions(newlines_in_values=True)
_KINDS = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}


@dataclass(frozen=True)
class Run:
    """Hold a finished run's folder, `path`, and manifest, and read its tables on first use.

    The manifest is the content of `run.json`, all settings and origin. A table that is missing or
    broken raises UserError.
    """

    path: Path  # the run's folder
    manifest: Manifest  # the content of `run.json`

    @property
    def world(self) -> World:
        """Return the kind of world: `frozen` (recorded scenes) or `closed-loop` (a simulator)."""
        return "frozen" if isinstance(self.manifest.world, FrozenScenes) else "closed-loop"

    @property
    def actions(self) -> tuple[str, ...]:
        return self.manifest.actions

    @property
    def conditions(self) -> tuple[str, ...]:
        return tuple(str(condition["name"]) for condition in self.manifest.conditions)

    @property
    def source(self) -> str:
        """Return the name of the dataset or the scenario of the episodes, for people."""
        world = self.manifest.world
        return (
            world.name
            if isinstance(world, FrozenScenes)
            else f"{world.title} (driven in closed loop)"
        )

    @cached_property
    def record(self) -> dict[str, Any]:
        """Return the content of `run.json` as it is in the file, of whatever version."""
        return self.read_file("run.json", _record)

    @cached_property
    def scores(self) -> tuple[Score, ...]:
        return self.read_file("summary.csv", scores_of)

    @property
    def episodes(self) -> tuple[Episode, ...]:
        """Return the rows of `episodes.csv`: one for each condition, seed and episode.

        A condition is a named set of settings of channel, asking and fusion.
        """
        return self._placed[1]

    @property
    def grid(self) -> Grid:
        return self._placed[0]

    @cached_property
    def clusters(self) -> Ints | None:
        """Return the number from 0 of each episode's cluster, (E,); None if each is of its own.

        A cluster is what layouts are cut from, such as a recording of traffic; episodes are in the
        order of the grid.
        """
        return cluster_numbers(self.cluster_names)

    @property
    def cluster_names(self) -> list[str | None]:
        """Return the name of each episode's cluster, (E,); None for one of its own."""
        return [episode.cluster for episode in self.episodes[: len(self.grid.episodes)]]

    @cached_property
    def _placed(self) -> tuple[Grid, tuple[Episode, ...]]:
        return self.read_file("episodes.csv", self._place)

    @cached_property
    def decisions(self) -> Decisions:
        """Return the rows of `decisions.parquet`, checked to belong to the run's episodes."""
        return self.read_file("decisions.parquet", self._decisions)

    @cached_property
    def answers(self) -> Answers:
        return self.read_file(
            "answers.jsonl", lambda file: Answers(bytes_of(file, "rows"), len(self.actions))
        )

    @cached_property
    def answered(self) -> Answered:
        """Return how many answers there are and failed, and what the ego answered, read once."""
        return self.answers.counted()

    @cached_property
    def answers_by_scene(self) -> Mapping[str, list[Answer]]:
        return self.answers.by_scene

    def episodes_of(self, layout: int) -> list[Episode]:
        number, layouts = self._places[layout], len(self.grid.episodes)
        return list(self.episodes[number::layouts])

    @cached_property
    def _places(self) -> dict[int, int]:
        return {layout: place for place, layout in enumerate(self.grid.episodes)}

    def of_scenes(self, ids: Collection[str]) -> "Run":
        """Return a copy with the decisions and answers of some scenes alone, and their episodes.

        A scene is the state at one decision point; `ids` are the scenes' ids.
        """
        rows = [row for scene in ids for row in self.decisions.scenes.get(scene, ())]
        decisions = self.decisions.take(rows)
        layouts = tuple(dict.fromkeys(decisions.whole("episode").tolist()))
        grid = replace(self.grid, episodes=layouts)
        part = replace(self)
        part.__dict__.update(
            {  # as if it had read them from its files
                "decisions": decisions,
                "_placed": (
                    grid,
                    tuple(grid.ordered([e for n in layouts for e in self.episodes_of(n)])),
                ),
                "answers_by_scene": {scene: self.answers_by_scene.get(scene, []) for scene in ids},
            }
        )
        return part

    def agent(self, answer: Answer) -> dict[str, Any]:
        """Return who gave an answer: the model, prompt and way of answering, as plain values.

        The keys are those of an entry of `Manifest.helpers`, such as `model` and `prompt`.
        """
        place = self._viewer_place(answer)
        if place not in self._agents:
            self._agents[place] = self.manifest.agent(place)
        return self._agents[place]

    @cached_property
    def _agents(self) -> dict[int, dict[str, Any]]:
        return {}

    def undeclared_delay(self, answer: Answer) -> str | None:
        """Return a phrase on seconds that an answer took beyond what its model's card declares.

        A model card, a file that describes a model, may declare that some answers take longer. None
        if this one took no longer, or so much as declared.
        """
        models = [self.agent(answer)["model"]]
        if models[0]["engine"] == REPLAY:
            earlier = self.manifest.answerers_at(self._viewer_place(answer))
            # which of the helpers of a run that is replayed answered, nothing says
            models = [earlier.model, *(helper["model"] for helper in earlier.helpers or ())]
        if any(answer.may_take_longer(_slow_s(each)) for each in models):
            return None
        name = printable(answer.id)
        return f"a delay of {answer.slow_s:g} s in {name}, which its model's card does not declare"

    def impossible_agent(self, answer: Answer) -> str | None:
        """Return a phrase on the agent that an answer states, if no such answer can; else None.

        An answer states which agent gave it only where that does not follow from whose it is: where
        helpers have several models, or other vehicles decide as well.
        """
        if answer.agent is msgspec.UNSET:
            return None
        agents = range(1 + len(self.manifest.helpers))
        if len(agents) > 1 and self._several_decide:
            is_possible = answer.agent in agents
        else:
            is_possible = len(agents) > 2 and is_helper(answer.role) and answer.agent in agents[1:]
        return None if is_possible else f"agent {answer.agent} of {printable(answer.id)}"

    @cached_property
    def _several_decide(self) -> bool:
        with suppress(UserError):  # a scenario that is not here
            frozen = isinstance(self.manifest.world, FrozenScenes)
            return not frozen and agent_share(self.manifest.scenario) > 0
        return True

    def seconds(self, answer: Answer) -> float:
        """Return the seconds that an answer takes by the run's latency, a repair turn included.

        These are the times that the run states for a model's answers, or what its timer computes
        from the answer's tokens; NaN if answers are timed and the engine failed. A repair turn is a
        second question after an answer that cannot be parsed.
        """
        return self.manifest.latency.answer_s(self._viewer_place(answer), answer)

    def _viewer_place(self, answer: Answer) -> int:
        """Return the place of an answer's viewer, the ego at 0;
        also 0 if one agent answers for all.
        """
        if not self.manifest.helpers:
            return 0
        if answer.agent is not msgspec.UNSET:
            return answer.agent
        if answer.role in ("ego", "merge"):
            return 0
        # The answers of a scene are in the order of its viewers, the ego first.
        viewers = [each.viewer for each in self.answers_by_scene[answer.scene] if not each.heard]
        return viewers.index(answer.viewer)

    @cached_property
    def layouts(self) -> tuple[Layout, ...]:
        """Return the rows of `difficulty.csv`: all layouts that the run's are sampled from.

        A layout is one start situation of a scenario; a row has how reference policies do in it.
        There are none for a run with all layouts of its dataset, or in closed loop.
        """
        exists = self.world == "frozen" and (self.path / DIFFICULTY).is_file()
        return self.read_file(DIFFICULTY, self._layouts) if exists else ()

    def _layouts(self, file: Path) -> tuple[Layout, ...]:
        layouts = records_of(file, Layout)
        dangers = {layout.episode: layout.danger for layout in layouts}
        if len(dangers) < len(layouts) or any(
            dangers.get(e.episode) != e.danger for e in self.episodes
        ):
            raise ValueError("an episode is there twice, or it lacks one of the run's")
        return layouts

    def score(self, condition: str, metric: str) -> Score | None:
        """Return a metric's score in one condition, both by name; None if it has no value there.

        A score has several kinds of interval: preferred is the one that holds however often the run
        was looked at while it went on, else the one over episodes. A condition is a named set of
        settings of channel, asking and fusion.
        """
        of_metric = [s for s in self.scores if (s.condition, s.metric) == (condition, metric)]
        candidates = [score for score in of_metric if score.value is not None]
        order = {ANY_TIME: 0, PAIRED: 1, "episodes": 2}
        return min(candidates, key=lambda s: order.get(s.interval, 3), default=None)

    def _place(self, file: Path) -> tuple[Grid, tuple[Episode, ...]]:
        episodes = records_of(file, Episode)
        numbers = tuple(dict.fromkeys(episode.episode for episode in episodes))
        world = self.manifest.world
        if len(numbers) != world.episodes:
            raise ValueError(f"it has {len(numbers)} episodes, and run.json says {world.episodes}")
        _refuse_unlike(episodes)
        if isinstance(world, ClosedLoop):
            drawn = range(world.selection.get("of", world.episodes))
            for episode in episodes:
                seed = world.first_seed + episode.episode
                if episode.episode not in drawn or episode.layout_seed != seed:
                    raise ValueError(
                        "a layout that is none of run.json's, whose first seed is "
                        f"{world.first_seed}"
                    )
        grid = Grid(self.conditions, self.manifest.seeds, numbers)
        return grid, tuple(grid.ordered(episodes))

    def _decisions(self, file: Path) -> Decisions:
        decisions = Decisions.read(file, self.actions, most_rows(self.episodes))
        decisions.codes("action", self.actions)
        decisions.refuse_impossible()
        places = self.grid.places(decisions)
        steps, step = np.unique(decisions.whole("step"), return_inverse=True)
        agents = decisions.names("agent")
        agent = 1 + decisions.codes("agent", agents)  # 0 for none
        keys = np.sort((places * len(steps) + step) * (1 + len(agents)) + agent, kind="stable")
        if (keys[1:] == keys[:-1]).any():
            raise ValueError("a decision is there twice")
        counts = np.bincount(places, minlength=len(self.episodes))
        if (counts != [episode.decisions for episode in self.episodes]).any():
            raise ValueError("not every decision of episodes.csv is there")
        _ = decisions.scenes  # which raises if those of one do not stand together
        return decisions

    def read_file(self, name: str, reader: Callable[[Path], T]) -> T:
        """Return what `reader` makes of the file `name` in the run's folder, given the file's path.

        Raises UserError if the file is missing or broken.
        """
        try:
            return whole(self.path / name, reader)
        except UserError as error:
            remedy = f": --model replay:{printable(self.path)} asks its model nothing"
            # What reads one file may need another of the run, whose error says it already.
            if str(error).endswith(remedy):
                raise
            if name == "answers.jsonl" or self.world != "frozen" or not self._has_answers:
                raise
            raise UserError(f"{error}{remedy}") from None

    @property
    def _has_answers(self) -> bool:
        with suppress(UserError):
            return len(self.answers) > 0
        return False


def read(path: Path) -> Run:
    """Read the manifest of a run's folder and return the run.

    Raises UserError if nothing can show its name, if it holds no finished run, or its manifest is
    broken or of another version.
    """
    sayable("run", path.name)
    file = path / "run.json"
    if not file.is_file():
        raise UserError(f"{printable(path)} is {_other_than_run(path)}")
    record: Any = whole(file, _record)
    formats.checked(record.get("format") if isinstance(record, dict) else None, file)
    return Run(path, whole(file, lambda file: msgspec.convert(formats.upgraded(record), Manifest)))


def _record(file: Path) -> Any:
    return shallow(msgspec.json.decode(text_of(file, "record")))


def _slow_s(model: Mapping[str, Any]) -> float:
    """Return the seconds that some answers of a model take longer, as the run states its card."""
    failures = model.get("failures")
    tail_s = failures.get("slow_s", 0.0) if isinstance(failures, Mapping) else 0.0
    return tail_s if isinstance(tail_s, int | float) and 0 <= tail_s <= LONGEST_S else 0.0


def _other_than_run(path: Path) -> str:
    """Return what a path without a run's record is, and what to give instead."""
    if (path / SUITE).is_file():
        return "a suite; give the folder of one of its runs"
    is_begun = (path / WORK).is_dir()
    with suppress(OSError):
        if not is_begun and (runs := sorted(file.parent for file in path.glob("*/run.json"))):
            return f"a folder of {amount(len(runs), 'run')}; give one, such as {printable(runs[0])}"
    if reason := work.unanswered(path):
        whose = "its model" if is_begun else "the model of a run in it"
        return f"no finished run, since {whose} could not be asked: {reason}"
    with suppress(OSError, ValueError, RecursionError):
        start = msgspec.json.decode(text_of(path / WORK / CONFIG, "record"), type=work.WorkStart)
        if start.shard:
            return "a shard of a run; `harness run merge` makes one of all its shards"
        return "no finished run, and the command that began it continues it"
    if path.is_file():
        return "a file; a run is a folder, made by `harness eval` or `harness drive`"
    lack = "it has no run.json" if path.exists() else "there is no such folder"
    return f"no finished run: {lack}; give a folder made by `harness eval` or `harness drive`"


def _refuse_unlike(episodes: Sequence[Episode]) -> None:
    """Raise ValueError if two rows of one episode have another layout."""
    firsts: dict[int, Episode] = {}
    for episode in episodes:
        first = firsts.setdefault(episode.episode, episode)
        for name in OF_LAYOUT:
            one, other = getattr(first, name), getattr(episode, name)
            if one != other:
                raise ValueError(
                    f"episode {first.episode} has {name} {printable(one)} in one row and "
                    f"{printable(other)} in another"
                )


def most_rows(episodes: Sequence[Episode]) -> int:
    """Return an upper bound of the rows of `decisions.parquet` for these episodes.

    It is twice what they can have, so that a file with a few too many is read and refused by name.
    """
    return 2 * MOST_DECISIONS * sum(episode.agents or 1 for episode in episodes)


def records_of(file: Path, kind: type[Record]) -> tuple[Record, ...]:
    """Return the rows of a CSV file as records of type `kind`, whose fields are the columns.

    Raises ValueError for a column that is missing or has gaps.
    """
    hints = dict(zip(kind.__struct_encode_fields__, get_type_hints(kind).values(), strict=True))
    optional = {name for name, hint in hints.items() if type(None) in get_args(hint)}
    with arrow_file(file) as lines:
        there = pacsv.open_csv(lines, parse_options=PARSED).schema.names
        lines.seek(0)
        if lacking := hints.keys() - {*there, *formats.EPISODE}:
            raise ValueError(f"it lacks {', '.join(sorted(lacking))}")
        records: list[Record] = []
        batches = pacsv.open_csv(
            lines,
            read_options=pacsv.ReadOptions(block_size=BLOCK),
            parse_options=PARSED,
            convert_options=pacsv.ConvertOptions(
                column_types={
                    name: _KINDS[(*get_args(hint), hint)[0]] for name, hint in hints.items()
                },
                include_columns=list(hints),
                include_missing_columns=True,
                null_values=[""],
                true_values=["True"],
                false_values=["False"],
            ),
        )
        for batch in batches:
            columns = {}
            for field, name in zip(kind.__struct_fields__, hints, strict=True):
                refuse_impossible(name, batch[name])
                if batch[name].null_count and name not in optional:
                    raise ValueError(f"{name} is unknown in some rows")
                columns[field] = _cells(batch[name], name in optional)
            rows = zip(*columns.values(), strict=True)
            records += [kind(**dict(zip(columns, row, strict=True))) for row in rows]
    return tuple(records)


def texts_of(file: Path, names: Collection[str]) -> dict[str, set[str]]:
    """Return the different texts in columns of a CSV file, by the columns' names.

    Of `names` those are left out that it lacks. An empty cell is an empty text.
    """
    with arrow_file(file) as lines:
        there = pacsv.open_csv(lines, parse_options=PARSED).schema.names
        lines.seek(0)
        texts: dict[str, set[str]] = {name: set() for name in names if name in there}
        kinds = dict.fromkeys(texts, pa.string())
        only = pacsv.ConvertOptions(column_types=kinds, include_columns=list(texts))
        for batch in pacsv.open_csv(lines, parse_options=PARSED, convert_options=only):
            for name, values in texts.items():
                values.update(batch[name].unique().to_pylist())
    return texts


def _cells(column: pa.Array, is_optional: bool) -> list[Any]:
    """Return a column's n values, of which those that are equal are one object.

    Millions of episodes have few different values. An empty text is None in an optional column.
    """
    encoded = column.dictionary_encode("encode")
    values = encoded.dictionary.to_pylist()
    if is_optional:
        values = [None if value == "" else value for value in values]
    return [values[code] for code in encoded.indices.to_pylist()]


def scores_of(file: Path) -> tuple[Score, ...]:
    """Return the scores of a `summary.csv`. Raises ValueError if one is there twice."""
    scores = records_of(file, Score)
    if len({score.key for score in scores}) < len(scores):
        raise ValueError("a figure is there twice")
    return scores


def whole(file: Path, reader: Callable[[Path], T]) -> T:
    """Return what `reader` makes of a file's path. Raises UserError if the file is broken."""
    try:
        with uncollected():
            return reader(file)
    except _BROKEN as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(
            f"{printable(file)} is broken ({printable(reason)}); make the run again"
        ) from None
