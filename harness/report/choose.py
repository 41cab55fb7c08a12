"""Which rows of a run tell most: where episodes begin to fail, others of note, and then an even sample."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from harness.runs.driven_folder import Driven
from harness.runs.folder import Row, Run, answers_of

FAILURE, DISAGREEMENT, ANSWER, SAMPLE = (
    "first failure",
    "conditions disagree",
    "answer not strict",
    "even sample",
)


class Pick(NamedTuple):
    """A row, the seed of the channel under which it tells, and why it was chosen."""

    row: Row
    seed: int
    why: str


def decisions_of(row: Row, seed: int) -> list[dict[str, Any]]:
    """The row's decisions of one seed, one a condition."""
    return [d for d in row["decisions"] if d["seed"] == seed]


def failures(run: Run) -> dict[int, int]:
    """Rows in which an episode begins to fail, and the seed with which it does."""
    return _wrecks(run) if isinstance(run, Driven) else _unsafe(run.rows)


def _unsafe(rows: Sequence[Row]) -> dict[int, int]:
    """Each episode's first action of the run's first seed that is unsafe where another was safe."""
    found: dict[int, int] = {}
    episodes: set[int] = set()
    for i, row in enumerate(rows):
        seed = _first_seed(row)
        bad = any(row["safe"]) and not all(d["safe"] for d in decisions_of(row, seed))
        if bad and row["episode"] not in episodes:
            episodes.add(row["episode"])
            found[i] = seed
    return found


def _wrecks(run: Driven) -> dict[int, int]:
    """The last moment that a layout's failed episodes have in common with one that did not fail.

    Where all episodes of a layout fail, it is the last moment of the first of them.
    """
    telling: dict[int, tuple[bool, int, int]] = {}
    for i, row in enumerate(run.rows):
        number = row["episode"]
        ends = {
            (d["condition"], d["seed"]): run.ends[d["condition"], d["seed"], number]["result"]
            for d in row["decisions"]
        }
        failed = [seed for (_, seed), result in ends.items() if result != "cleared"]
        if failed:
            parts = len(failed) < len(ends)
            if number not in telling or parts >= telling[number][0]:
                telling[number] = parts, i, failed[0]
    return {i: seed for _, i, seed in telling.values()}


def _first_seed(row: Row) -> int:
    return int(row["decisions"][0]["seed"])


def pick(rows: Sequence[Row], failed: Mapping[int, int], n: int) -> list[Pick]:
    """Choose up to n rows, kept in their order; the same rows always give the same choice.

    Up to a quarter each are: failures, each with the seed that shows it; conditions that act differently;
    answers that were recovered or failed. The rest is spread evenly. Where one kind is scarce, the sample is
    larger.
    """
    seeds = [failed.get(i, _first_seed(row)) for i, row in enumerate(rows)]
    kinds: dict[str, list[int]] = {
        FAILURE: list(failed),
        DISAGREEMENT: [],
        ANSWER: [],
        SAMPLE: list(range(len(rows))),
    }
    for i, row in enumerate(rows):
        if len({d["action"] for d in decisions_of(row, seeds[i])}) > 1:
            kinds[DISAGREEMENT].append(i)
        if any(a["verdict"] != "strict" for a in answers_of(row).values()):
            kinds[ANSWER].append(i)
    why: dict[int, str] = {}
    for kind, candidates in kinds.items():
        left = [i for i in candidates if i not in why]
        room = n - len(why) if kind == SAMPLE else n // 4
        why |= dict.fromkeys(_spread(left, room), kind)
    return [Pick(rows[i], seeds[i], why[i]) for i in sorted(why)]


def _spread(items: Sequence[int], n: int) -> list[int]:
    """Up to n of the items, evenly spaced, the first among them."""
    n = min(n, len(items))
    return [items[k * len(items) // n] for k in range(n)]
