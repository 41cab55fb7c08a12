"""Repeats: one evaluation several times, with other draws of the model's answers;
figures played by hand.
"""

import importlib
import json
import math
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import Scripted, Watched, course, same_files, spec_of, sure
from hypothesis import given
from hypothesis import strategies as st
from priced import priced, typed_eval
from run_on_disk import Row, digested, made_up

from harness.backends.base import Completion, Request
from harness.coordination.named_points import POINTS
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.evaluate.spec import Spec
from harness.extensions.studies.repeats.study import (
    DOUBT,
    FLIPS,
    MARKER,
    SAMPLED,
    STABLE,
    STATED,
    WRITTEN,
    Repeats,
    all_of,
    any_of,
    between_share,
    flips,
    headline,
    repeats_study,
    run_repeats,
    stable,
)
from harness.runs.folder import read
from harness.runs.headline import SUCCESS
from harness.runs.listing import runs
from harness.runs.metric_names import ALL
from harness.studies.study import write_study

pytestmark = pytest.mark.usefixtures("svg_alone")
Said = tuple[int, str, str]
# Episode 0 crashes in the first repeat; the others go on and decide otherwise at its second step.
OUTCOMES: dict[str, dict[str, float | str]] = {
    "00000-0": {"FASTER": "collision"},
    "00000-1": {},
    "00001-0": {},
}
DECIDED = {
    "00000-0": ("FASTER", "IDLE", "IDLE"),
    "00000-1": ("IDLE", "IDLE", "SLOWER"),
    "00001-0": ("IDLE", "IDLE", "IDLE"),
}


class Wanderer(Scripted):
    """Decides by the scene and by which answer it is."""

    def __init__(self) -> None:
        super().__init__({})

    def _say(self, request: Request) -> Completion:
        scene = request.id.partition("/")[0]
        action = DECIDED[scene][request.sample % 3] if scene in DECIDED else "IDLE"
        return Completion(request.id, sure(action, request.role), 400, 40, "stop", None, 1)

    def rendered(self, requests: Sequence[Request]) -> list[str]:
        return [json.dumps(request.messages) for request in requests]


@pytest.fixture
def wanderer(monkeypatch: pytest.MonkeyPatch) -> Wanderer:
    """In the place of every model's engine."""
    # A module that is first imported under the patch would keep it, in all tests of this process.
    for module in ("harness.evaluate.recompute", "harness.studies.replayed_run"):
        importlib.import_module(module)
    backend = Wanderer()
    monkeypatch.setattr("harness.backends.registry.open_backend", lambda card, **options: backend)
    return backend


def hot(data: Dataset, **options: Any) -> Spec:
    return spec_of(
        data, "swarm-tiny", **{"points": (POINTS["single-local"],), "temperature": 0.7, **options}
    )


def repeated(
    spec: Spec,
    out: Path,
    k: int = 3,
    done: Callable[[int], None] = lambda n: None,
    cache: Path | None = None,
) -> Repeats:
    return run_repeats(spec, k, out, Watched(done), cache)


# -- figures ---------------------------------------------------------------------------------------


def test_pairs_that_differ_are_counted() -> None:
    """Of six pairs 4 differ among (2, 2), 3 among (1, 3), none among (4, 0)."""
    counts = np.array([[2, 2], [1, 3], [4, 0], [1, 0], [0, 0]])
    np.testing.assert_allclose(flips(counts), [4 / 6, 3 / 6, 0, np.nan, np.nan])
    np.testing.assert_array_equal(stable(counts), [0, 0, 1, np.nan, np.nan])


def test_pass_and_any_are_those_of_repeats_drawn_without_replacement() -> None:
    """3 of 4 succeed: two drawn are both good in 3 of 6 draws, and never both bad."""
    wins = np.array([0.0, 1.0, 3.0, 4.0])
    np.testing.assert_allclose(all_of(wins, 4, 2), [0, 0, 0.5, 1])
    np.testing.assert_allclose(any_of(wins, 4, 2), [0, 0.5, 1, 1])
    np.testing.assert_allclose(all_of(wins, 4, 1), wins / 4)
    np.testing.assert_allclose(any_of(wins, 4, 1), wins / 4)


@given(st.lists(st.integers(0, 6), min_size=1, max_size=8))
def test_more_repeats_never_make_all_likelier_nor_any_less(wins: list[int]) -> None:
    of = np.array(wins, dtype=float)
    for j in range(1, 6):
        assert (all_of(of, 6, j + 1) <= all_of(of, 6, j) + 1e-12).all()
        assert (any_of(of, 6, j + 1) >= any_of(of, 6, j) - 1e-12).all()


