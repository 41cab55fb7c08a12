"""What a page shows of all decisions: an index that it lists and filters by,
and their details in parts.
"""

from collections.abc import Mapping, Sequence
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
    """Collect what a report page shows of every single scene, ordered by episode, step and agent.

    A scene is one decision point; an agent is a vehicle that decides there.

    Attributes:
        ids: ids of the scenes that any of the runs has.
        index: the data by which the page lists and filters scenes, as JSON values.
    """

    def __init__(self, runs: Runs, prompts: Prompts = prompts_of, full: bool = False) -> None:
        self._runs, self._full = runs, full
        places = _places(runs.runs)
        self.ids = list(places)
        failed = [failures(run) if runs.live else {} for run in runs.runs]
        if runs.dataset:
            for run in runs.runs:
                # decisions are checked where their trees are read
                check_scenes(run, runs.dataset, ())
        self._not_replayed = 0
        self._replayed = {} if runs.dataset else self._replayed_scenes(failed)
        framed = self._framed()
        remarks = [left_out(run) for run in runs.runs]
        self._details = Details(runs, self._replayed, framed, prompts, full, remarks)
        self.index = {
            "actions": runs.actions,
            "scenes": [[scene, *place] for scene, place in places.items()],
            "block": BLOCK,
            "live": runs.live,
            "framed": len(framed),
            "statuses": list(map(str, Status)),
            "runs": [self._indexed(n, list(scenes)) for n, scenes in enumerate(failed)],
        }

    def _replayed_scenes(self, failed: Sequence[dict[str, int]]) -> dict[str, Scene]:
        """Return by id the decision points of closed-loop runs that the page draws, played again.

        Those are missing that come out otherwise in this simulator; they are counted.
        """
        ids = dict[str, None]()
        for run, failures_of_run in zip(self._runs.runs, failed, strict=True):
            scenes = run.decisions.scenes if self._full else pick(run, failures_of_run, REPLAYED)
            ids |= dict.fromkeys(scenes)
        played = replayed(self._runs, list(ids))
        self._not_replayed = len(ids) - len(played)
        return played

    def _framed(self) -> frozenset[str]:
        """Return decision points that have cameras' pictures:
        where episodes are lost, then a sample.

        Models that see were shown them; of others a page has them only if it is to be full.
        """
        runs = self._runs.runs
        if self._full:
            return frozenset(self.ids)
        if not any(answer.image_sha256 for run in runs for answer in run.answers):
            return frozenset()
        most = FRAMES // (1 + max(run.decisions.helpers for run in runs))
        if self._runs.live:
            return frozenset(spread(list(self._replayed), most))
        lost_scenes = dict.fromkeys(scene for run in runs for scene in lost(run))
        first = spread(list(lost_scenes), most)
        picked = dict.fromkeys(scene for run in runs for scene in pick(run, {}, most))
        more = [scene for scene in picked if scene not in first]
        return frozenset((*first, *spread(more, most - len(first))))

    def _indexed(self, n: int, first_failures: Sequence[str]) -> dict[str, Any]:
        """Return one run's part of the index:
        a letter a scene, condition and seed, in this order.
        """
        run = self._runs.runs[n]
        place = {scene: position for position, scene in enumerate(self.ids)}
        index: dict[str, Any] = {
            "conditions": run.conditions,
            "seeds": run.manifest.seeds,
            **self._letters(n, place),
            "statuses": [self._statuses(run, scene) for scene in self.ids],
            "first": [place[scene] for scene in first_failures],
        }
        if len(self._runs.runs) > 1:
            index |= self._ego_answers(run)
        return index

    def _letters(self, n: int, place: Mapping[str, int]) -> dict[str, str]:
        """Return of each decision of a run its action, what it led to and whether helpers were
        asked, a text each.

        `place` is that of each scene in the index. Decisions that a run has not are `ABSENT`, and
        nobody was asked in them.
        """
        run = self._runs.runs[n]
        decisions = run.decisions
        conditions, seeds, episodes = run.grid.shape
        row = np.empty(len(decisions), dtype=int)
        for scene, rows in decisions.scenes.items():
            row[rows.start : rows.stop] = place[scene]
        column = run.grid.places(decisions) // episodes
        digits = np.array([str(code) for code in range(len(run.actions))])
        letters = {
            "acted": (digits[decisions.codes("action", run.actions)], ABSENT),
            "ended": (self._details.ends[n], ABSENT),
            "asked": (np.where(decisions.flags("triggered"), "1", "0"), "0"),
        }
        texts = {}
        for name, (values, absent) in letters.items():
            table = np.full((len(self.ids), conditions * seeds), absent)
            table[row, column] = values
            texts[name] = "".join(table.ravel().tolist())
        return texts

    def _statuses(self, run: Run, scene: str) -> int:
        """Return which statuses the answers of a scene have, a bit for each, the first lowest."""
        statuses = list(map(str, Status))
        of_scene = {answer.status for answer in run.answers_by_scene.get(scene, ())}
        return sum(1 << statuses.index(status) for status in of_scene if status in statuses)

    def _ego_answers(self, run: Run) -> dict[str, Any]:
        """Return the ego's own answers, to be read beside those of other runs.

        `said` has a letter a scene, the likeliest action; `sure` its probability in percent.
        """
        letters, percents = list[str](), list[int]()
        for scene in self.ids:
            answers = run.answers_by_scene.get(scene, ())
            answer = next((answer for answer in answers if answer.role == "ego"), None)
            if answer is None or not answer.intent:
                letters.append(ABSENT if answer is None else UNREAD)
                percents.append(0)
            else:
                largest = max(answer.intent)
                letters.append(str(answer.intent.index(largest)))
                percents.append(round(100 * min(largest, 1.0)))
        return {"said": "".join(letters), "sure": percents}

    def lacks(self) -> dict[str, str]:
        """Return why the page lacks the prompts or pictures of some scenes: sentences by word.

        The words are `prompts` and `pictures`; what lacks nothing has none.
        """
        lacks = {}
        if unknown := self._details.without_prompts():
            lacks["prompts"] = lacking(unknown[0]) or "they are not known"
        if self._not_replayed:
            lacks["pictures"] = (
                f"{self._not_replayed} decision points come out otherwise in this simulator"
            )
        return lacks

    def parts(self) -> list[Part]:
        """Return the page's details of all scenes as chunks of `AT_ONCE` scenes, not yet prepared.

        Details of many scenes take long to prepare and compress, so each chunk can be given to a
        process of its own (`Part.packed`). A scene is one decision point, with its world, answers
        and decisions.
        """
        starts = range(0, len(self.ids), AT_ONCE)
        return [Part(self._details, self.ids[start : start + AT_ONCE]) for start in starts]


