"""Read and write a run's folder; one reader and one writer serve every world.

`answers.jsonl` has one answer a line, `decisions.parquet` one decision a row. `episodes.csv` and
`summary.csv` follow from both. `run.json` records the run's settings and origin, and is written last.
"""

import csv
import io
import os
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, get_args, get_type_hints

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
from msgspec import Struct
from msgspec.structs import asdict

from harness.core import work
from harness.core.errors import UserError, printable
from harness.core.files import BROKEN, bytes_of, replacing, text_of, write_whole
from harness.core.formats import SUITE
from harness.core.memory import uncollected
from harness.dataset.load import Dataset, find, load
from harness.dataset.verify import read_manifest
from harness.runs import formats
from harness.runs.answers import Answered, Answers
from harness.runs.decisions import DecisionFiles, Decisions, arrow_file
from harness.runs.devices import Speed
from harness.runs.difficulty import FILE as DIFFICULTY
from harness.runs.difficulty import Layout
from harness.runs.leading import ANY_TIME, PAIRED
from harness.runs.metrics import Grid, World
from harness.runs.records import (
    Answer,
    AnswerFacts,
    ClosedLoop,
    Episode,
    FrozenScenes,
    Manifest,
    Score,
    Variant,
)
from harness.world.parameters import MOST_DECISIONS

T = TypeVar("T")
Record = TypeVar("Record", bound=Struct)
# Arrow raises NotImplementedError for a column of another type.
_BROKEN = (*BROKEN, NotImplementedError, csv.Error)
NOBODY: Mapping[str, Sequence[str]] = MappingProxyType({})
_KINDS = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
_FACTS = msgspec.json.Decoder(AnswerFacts)
_ENCODER = msgspec.json.Encoder()
DEEPEST = 8  # folders of a dataset's stated path that are looked for above a run


