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
from harness.coordination.operating_point import questions
from harness.core.arrays import Floats, Ints
from harness.core.errors import UserError, printable
from harness.core.files import digest
from harness.core.image import Image
from harness.core.places import text
from harness.dataset.forest import Forest
from harness.dataset.load import TREES_AT_ONCE, Scene
from harness.evaluate.agent import in_mode, shown
from harness.evaluate.device import answer_s
from harness.evaluate.fusion import messages_of, source_of
from harness.evaluate.sharing import as_asked
from harness.parsing.parse import spans
from harness.prompts.versions import Prompt
from harness.report.drawing.geometry import conflict_points, spots, view_of
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
    """Gives the chat messages that a viewer was sent;
    None if one of its prompts is neither here nor kept.
    """
    manifest, prompts = run.manifest, dict[str, Prompt]()
    failed = set[str]()
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
            messages = shown(agent["image"], rendered)
            return in_mode(agent["answer"], prompt, messages, graph, run.actions, words)
        except UserError:  # a stranger's, which no run can have used
            failed.add(prompt.version)
            return ()

    return sent


@dataclass(frozen=True)
class Details:
    """The details of scenes."""

    runs: Runs  # the runs
    replayed: Mapping[str, Scene]  # of closed-loop runs, the scenes that could be replayed
    framed: frozenset[str]  # scenes that have their cameras' pictures
    prompts: Prompts  # as in `harness.report.page.write_report`
    full: bool  # whether prompts that a rule was given, and did not read, are among them
    left_out: Sequence[LeftOut]  # of each run

    def of_scenes(self, ids: Sequence[str]) -> "Details":
        """Return the same with no more of the runs than these scenes need."""
        replayed = {name: self.replayed[name] for name in ids if name in self.replayed}
        left_out = [{name: of[name] for name in ids if name in of} for of in self.left_out]
        return replace(self, runs=self.runs.of_scenes(ids), replayed=replayed, left_out=left_out)

    def blocks(self, ids: Sequence[str]) -> Iterator[list[dict[str, Any]]]:
        """Details of these scenes, so many a block."""
        forest, scenes = None, self.replayed
        if dataset := self.runs.dataset:
            for run in self.runs.runs:
                check_scenes(run, dataset, ids)
            scenes = dict(zip(ids, dataset.scenes(ids), strict=True))
            shown = {scene.record.episode for scene in scenes.values()}
            # A small dataset's trees are laid out once, and a large one's where they are shown.
            forest = (
                dataset if len(dataset.trees) <= TREES_AT_ONCE else dataset.of_episodes(shown)
            ).forest
        for at in range(0, len(ids), BLOCK):
            yield [self._detail(name, scenes.get(name), forest) for name in ids[at : at + BLOCK]]

    @cached_property
    def _sent(self) -> list[Sent | None]:
        return [self.prompts(run) for run in self.runs.runs]

    def without_prompts(self) -> list[Run]:
        return [run for run, sent in zip(self.runs.runs, self._sent, strict=True) if sent is None]

    @cached_property
    def ends(self) -> list[Any]:
        """What each decision of each run led to, a letter a decision (n,)."""
        return [_ends(run) for run in self.runs.runs]

    @cached_property
    def _rows(self) -> list[Decisions]:
        """The decisions of each run, with the columns that a page shows."""
        return [run.decisions.selected(_columns(run.decisions)) for run in self.runs.runs]

    @cached_property
    def _episodes(self) -> list[Ints]:
        return [run.decisions.whole("episode") for run in self.runs.runs]

    def _detail(self, name: str, scene: Scene | None, forest: Forest | None) -> dict[str, Any]:
        sent: dict[str, Any] = {}
        runs = [self._of_run(n, name, scene, sent) for n in range(len(self.runs.runs))]
        asked = {
            tuple(m["from"] for m in d["messages"]) for run in runs if run for d in run["decisions"]
        }
        return {
            "world": scene and _world(scene.seat or self.runs.scenario, scene, asked),
            "cameras": scene
            and name in self.framed
            and cameras(scene.seat or self.runs.scenario, scene),
            "outcomes": forest and _outcomes(forest, name),
            "runs": runs,
            "prompts": list(sent.values()),
        }

    def _of_run(
        self, n: int, name: str, scene: Scene | None, sent: dict[str, Any]
    ) -> dict[str, Any] | None:
        run, prompts = self.runs.runs[n], self._sent[n]
        rows = run.decisions.scenes.get(name)
        if rows is None:
            return None
        answers = []
        by_viewer = {answer.key: answer for answer in run.answers_by_scene.get(name, ())}
        for answer in by_viewer.values():
            if scene and answer.viewer not in scene.viewers:
                raise UserError(
                    f"{printable(run.path / 'answers.jsonl')} has an answer of "
                    f"{printable(answer.viewer)} in "
                    f"scene {printable(name)}, where nobody of that name answers; make the run "
                    "again"
                )
            shown = {
                key: v
                for key in KEPT
                if (v := getattr(answer, key)) is not None
                and v is not False
                and v is not UNSET
                and v != ()
            }
            shown |= {key: text(shown[key]) for key in ("error", "detail") if key in shown}
            asked: int | None = None  # place among the prompts; False for one that is left out
            agent = run.agent(answer)
            if not (self.full or reads_prompts(str(agent["model"]["engine"]))):
                asked = False
            # Shuffled messages are in the details of another scene.
            elif scene and prompts and source_of(name, answer.heard) == name:
                heard = messages_of(by_viewer, answer.heard, run.actions)
                as_shown = as_asked(scene.seat or self.runs.scenario, scene, answer)
                messages = prompts(as_shown, answer.viewer, heard)
                key = digest(messages)
                if answer.prompt_sha256 == key:
                    sent.setdefault(key, messages)
                    asked = list(sent).index(key)
            if answer.image_sha256:
                pictured = questions()[answer.question].pictured
                shown["picture"] = agent["image"] if pictured else "blank"
            if run.manifest.helpers:
                shown["agent"] = " · ".join(
                    (agent["model"]["name"], agent["prompt"]["version"], agent["answer"])
                )
            if run.manifest.latency.speeds:
                shown["took_s"] = None if answer.error else answer_s(run.speed(answer), answer)
            elif run.manifest.helpers:
                shown["took_s"] = run.seconds(answer)
            spans_read = _read_in(answer, run) if answer.repairs else []
            answers.append({**shown, "viewer": answer.key, "spans": spans_read, "prompt": asked})
        decisions: dict[Any, dict[str, Any]] = {}  # seeds with the same decision share an entry
        for index in rows:
            row, end = self._rows[n].row(index), str(self.ends[n][index])
            seed, *same = row.values()
            if (alike := (*same, end)) not in decisions:
                decisions[alike] = {**_shown(self._rows[n], row), "end": end, "seeds": []}
            decisions[alike]["seeds"].append(seed)
        detail: dict[str, Any] = {"answers": answers, "decisions": list(decisions.values())}
        if self.runs.live:  # in frozen scenes each action has its outcome
            ended = run.episodes_of(int(self._episodes[n][rows.start]))
            detail["ends"] = [_end(end) for end in ended]
        if left_out := self.left_out[n].get(name):
            detail |= {"left_out": left_out}
        return detail