def _places(runs: Sequence[Run]) -> dict[str, tuple[int | str | None, ...]]:
    """Return by scene its episode, step and danger, in order of episode, step and agent.

    Where several agents decide, who does comes last.
    """
    places: dict[str, tuple[int, int, str | None, str | None]] = {}
    for run in reversed(runs):
        scenes = run.decisions.scenes
        columns = run.decisions.selected(["episode", "step", "danger", "agent"])
        firsts = columns.take([rows.start for rows in scenes.values()])
        for row, scene in enumerate(scenes):
            of_scene = firsts.row(row)
            places[scene] = tuple(of_scene.values())

    def order(scene: str) -> tuple[int, int, str, str]:
        number, step, _, agent = places[scene]
        return number, step, agent or "", scene

    ordered = {scene: places[scene] for scene in sorted(places, key=order)}
    if any(agent for *_, agent in places.values()):
        return dict(ordered)
    return {scene: place[:3] for scene, place in ordered.items()}


def replayed(runs: Runs, names: Sequence[str]) -> dict[str, Scene]:
    """Return decision points of closed-loop runs by id, simulated again to know their full state.

    A decision point is a scene in which decisions are due; `names` are their ids. Points that come
    out otherwise in this simulator are missing.
    """
    from harness.evaluate.replay import scenes_of  # loads the simulator

    names_of: dict[int, list[str]] = {}  # by the place of the run that is played again
    for name in names:
        places = [n for n, run in enumerate(runs.runs) if name in run.decisions.scenes]
        # A run without helpers, such as a driver's, has fewer viewers.
        most_viewers = max(places, key=lambda n: runs.runs[n].decisions.helpers)
        names_of.setdefault(most_viewers, []).append(name)
    scenes = {}
    for place, names_of_run in names_of.items():
        played = scenes_of(runs.runs[place], names_of_run)
        for name, scene in zip(names_of_run, played, strict=True):
            if scene.id == name:
                scenes[name] = scene
    return {name: scenes[name] for name in names if name in scenes}


