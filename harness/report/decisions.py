"""What a page shows of each decision: an index of all, and details in blocks that are read when opened."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from harness.core.files import digest
from harness.dataset.forest import Forest
from harness.dataset.load import Scene
from harness.evaluate.agent import in_mode, shown
from harness.evaluate.device import answer_s
from harness.evaluate.fusion import messages_of
from harness.parsing.parse import spans
from harness.parsing.status import Status
from harness.prompts import versions
from harness.report import scenes
from harness.report.choose import failures, lost, pick, spread
from harness.report.runs import Runs
from harness.runs.folder import Run, check_scenes
from harness.runs.records import Answer, Decision, Episode
from harness.world import scenarios
from harness.world.perception.graph import blinded

BLOCK = 24  # scenes that are compressed and read together
READ = 64 * BLOCK  # that are in memory at a time
FRAMES = 400  # cameras' pictures in a page, each some 3.5 kB of it
REPLAYED = 60  # decision points of a closed-loop run that are replayed, for their picture and prompts

Messages = Sequence[Mapping[str, Any]]
Sent = Callable[[Scene, str, Messages], Sequence[Mapping[str, str]]]
Prompts = Callable[[Run], Sent | None]
GOOD, SLOW, BAD, BLAMELESS, ABSENT = "s", "d", "u", "n", "-"
KEPT = (
    "role", "raw", "finish_reason", "error", "status", "verdict", "repairs", "detail", "intent", "mass",
    "message", "prompt_tokens", "completion_tokens", "seconds", "label_mass", "retries", "cached",
    "first_raw", "first_status",
)  # fmt: skip
# The same for all decisions of a scene, or known from its outcomes.
LEFT_OUT = ("scene", "episode", "step", "danger", "seed", "safe", "delay_s")


def prompts_of(run: Run) -> Sent | None:
    """Gives the chat messages that a viewer was sent; None if a prompt of the run is not here as it was."""
    manifest, prompts = run.manifest, dict[str, versions.Prompt]()
    for agent in (manifest.agent(0), *manifest.helpers):
        prompt = versions.as_it_was(agent["prompt"]["version"], agent["prompt"]["sha256"])
        if prompt is None:
            return None
        prompts[prompt.version] = prompt

    def sent(scene: Scene, viewer: str, heard: Messages) -> Sequence[Mapping[str, str]]:
        words = scenarios.get(scene.state.scenario).prompt_words
        agent = manifest.agent(scene.viewers.index(viewer))
        prompt = prompts[agent["prompt"]["version"]]
        graph = scene.record["graphs"][viewer]
        messages = shown(agent.get("image", "own"), prompt.render(graph, run.actions, heard, words))
        return in_mode(agent["answer"], prompt, messages, graph["role"], run.actions)

    return sent


def as_shown(scene: Scene, answer: Answer) -> Scene:
    """A decision point as it was shown to who answered."""
    if answer.role != "blind":
        return scene
    graphs = {viewer: blinded(graph) for viewer, graph in scene.record["graphs"].items()}
    return Scene({**scene.record, "graphs": graphs})


class Decisions:
    """Everything that runs have to say of single scenes, in order of episode and step.

    Attributes:
        ids: of the scenes that any run has.
        index: what the list shows and filters by, for the page.
    """

    def __init__(self, runs: Runs, prompts: Prompts = prompts_of) -> None:
        self._runs = runs
        self._prompts = [prompts(run) for run in runs.runs]
        places: dict[str, tuple[int, int, str | None]] = {}
        for run in reversed(runs.runs):
            episode, step = run.decisions.whole("episode"), run.decisions.whole("step")
            danger = run.decisions.labels("danger")
            for scene, rows in run.decisions.scenes.items():
                places[scene] = int(episode[rows.start]), int(step[rows.start]), danger[rows.start]
        order = sorted(places.items(), key=lambda item: (*item[1][:2], item[0]))
        self.ids = [scene for scene, _ in order]
        self._episode_of = {scene: episode for scene, (episode, _, _) in order}
        failed = [failures(run) if runs.live else {} for run in runs.runs]
        self._ends = [_ends(run) for run in runs.runs]
        self._left_out = [_left_out(run) for run in runs.runs]
        self._episodes = [_episodes(run) for run in runs.runs]
        if runs.dataset:
            for run in runs.runs:
                check_scenes(run, runs.dataset)
        self._replayed = {} if runs.dataset else self._played(failed)
        self._framed = self._telling()
        self.index = {
            "actions": runs.actions,
            "scenes": [[scene, *place] for scene, place in order],
            "block": BLOCK,
            "live": runs.live,
            "framed": len(self._framed),
            "statuses": list(map(str, Status)),
            "runs": [self._indexed(n, list(of)) for n, of in enumerate(failed)],
        }

    def _played(self, failed: Sequence[dict[str, int]]) -> dict[str, Scene]:
        """The telling decision points, replayed; none where this simulator differs from the run's."""
        from harness.evaluate.replay import scene_of  # loads the simulator

        telling = [
            scene
            for run, of in zip(self._runs.runs, failed, strict=True)
            for scene in pick(run, of, REPLAYED)
        ]
        replayed: dict[str, Scene] = {}
        for name in dict.fromkeys(telling):
            # A run without helpers, such as a driver's, has fewer viewers.
            here = [run for run in self._runs.runs if name in run.decisions.scenes]
            scene = scene_of(max(here, key=lambda run: len(run.answers_by_scene.get(name, ()))), name)
            if scene.id == name:
                replayed[name] = scene
        return replayed

    def _telling(self) -> set[str]:
        """Decision points that have cameras' pictures: where episodes are lost, then a sample."""
        most = FRAMES // (1 + max(run.decisions.helpers for run in self._runs.runs))
        if self._runs.live:
            return set(spread(list(self._replayed), most))
        runs = self._runs.runs
        first = spread(list(dict.fromkeys(scene for run in runs for scene in lost(run))), most)
        more = dict.fromkeys(scene for run in runs for scene in pick(run, {}, most) if scene not in first)
        return {*first, *spread(list(more), most - len(first))}

    def _indexed(self, n: int, first_failures: Sequence[str]) -> dict[str, Any]:
        """One run's part of the index: a letter a scene, condition and seed, in this order."""
        run, ends = self._runs.runs[n], self._ends[n]
        d, shape = run.decisions, run.grid.shape[:2]
        place = {scene: position for position, scene in enumerate(self.ids)}
        of_scene = np.empty(len(d), dtype=int)
        for scene, rows in d.scenes.items():
            of_scene[rows.start : rows.stop] = place[scene]
        of_run = run.grid.places(d) // run.grid.shape[2]
        letters = {
            "acted": np.array([str(number) for number in range(len(run.actions))])[
                d.codes("action", run.actions)
            ],
            "ended": ends,
            "asked": np.where(d.flags("triggered"), "1", "0"),
        }
        index = {}
        for name, values in letters.items():
            line = np.full((len(self.ids), shape[0] * shape[1]), "0" if name == "asked" else ABSENT)
            line[of_scene, of_run] = values
            index[name] = "".join(line.ravel().tolist())
        statuses = list(map(str, Status))
        met = [{a.status for a in run.answers_by_scene.get(scene, ())} for scene in self.ids]
        return {
            "conditions": run.conditions, "seeds": run.manifest.seeds, **index,
            "statuses": [sum(1 << statuses.index(s) for s in of if s in statuses) for of in met],
            "first": [place[scene] for scene in first_failures],
        }  # fmt: skip

    def blocks(self) -> Iterator[list[dict[str, Any]]]:
        """Details of the scenes, so many a block."""
        for start in range(0, len(self.ids), READ):
            ids, forest, scenes = self.ids[start : start + READ], None, self._replayed
            if dataset := self._runs.dataset:
                scenes = dict(zip(ids, dataset.scenes(ids), strict=True))
                forest = dataset.of_episodes({scene.record["episode"] for scene in scenes.values()}).forest
            for at in range(0, len(ids), BLOCK):
                yield [self._detail(name, scenes.get(name), forest) for name in ids[at : at + BLOCK]]

    def _detail(self, name: str, scene: Scene | None, forest: Forest | None) -> dict[str, Any]:
        sent: dict[str, Any] = {}
        runs = [self._of_run(n, name, scene, sent) for n in range(len(self._runs.runs))]
        asked = {tuple(m["from"] for m in d["messages"]) for run in runs if run for d in run["decisions"]}
        return {
            "world": scene and scenes.world(self._runs.scenario, scene, asked),
            "cameras": scene and name in self._framed and scenes.cameras(self._runs.scenario, scene),
            "outcomes": forest and scenes.outcomes(forest, name),
            "runs": runs,
            "prompts": list(sent.values()),
        }

    def _of_run(self, n: int, name: str, scene: Scene | None, sent: dict[str, Any]) -> dict[str, Any] | None:
        run, prompts = self._runs.runs[n], self._prompts[n]
        rows = run.decisions.scenes.get(name)
        if rows is None:
            return None
        answers = []
        by_viewer = {answer.key: answer for answer in run.answers_by_scene.get(name, ())}
        for answer in by_viewer.values():
            shown = {
                key: v
                for key in KEPT
                if (v := getattr(answer, key)) is not None and v is not False and v != ()
            }
            asked = None
            if scene and prompts:
                shown_to = as_shown(scene, answer)
                messages = prompts(shown_to, answer.viewer, messages_of(by_viewer, answer.heard, run.actions))
                key = digest(messages)
                if answer.prompt_sha256 == key:
                    sent.setdefault(key, messages)
                    asked = list(sent).index(key)
            agent = run.agent(answer)
            if answer.image_sha256:
                shown["picture"] = "blank" if answer.role == "blind" else agent["image"]
            if run.manifest.helpers:
                shown["agent"] = " · ".join(
                    (agent["model"]["name"], agent["prompt"]["version"], agent["answer"])
                )
            if run.manifest.latency.speeds:
                shown["took_s"] = answer_s(run.speed(answer), answer)
            spans_read = _read_in(answer, run) if answer.repairs else []
            answers.append({**shown, "viewer": answer.key, "spans": spans_read, "prompt": asked})
        decisions: dict[str, dict[str, Any]] = {}  # seeds with the same decision share an entry
        for row, d in enumerate(run.decisions.records(rows.start, rows.stop), rows.start):
            shown = {**_shown(d), "end": str(self._ends[n][row])}
            decisions.setdefault(repr(shown), {**shown, "seeds": []})["seeds"].append(d.seed)
        ends = [_end(episode) for episode in self._episodes[n][self._episode_of[name]]]
        detail = {"answers": answers, "decisions": list(decisions.values()), "ends": ends}
        if left_out := self._left_out[n].get(name):
            detail |= {"left_out": left_out}
        return detail


