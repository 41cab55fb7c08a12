"""No sentence names a winner that cannot be told apart from the next."""

from collections.abc import Mapping

import numpy as np
import pytest

from harness.core.arrays import Floats
from harness.core.figures import some_of
from harness.extensions.trust.bench import BASE, PEACE, Bench, Cell
from harness.extensions.trust.page import headline
from harness.runs.success import Success

EPISODES = 60
PLAIN = Success(np.zeros(EPISODES, dtype=bool))


def won(n: int) -> Floats:
    """Success of one seed in the first n episodes, (1, E)."""
    return (np.arange(EPISODES) < n)[None].astype(float)


def test_the_most_stands_alone_only_where_the_difference_is_clear() -> None:
    assert PLAIN.most({"a": won(10), "b": won(50), "c": won(20)}) == ["b"]
    assert PLAIN.most({"a": won(49), "b": won(50), "c": won(20)}) == ["b", "a"]
    assert PLAIN.most({"a": won(50), "b": won(50)}) == ["a", "b"], "equals have no p"
    assert PLAIN.most({"a": won(7)}) == ["a"]


def test_the_best_of_many_has_to_be_clearer_than_the_best_of_two() -> None:
    """What p lets stand for one pair does not stand for one picked of many."""
    two = {"a": won(44), "b": won(50)}
    assert PLAIN.p_value(*two.values()) is not None
    assert PLAIN.most(two) == ["b"]
    many = two | {f"bad-{n}": won(n) for n in range(12)}
    assert PLAIN.most(many) == ["b", "a"]


@pytest.mark.parametrize(
    ("names", "said"),
    [("a", "a"), ("ab", "a and b"), ("abc", "a, b and c"), ("abcde", "a, b, c and 2 more")],
)
def test_a_few_names_are_listed(names: str, said: str) -> None:
    assert some_of(list(names)) == said


def bench(won_under: Mapping[tuple[str, str], int]) -> Bench:
    """Rules that succeed in so many episodes, by rule and attack; in peace in all."""
    rules = dict.fromkeys(rule for rule, _ in won_under)
    cells = {(rule, attack, 0.5): cell(rule, attack, n) for (rule, attack), n in won_under.items()}
    cells |= {(rule, PEACE, 0.0): cell(rule, PEACE, EPISODES) for rule in rules}
    return Bench("proxy", "made up", "6g", (0,), cells, won(30), PLAIN)


def cell(rule: str, attack: str, n: int) -> Cell:
    return Cell(rule, attack, 0.5, won(n), won(0), won(0), None, ())


def test_trust_names_the_rule_and_the_attack_that_are_clear() -> None:
    clear = {(BASE, "liar"): 5, (BASE, "stale"): 40, ("trust", "liar"): 55, ("trust", "stale"): 58}
    said = " ".join(headline(bench(clear)))
    assert "liar harms the linear pool most: success is 8.3 [" in said
    assert "On average over all 2 attacks, trust has the most, 94.2 [" in said


def test_trust_names_none_where_its_numbers_do_not_tell() -> None:
    near = {(BASE, "liar"): 50, (BASE, "stale"): 51, ("trust", "liar"): 51, ("trust", "stale"): 52}
    said = " ".join(headline(bench(near)))
    assert "no attack clearly harms the linear pool most: success is 83.3 [" in said
    assert "these attacks cannot be told apart there: liar and stale." in said
    assert "no rule clearly has the most: it is 85.8 [" in said
    assert "these rules cannot be told apart there: trust and linear." in said
    assert "has the most, " not in said
