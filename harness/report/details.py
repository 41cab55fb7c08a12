"""What a page shows of each decision: what was seen, asked, answered and decided,
and where it led.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import msgspec
import numpy as np
from markupsafe import Markup
from msgspec import UNSET

from harness.backends.base import BARE
from harness.backends.registry import reads_prompts
from harness.coordination.part_settings import questions
from harness.core.arrays import Floats, Ints
from harness.core.errors import UserError, printable
from harness.core.figures import number_or_none
from harness.core.files import digest
from harness.core.image import Image
from harness.core.places import text
from harness.dataset.forest import Forest
from harness.dataset.load import TREES_AT_ONCE, Scene
from harness.evaluate.agent import in_mode, sent_messages
from harness.evaluate.fusion import messages_of, source_of
from harness.evaluate.sharing import as_asked
from harness.parsing.parse import spans
from harness.prompts.versions import Prompt
from harness.report.drawing.geometry import (
    conflict_points,
    drawn_ground,
    north_up,
    spots,
    view_of,
)
from harness.report.library import packed, picture
from harness.report.remarks import LeftOut
from harness.report.runs import Runs
from harness.runs.decisions import Decisions
from harness.runs.folder import Run
from harness.runs.records import Answer, Episode, is_helper
from harness.runs.run_dataset import check_scenes
from harness.runs.sources import prompt_of
from harness.world import scenarios
from harness.world.perception.camera import frame
from harness.world.scenario import Scenario
from harness.world.scene_graph import Conflict
from harness.world.state import VehicleState

BLOCK = 24  # scenes that are compressed and read together

Messages = Sequence[Mapping[str, Any]]
Sent = Callable[[Scene, str, Messages], Sequence[Mapping[str, str]]]
Prompts = Callable[[Run], Sent | None]
GOOD, SLOW, BAD, BLAMELESS = "s", "d", "u", "n"
KEPT = (
    "role",
    "raw",
    "finish_reason",
    "error",
    "status",
    "verdict",
    "faults",
    "repairs",
    "detail",
    "intent",
    "mass",
    "message",
    "prompt_tokens",
    "completion_tokens",
    "seconds",
    "label_mass",
    "retries",
    "cached",
    "first_raw",
    "first_status",
)
ENDING = (
    "condition",
    "seed",
    "partner",
    "striker",
    "fault",
    "time_s",
    "delay_s",
    "least_gap_m",
    "hard_brakings",
    "other_crashes",
    "least_ttc_s",
    "least_pet_s",
)
# Of a decision, besides its policy and its messages.
SHOWN = (
    "condition",
    "action",
    "entropy_nats",
    "triggered",
    "own_failed",
    "own_weight",
    "latency_ms",
    "fusion_ms",
    "deadline_missed",
)
OF_DRIVEN = ("acts_at_s", "acted")  # known in the closed loop only
OF_MESSAGE = ("delivered", "on_time", "arrival_ms", "weight", "trust", "attacker")


def prompts_of(run: Run) -> Sent | None:
    """Return a function that renders a run's prompts again, as chat messages.

    Its arguments are a scene, a viewer's id and the messages that the viewer had heard. None if a
    prompt version of the run is neither installed nor stored with it.
    """
    manifest = run.manifest
    prompts: dict[str, Prompt] = {}  # by version
    failed: set[str] = set()  # versions
    for agent in (manifest.agent(0), *manifest.helpers):
        prompt = prompt_of(run, agent["prompt"])
        if prompt is None:
            return None
        prompts[prompt.version] = prompt

    def sent(scene: Scene, viewer: str, heard: Messages) -> Sequence[Mapping[str, str]]:
        words = (scene.seat or scenarios.get(scene.state.scenario)).prompt_words
        agent = manifest.agent(scene.place(scene.viewers.index(viewer)))
        prompt = prompts[agent["prompt"]["version"]]
        graph = scene.graphs[viewer]
        if prompt.version in failed:  # it would take as long again
            return ()
        try:
            letter = agent["answer"] in BARE
            rendered = prompt.render(graph, run.actions, heard, words, letter)
            messages = sent_messages(agent["image"], rendered)
            return in_mode(agent["answer"], prompt, messages, graph, run.actions, words)
        except UserError:  # a stranger's, which no run can have used
            failed.add(prompt.version)
            return ()

    return sent


@dataclass(frozen=True)
class Details:
    """Collect what the page shows of single scenes: the world, answers, decisions and outcomes.

    A scene is one decision point, and `runs` are those that the page shows. `replayed` has
    closed-loop scenes by id that could be simulated again, `framed` the ids of scenes shown with
    camera pictures. `prompts` takes a run and returns a function that makes its prompts again: of a
    scene, a viewer's id and the messages heard it returns the chat messages; it is None where they
    are unknown. `full` adds prompts that a rule did not read. `left_out` has for each run, by
    scene, how answers change without one object or message.
    """

    runs: Runs  # the runs
    replayed: Mapping[str, Scene]  # of closed-loop runs, the scenes that could be replayed
    framed: frozenset[str]  # scenes that have their cameras' pictures
    # takes a run and returns a function that makes its prompts again, or None where they are
    # unknown; that function takes a scene, a viewer's id and the messages heard, and returns the
    # chat messages
    prompts: Prompts
    full: bool  # whether prompts that a rule was given, and did not read, are shown, too
    # for each run, by scene id, how answers change without one object or message
    # (`remarks.LeftOut`)
    left_out: Sequence[LeftOut]

    def of_scenes(self, ids: Sequence[str]) -> "Details":
        """Return a copy for some scenes alone, by id, small enough to send to a process."""
        scenes = set(ids)
        replayed = {name: scene for name, scene in self.replayed.items() if name in scenes}
        left_out = []
        for of_run in self.left_out:
            left_out.append({name: some for name, some in of_run.items() if name in scenes})
        return replace(self, runs=self.runs.of_scenes(ids), replayed=replayed, left_out=left_out)

    def blocks(self, ids: Sequence[str]) -> Iterator[list[dict[str, Any]]]:
        """Yield what the page shows of scenes as JSON values, `BLOCK` scenes at a time.

        `ids` says of which scenes. Raises UserError if a run does not fit its dataset.
        """
        forest, scenes = None, self.replayed
        if dataset := self.runs.dataset:
            for run in self.runs.runs:
                check_scenes(run, dataset, ids)
            scenes = dict(zip(ids, dataset.scenes(ids), strict=True))
            # A small dataset's trees are laid out once, and a large one's where they are shown.
            if len(dataset.trees) > TREES_AT_ONCE:
                dataset = dataset.of_episodes({each.record.episode for each in scenes.values()})
            forest = dataset.forest
        for start in range(0, len(ids), BLOCK):
            block = ids[start : start + BLOCK]
            yield [self._detail(name, scenes.get(name), forest) for name in block]

    @cached_property
    def _sent(self) -> list[Sent | None]:
        return [self.prompts(run) for run in self.runs.runs]

    def without_prompts(self) -> list[Run]:
        """Return the runs whose prompts cannot be shown, as a prompt version is not to be found."""
        return [run for run, sent in zip(self.runs.runs, self._sent, strict=True) if sent is None]

    @cached_property
    def ends(self) -> list[Any]:
        """Return for each run an array (n,) with a letter for what each of its n decisions led to.

        The letters are `GOOD`, `SLOW` (success with a needless delay; driven: late), `BAD` (unsafe;
        driven: a failed episode) and `BLAMELESS` (no action could have led to success).
        """
        return [_ends(run) for run in self.runs.runs]

    @cached_property
    def _rows(self) -> list[Decisions]:
        """The decisions of each run, with the columns that a page shows."""
        return [run.decisions.selected(_columns(run.decisions)) for run in self.runs.runs]

    @cached_property
    def _episodes(self) -> list[Ints]:
        return [run.decisions.whole("episode") for run in self.runs.runs]

    def _detail(self, name: str, scene: Scene | None, forest: Forest | None) -> dict[str, Any]:
        prompts: dict[str, Any] = {}  # by digest
        runs = [self._of_run(n, name, scene, prompts) for n in range(len(self.runs.runs))]
        world = pictures = None
        if scene:
            scenario = scene.seat or self.runs.scenario
            world = _world(scenario, scene, _helpers_asked(runs))
            pictures = cameras(scenario, scene) if name in self.framed else False
        return {
            "world": world,
            "cameras": pictures,
            "outcomes": forest and _outcomes(forest, name),
            "runs": runs,
            "prompts": list(prompts.values()),
        }

    def _of_run(
        self, n: int, name: str, scene: Scene | None, prompts: dict[str, Any]
    ) -> dict[str, Any] | None:
        """Return what a run has of a scene; None where it has nothing.

        The chat messages of its answers are added to `prompts`, once for all answers to them.
        """
        run = self.runs.runs[n]
        rows = run.decisions.scenes.get(name)
        if rows is None:
            return None
        by_key = {answer.key: answer for answer in run.answers_by_scene.get(name, ())}
        answers = [self._answer(n, name, scene, by_key, each, prompts) for each in by_key.values()]
        detail: dict[str, Any] = {"answers": answers, "decisions": self._decisions(n, rows)}
        if self.runs.live:  # in frozen scenes each action has its outcome
            episodes = run.episodes_of(int(self._episodes[n][rows.start]))
            detail["ends"] = [_end(episode) for episode in episodes]
        if left_out := self.left_out[n].get(name):
            detail["left_out"] = left_out
        return detail

    def _answer(
        self,
        n: int,
        name: str,
        scene: Scene | None,
        by_key: Mapping[str, Answer],
        answer: Answer,
        prompts: dict[str, Any],
    ) -> dict[str, Any]:
        """Return what the page shows of one of the answers `by_key` of a scene.

        Raises UserError if nobody of the viewer's name answers there.
        """
        run = self.runs.runs[n]
        if scene and answer.viewer not in scene.viewers:
            raise UserError(
                f"{printable(run.path / 'answers.jsonl')} has an answer of "
                f"{printable(answer.viewer)!r} in scene {printable(name)}, "
                "where nobody of that name answers; make the run again"
            )
        fields = _fields(answer)
        agent = run.agent(answer)
        if answer.image_sha256:
            pictured = questions()[answer.question].pictured
            fields["picture"] = agent["image"] if pictured else "blank"
        if run.manifest.helpers:
            names = agent["model"]["name"], agent["prompt"]["version"], agent["answer"]
            fields["agent"] = " · ".join(names)
        if run.manifest.latency.speeds or run.manifest.helpers:
            fields["took_s"] = number_or_none(run.seconds(answer))
        return {
            **fields,
            "viewer": answer.key,
            "spans": _read_in(answer, run) if answer.repairs else [],
            "prompt": self._prompt(n, name, scene, by_key, answer, prompts),
        }

    def _prompt(
        self,
        n: int,
        name: str,
        scene: Scene | None,
        by_key: Mapping[str, Answer],
        answer: Answer,
        prompts: dict[str, Any],
    ) -> int | None:
        """Return the place of an answer's chat messages among `prompts`, which they are added to.

        None where they are not known; False where the page leaves them out.
        """
        run, messages_sent = self.runs.runs[n], self._sent[n]
        if not (self.full or reads_prompts(str(run.agent(answer)["model"]["engine"]))):
            return False
        # Shuffled messages are in the details of another scene.
        if not scene or not messages_sent or source_of(name, answer.heard) != name:
            return None
        heard = messages_of(by_key, answer.heard, run.actions)
        try:
            view = as_asked(scene.seat or self.runs.scenario, scene, answer)
        except UserError as error:
            raise UserError(f"{printable(run.path)}: {error}") from None
        messages = messages_sent(view, answer.viewer, heard)
        sha256 = digest(messages)
        if answer.prompt_sha256 != sha256:
            return None
        prompts.setdefault(sha256, messages)
        return list(prompts).index(sha256)

    def _decisions(self, n: int, rows: Iterable[int]) -> list[dict[str, Any]]:
        """Return the decisions of some rows of a run; seeds with the same one share an entry."""
        decisions: dict[Any, dict[str, Any]] = {}
        for index in rows:
            row, end = self._rows[n].row(index), str(self.ends[n][index])
            seed, *values = row.values()
            entry = decisions.get((*values, end))
            if entry is None:
                entry = {**_row_for_page(self._rows[n], row), "end": end, "seeds": []}
                decisions[(*values, end)] = entry
            entry["seeds"].append(seed)
        return list(decisions.values())


@dataclass(frozen=True)
class Part:
    """Hold a chunk of scenes whose details for a page one process prepares and compresses.

    `details` has what the page shows of scenes, `ids` says of which. It is pickled with no more of
    the runs than these scenes need.
    """

    details: Details  # what the page shows of scenes
    ids: Sequence[str]  # ids of the chunk's scenes

    def __reduce__(self) -> Any:
        return Part, (self.details.of_scenes(self.ids), self.ids)

    def packed(self) -> list[Markup]:
        """Return what the page shows of these scenes as compressed JSON, in base64.

        There is one text for each block of `BLOCK` scenes.
        """
        return [packed(block) for block in self.details.blocks(self.ids)]


def _columns(d: Decisions) -> list[str]:
    policy = [f"fused_{action}" for action in d.actions]
    places = range(1, d.helpers + 1)
    messages = [f"{name}_{place}" for place in places for name in ("helper", *OF_MESSAGE)]
    return ["seed", *SHOWN, *OF_DRIVEN, *policy, *messages]


def _row_for_page(d: Decisions, row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row of decisions for the page, with its policy and its messages as lists."""
    messages = []
    for place in range(1, d.helpers + 1):
        helper = row[f"helper_{place}"]
        if helper is not None:
            values = {name: row[f"{name}_{place}"] for name in OF_MESSAGE}
            messages.append({"from": helper, **values})
    return {
        **{name: row[name] for name in SHOWN},
        **{name: row[name] for name in OF_DRIVEN if row[name] is not None},
        "fused": [row[f"fused_{action}"] for action in d.actions],
        "messages": messages,
    }


