"""Which decisions a report shows: the telling ones first, and then an even sample of the rest."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from harness.run.folder import Row

FAILURE, DISAGREEMENT, ANSWER, SAMPLE = (
    "first failure",
    "conditions disagree",
    "answer not strict",
    "even sample",
)


class Pick(NamedTuple):
    """A decision to show, and why."""

    row: Row
    why: str


def decisions_of(row: Row) -> list[dict[str, Any]]:
    """The row's decisions of its first seed, one a condition."""
    return [d for d in row["decisions"] if d["seed"] == row["decisions"][0]["seed"]]


def pick(rows: Sequence[Row], n: int) -> list[Pick]:
    """Choose up to n rows, kept in their order; the same rows always give the same choice.

    Up to a quarter each are: an episode's first action that is unsafe where another was safe; conditions
    that act differently; answers that were recovered or failed. The rest is spread evenly. Where one kind is
    scarce, the sample is larger.
    """
    episodes: set[int] = set()
    kinds: dict[str, list[int]] = {FAILURE: [], DISAGREEMENT: [], ANSWER: [], SAMPLE: list(range(len(rows)))}
    for i, row in enumerate(rows):
        decisions = decisions_of(row)
        avoidable = any(row["safe"])
        if avoidable and row["episode"] not in episodes and not all(d["safe"] for d in decisions):
            episodes.add(row["episode"])
            kinds[FAILURE].append(i)
        if len({d["action"] for d in decisions}) > 1:
            kinds[DISAGREEMENT].append(i)
        if any(answer["verdict"] != "strict" for answer in row["answers"].values()):
            kinds[ANSWER].append(i)
    why: dict[int, str] = {}
    for kind, candidates in kinds.items():
        left = [i for i in candidates if i not in why]
        room = n - len(why) if kind == SAMPLE else n // 4
        why |= dict.fromkeys(_spread(left, room), kind)
    return [Pick(rows[i], why[i]) for i in sorted(why)]


def _spread(items: Sequence[int], n: int) -> list[int]:
    """Up to n of the items, evenly spaced, the first among them."""
    n = min(n, len(items))
    return [items[k * len(items) // n] for k in range(n)]