@dataclass(frozen=True)
class Part:
    """Some scenes whose details are packed together, here or in another process.

    It is pickled with no more of the runs than these scenes need.
    """

    details: Details
    ids: Sequence[str]

    def __reduce__(self) -> Any:
        return Part, (self.details.of_scenes(self.ids), self.ids)

    def packed(self) -> list[Markup]:
        return [packed(block) for block in self.details.blocks(self.ids)]


def _columns(d: Decisions) -> list[str]:
    of_messages = [
        f"{name}_{n}" for n in range(1, d.helpers + 1) for name in ("helper", *OF_MESSAGE)
    ]
    return ["seed", *SHOWN, *OF_DRIVEN, *(f"fused_{action}" for action in d.actions), *of_messages]


def _shown(d: Decisions, row: Mapping[str, Any]) -> dict[str, Any]:
    return {
        **{name: row[name] for name in SHOWN},
        **{name: row[name] for name in OF_DRIVEN if row[name] is not None},
        "fused": [row[f"fused_{action}"] for action in d.actions],
        "messages": [
            {"from": helper, **{name: row[f"{name}_{n}"] for name in OF_MESSAGE}}
            for n in range(1, d.helpers + 1)
            if (helper := row[f"helper_{n}"]) is not None
        ],
    }


def _read_in(answer: Answer, run: Run) -> list[tuple[int, int]]:
    """Return where in a recovered completion its answers stand."""
    role = "helper" if is_helper(answer.role) else "ego"
    return spans(answer.raw, role, run.actions, run.agent(answer)["thinking"])


