"""Layouts of one recording are one cluster: intervals count recordings in their place."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from run_on_disk import Row, made_up

from harness.core.arrays import Floats, Ints
from harness.core.errors import UserError
from harness.core.statistics import (
    FEWEST,
    Estimate,
    cluster_numbers,
    episode_interval,
    joined_clusters,
    mean_of,
    paired_difference,
    paired_reach,
    rate_interval,
    resampled,
    resampled_estimate,
    too_few,
    units_of,
    wilson,
)
from harness.report.caveats import clustered, few
from harness.report.compare.difference import compare
from harness.report.compare.gate import gate, judge
from harness.report.compare.pair import pair
from harness.report.matrix import lines
from harness.report.panels import errors, reliability
from harness.report.plan import from_pilots
from harness.report.runs import Runs
from harness.runs import listing, pinned
from harness.runs.contradictions import sound
from harness.runs.folder import Run, read
from harness.runs.metric_names import GAIN
from harness.runs.success import (
    Success,
    clusters_of,
    half_difference,
    mean_difference,
    of_families,
)
from harness.runs.suite import SuiteRun, write

NONE = np.zeros(6, dtype=bool)


def test_clusters_are_numbered_as_they_come_and_none_is_told_where_each_layout_is_its_own() -> None:
    numbered = cluster_numbers(["b", "a", None, "b", None])
    assert numbered is not None
    assert numbered.tolist() == [0, 1, 2, 0, 3]
    values = np.array([7, 7, 2, 4])
    assert units_of(values, (4, 2, 7), np.array([0, 0, 1])).tolist() == [1, 1, 0, 0]
    assert units_of(values, (4, 2, 7), None) is values
    parts = cluster_numbers(["a + b", "c", "b + d", "d", None])
    assert parts is not None
    assert parts.tolist() == [0, 1, 0, 0, 2]
    for alone in (["a", "b"], [None, None], [None, "a"], ["a + b", "a+b"], []):
        assert cluster_numbers(alone) is None


@pytest.mark.parametrize(
    ("partitions", "joined"),
    [
        ([["a", "b", "c"], ["x", "x", None]], [0, 0, 1]),
        ([["x", "x", None], ["a", "b", "c"]], [0, 0, 1]),
        ([["a", "a", "b", "b"], [None, "x", "x", None]], [0, 0, 0, 0]),  # by way of both
        ([["a", "b", "a", "b"], ["b", "a", "b", None]], [0, 1, 0, 1]),  # a name says nothing
        ([["a + b", "c", "b"], [None, "x", "x"]], [0, 0, 0]),  # a part is enough
        ([["a", "b"], [None, None]], None),
        ([[], []], None),
    ],
)
def test_episodes_are_in_one_cluster_if_any_source_says_so(
    partitions: list[list[str | None]], joined: list[int] | None
) -> None:
    clusters = joined_clusters(partitions)
    assert (None if clusters is None else clusters.tolist()) == joined


def test_a_clustered_difference_is_that_of_the_totals_by_hand() -> None:
    """Clusters {1, 1}, {0, 0} and {0, -1}: mean 1/6; totals of deviations, times 1/6, are
    5/18, -1/18 and -4/18. Two more that differ: effects 1/3, 0, -1/6; greatest weight 1/3.
    """
    values, clusters = np.array([1.0, 1, 0, 0, 0, -1]), np.array([0, 0, 1, 1, 2, 2])
    variance = 3 / 2 * (25 + 1 + 16) / 18**2
    usual = (1 / 9 + 1 / 36) / 2
    more = 2 * (usual + (1 / 9 - usual) * math.exp(-2 / 6))
    found = paired_reach([values], 0.5, [clusters])
    half = 0.5 * math.sqrt(variance + more)
    assert found.value == pytest.approx(1 / 6)
    assert (found.low, found.high) == pytest.approx((1 / 6 - half, 1 / 6 + half))
    assert found.n == 6
    whole = paired_difference([values], clusters=[clusters])
    assert (whole.low, whole.high) == (-1.0, 1.0), "three recordings say little"
    # One part of clusters of one is the plain interval, to the last bit.
    assert paired_difference([values], clusters=[np.arange(6)]) == paired_difference([values])


def test_the_order_of_layouts_and_the_names_of_clusters_change_nothing() -> None:
    values, clusters = np.array([1.0, 1, 0, np.nan, 0, -1]), np.array([0, 0, 1, 1, 2, 2])
    order = np.array([4, 2, 0, 5, 1, 3])
    for interval in (
        lambda v, c: paired_difference([v], clusters=[c]),
        lambda v, c: rate_interval(np.abs(v), c),
        lambda v, c: episode_interval(v, c),
    ):
        one, other = interval(values, clusters), interval(values[order], 7 - clusters[order])
        assert (one.n, one.n_excluded) == (other.n, other.n_excluded) == (5, 1)
        assert (one.value, one.low, one.high) == pytest.approx((other.value, other.low, other.high))


@pytest.mark.parametrize(("clusters", "share"), [(1, "one draw"), (2, "wide")])
def test_of_one_recording_no_interval_claims_what_it_cannot_know(clusters: int, share: str) -> None:
    numbers = np.arange(40) % clusters
    values = (np.arange(40) < 20).astype(float)
    rate, change = rate_interval(values, numbers), paired_difference([values], clusters=[numbers])
    assert rate.high - rate.low > 0.7, share
    if clusters == 1:
        assert (rate.low, rate.high) == pytest.approx(wilson(0.5, 1.0))
        assert math.isnan(change.low)
        assert math.isnan(episode_interval(values, numbers).low)
    else:
        assert change.high - change.low > 1.2
    counts = resampled(np.random.default_rng(0), 40, 99, numbers)
    assert too_few(numbers)
    assert math.isnan(resampled_estimate(counts @ values / 40, 40, numbers).low)


def test_clusters_are_resampled_whole() -> None:
    clusters = np.arange(4 * FEWEST) // 4
    counts = resampled(np.random.default_rng(0), len(clusters), 50, clusters)
    assert not too_few(clusters)
    assert counts.shape == (51, len(clusters))
    assert (counts[0] == 1).all()
    assert (counts == np.repeat(counts[:, ::4], 4, axis=1)).all()
    assert (counts[:, ::4].sum(axis=1) == FEWEST).all()


def test_halves_that_share_clusters_are_combined_as_if_off_the_same_way() -> None:
    halves = [Estimate(0.5, 0.25, 0.75, 4, 0), Estimate(0.75, 0.5, 1.0, 4, 0)]
    assert mean_of(halves, together=True) == Estimate(0.625, 0.375, 0.875, 8, 0)
    assert mean_of(halves).low == pytest.approx(0.625 - 0.25 / math.sqrt(2))


def test_families_have_no_cluster_in_common_and_halves_of_one_do() -> None:
    dangerous = np.array([True, False, True, False, True, False])
    clusters = np.array([0, 0, 1, 1, 2, 2])
    a, b = np.array([[1.0, 1, 1, 0, 0, 1]]), np.array([[0.0, 0, 1, 0, 0, 1]])
    family, plain = (Success(dangerous, clusters), a, b), (Success(NONE), a, b)
    change = (a - b)[0]
    halves = [change[dangerous], change[~dangerous]]
    of_halves = [clusters[dangerous], clusters[~dangerous]]
    assert mean_difference([family]) == paired_difference(halves, clusters=of_halves)
    both = [*halves, change]
    apart = [*of_halves, np.arange(6) + 6]
    assert mean_difference([family, plain]) == paired_difference(both, clusters=apart)
    of_danger = half_difference([family], True)
    assert of_danger == paired_difference(halves[:1], clusters=of_halves[:1])
    assert Success(dangerous, clusters).plain.clusters is clusters


@pytest.mark.parametrize(
    ("names", "joined"),
    [
        ([["a", "a", "b"], ["b", "c", None]], [0, 0, 1, 1, 2, 3]),
        ([["a", "b", "c"], ["c", "b", "a"]], [0, 1, 2, 2, 1, 0]),  # in one alone each is its own
        ([["a + b", "a + b", "c"], ["b", "d", "e"]], [0, 0, 1, 0, 2, 3]),  # what a cut overlaps
        ([["a", "b", "c"], ["d", "e", None]], None),
        ([[], []], None),  # not known
    ],
)
def test_families_share_what_they_name_alike(
    names: list[list[str | None]], joined: list[int] | None
) -> None:
    """Two imports of one traffic are no two families' worth of it."""
    of_first, of_second = (cluster_numbers(each) for each in names)
    none = np.zeros(3, dtype=bool)
    rules = [Success(none, of_first, names[0]), Success(none, of_second, names[1])]
    values = np.array([[1.0, 1, 0]]), np.array([[0.0, 1, 1]])
    pairs = [(rule, *values) for rule in rules]
    clusters = clusters_of(rules)
    if joined is None:
        assert clusters is None
        assert mean_difference(pairs) == paired_difference([values[0][0] - values[1][0]] * 2)
        assert pinned.mean_difference(pairs) != mean_difference(pairs)
    else:
        assert clusters is not None
        assert np.concatenate(clusters).tolist() == joined
        assert mean_difference(pairs) == paired_difference(
            [values[0][0] - values[1][0]] * 2, clusters=clusters
        )
        assert pinned.mean_difference(pairs) == mean_difference(pairs)
    alone = [rule.estimate(values[0]) for rule in rules]
    assert of_families(alone, rules) == mean_of(alone, together=joined is not None)