@dataclass(frozen=True)
class Run:
    """A finished run; each table is read on first use, and raises UserError if it is broken."""

    path: Path  # the run's folder
    manifest: Manifest  # the content of `run.json`

    @property
    def world(self) -> World:
        """Whether the world is frozen or closed-loop."""
        return "frozen" if isinstance(self.manifest.world, FrozenScenes) else "closed-loop"

    @property
    def actions(self) -> tuple[str, ...]:
        return self.manifest.actions

    @property
    def conditions(self) -> tuple[str, ...]:
        return tuple(str(condition["name"]) for condition in self.manifest.conditions)

    @property
    def source(self) -> str:
        """The dataset or scenario of the episodes, in words for people."""
        world = self.manifest.world
        return world.name if isinstance(world, FrozenScenes) else f"{world.title} (driven in closed loop)"

    @cached_property
    def scores(self) -> tuple[Score, ...]:
        return self.read_file("summary.csv", scores_of)

    @property
    def episodes(self) -> tuple[Episode, ...]:
        """The rows of `episodes.csv`: one for each condition, seed and episode."""
        return self._placed[1]

    @property
    def grid(self) -> Grid:
        return self._placed[0]

    @cached_property
    def _placed(self) -> tuple[Grid, tuple[Episode, ...]]:
        return self.read_file("episodes.csv", self._place)

    @cached_property
    def decisions(self) -> Decisions:
        """The rows of `decisions.parquet`; each belongs to an episode of the run."""
        return self.read_file("decisions.parquet", self._decisions)

    @cached_property
    def answers(self) -> Answers:
        return self.read_file(
            "answers.jsonl", lambda file: Answers(bytes_of(file, "rows"), len(self.actions))
        )

    @cached_property
    def answered(self) -> Answered:
        """What the answers came to, of one pass through them."""
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
        """Return the run with only its decisions and answers in some scenes, and the episodes of these."""
        rows = [row for scene in ids for row in self.decisions.scenes.get(scene, ())]
        decisions = self.decisions.take(rows)
        layouts = tuple(dict.fromkeys(decisions.whole("episode").tolist()))
        grid = replace(self.grid, episodes=layouts)
        part = replace(self)
        part.__dict__.update({  # as if it had read them from its files
            "decisions": decisions,
            "_placed": (grid, tuple(grid.ordered([e for n in layouts for e in self.episodes_of(n)]))),
            "answers_by_scene": {scene: self.answers_by_scene.get(scene, []) for scene in ids},
        })  # fmt: skip
        return part

    def agent(self, answer: Answer) -> dict[str, Any]:
        """Return the agent of an answer: its model, prompt, answer mode and thinking (`Manifest.agent`)."""
        place = self._viewer_place(answer)
        if place not in self._agents:
            self._agents[place] = self.manifest.agent(place)
        return self._agents[place]

    @cached_property
    def _agents(self) -> dict[int, dict[str, Any]]:
        return {}

    def speed(self, answer: Answer) -> Speed:
        """Return the speed of an answer's agent; only for a run with a device profile."""
        return self.manifest.latency.speed(self._viewer_place(answer))

    def seconds(self, answer: Answer) -> float | None:
        """Return the seconds that an answer of its agent takes, a repair turn included; None if unknown."""
        usual_s = self.manifest.latency.seconds(self._viewer_place(answer))
        return None if usual_s is None else usual_s * answer.turns + answer.slow_s

    def _viewer_place(self, answer: Answer) -> int:
        """Return the place of an answer's viewer, the ego at 0; also 0 if one agent answers for all."""
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
        """The rows of `difficulty.csv`; none where the run came to all of its dataset's layouts."""
        exists = self.world == "frozen" and (self.path / DIFFICULTY).is_file()
        return self.read_file(DIFFICULTY, self._layouts) if exists else ()

    def _layouts(self, file: Path) -> tuple[Layout, ...]:
        layouts = _records(file, Layout)
        dangers = {layout.episode: layout.danger for layout in layouts}
        if len(dangers) < len(layouts) or any(dangers.get(e.episode) != e.danger for e in self.episodes):
            raise ValueError("an episode is there twice, or it lacks one of the run's")
        return layouts

    def score(self, condition: str, metric: str) -> Score | None:
        """Return a metric's score in one condition; of several intervals, one that holds at every look.

        Else it is the one over episodes.
        """
        candidates = [
            s for s in self.scores if (s.condition, s.metric) == (condition, metric) and s.value is not None
        ]
        order = {ANY_TIME: 0, PAIRED: 1, "episodes": 2}
        return min(candidates, key=lambda s: order.get(s.interval, 3), default=None)

    def _place(self, file: Path) -> tuple[Grid, tuple[Episode, ...]]:
        episodes = _records(file, Episode)
        numbers = tuple(dict.fromkeys(episode.episode for episode in episodes))
        world = self.manifest.world
        if len(numbers) != world.episodes:
            raise ValueError(f"it has {len(numbers)} episodes, and run.json says {world.episodes}")
        if isinstance(world, ClosedLoop) and any(
            e.episode not in range(world.selection.get("of", world.episodes))
            or e.layout_seed != world.first_seed + e.episode
            for e in episodes
        ):
            raise ValueError(f"a layout that is none of run.json's, whose first seed is {world.first_seed}")
        grid = Grid(self.conditions, self.manifest.seeds, numbers)
        return grid, tuple(grid.ordered(episodes))

    def _decisions(self, file: Path) -> Decisions:
        decisions = Decisions.read(file, self.actions, _most_rows(self.episodes))
        decisions.codes("action", self.actions)
        if infinite := decisions.infinite():
            raise ValueError(f"{infinite} is infinite")
        places = self.grid.places(decisions)
        steps, step = np.unique(decisions.whole("step"), return_inverse=True)
        agent = np.unique(np.array(decisions.labels("agent"), dtype=str), return_inverse=True)[1]
        keys = np.sort((places * len(steps) + step) * (1 + agent.max(initial=0)) + agent, kind="stable")
        if (keys[1:] == keys[:-1]).any():
            raise ValueError("a decision is there twice")
        counts = np.bincount(places, minlength=len(self.episodes))
        if (counts != [episode.decisions for episode in self.episodes]).any():
            raise ValueError("not every decision of episodes.csv is there")
        return decisions

    def read_file(self, name: str, reader: Callable[[Path], T]) -> T:
        """Return what a file of the run's folder holds. Raises UserError if the reader calls it broken."""
        try:
            return whole(self.path / name, reader)
        except UserError as error:
            if name == "answers.jsonl" or self.world != "frozen" or not self._has_answers:
                raise
            raise UserError(
                f"{error}: --model replay:{printable(self.path)} asks its model nothing"
            ) from None

    @property
    def _has_answers(self) -> bool:
        with suppress(UserError):
            return len(self.answers) > 0
        return False