def failures(run: Run) -> dict[str, int]:
    """Return the decision points at which a closed-loop run's layouts begin to fail.

    Each is given by its id, with a channel seed under which it is so. A layout is one drawn start
    situation; it begins to fail at the last decision point that its failed episodes share with one
    that succeeded, or if all fail, at the last of its first episode. With several agents (vehicles
    that decide), there is one for each that decides then. In closed loop a simulator plays the
    episodes.
    """
    decisions = run.decisions
    failed = np.array([not episode.success for episode in run.episodes])
    failed = failed[run.grid.places(decisions)]
    seeds, episodes = decisions.whole("seed"), decisions.whole("episode")
    steps, agents = decisions.whole("step"), decisions.labels("agent")
    # By episode: whether others do not fail from there, and the step; by agent, its scene and seed.
    latest: dict[int, tuple[bool, int]] = {}
    beginnings: dict[int, dict[str | None, tuple[str, int]]] = {}
    for scene, rows in decisions.scenes.items():
        of_scene = failed[rows.start : rows.stop]
        if not of_scene.any():
            continue
        episode = int(episodes[rows.start])
        rank = (not of_scene.all(), int(steps[rows.start]))
        if episode not in latest or rank > latest[episode]:
            latest[episode] = rank
            beginnings[episode] = {}
        if rank == latest[episode]:
            seed = int(seeds[rows.start + int(of_scene.argmax())])
            beginnings[episode][agents[rows.start]] = scene, seed
    return dict(pair for by_agent in beginnings.values() for pair in by_agent.values())


def pick(run: Run, failed: dict[str, int], n: int) -> list[str]:
    """Return the ids of up to n scenes of a run that a page shows, those worth looking at first.

    Up to a quarter each are scenes where an episode begins to fail (the keys of `failed`, as
    `failures` returns them), where conditions act differently, and with an answer that was repaired
    or failed to parse; the rest is evenly spaced. The choice is always the same, and in order. A
    condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages.
    """
    decisions = run.decisions
    action, seeds = decisions.codes("action", run.actions), decisions.whole("seed")
    disagreements, repaired = [], []
    for scene, rows in decisions.scenes.items():
        seeds_of_scene = seeds[rows.start : rows.stop]
        with_seed = seeds_of_scene == failed.get(scene, int(seeds[rows.start]))
        actions = set(action[rows.start : rows.stop][with_seed].tolist())
        if len(actions) > 1:
            disagreements.append(scene)
        if any(answer.verdict != "strict" for answer in run.answers_by_scene.get(scene, ())):
            repaired.append(scene)
    chosen: list[str] = []
    quarter = n // 4
    kinds = [(list(failed), quarter), (disagreements, quarter), (repaired, quarter)]
    for scenes, room in [*kinds, (list(decisions.scenes), n)]:
        left = [scene for scene in scenes if scene not in chosen]
        chosen += spread(left, min(room, n - len(chosen)))
    return [scene for scene in decisions.scenes if scene in chosen]


def lost(run: Run) -> list[str]:
    """Return the ids of the scenes, of a run on recorded ones, where a decision gave success away.

    Before that decision success was still possible, after it no more.
    """
    regret = np.nan_to_num(run.decisions["regret"]) == 1.0
    scenes = run.decisions.scenes
    return [scene for scene, rows in scenes.items() if regret[rows.start : rows.stop].any()]


def spread(items: Sequence[str], n: int) -> list[str]:
    """Return up to n of the items, evenly spaced, beginning with the first."""
    n = min(n, len(items))
    return [items[k * len(items) // n] for k in range(n)]
