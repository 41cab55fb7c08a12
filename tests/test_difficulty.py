"""Success corrected by how hard layouts are:
by hand, exact where it must be, and in what a run states.
"""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from evaluating import run, spec_of
from hypothesis import given
from hypothesis import strategies as st
from run_on_disk import configure
from scipy.stats import t as student
from tiers import some

from harness.coordination.named_points import POINTS
from harness.core import covariate
from harness.core.arrays import Floats
from harness.core.covariate import LEAST, corrected, worth
from harness.core.errors import UserError
from harness.core.statistics import Estimate, rate_interval
from harness.dataset import select
from harness.dataset.load import find, load
from harness.dataset.select import Choice
from harness.evaluate import frozen_world
from harness.evaluate.frozen_world import FrozenSource
from harness.report import words
from harness.report.compare.difference import compare
from harness.report.compare.gate import gate, judge
from harness.report.compare.pair import pair
from harness.report.words import adjusted_lines, as_good_as, figures
from harness.runs.difficulty import FILE, Pool, adjusted_scores
from harness.runs.folder import read
from harness.runs.grid import Grid
from harness.runs.headline import BALANCED, SUCCESS
from harness.runs.metric_names import ADJUSTED, GAIN
from harness.runs.records import Score
from harness.runs.success import Success
from harness.runs.writer import csv_text

Typed = Callable[..., tuple[int, str, str]]
ASKED = 50


def drawn(seed: int, n: int, layouts: int) -> tuple[Floats, Floats]:
    """Success of n layouts, and what is known of all, (N, 2)."""
    rng = np.random.default_rng(seed)
    known = np.column_stack([rng.integers(2, size=layouts), rng.random(layouts)]).astype(float)
    return (rng.random(n) < 0.2 + 0.6 * known[:n, 0]).astype(float), known


def of(values: Floats, known: Floats, level: float = 0.95) -> Estimate:
    corrections = corrected(rate_interval(values), values, known[: len(values)], known, 0.0, level)
    assert corrections
    return corrections


def test_it_is_the_regression_worked_out_by_hand() -> None:
    """One thing is known: the line through the values, read off at the mean of all layouts."""
    values, known = drawn(1, 50, 200)
    known = known[:, :1]
    x = known[:50, 0]
    slope, at_0 = np.polyfit(x, values, 1)
    ahead = known.mean() - x.mean()
    left = np.sum((values - at_0 - slope * x) ** 2) / 48
    variance = (
        left * (1 / 50 + ahead**2 / np.sum((x - x.mean()) ** 2))
        + slope**2 * known.var(ddof=1) / 200
    )
    plain, estimate = rate_interval(values), of(values, known)
    half, plain_half = (
        student.ppf(0.975, freedom) * math.sqrt(of_mean)
        for freedom, of_mean in ((48, variance), (49, values.var(ddof=1) / 50))
    )
    narrower = max(half / plain_half, 2 * half / (plain.high - plain.low))
    value = at_0 + slope * known.mean()
    assert estimate.value == pytest.approx(value)
    assert estimate.low == pytest.approx(value - narrower * (plain.value - plain.low))
    assert estimate.high == pytest.approx(value + narrower * (plain.high - plain.value))
    assert worth(plain, estimate) == pytest.approx(narrower**-2)


@given(st.integers(0, 99), st.floats(-1, 1))
def test_what_says_nothing_new_changes_nothing(seed: int, factor: float) -> None:
    """Neither a constant, nor a sum of what is known,
    nor the order of layouts that were not asked.
    """
    values, known = drawn(seed, 40, 90)
    more = np.column_stack([known, np.full(90, 0.3), known[:, 0] * factor - known[:, 1]])
    more[40:] = more[:39:-1]
    for end in ("value", "low", "high"):
        assert getattr(of(values, more), end) == pytest.approx(getattr(of(values, known), end))


def test_values_that_follow_from_what_is_known_are_those_of_all_layouts() -> None:
    _, known = drawn(3, 40, 90)
    values = 0.1 + 0.5 * known[:, 0] + 0.3 * known[:, 1]
    estimate = of(values[:40], known)
    assert estimate.value == pytest.approx(values.mean())
    assert estimate.low < values.mean() < estimate.high


def test_an_estimate_stays_within_its_bounds() -> None:
    known = np.zeros((200, 1))
    known[29:], known[100:] = 0.1, 1.0
    estimate = of(np.append(np.zeros(29), 1.0), known)
    assert estimate.value == estimate.high == 1.0
    assert 0 <= estimate.low < 1


def test_where_nothing_can_be_corrected_there_is_none() -> None:
    values, known = drawn(4, 40, 90)
    few = LEAST - 1
    for part, of_part, of_all in (
        (values, known[:40], known[:40]),
        (values[:few], known[:few], known),
        (np.ones(40), known[:40], known),
        (values, np.ones((40, 2)), known),
    ):
        assert corrected(rate_interval(part), part, of_part, of_all, 0.0) is None
    unbounded = Estimate(0.5, math.nan, math.nan, 1, 0)
    assert worth(unbounded, unbounded) == 1.0


