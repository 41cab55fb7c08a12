"""Which decision points of a run tell most: where episodes are lost, then a sample."""

from collections.abc import Sequence

import numpy as np

from harness.runs.folder import Run


def failures(run: Run) -> dict[str, int]:
    """Return decision points at which a driven layout begins to fail, and the seed with which it does.

    It is the last that a layout's failed episodes share with one that did not fail; where all of them fail,
    the last of the first.
    """
    d = run.decisions
    failed = np.array([not episode.success for episode in run.episodes])[run.grid.places(d)]
    seeds, episodes = d.whole("seed"), d.whole("episode")
    telling: dict[int, tuple[bool, str, int]] = {}
    for scene, rows in d.scenes.items():
        here = failed[rows.start : rows.stop]
        number = int(episodes[rows.start])
        if here.any():
            parts = not here.all()
            if number not in telling or parts >= telling[number][0]:
                telling[number] = parts, scene, int(seeds[rows.start + int(here.argmax())])
    return {scene: seed for _, scene, seed in telling.values()}


def pick(run: Run, failed: dict[str, int], n: int) -> list[str]:
    """Choose up to n decision points, in their order; the same run always gives the same choice.

    Up to a quarter each are: failures; conditions that act differently with the seed that shows a failure, or
    the first; answers that were recovered or failed. The rest is spread evenly. Where one kind is scarce, the
    sample is larger.
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
    for kind, room in ((list(failed), n // 4), (disagreement, n // 4), (answer, n // 4), (list(d.scenes), n)):
        left = [scene for scene in kind if scene not in chosen]
        chosen += spread(left, min(room, n - len(chosen)))
    return [scene for scene in d.scenes if scene in chosen]


def lost(run: Run) -> list[str]:
    """Decision points of a frozen run whose action, with some seed and condition, gives success away."""
    regret = np.nan_to_num(run.decisions["regret"]) == 1.0
    return [scene for scene, rows in run.decisions.scenes.items() if regret[rows.start : rows.stop].any()]


def spread(items: Sequence[str], n: int) -> list[str]:
    """Return up to n of the items, evenly spaced, the first among them."""
    n = min(n, len(items))
    return [items[k * len(items) // n] for k in range(n)]
