"""Which decisions a report shows."""

from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from run_on_disk import made_up

from harness.coordination.named_points import POINTS
from harness.report import decisions
from harness.runs.folder import read


def point(actions=("IDLE", "IDLE"), safe=(True, True), verdict="strict"):
    """A decision point in two conditions; an episode fails where one of its points is not safe."""
    return actions, safe, verdict


def run_of(out, episodes):
    """A driven run of episodes, each a list of decision points, all as long."""
    points = {
        f"{e:05d}-{step}": p for e, course in enumerate(episodes) for step, p in enumerate(course)
    }
    conditions = ("single-local", "6g")

    def decision(row):
        row["action"] = points[row["scene"]][0][conditions.index(row["condition"])]

    def episode(row):
        place = conditions.index(row["condition"])
        if not all(safe[place] for _, safe, _ in episodes[row["episode"]]):
            row |= {"success": False, "failure": "collision"}

    def answer(row):
        row["verdict"] = points[row["scene"]][2]

    return read(made_up(
        out, decision, episode, answer, closed_loop=True, points=[POINTS[name] for name in conditions],
        seeds=(0,), episodes=len(episodes), steps=len(episodes[0]), helpers=0,
    ))  # fmt: skip


def pick(run, n):
    """Episode and step of what is chosen."""
    return [
        tuple(map(int, scene.split("-")))
        for scene in decisions.pick(run, decisions.failures(run), n)
    ]


def test_telling_decisions_are_chosen_and_an_even_sample_fills_up(tmp_path):
    episodes = [[point()] for _ in range(100)]
    failure, disagreement, recovered, failed = 10, 20, 30, 31
    episodes[failure] = [point(safe=(True, False))]
    episodes[disagreement] = [point(actions=("IDLE", "SLOWER"))]
    episodes[recovered] = [point(verdict="recovered")]
    episodes[failed] = [point(verdict="failed")]
    chosen = [episode for episode, _ in pick(run_of(tmp_path / "run", episodes), 8)]
    telling, sample = {failure, disagreement, recovered, failed}, {0, 26, 52, 76}
    assert chosen == sorted(telling | sample)


def test_a_layout_begins_to_fail_where_its_failed_episodes_leave_those_that_did_not(tmp_path):
    parted = [point(), point(safe=(False, True)), point()]
    all_fail = [point(safe=(False, False)), point(), point()]
    run = run_of(tmp_path / "run", [parted, all_fail, [point()] * 3])
    assert decisions.failures(run) == {"00000-2": 0, "00001-2": 0}


def test_a_run_full_of_failures_still_shows_ordinary_decisions(tmp_path):
    run = run_of(tmp_path / "run", [[point(safe=(n > 50, True))] for n in range(100)])
    failures = decisions.failures(run)
    assert len(failures) == 51
    chosen = decisions.pick(run, failures, 40)
    # A quarter are chosen as failures, and 30 are spread over the other 90, of which 49 are
    # ordinary.
    assert set(decisions.spread(list(failures), 10)) <= set(chosen)
    assert len([scene for scene in chosen if scene not in failures]) == 16


def test_a_decision_lost_an_episode_where_any_condition_with_any_seed_gave_success_away(tmp_path):
    def decision(row):
        row["regret"] = (row["scene"], row["condition"]) == ("00001-1", "6g")
        row["value"] = row["scene"] != "00002-0"  # nothing was left to lose, so regret is not known

    points = [POINTS[name] for name in ("single-local", "6g")]
    run = read(
        made_up(
            tmp_path / "run", decision, points=points, seeds=(0, 1), episodes=3, steps=2, helpers=0
        )
    )
    assert decisions.lost(run) == ["00001-1"]


POINTS_AS_DRAWN = st.builds(
    point,
    st.tuples(*[st.sampled_from(["IDLE", "SLOWER"])] * 2),
    st.tuples(st.booleans(), st.booleans()),
    st.sampled_from(["strict", "recovered", "failed"]),
)
EPISODES = st.integers(1, 8).flatmap(
    lambda steps: st.lists(
        st.lists(POINTS_AS_DRAWN, min_size=steps, max_size=steps), min_size=1, max_size=5
    )
)


@pytest.mark.slow
@settings(max_examples=8)  # each writes a run
@given(EPISODES, st.integers(4, 50))
def test_as_many_as_asked_for_each_once_in_the_runs_order_and_always_the_same(episodes, n):
    with TemporaryDirectory() as folder:
        run = run_of(Path(folder) / "run", episodes)
        chosen = pick(run, n)
        assert chosen == sorted(set(chosen))
        assert len(chosen) == min(n, sum(map(len, episodes)))
        assert chosen == pick(run, n)