def _helpers_asked(runs: Iterable[dict[str, Any] | None]) -> set[tuple[str, ...]]:
    """Return the ids of the helpers whom the ego asked together in some decision of these runs."""
    sets = set[tuple[str, ...]]()
    for run in filter(None, runs):
        for decision in run["decisions"]:
            sets.add(tuple(message["from"] for message in decision["messages"]))
    return sets


def _fields(answer: Answer) -> dict[str, Any]:
    """Return those fields of an answer that the page shows and that say something."""
    fields = {}
    for name in KEPT:
        value = getattr(answer, name)
        if value not in (None, UNSET, ()) and value is not False:
            fields[name] = text(value) if name in ("error", "detail") else value
    return fields


def _read_in(answer: Answer, run: Run) -> list[tuple[int, int]]:
    """Return where in a recovered completion its answers stand."""
    role = "helper" if is_helper(answer.role) else "ego"
    return spans(answer.raw, role, run.actions, run.agent(answer)["thinking"])


def _end(e: Episode) -> dict[str, Any]:
    """Return how an episode ended, for the page."""
    return {"result": e.failure or "cleared", **{key: getattr(e, key) for key in ENDING}}


def _ends(run: Run) -> Any:
    """Return a letter for what each decision led to, (n,);
    in the closed loop, for how its episode ended.
    """
    decisions = run.decisions
    if run.world == "closed-loop":
        letters = {"": GOOD, "late": SLOW}
        of_episodes = np.array([letters.get(episode.failure, BAD) for episode in run.episodes])
        return of_episodes[run.grid.places(decisions)]
    of_safe = np.where(np.nan_to_num(decisions["delay_s"]) > 0, SLOW, GOOD)
    of_avoidable = np.where(decisions.flags("safe"), of_safe, BAD)
    return np.where(decisions.flags("value"), of_avoidable, BLAMELESS)