def read(path: Path) -> Run:
    """Read a run's folder.

    Raises UserError if it holds no finished run, or its manifest is broken or of another version.
    """
    file = path / "run.json"
    if not file.is_file():
        raise UserError(
            f"{printable(path)} is a suite; give the folder of one of its runs"
            if (path / SUITE).is_file()
            else f"{printable(path)} is no finished run, since its model could not be asked: {reason}"
            if (reason := work.unanswered(path))
            else f"{printable(path)} is a file; a run is a folder, made by `harness eval` or `harness drive`"
            if path.is_file()
            else f"{printable(path)} is no finished run: it has no run.json; "
            "give a folder made by `harness eval` or `harness drive`"
        )
    stated: Any = whole(file, lambda file: msgspec.json.decode(text_of(file, "record")))
    formats.checked(stated.get("format") if isinstance(stated, dict) else None, file)
    return Run(path, whole(file, lambda file: msgspec.convert(formats.upgraded(stated), Manifest)))


def write(
    out: Path, manifest: Manifest, decisions: Decisions | DecisionFiles, episodes: Sequence[Episode],
    answers: Iterable[bytes], scores: Sequence[Score], layouts: Sequence[Layout] = (),
) -> None:  # fmt: skip
    """Write a run's files, the manifest last.

    The decisions are already rounded; the lines of `answers.jsonl` come some at a time.
    """
    with replacing(out / "answers.jsonl") as part, part.open("wb") as file:
        file.writelines(answers)
    decisions.write(out / "decisions.parquet")
    write_whole(out / "episodes.csv", csv_text(Episode, episodes, manifest.variant))
    write_whole(out / "summary.csv", csv_text(Score, scores, manifest.variant))
    if layouts:
        write_whole(out / DIFFICULTY, csv_text(Layout, layouts))
    text = msgspec.json.format(_ENCODER.encode(manifest), indent=1)
    write_whole(out / "run.json", text + b"\n")
    pa.default_memory_pool().release_unused()  # a report often follows, which needs memory for its own tables


def part_files(
    decisions: Decisions, episodes: Sequence[Episode], answers: Iterable[Answer],
    viewers: Mapping[str, Sequence[str]],
) -> dict[str, bytes]:  # fmt: skip
    """Return the files of a part of a run, by name; the answers may be in any order.

    `viewers` has the ids of each decision point's viewers, the ego first.
    """
    return {
        "decisions.parquet": decisions.encoded(),
        "answers.jsonl": lines(ordered(answers, decisions, viewers)),
        "episodes.csv": csv_text(Episode, episodes).encode(),
    }


def write_part(out: Path, files: Mapping[str, bytes]) -> None:
    """Write a part of a run to its own folder, which exists only once it is complete."""
    part = out.with_name(f".{out.name}.{os.getpid()}.part")
    shutil.rmtree(part, ignore_errors=True)
    for name, data in files.items():
        write_whole(part / name, data)
    os.replace(part, out)


def read_part(part: Path, actions: Sequence[str]) -> tuple[Decisions, tuple[Episode, ...], list[AnswerFacts]]:
    """Read a part that `write_part` wrote. Raises UserError if it is broken."""
    return whole(part, lambda part: (
        *_read_tables(part, actions), facts_of(part),
    ))  # fmt: skip


def facts_of(part: Path) -> list[AnswerFacts]:
    """Read a part's answers, without their texts. Raises UserError if it is broken."""
    return whole(part, lambda part: _FACTS.decode_lines(bytes_of(part / "answers.jsonl", "rows")))


