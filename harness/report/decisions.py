"""What a page shows of all decisions: an index that it lists and filters by,
and their details in parts.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from harness.dataset.load import Scene
from harness.parsing.status import Status
from harness.report.details import BLOCK, Details, Part, Prompts, prompts_of
from harness.report.remarks import left_out
from harness.report.runs import Runs
from harness.runs.folder import Run
from harness.runs.run_dataset import check_scenes
from harness.runs.sources import lacking

AT_ONCE = 32 * BLOCK  # scenes of a part, which are in memory together
FRAMES = 400  # cameras' pictures in a page, each some 3.5 kB of it
# decision points of a closed-loop run that are replayed, for their picture and prompts
REPLAYED = 60
ABSENT, UNREAD = "-", "?"


class Decisions:
    """Everything that runs have to say of single scenes, in order of episode, step and agent.

    Attributes:
        ids: of the scenes that any run has.
        index: what the list shows and filters by, for the page.
    """

    def __init__(self, runs: Runs, prompts: Prompts = prompts_of, full: bool = False) -> None:
        self._runs, self._full = runs, full
        places: dict[str, tuple[int, int, str | None, str | None]] = {}
        for run in reversed(runs.runs):
            episode, step = run.decisions.whole("episode"), run.decisions.whole("step")
            danger, agent = run.decisions.labels("danger"), run.decisions.labels("agent")
            for scene, rows in run.decisions.scenes.items():
                at = rows.start
                places[scene] = int(episode[at]), int(step[at]), danger[at], agent[at]
        order = sorted(places.items(), key=lambda item: (*item[1][:2], item[1][3] or "", item[0]))
        # else a scene has no place for who decides
        several = any(agent for *_, agent in places.values())
        self.ids = [scene for scene, _ in order]
        failed = [failures(run) if runs.live else {} for run in runs.runs]
        if runs.dataset:
            for run in runs.runs:
                # decisions are checked where their trees are read
                check_scenes(run, runs.dataset, ())
        self._not_replayed = 0
        self._replayed = {} if runs.dataset else self._played(failed)
        framed = self._telling()
        self._details = Details(
            runs, self._replayed, framed, prompts, full, [*map(left_out, runs.runs)]
        )
        self.index = {
            "actions": runs.actions,
            "scenes": [[scene, *(place if several else place[:3])] for scene, place in order],
            "block": BLOCK,
            "live": runs.live,
            "framed": len(framed),
            "statuses": list(map(str, Status)),
            "runs": [self._indexed(n, list(of)) for n, of in enumerate(failed)],
        }

    def _played(self, failed: Sequence[dict[str, int]]) -> dict[str, Scene]:
        """Return the telling decision points, replayed;
        none where this simulator differs from the run's.
        """
        telling = dict.fromkeys(
            scene
            for run, of in zip(self._runs.runs, failed, strict=True)
            for scene in (run.decisions.scenes if self._full else pick(run, of, REPLAYED))
        )
        scenes = replayed(self._runs, list(telling))
        self._not_replayed = len(telling) - len(scenes)
        return scenes

    def _telling(self) -> frozenset[str]:
        """Return decision points that have cameras' pictures:
        where episodes are lost, then a sample.

        Models that see were shown them; of others a page has them only if it is to be full.
        """
        if self._full:
            return frozenset(self.ids)
        if not any(answer.image_sha256 for run in self._runs.runs for answer in run.answers):
            return frozenset()
        most = FRAMES // (1 + max(run.decisions.helpers for run in self._runs.runs))
        if self._runs.live:
            return frozenset(spread(list(self._replayed), most))
        runs = self._runs.runs
        first = spread(list(dict.fromkeys(scene for run in runs for scene in lost(run))), most)
        more = dict.fromkeys(
            scene for run in runs for scene in pick(run, {}, most) if scene not in first
        )
        return frozenset((*first, *spread(list(more), most - len(first))))

    def _indexed(self, n: int, first_failures: Sequence[str]) -> dict[str, Any]:
        """Return one run's part of the index:
        a letter a scene, condition and seed, in this order.
        """
        run = self._runs.runs[n]
        d, shape = run.decisions, run.grid.shape[:2]
        place = {scene: position for position, scene in enumerate(self.ids)}
        of_scene = np.empty(len(d), dtype=int)
        for scene, rows in d.scenes.items():
            of_scene[rows.start : rows.stop] = place[scene]
        of_run = run.grid.places(d) // run.grid.shape[2]
        letters = {
            "acted": np.array(list(map(str, range(len(run.actions)))))[
                d.codes("action", run.actions)
            ],
            "ended": self._details.ends[n],
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
            "conditions": run.conditions,
            "seeds": run.manifest.seeds,
            **index,
            "statuses": [sum(1 << statuses.index(s) for s in of if s in statuses) for of in met],
            "first": [place[scene] for scene in first_failures],
            **(self._own(run) if len(self._runs.runs) > 1 else {}),
        }

    def _own(self, run: Run) -> dict[str, Any]:
        """Return the ego's own answers, to be read beside those of other runs.

        `said` has a letter a scene, the likeliest action; `sure` its probability in percent.
        """
        own = [
            next(
                (answer for answer in run.answers_by_scene.get(scene, ()) if answer.role == "ego"),
                None,
            )
            for scene in self.ids
        ]
        intents = [answer.intent if answer else None for answer in own]
        likeliest = [str(intent.index(max(intent))) if intent else UNREAD for intent in intents]
        return {
            "said": "".join(
                letter if answer else ABSENT for letter, answer in zip(likeliest, own, strict=True)
            ),
            "sure": [round(100 * min(max(intent), 1.0)) if intent else 0 for intent in intents],
        }

    def lacks(self) -> dict[str, str]:
        """Return what these scenes could show and do not, in a word, and why."""
        lacks = {}
        if unknown := self._details.without_prompts():
            lacks["prompts"] = lacking(unknown[0]) or "they are not known"
        if self._not_replayed:
            lacks["pictures"] = (
                f"{self._not_replayed} decision points come out otherwise in this simulator"
            )
        return lacks

    def parts(self) -> list[Part]:
        return [
            Part(self._details, self.ids[at : at + AT_ONCE])
            for at in range(0, len(self.ids), AT_ONCE)
        ]


def replayed(runs: Runs, names: Sequence[str]) -> dict[str, Scene]:
    """Return decision points of closed-loop runs, played again;
    those are missing that end elsewhere here.
    """
    from harness.evaluate.replay import scenes_of  # loads the simulator

    of_run: dict[int, list[str]] = {}
    for name in names:
        here = [n for n, run in enumerate(runs.runs) if name in run.decisions.scenes]
        # A run without helpers, such as a driver's, has fewer viewers.
        of_run.setdefault(max(here, key=lambda n: runs.runs[n].decisions.helpers), []).append(name)
    scenes = {
        name: scene
        for n, mine in of_run.items()
        for name, scene in zip(mine, scenes_of(runs.runs[n], mine), strict=True)
        if scene.id == name
    }
    return {name: scenes[name] for name in names if name in scenes}


def failures(run: Run) -> dict[str, int]:
    """Return decision points at which a driven layout begins to fail,
    and the seed with which it does.

    It is the last that a layout's failed episodes share with one that did not fail; where all of
    them fail, the last of the first. With several agents it is one of each that decides in that
    step.
    """
    d = run.decisions
    failed = np.array([not episode.success for episode in run.episodes])[run.grid.places(d)]
    seeds, episodes, steps, agents = (
        d.whole("seed"),
        d.whole("episode"),
        d.whole("step"),
        d.labels("agent"),
    )
    telling: dict[int, tuple[bool, int, dict[str | None, tuple[str, int]]]] = {}
    for scene, rows in d.scenes.items():
        here = failed[rows.start : rows.stop]
        number = int(episodes[rows.start])
        if here.any():
            parts, step = not here.all(), int(steps[rows.start])
            if number not in telling or (parts, step) > telling[number][:2]:
                telling[number] = parts, step, {}
            if (parts, step) == telling[number][:2]:
                found = scene, int(seeds[rows.start + int(here.argmax())])
                telling[number][2][agents[rows.start]] = found
    return dict(each for *_, by_agent in telling.values() for each in by_agent.values())


def pick(run: Run, failed: dict[str, int], n: int) -> list[str]:
    """Choose up to n decision points, in their order; the same run always gives the same choice.

    Up to a quarter each are: failures; conditions that act differently with the seed that shows a
    failure, or the first; answers that were recovered or failed. The rest is spread evenly. Where
    one kind is scarce, the sample is larger.
    """
    d = run.decisions
    action, seeds = d.codes("action", run.actions), d.whole("seed")
    disagreement, answer = [], []
    for scene, rows in d.scenes.items():
        mine = seeds[rows.start : rows.stop] == failed.get(scene, int(seeds[rows.start]))
        if len(set(action[rows.start : rows.stop][mine].tolist())) > 1:
            disagreement.append(scene)
        if any(a.verdict != "strict" for a in run.answers_by_scene.get(scene, ())):
            answer.append(scene)
    chosen: list[str] = []
    for kind, room in (
        (list(failed), n // 4),
        (disagreement, n // 4),
        (answer, n // 4),
        (list(d.scenes), n),
    ):
        left = [scene for scene in kind if scene not in chosen]
        chosen += spread(left, min(room, n - len(chosen)))
    return [scene for scene in d.scenes if scene in chosen]


def lost(run: Run) -> list[str]:
    """Decision points of a frozen run whose action, with some seed and condition,
    gives success away.
    """
    regret = np.nan_to_num(run.decisions["regret"]) == 1.0
    return [
        scene
        for scene, rows in run.decisions.scenes.items()
        if regret[rows.start : rows.stop].any()
    ]


def spread(items: Sequence[str], n: int) -> list[str]:
    """Return up to n of the items, evenly spaced, the first among them."""
    n = min(n, len(items))
    return [items[k * len(items) // n] for k in range(n)]
