"""Which decisions a report shows."""

from hypothesis import given
from hypothesis import strategies as st

from harness.report import choose
from harness.runs.folder import Run


def pick(rows, n):
    return choose.pick(rows, choose.failures(Run(None, {}, (), rows)), n)


def row(episode, actions=("IDLE", "IDLE"), safe=(True, True), verdict="strict", avoidable=True):
    """A decision point in two conditions."""
    return {
        "episode": episode,
        "safe": [avoidable, False, False],
        "answers": {"v1": {"verdict": verdict}},
        "decisions": [
            {"condition": str(n), "seed": 0, "action": a, "safe": s}
            for n, (a, s) in enumerate(zip(actions, safe, strict=True))
        ],
    }


def test_telling_decisions_come_with_the_reason_and_an_even_sample_fills_up():
    rows = [row(n) for n in range(100)]
    rows[10] = row(10, safe=(True, False))
    rows[20] = row(20, actions=("IDLE", "SLOWER"))
    rows[30] = row(30, verdict="recovered")
    rows[31] = row(31, verdict="failed")
    chosen = pick(rows, 8)
    why = {c.row["episode"]: c.why for c in chosen if c.why != "even sample"}
    assert why == {
        10: "first failure",
        20: "conditions disagree",
        30: "answer not strict",
        31: "answer not strict",
    }
    assert [c.row["episode"] for c in chosen if c.why == "even sample"] == [0, 26, 52, 76]


def test_only_the_first_failure_of_an_episode_is_one_and_none_where_nothing_was_safe():
    rows = [row(1, safe=(False, False), avoidable=False)] + [row(1, safe=(False, False))] * 2 + [row(2)] * 2
    assert [c.why == "first failure" for c in pick(rows, 5)] == [False, True, False, False, False]


def test_a_run_full_of_failures_still_shows_ordinary_decisions():
    rows = [row(n, safe=(n > 50, True)) for n in range(100)]
    assert [c.why for c in pick(rows, 40)].count("first failure") == 10


ROWS = st.lists(
    st.builds(
        row,
        st.integers(0, 5),
        st.tuples(*[st.sampled_from(["IDLE", "SLOWER"])] * 2),
        st.tuples(st.booleans(), st.booleans()),
        st.sampled_from(["strict", "recovered", "failed"]),
        st.booleans(),
    ),
    max_size=40,
)


@given(ROWS, st.integers(4, 50))
def test_as_many_as_asked_for_each_once_in_the_runs_order_and_always_the_same(rows, n):
    chosen = [id(c.row) for c in pick(rows, n)]
    order = [id(r) for r in rows]
    assert chosen == sorted(set(chosen), key=order.index)
    assert len(chosen) == min(n, len(rows))
    assert chosen == [id(c.row) for c in pick(rows, n)]