def ends_of(part: Path) -> tuple[Episode, ...]:
    """Read how a part's episodes ended. Raises UserError if it is broken."""
    return whole(part, lambda part: _records(part / "episodes.csv", Episode))


def _read_tables(part: Path, actions: Sequence[str]) -> tuple[Decisions, tuple[Episode, ...]]:
    episodes = _records(part / "episodes.csv", Episode)
    return Decisions.read(part / "decisions.parquet", actions, _most_rows(episodes)), episodes


def _most_rows(episodes: Sequence[Episode]) -> int:
    """Return how many decisions a file may hold, so that one with a few too many is still read and named."""
    return 2 * MOST_DECISIONS * sum(episode.agents or 1 for episode in episodes)


def decisions_of(parts: Sequence[Path], actions: Sequence[str]) -> DecisionFiles:
    """Return the decisions of a run's parts."""
    return DecisionFiles([part / "decisions.parquet" for part in parts], tuple(actions))


def answers_in(part: Path) -> int:
    """Return the number of answers in a part."""
    return bytes_of(part / "answers.jsonl", "rows").count(b"\n")


def lines_of(parts: Iterable[Path]) -> Iterator[bytes]:
    """Yield the content of a run's `answers.jsonl` from its parts, one part at a time."""
    for part in parts:
        yield bytes_of(part / "answers.jsonl", "rows")


def lines(answers: Sequence[Answer]) -> bytes:
    """Return answers as lines of `answers.jsonl`."""
    return _ENCODER.encode_lines(answers)


def ordered(
    answers: Iterable[Answer], decisions: Decisions, viewers: Mapping[str, Sequence[str]] = NOBODY
) -> list[Answer]:
    """Sort answers by decision point, and there: the ego's, the helpers', blind helpers', fusion calls'.

    Those of one kind are in the order of the decision point's `viewers`, where these are known. Answers for a
    decision point without a decision, or by nobody among its viewers, are left out.
    """

    def place(answer: Answer) -> tuple[Any, ...]:
        first = viewers[answer.scene].index(answer.viewer) if answer.scene in viewers else 0
        return order[answer.scene], answer.heard, answer.role == "blind", first

    order = {scene: n for n, scene in enumerate(dict.fromkeys(decisions.labels("scene")))}
    reached = (answer for answer in answers if answer.scene in order)
    return sorted((a for a in reached if a.viewer in viewers.get(a.scene, (a.viewer,))), key=place)


def dataset_of(run: Run, given: Path | None = None) -> Dataset:
    """Return the dataset of a run on frozen scenes, wherever it lies now, if it has the run's digest.

    It is looked for where the run states, at that path seen from each folder above the run's, and by its
    name; nowhere else if the user names its folder, `given`. Raises UserError if it is not found, has another
    digest, or is damaged.
    """
    stated = run.manifest.world
    assert isinstance(stated, FrozenScenes)
    folders: list[Path] = []
    for path in [given] if given else dict.fromkeys(_datasets(run, stated)):
        if given or _holds(path):
            if _sha256_of(path) == stated.sha256:
                return load(path)
            folders.append(path)
    repair = "restore it, give its folder to a command that has --dataset, or run again"
    if folders:
        sha256 = _sha256_of(folders[0]) or read_manifest(folders[0])[1]  # which says what is wrong with it
        raise UserError(
            f"dataset {printable(folders[0])} is not the one that {printable(run.path)} was made on "
            f"(sha256 {sha256}, not {printable(stated.sha256)}); {repair}"
        )
    raise UserError(
        f"{printable(run.path)} was made on dataset {printable(stated.name, 40)}, which is neither at "
        f"{printable(stated.path)}, seen from here or from a folder above the run, nor known by its name; "
        f"{repair}"
    )


def _datasets(run: Run, stated: FrozenScenes) -> Iterator[Path]:
    """Yield where a run's dataset may lie."""
    path = Path(stated.path)
    yield path
    with suppress(UserError):
        yield find(stated.name)
    # The run may have moved together with its dataset, or be read from another folder.
    parts = [part for part in path.parts if part not in (path.anchor, "..")][-DEEPEST:]
    for above in run.path.resolve().parents:
        yield above / path
        yield from (above.joinpath(*parts[at:]) for at in range(len(parts)))
        yield above / "datasets" / stated.name