# A camera's picture in a page: half as wide and high as a model is shown it, and in 32 shades of
# each colour.
FRAME_PX = 256, 128
SHADES, HALF_A_SHADE = np.uint8(0xF8), np.uint8(0x04)


def _world(
    scenario: Scenario, scene: Scene, helpers_asked: Iterable[tuple[str, ...]]
) -> dict[str, Any]:
    """Return what is where, in m to the east and to the north, and what each viewer sees of it.

    Of each viewer, too, the part of the world that is drawn,
    for each set of helpers that the ego asked in some decision.
    """
    state, danger = scene.state, scene.record.danger.vehicle
    zone_m, sets_of_helpers = scenario.road().zone_m, sorted({(), *helpers_asked})
    viewers = {}
    for viewer, graph in scene.graphs.items():
        crossed = conflict_points(state, graph)
        views = {}
        for ids in sets_of_helpers:
            view = view_of(spots(state, zone_m, graph, (danger, *ids), crossed))
            corner_and_width = (view.west_m, view.south_m, view.width_m)
            views[" ".join(ids)] = [round(metres, 1) for metres in corner_and_width]
        viewers[viewer] = {
            "role": graph.role,
            "seen": [*graph.seen],
            "occluded": [*graph.occluded],
            "conflicts": _conflicts(*crossed),
            "views": views,
        }
    ground = {"ground": drawn_ground(scenario)} if scenario.layout_seed is not None else {}
    return {
        **ground,
        "time_s": round(state.time_s, 3),
        "vehicles": [_vehicle(vehicle, danger) for vehicle in state.vehicles],
        "buildings": [
            {"id": building.id, "corners": north_up(building.corners()).round(1).tolist()}
            for building in state.buildings
        ],
        "viewers": viewers,
    }