def _shown(d: Decision) -> dict[str, Any]:
    plain = msgspec.to_builtins(d)
    return {key: value for key, value in plain.items() if key not in LEFT_OUT and not (
        value is None and key in ("acts_at_s", "acted")
    )}  # fmt: skip


def _read_in(answer: Answer, run: Run) -> list[tuple[int, int]]:
    """Where in a recovered completion its answers stand."""
    role = "helper" if answer.role in ("helper", "blind") else "ego"
    return spans(answer.raw, role, run.actions, run.agent(answer)["thinking"])


def _left_out(run: Run) -> dict[str, list[dict[str, Any]]]:
    """What was left out of each decision point that `harness attribute` drew, what moved most first."""
    of: dict[str, list[dict[str, Any]]] = {}
    if run.attribution:
        for each in sorted(run.attribution.left_out, key=lambda each: -(each.shift or 0.0)):
            plain = {**msgspec.to_builtins(each), "condition": run.attribution.condition}
            of.setdefault(each.scene, []).append(plain)
    return of


def _episodes(run: Run) -> dict[int, list[Episode]]:
    """The run's episodes by number: one of each condition and seed."""
    of: dict[int, list[Episode]] = {}
    for episode in run.episodes:
        of.setdefault(episode.episode, []).append(episode)
    return of


def _end(e: Episode) -> dict[str, Any]:
    """How an episode ended, for the page."""
    return {
        "condition": e.condition, "seed": e.seed, "result": e.failure or "cleared", "partner": e.partner,
        "striker": e.striker, "fault": e.fault, "time_s": e.time_s, "delay_s": e.delay_s,
        "least_gap_m": e.least_gap_m, "hard_brakings": e.hard_brakings, "other_crashes": e.other_crashes,
    }  # fmt: skip


def _ends(run: Run) -> Any:
    """What each decision led to, a letter a decision (n,); in the closed loop, what its episode came to."""
    d = run.decisions
    if run.world == "closed-loop":
        letters = {"": GOOD, "late": SLOW}
        return np.array([letters.get(e.failure, BAD) for e in run.episodes])[run.grid.places(d)]
    safe = np.where(np.nan_to_num(d["delay_s"]) > 0, SLOW, GOOD)
    return np.where(d.flags("value"), np.where(d.flags("safe"), safe, BAD), BLAMELESS)