RUNS = {  # by name: who drives, and the first of how many layouts
    "some": ("proxy", ASKED),
    "faulty": ("proxy-faulty", ASKED),
    "cruise": ("cruise", ASKED),
    "more": ("proxy", ASKED + 10),
    "all": ("proxy", None),
}


class Made(dict[str, Path]):
    """Runs of the first layouts of a dataset, and `proxy` alone in all;
    each is made when it is first asked for.
    """

    def __init__(self, out: Path) -> None:
        super().__init__()
        self.out, self.path = out, find("occluded-intersection-v2")

    def __missing__(self, name: str) -> Path:
        model, limit = RUNS[name]
        alone = (POINTS["single-local"],)
        points = alone if name == "all" else (*alone, POINTS["6g"])
        data = load(self.path, limit)
        run(spec_of(data, model, limit=limit, points=points, seeds=(0,)), self.out / name)
        return self.setdefault(name, self.out / name)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return Made(tmp_path_factory.mktemp("difficulty"))


@pytest.mark.exhaustive
def test_a_run_of_some_layouts_states_its_success_corrected_for_all(runs: dict[str, Path]) -> None:
    """Alone the proxy is `local-view`, so that this is its success in all layouts,
    to the last digit.
    """
    some, full = read(runs["some"]), read(runs["all"])
    in_all = full.score("single-local", SUCCESS)
    assert some.score("single-local", SUCCESS).value != in_all.value
    assert some.score("single-local", ADJUSTED[SUCCESS]).value == pytest.approx(in_all.value)
    gain = some.score("6g", ADJUSTED[GAIN])
    helped, alone = (some.score(name, ADJUSTED[SUCCESS]).value for name in ("6g", "single-local"))
    assert gain.value == pytest.approx(helped - alone)
    assert (gain.n, gain.interval) == (ASKED, "episodes")
    assert some.score("6g", ADJUSTED[BALANCED]) is not None
    assert any(
        "success % adjusted for difficulty: single-local" in line for line in adjusted_lines(some)
    )
    assert full.layouts == ()
    assert not [*adjusted_lines(full)]
    assert not [score for score in full.scores if score.metric in ADJUSTED.values()]


@pytest.mark.exhaustive
def test_the_first_layouts_of_a_run_are_a_run_of_the_first_layouts(runs: dict[str, Path]) -> None:
    some, full = read(runs["some"]), read(runs["more"])
    first = [e for e in full.episodes if e.episode < ASKED]
    assert first == list(some.episodes)
    grid = Grid(full.conditions, full.grid.seeds, full.grid.episodes[:ASKED])
    stated = [score for score in some.scores if score.metric in ADJUSTED.values()]
    assert [*adjusted_scores(grid, first, some.layouts)] == stated


@pytest.mark.parametrize(
    ("a", "b"), some([("some", "faulty")], exhaustive=[("all", "faulty"), ("faulty", "all")])
)
def test_two_runs_are_compared_corrected_and_gated(
    a: str, b: str, runs: dict[str, Path], harness: Typed
) -> None:
    gates = "--fail-if", "single-local:adjusted_success_rate < -0.9"
    code, out, _ = harness("compare", runs[a], runs[b], *gates, "--json")
    assert code == 0
    metrics = json.loads(out)["conditions"][0]["metrics"]
    adjusted, plain = metrics["adjusted_success_rate"], metrics["success_rate"]
    assert adjusted["difference"] == pytest.approx(adjusted["b"] - adjusted["a"])
    assert adjusted["n"] == ASKED
    assert not adjusted["primary"]
    assert adjusted["low"] < adjusted["difference"] < adjusted["high"]
    assert adjusted["difference"] != plain["difference"]


@pytest.mark.exhaustive
def test_what_two_runs_have_alike_in_all_layouts_is_no_corrected_figure_to_gate(
    runs: dict[str, Path],
) -> None:
    alike = compare(pair(runs["some"], runs["all"]))
    with pytest.raises(UserError, match="adjusted_success_rate"):
        judge(gate("adjusted_success_rate < 0"), alike)


@pytest.mark.exhaustive
def test_a_difference_of_references_is_that_of_all_layouts_and_is_said(
    runs: dict[str, Path], harness: Typed
) -> None:
    """Alone the proxy is `local-view`, so that both successes follow from what trees know."""
    layouts = read(runs["some"]).layouts
    in_all = 100 * np.mean([each.cruise - each.local_view for each in layouts])
    for option, start in (("--all", ""), ("--markdown", "- ")):
        _, out, _ = harness("compare", runs["some"], runs["cruise"], option)
        assert f"\n{start}success adjusted for difficulty: B - A {in_all:+.1f} [" in out
        assert "times as many layouts" in " ".join(out.split())
    harness("compare", runs["some"], runs["cruise"], "--html", "page.html")
    assert (
        f"Success adjusted for difficulty: B - A {in_all:+.1f} [" in Path("page.html").read_text()
    )
    tiles = {figure["what"].partition(",")[0] for figure in figures(read(runs["cruise"]))}
    assert "adjusted for difficulty" in tiles