def test_variance_lies_between_episodes_or_within() -> None:
    """By hand: means 1, 0.5, 0; between 2 * 0.5 / 2 = 0.5, within 0.5 / 3;
    (1/2 - 1/6) / (1/2 + 1/6).
    """
    share = between_share(np.array([[1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]))
    assert share.value == pytest.approx(0.5)
    assert share.low < 0.5 < share.high <= 1
    assert share.n == 3
    assert between_share(np.array([[1.0, 1.0], [0.0, 0.0]])).value == pytest.approx(1)
    assert between_share(np.array([[1.0, 0.0], [0.0, 1.0]])).value == pytest.approx(-1)
    none = between_share(np.array([[1.0, 0.0, 1.0], [1.0, 1.0, 1.0]]) / 3)
    assert none.value == 0, "what rounding takes off is no share below 0"
    for nothing in (np.ones((4, 3)), np.ones((1, 3))):
        assert math.isnan(between_share(nothing).value)


@pytest.mark.slow
def test_the_share_between_episodes_is_found_again() -> None:
    """Of 1000 episodes whose variance is 3 parts of 4 between them."""
    rng = np.random.default_rng(5)
    values = rng.normal(size=(1000, 1)) * 3**0.5 + rng.normal(size=(1000, 4))
    share = between_share(values)
    assert share.low < 0.75 < share.high
    assert share.high - share.low < 0.08


def test_repeats_played_by_hand(small: Dataset, tmp_path: Path, wanderer: Wanderer) -> None:
    of = repeated(hot(course(small, 2, OUTCOMES)), tmp_path / "repeats")

    def value(metric: str, condition: str = "single-local") -> float:
        return of.estimate(condition, metric).value

    # 2 of 3 pairs differ at the first point, the one pair at the second, none at the third.
    assert value(FLIPS) == pytest.approx((2 / 3 + 1 + 0) / 3)
    assert value(STABLE) == pytest.approx(1 / 3)
    assert of.estimate("single-local", FLIPS).n == 3
    assert value(SUCCESS) == pytest.approx((2 / 3 + 1) / 2)
    assert (value("pass^2"), value("pass^3")) == pytest.approx(((1 / 3 + 1) / 2, 1 / 2))
    assert (value("any@2"), value("any@3")) == (1, 1)
    # Sure answers state none; 1 and 2 of 3 are 0.637 nats and 1/6, 1 and 1 are ln 2 and 1/4.
    entropy = [-(math.log(1 / 3) + 2 * math.log(2 / 3)) / 3 + 1 / 6, math.log(2) + 1 / 4, 0]
    assert value(STATED, ALL) == pytest.approx(0)
    assert value(SAMPLED, ALL) == pytest.approx(sum(entropy) / 3)
    assert value(DOUBT, ALL) == pytest.approx(-sum(entropy) / 3)
    assert [(point.scene, round(point.flips, 6), point.actions) for point in of.wavering(9)] == [
        ("00000-0", 0.666667, {"IDLE": 4, "FASTER": 2}),
        ("00000-1", 1.0, {"SLOWER": 2, "IDLE": 2}),
    ]
    first, *others = headline(of)
    assert "at temperature 0.7, swarm-tiny · v2 · json decides differently in 55.6 [" in first
    assert [rate for rate in ("83.3 [", "50.0 [", "100.0 [") if rate not in first] == []
    assert others[-1].startswith(
        "The ego's answers state 0.00 [–, –] nats of entropy, not clearly more or less"
    )


def test_every_figure_has_its_n_and_interval(
    small: Dataset, tmp_path: Path, wanderer: Wanderer
) -> None:
    of = repeated(hot(course(small, 2, OUTCOMES)), tmp_path / "repeats")
    for score in of.scores:
        assert score.n > 1, score
        assert score.low is None or score.value is None or score.low <= score.value <= score.high
    assert len(of.scores) == len({(s.condition, s.metric) for s in of.scores}) == 8 + 3


# -- runs ------------------------------------------------------------------------------------------


def test_a_repeat_is_a_run_with_its_own_sampling_seed(
    small: Dataset, tmp_path: Path, wanderer: Wanderer
) -> None:
    of = repeated(hot(small, sampling_seed=4), tmp_path / "repeats", 2)
    assert [run.manifest.settings.sampling_seed for run in of.runs] == [4, 5]
    assert [run.path.name for run in of.runs] == ["repeat-1", "repeat-2"]
    assert all("--temperature 0.7 --sampling-seed" in run.manifest.command for run in of.runs)


def test_a_repeat_that_is_a_copy_of_another_is_said_to_be(
    small: Dataset, tmp_path: Path, wanderer: Wanderer
) -> None:
    """Its record may state any sampling seed."""
    spec, out = hot(course(small, 2)), tmp_path / "repeats"
    assert list(repeated(spec, out, 2).copies()) == []
    record = (out / "repeat-2/run.json").read_text()
    shutil.rmtree(out / "repeat-2")
    shutil.copytree(out / "repeat-1", out / "repeat-2")
    (out / "repeat-2/run.json").write_text(record)
    digested(out / "repeat-2")
    [caveat] = repeats_study(repeated(spec, out, 2)).caveats
    assert caveat.startswith("repeat-1 and repeat-2 have the same ")
    assert caveat.endswith("chance changed nothing there, or one is a copy of the other.")


@pytest.mark.exhaustive
def test_a_stopped_one_goes_on_as_if_it_had_not_been(
    small: Dataset, tmp_path: Path, wanderer: Wanderer
) -> None:
    whole = repeated(hot(course(small, 2)), tmp_path / "whole")
    asked = len(wanderer.asked)

    class Stopped(Exception):
        pass

    def stop(done: int) -> None:
        raise Stopped

    with pytest.raises(Stopped):
        repeated(hot(course(small, 2)), tmp_path / "stopped", done=stop)
    again = repeated(hot(course(small, 2)), tmp_path / "stopped")
    for one, other in zip(whole.runs, again.runs, strict=True):
        assert same_files(one.path, other.path)
    shutil.rmtree(tmp_path / "stopped/repeat-3")
    wanderer.asked.clear()
    assert repeated(hot(course(small, 2)), tmp_path / "stopped").scores == whole.scores
    assert 0 < len(wanderer.asked) < asked / 2
    with pytest.raises(UserError, match="begun with --temperature"):
        repeated(hot(course(small, 2), temperature=0.8), tmp_path / "stopped")


@pytest.mark.exhaustive
def test_the_cache_keeps_repeats_apart(small: Dataset, tmp_path: Path, wanderer: Wanderer) -> None:
    kept = tmp_path / "completions.sqlite"
    first = repeated(hot(course(small, 2)), tmp_path / "first", cache=kept)
    cached = [sum(a.cached for a in run.answers) for run in first.runs]
    assert cached == [0, 0, 0]
    wanderer.asked.clear()
    again = repeated(hot(course(small, 2)), tmp_path / "again", cache=kept)
    assert wanderer.asked == []
    assert [a.raw for run in again.runs for a in run.answers] == [
        a.raw for run in first.runs for a in run.answers
    ]
    repeated(hot(course(small, 2), temperature=0.8), tmp_path / "hotter", cache=kept)
    assert wanderer.asked


# -- the command -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_folder_has_a_page_and_all_figures(
    small: Dataset, tmp_path: Path, wanderer: Wanderer
) -> None:
    of = repeated(hot(course(small, 2, OUTCOMES)), tmp_path / "repeats")
    assert "<a href=" not in write_study(repeats_study(of), of.path).read_text()
    (of.path / "repeat-2/report.html").write_text("what `harness report` wrote")
    page = write_study(repeats_study(of), of.path).read_text()
    assert '<a href="repeat-2/report.html">Report of repeat-2</a>' in page
    assert page.index("decides differently in 55.6 [") < page.index("<table")
    assert "pass^3" in page
    assert "2 × SLOWER, 2 × IDLE" in page
    assert page.index("data-chart") < page.index("<table")
    drawn = (of.path / "repeats.svg").read_text()
    assert all(
        f">{row}<" in drawn
        for row in ("decisions flip", "any@3", "succeed", "pass^2", *of.conditions)
    )
    lines = (tmp_path / "repeats/repeats.csv").read_text().splitlines()
    assert len(lines) == 1 + len(of.scores)
    found = {listed.name: (listed.kind, listed.state) for listed in runs(tmp_path)}
    assert found["repeats"] == ("repeats", "finished")
    assert found["repeats/repeat-2"] == ("eval", "finished")
    # killed before its last file, the command goes on in this folder
    (of.path / MARKER).unlink()
    names = {path.name for path in of.path.iterdir()}
    assert "repeats.svg" in names <= {*WRITTEN, *(run.path.name for run in of.runs)}