def covered(
    interval: Callable[[Floats, Ints | None], Estimate], clustered: bool, truth: float, low: float
) -> float:
    """Return how often the interval finds the truth in 400 draws of 24 recordings of 4 to 12
    layouts, of which nine in ten do as their recording does.
    """
    draws = np.random.default_rng(5)
    hits = 0
    for _ in range(400):
        clusters = np.repeat(np.arange(24), draws.integers(4, 13, 24))
        as_cluster = draws.random(len(clusters)) < 0.9
        chance = np.where(as_cluster, draws.random(24)[clusters], draws.random(len(clusters)))
        values = np.where(chance < 0.5, 1.0, np.where(chance < 0.7, low, 0.0))
        found = interval(values, clusters if clustered else None)
        hits += found.low <= truth <= found.high
    return hits / 400


@pytest.mark.slow
@pytest.mark.parametrize(
    ("interval", "truth", "low"),
    [
        (lambda v, c: rate_interval(v, c), 0.5, 0.0),
        (lambda v, c: episode_interval(v, np.arange(len(v)) if c is None else c), 0.3, -1.0),
        (lambda v, c: paired_difference([v], clusters=None if c is None else [c]), 0.3, -1.0),
    ],
)
def test_the_interval_over_clusters_holds_the_truth_and_that_over_layouts_does_not(
    interval: Callable[[Floats, Ints | None], Estimate], truth: float, low: float
) -> None:
    assert covered(interval, True, truth, low) >= 0.9
    assert covered(interval, False, truth, low) < 0.75