def _sha256_of(path: Path) -> str | None:
    """Return the digest of the dataset in a folder; None if its manifest is broken."""
    try:
        return read_manifest(path)[1]
    except UserError:
        return None


def _holds(path: Path) -> bool:
    try:
        return (path / "manifest.json").is_file()
    except (OSError, ValueError):  # a name that no file can have
        return False


def check_scenes(run: Run, dataset: Dataset, some: Iterable[str] | None = None) -> None:
    """Raise UserError if a run has a decision or an answer in a scene that is not in its dataset.

    With `some`, only decisions in these scenes are checked, and answers where there is no decision.
    """
    decided = run.decisions.scenes
    scenes_by_file: dict[str, Iterable[str]] = {
        "decisions.parquet": decided if some is None else (scene for scene in some if scene in decided),
        "answers.jsonl": (scene for scene in run.answers_by_scene if scene not in decided),
    }
    for file, scenes in scenes_by_file.items():
        for scene in scenes:
            if scene not in dataset:
                raise UserError(
                    f"{printable(run.path / file)} has scene {printable(scene)!r}, "
                    "which its dataset has not; make the run again"
                )


def csv_text(kind: type[Record], records: Iterable[Record], variant: Variant | None = None) -> str:
    """Return records as CSV: the columns of the variant, then a column for each field; None is empty."""
    text, records = io.StringIO(), list(records)
    writer = csv.writer(text, lineterminator="\n")
    variant_columns = asdict(variant) if variant else {}
    columns = {
        field: name for field, name in zip(kind.__struct_fields__, kind.__struct_encode_fields__, strict=True)
        if field not in formats.SPARSE or any(getattr(record, field) is not None for record in records)
    }  # fmt: skip
    writer.writerow([*variant_columns, *columns.values()])
    values = attrgetter(*columns)
    writer.writerows((*variant_columns.values(), *values(record)) for record in records)
    return text.getvalue()


def _records(file: Path, kind: type[Record]) -> tuple[Record, ...]:
    hints = dict(zip(kind.__struct_encode_fields__, get_type_hints(kind).values(), strict=True))
    optional = {name for name, hint in hints.items() if type(None) in get_args(hint)}
    parsed = pacsv.ParseOptions(newlines_in_values=True)
    with arrow_file(file) as lines:
        there = pacsv.open_csv(lines, parse_options=parsed).schema.names
        lines.seek(0)
        if lacking := hints.keys() - {*there, *formats.EPISODE}:
            raise ValueError(f"it lacks {', '.join(sorted(lacking))}")
        table = pacsv.read_csv(
            lines,
            parse_options=parsed,
            convert_options=pacsv.ConvertOptions(
                column_types={name: _KINDS[(*get_args(hint), hint)[0]] for name, hint in hints.items()},
                include_columns=list(hints), include_missing_columns=True, null_values=[""],
                true_values=["True"], false_values=["False"],
            ),
        )  # fmt: skip
    columns = {}
    for field, name, column in zip(kind.__struct_fields__, hints, table.columns, strict=True):
        values = column.to_pylist()
        if name in optional:
            values = [None if value == "" else value for value in values]
        elif column.null_count:
            raise ValueError(f"{name} is unknown in some rows")
        columns[field] = values
    rows = zip(*columns.values(), strict=True)
    return tuple(kind(**dict(zip(columns, row, strict=True))) for row in rows)


def scores_of(file: Path) -> tuple[Score, ...]:
    """Return the figures of a `summary.csv`. Raises ValueError if one is there twice."""
    scores = _records(file, Score)
    if len({score.key for score in scores}) < len(scores):
        raise ValueError("a figure is there twice")
    return scores


def whole(file: Path, reader: Callable[[Path], T]) -> T:
    """Return what `reader` makes of a file. Raises UserError if the file is broken."""
    try:
        with uncollected():
            return reader(file)
    except _BROKEN as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{printable(file)} is broken ({printable(reason)}); make the run again") from None