@pytest.mark.slow
def test_it_is_shown_by_the_number_of_layouts_whatever_it_says(
    runs: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    some = read(runs["some"])
    [line] = [line for line in adjusted_lines(some) if line.startswith("success %")]
    assert line.count("times as many layouts") == len(some.conditions), (
        "under 6g it gains hardly anything"
    )
    monkeypatch.setattr(words, "SHOWN_FROM", ASKED)
    assert [*adjusted_lines(some)]
    monkeypatch.setattr(words, "SHOWN_FROM", ASKED + 1)
    assert not [*adjusted_lines(some)]
    assert not [figure for figure in figures(some) if "adjusted" in figure["what"]]


def test_words_say_also_what_is_worse() -> None:
    plain, wider = Estimate(0.5, 0.4, 0.6, 50, 0), Estimate(0.5, 0.395, 0.605, 50, 0)
    assert as_good_as(plain, plain) == "as good as 1.0 times as many layouts"
    assert as_good_as(plain, wider) == "as good as 0.9 times as many layouts"


@pytest.mark.exhaustive
def test_of_many_layouts_some_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those asked are among them, wherever they are drawn from."""
    monkeypatch.setattr(frozen_world, "MOST_KNOWN", 2)
    whole = load(find("occluded-intersection-v2"))
    numbers = tuple(select.drawn(whole.episodes, ASKED, 0, len(whole.episodes)))
    choice = Choice(numbers, whole.episodes, {"sample": ASKED, "sample_seed": 0})
    source = FrozenSource(whole.of_episodes(numbers), None, choice)
    known = {layout.episode for layout in source.layouts(ASKED)}
    assert known == {*range(2 * ASKED), *source.dataset.episodes}
    assert not source.layouts(LEAST - 1)


def uncorrected(run: Path) -> None:
    """Take the figures that are corrected for difficulty out of a run's summary,
    as an older one has none.
    """
    configure(run, versions={})
    (run / FILE).unlink(missing_ok=True)
    lines = (run / "summary.csv").read_text().splitlines(keepends=True)
    (run / "summary.csv").write_text("".join(line for line in lines if ",adjusted_" not in line))


def corrected_anew(run: Path) -> None:
    """Compute the corrected figures of a run again,
    whose layouts are said to be of another difficulty.
    """
    stated = read(run)
    scores = [score for score in stated.scores if "adjusted_" not in score.metric]
    scores += adjusted_scores(stated.grid, stated.episodes, stated.layouts)
    (run / "summary.csv").write_text(csv_text(Score, scores, stated.manifest.variant))


@pytest.mark.parametrize(
    ("change", "says"),
    some(
        [
            (
                lambda text: text.replace("0.0,0.0,0.09", "0.0,7.0,0.09", 1),
                "episode 0: a success that is not",
            )
        ],
        exhaustive=[
            (lambda text: text.replace("\n0,left", "\n900,left", 1), "lacks one of the run's"),
            (lambda text: text.replace("\n0,left", "\n0,none", 1), "lacks one of the run's"),
            (lambda text: text.replace("cruise", "crews", 1), "it lacks cruise"),
        ],
    ),
)
def test_a_strangers_difficulty_is_one_line(
    change: Callable[[str], str], says: str, runs: dict[str, Path], tmp_path: Path, harness: Typed
) -> None:
    copy = Path(shutil.copytree(runs["some"], tmp_path / "copy"))
    text = (copy / FILE).read_text()
    (copy / FILE).write_text(change(text))
    assert change(text) != text
    code, out, error = harness("compare", copy, runs["faulty"])
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert says in error
    uncorrected(copy)  # as in a run of an earlier version
    assert read(copy).layouts == ()
    assert harness("compare", copy, copy)[0] == 0


@pytest.mark.slow
def test_runs_that_differ_in_how_hard_a_layout_is_are_compared_as_they_are(
    runs: dict[str, Path], tmp_path: Path
) -> None:
    assert pair(runs["some"], runs["faulty"]).pool is not None
    copy = Path(shutil.copytree(runs["some"], tmp_path / "copy"))
    text = (copy / FILE).read_text()
    (copy / FILE).write_text(text.replace("0.0,0.0,0.09", "1.0,0.0,0.09", 1))
    with pytest.raises(UserError, match=r"contradicts itself: summary.csv has adjusted_"):
        pair(copy, runs["faulty"])
    corrected_anew(copy)
    assert pair(copy, runs["faulty"]).pool is None
    assert pair(runs["faulty"], copy).pool is None


def test_half_of_what_balanced_success_is_may_stay_as_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where few layouts have no danger, only the others are corrected."""
    values, known = drawn(7, 60, 120)
    dangerous = np.arange(120) % 5 > 0
    pool, success = Pool(known, dangerous, np.arange(60)), Success(dangerous[:60])
    estimate = pool.estimate(success, values[None])
    inside, others = dangerous[:60], ~dangerous[:60]
    half = corrected(
        rate_interval(values[inside]), values[inside], known[:60][inside], known[dangerous], 0.0
    )
    assert estimate.value == pytest.approx((half.value + values[others].mean()) / 2)
    monkeypatch.setattr(covariate, "LEAST", 50)
    assert pool.estimate(success, values[None]) is None