def _vehicle(vehicle: VehicleState, danger: str | None) -> dict[str, Any]:
    return {
        "id": vehicle.id,
        "kind": vehicle.kind,
        "part": "danger" if vehicle.id == danger else vehicle.part,
        "x": round(vehicle.x_m, 2),
        "y": round(-vehicle.y_m, 2),
        "heading": round(-vehicle.heading_rad, 4),
        "length": vehicle.length_m,
        "width": vehicle.width_m,
        "speed": round(vehicle.speed_mps, 2),
        "crashed": vehicle.crashed,
    }


def cameras(scenario: Scenario, scene: Scene) -> dict[str, Any]:
    """Return by viewer's id its rendered camera picture and the boxes of the objects in it, a dict.

    Keys are `picture`, a PNG as a data URI, `size`, (width, height) in pixels, and `boxes`, rows of
    an object's id and the pixels of its box's edges (`Frame.boxes`). `scenario` is that of the
    scene.
    """
    pictures = {}
    for viewer, graph in scene.graphs.items():
        seen = frame(scenario, scene.state, viewer, FRAME_PX)
        image = Image(seen.pixels & SHADES | HALF_A_SHADE)
        boxes = seen.boxes()
        pictures[viewer] = {
            "size": FRAME_PX,
            "picture": picture(image.png(), "png"),
            "boxes": [[name, *box] for name in graph.seen for box in boxes.get(name, ())],
        }
    return pictures


def _conflicts(conflicts: Sequence[Conflict], points: Floats) -> list[dict[str, Any]]:
    return [
        {"x": x, "y": y, "with": c.vehicle, "ego": c.ego.time_s, "other": c.other.time_s}
        for c, (x, y) in zip(conflicts, points.round(1).tolist(), strict=True)
    ]


def _outcomes(forest: Forest, name: str) -> list[dict[str, Any]]:
    """Return what each action leads to at a decision point if the full-view driver takes the
    rest.
    """
    place = forest.place[name]
    last_edges = forest.then_full_view[place]
    in_time = forest.succeeds(last_edges, forest.tree[place])
    outcomes = []
    for n, action in enumerate(forest.actions):
        end = forest.end(int(last_edges[n]))
        late = end.result == "cleared" and not in_time[n]
        outcome = msgspec.to_builtins(end)
        outcome["action"] = action
        outcome["safe"] = bool(forest.safe[place, n])
        outcome["result"] = "late" if late else end.result
        outcome["delay_s"] = number_or_none(round(float(forest.delay_s[place, n]), 3))
        outcomes.append(outcome)
    return outcomes