def made(out: Path, size: int, lost: tuple[int, ...] = (), episodes: int = 24) -> Run:
    """A run whose layouts are cut from recordings of so many each; 0 for none."""

    def change(row: Row) -> None:
        if size:
            row["cluster"] = f"street {row['episode'] // size}"
        if row["episode"] in lost and row["condition"] == "6g":
            row |= {"success": False, "failure": "collision"}

    return read(made_up(out, episode=change, episodes=episodes))


def test_a_run_states_its_recordings_and_its_figures_count_them(tmp_path: Path) -> None:
    lost = (0, 1, 2, 3, 4, 5)
    alone, whole = made(tmp_path / "alone", 0, lost), made(tmp_path / "whole", 6, lost)
    head = (alone.path / "episodes.csv").read_text().splitlines()[0]
    assert "cluster" not in head
    assert alone.clusters is None
    assert list(clustered(alone)) == []
    assert sound(whole.path).clusters is not None
    for metric, least in (("success_rate", 1.5), (GAIN, 1.5)):
        narrow, wide = alone.score("6g", metric), whole.score("6g", metric)
        assert narrow
        assert wide
        assert (narrow.value, narrow.n) == (wide.value, wide.n)
        assert None not in (narrow.low, narrow.high, wide.low, wide.high)
        width = (wide.high or 0) - (wide.low or 0)
        assert width > least * ((narrow.high or 0) - (narrow.low or 0))
    assert list(clustered(whole)) == [
        "24 layouts of 4 recordings: layouts of one are alike, so intervals count recordings. With "
        "fewer than 10, percentiles and figures of calibration have no interval."
    ]
    assert list(few(whole)) == ["Only 4 recordings: the interval of a rate may reach 49 points to "
                                "either side."]  # fmt: skip
    assert [row["n"] for row in reliability(whole)] == [row["n"] for row in reliability(alone)]
    assert len(errors(whole)) == len(errors(alone))
    with pytest.raises(UserError, match=r"24 layouts are of 4 recordings, and a plan counts"):
        from_pilots([whole.path], 0.1, 0.8, None)


def test_one_recording_says_nothing_of_others(tmp_path: Path) -> None:
    whole = made(tmp_path / "whole", 24, (0, 1))
    gain, rate = whole.score("6g", GAIN), whole.score("6g", "success_rate")
    assert gain
    assert rate
    assert (gain.low, gain.high) == (None, None)
    assert (rate.high or 0) - (rate.low or 0) > 0.5
    [said] = clustered(whole)
    assert said.endswith("One does not tell how others differ: only shares have an interval, a "
                         "wide one.")  # fmt: skip