def test_a_dry_run_counts_every_repeat_and_the_old_spelling_is_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, two_path: Path, harness: Callable[..., Said]
) -> None:
    with priced(tmp_path, monkeypatch) as there:
        _, *options = typed_eval(two_path, "--limit", "1", "--dry-run", "--temperature", "1")
        once = json.loads(harness("eval", *options, "--json")[1])["cost"]["mine"]["answers"]
        now = harness("study", "repeats", *options, "--repeats", "2")
        before = harness("eval", *options, "--repeats=2")
    assert "requests × 2 repeats for the " in now[1]
    assert f"mine, EUR: prompts not counted, {2 * once:.4g} for answers of the greatest" in now[1]
    assert before[:2] == now[:2]
    assert before[2] == (
        "harness: `harness eval --repeats` is now `harness study repeats`; the old spelling works "
        "until 0.5.0\n"
    )
    assert there.asked == []


@pytest.mark.slow
def test_no_suite_is_repeated(harness: Callable[..., Said]) -> None:
    asked = ("study", "repeats", "--model", "swarm-tiny", "--dataset", "suite:v2v-safety")
    code, out, err = harness(*asked, "--repeats", "3", "--temperature", "1")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert (
        "--repeats 3: needs one dataset, and --dataset names a suite; give one of its datasets"
        in err
    )
    assert not Path("reports").exists()


def test_episodes_are_in_one_cluster_if_any_repeat_says_so(tmp_path: Path) -> None:
    def of_four(row: Row) -> None:
        row["cluster"] = f"street {row['episode']}"

    runs = []
    for name, cut in (("one", lambda row: row.update(cluster="street")), ("four", of_four)):
        runs.append(read(made_up(tmp_path / name, episode=cut)))
    for order in (runs, runs[::-1]):
        clusters = Repeats(tmp_path, tuple(order)).clusters
        assert clusters is not None
        assert clusters.tolist() == [0, 0, 0, 0]