def _end(e: Episode) -> dict[str, Any]:
    """Return how an episode ended, for the page."""
    return {"result": e.failure or "cleared", **{key: getattr(e, key) for key in ENDING}}


def _ends(run: Run) -> Any:
    """What each decision led to, a letter a decision (n,);
    in the closed loop, what its episode came to.
    """
    d = run.decisions
    if run.world == "closed-loop":
        letters = {"": GOOD, "late": SLOW}
        return np.array([letters.get(e.failure, BAD) for e in run.episodes])[run.grid.places(d)]
    safe = np.where(np.nan_to_num(d["delay_s"]) > 0, SLOW, GOOD)
    return np.where(d.flags("value"), np.where(d.flags("safe"), safe, BAD), BLAMELESS)


# A camera's picture in a page: half as wide and high as a model is shown it, and in 32 shades of
# each colour.
FRAME_PX = 256, 128
SHADES, HALF_A_SHADE = np.uint8(0xF8), np.uint8(0x04)


def _world(scenario: Scenario, scene: Scene, asked: Iterable[tuple[str, ...]]) -> dict[str, Any]:
    """Return what is where, in m to the east and to the north, and what each viewer sees of it.

    Of each viewer, too, the part that is shown of it:
    for whom the ego asked in each of some decisions.
    """
    state, danger = scene.state, scene.record.danger.vehicle
    zone_m, heard = scenario.road().zone_m, sorted({(), *asked})
    return {
        "time_s": round(state.time_s, 3),
        "vehicles": [
            {
                "id": v.id,
                "kind": v.kind,
                "part": "danger" if v.id == danger else v.part,
                "x": round(v.x_m, 2),
                "y": round(-v.y_m, 2),
                "heading": round(-v.heading_rad, 4),
                "length": v.length_m,
                "width": v.width_m,
                "speed": round(v.speed_mps, 2),
                "crashed": v.crashed,
            }
            for v in state.vehicles
        ],
        "buildings": [
            {"id": b.id, "corners": (b.corners() * [1.0, -1.0]).round(1).tolist()}
            for b in state.buildings
        ],
        "viewers": {
            viewer: {
                "role": graph.role,
                "seen": [*graph.seen],
                "occluded": [*graph.occluded],
                "conflicts": _conflicts(*crossed),
                "views": {
                    " ".join(ids): [
                        round(view.west_m, 1),
                        round(view.south_m, 1),
                        round(view.width_m, 1),
                    ]
                    for ids in heard
                    for view in [view_of(spots(state, zone_m, graph, (danger, *ids), crossed))]
                },
            }
            for viewer, graph in scene.graphs.items()
            for crossed in [conflict_points(state, graph)]
        },
    }


def cameras(scenario: Scenario, scene: Scene) -> dict[str, Any]:
    """Of each viewer, what its cameras see and boxes around what its sensors list
    (`Frame.boxes`).
    """
    shown = {}
    for viewer, graph in scene.graphs.items():
        seen = frame(scenario, scene.state, viewer, FRAME_PX)
        boxes = seen.boxes()
        shown[viewer] = {
            "size": FRAME_PX,
            "picture": picture(Image(seen.pixels & SHADES | HALF_A_SHADE).png(), "png"),
            "boxes": [[name, *box] for name in graph.seen for box in boxes.get(name, ())],
        }
    return shown


def _conflicts(conflicts: Sequence[Conflict], points: Floats) -> list[dict[str, Any]]:
    return [
        {"x": x, "y": y, "with": c.vehicle, "ego": c.ego.time_s, "other": c.other.time_s}
        for c, (x, y) in zip(conflicts, points.round(1).tolist(), strict=True)
    ]


def _outcomes(forest: Forest, name: str) -> list[dict[str, Any]]:
    """Return what each action leads to at a decision point if the full-view driver takes the
    rest.
    """
    n = forest.place[name]
    last = forest.then_full_view[n]
    in_time = forest.succeeds(last, forest.tree[n])
    rows = zip(
        forest.actions, last.tolist(), in_time, forest.safe[n], forest.delay_s[n], strict=True
    )
    return [
        {
            **msgspec.to_builtins(end := forest.end(edge)),
            "action": action,
            "safe": bool(safe),
            "result": "late" if end.result == "cleared" and not success else end.result,
            "delay_s": None if np.isnan(delay_s) else round(float(delay_s), 3),
        }
        for action, edge, success, safe, delay_s in rows
    ]