def test_two_runs_are_compared_over_recordings(tmp_path: Path) -> None:
    found = {}
    for size in (0, 6):
        a = made(tmp_path / f"a{size}", size, tuple(range(6)))
        b = made(tmp_path / f"b{size}", size)
        comparison = compare(pair(a.path, b.path))
        of_6g = next(each for each in comparison.conditions if each.condition == "6g")
        found[size] = {each.metric: each for each in of_6g.differences}
    alone, whole = found[0]["success_rate"], found[6]["success_rate"]
    assert (alone.a, alone.b, alone.change.value) == (whole.a, whole.b, whole.change.value)
    assert alone.p_value is not None
    assert whole.p_value is not None
    assert alone.p_value < 0.05 < whole.p_value
    assert whole.change.low < 0 < alone.change.low
    late = found[6]["latency_p95_ms"].change
    assert math.isnan(late.low)


def test_a_gate_on_the_end_of_an_interval_that_is_not_there_is_refused(tmp_path: Path) -> None:
    """Of one recording nothing bounds a difference; of two, one that is alike in all is bounded."""
    found = {}
    for size in (12, 24):
        a, b = made(tmp_path / f"a{size}", size, (0, 1)), made(tmp_path / f"b{size}", size)
        found[size] = compare(pair(a.path, b.path))
    for metric, size, is_bounded in (
        ("success_rate", 24, False),
        ("success_rate", 12, True),
        ("latency_proxy_ms", 24, False),  # alike in all episodes
        ("latency_proxy_ms", 12, True),
        ("latency_p95_ms", 12, False),  # two recordings are too few to resample
    ):
        for end in ("", ".low", ".high"):
            typed = gate(f"6g:{metric}{end} < -0.5")
            if is_bounded or not end:
                assert judge(typed, found[size]).conditions == ("6g",)
            else:
                with pytest.raises(UserError, match=r"6g has no interval in these runs; name a c"):
                    judge(typed, found[size])


def test_a_run_that_states_finer_recordings_gains_nothing(tmp_path: Path) -> None:
    whole = made(tmp_path / "whole", 24, (0, 1))
    fine, best = made(tmp_path / "fine", 1, (0, 1)), made(tmp_path / "best", 24)
    for one, other in ((whole, best), (fine, best), (best, fine), (best, whole)):
        comparison = compare(pair(one.path, other.path))
        changes = [change for each in comparison.conditions for change in each.differences]
        of_success = [each for each in changes if each.metric == "success_rate"]
        assert {each.p_value for each in of_success} == {None}
        both = lines(Runs((one, other), ("one", "other"), None))
        assert all(math.isnan(line.behind.change.low) for line in both if line.behind)


def test_the_rows_of_an_episode_have_one_layout(tmp_path: Path) -> None:
    for name, value in (("cluster", "street 1"), ("danger", "left"), ("layout_seed", 99)):
        folder = made(tmp_path / name, 24, episodes=2).path
        table = folder / "episodes.csv"
        head, *rows = table.read_text().splitlines()
        cells = rows[-1].split(",")
        cells[head.split(",").index(name)] = str(value)
        table.write_text("\n".join([head, *rows[:-1], ",".join(cells)]) + "\n")
        with pytest.raises(UserError, match=rf"episode 1 has {name} .* in one row and {value} in"):
            sound(folder)


def test_a_suite_and_its_line_in_a_list_know_families_of_one_recording(tmp_path: Path) -> None:
    is_as_wide = []
    for name, size in (("alike", 12), ("apart", 0)):
        folder = tmp_path / name
        runs = {each: made(folder / each, size, (0, 13)) for each in ("first", "second")}
        suite = SuiteRun(folder, name, "two families", runs)
        write(suite)
        score = suite.score("6g", "success_rate")
        assert score
        assert suite.shares_cluster == bool(size)
        [listed] = [each for each in listing.runs(tmp_path) if each.name == name]
        best = suite.score(listed.condition or "", listed.metric or "")
        assert best
        assert (listed.low, listed.high) == pytest.approx((best.low, best.high))
        alone = runs["first"].score("6g", "success_rate")
        assert alone
        is_as_wide.append(alone.low == pytest.approx(score.low))
    assert is_as_wide == [True, False]  # the same layouts twice say no more than once
