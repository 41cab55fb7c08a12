"""Which of several likeliest actions is taken: drawn by seed, layout and step, or the first."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from evaluating import (
    Scripted,
    Walked,
    all_scenes,
    decisions,
    live_spec_of,
    run,
    same_decisions,
    says,
    spec_of,
    with_ego,
)
from evaluating import walked as walk_all
from hypothesis import given
from hypothesis import strategies as st

from harness.backends import cards, registry
from harness.backends.base import Completion, Request
from harness.backends.card import Card
from harness.coordination.coordinate import TIE, FusionInputs, coordinate
from harness.coordination.intents import Intents
from harness.coordination.named_points import POINTS, named_point
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.evaluate.lifecycle import finished
from harness.radio.channel import Draws
from harness.runs.folder import read
from harness.runs.settings import words
from harness.studies.axes import Setting
from harness.studies.replayed_run import ReplayedRun

ALONE, OVER_6G = POINTS["single-local"], POINTS["6g"]
DEAF = named_point("6g:loss=1")
THIRDS = says([1 / 3, 1 / 3, 1 / 3])
ACTIONS = ("SLOWER", "IDLE", "FASTER")


def taken(policies: Any, draws: Any = None) -> list[int]:
    """The actions of an ego alone with these policies,
    where `draws` has what decides each that is tied.
    """
    own = np.array(policies, dtype=float)
    n = len(own)
    none = np.zeros((n, 0))
    intents = Intents(
        own, np.zeros((n, 0, own.shape[1])), none > 0, np.ones((n, 1)), none, none, np.ones((n, 1))
    )
    fusion = FusionInputs(ties=None if draws is None else lambda tied: np.array(draws)[tied])
    return coordinate(ALONE, intents, Draws(np.zeros((n, 0, 2)), none), fusion).action.tolist()


def test_a_tie_among_some_actions_is_drawn_among_these_alone() -> None:
    policies = [[0.4, 0.2, 0.4]] * 4 + [[0.2, 0.4, 0.4]] * 2 + [[0.2, 0.5, 0.3]]
    assert taken(policies, [0.0, 0.49, 0.5, 0.99, 0.49, 0.5, 0.99]) == [0, 0, 2, 2, 1, 2, 1]
    assert taken(policies) == [0, 0, 0, 0, 1, 1, 1]


def test_rounding_makes_no_difference_and_a_real_one_is_none_to_draw() -> None:
    third = 1 / 3
    assert taken(
        [[third - TIE / 2, third, third], [third - 1e-6, third + 1e-6, third]], [0.1, 0.9]
    ) == [0, 1]


@given(
    st.lists(st.floats(0, 1), min_size=2, max_size=6).filter(sum), st.floats(0, 1, exclude_max=True)
)
def test_without_a_tie_the_draw_changes_nothing(weights: list[float], draw: float) -> None:
    p = np.array(weights) / sum(weights)
    best, next_best = sorted(p)[::-1][:2]
    [action] = taken([p], [draw])
    assert p[action] >= best - TIE
    if best - next_best > TIE:
        assert taken([p]) == [action]


def drawn(small: Dataset, line: str = THIRDS, **options: Any) -> Walked:
    """A walk in which every ego says the line."""
    egos = {f"{scene.id}/{scene.viewers[0]}": line for scene in all_scenes(small)}
    return walk_all(spec_of(small, **options), Scripted(egos))


@pytest.mark.slow
def test_an_ego_that_says_all_alike_takes_each_action_a_third_of_the_time(small: Dataset) -> None:
    found = drawn(small, points=(ALONE,), seeds=tuple(range(200))).records(ALONE.name)
    first = Counter(d.action for d in found if d.step == 0)
    every = Counter(d.action for d in found)
    for shares in (first, every):
        assert [shares[action] / shares.total() for action in ACTIONS] == pytest.approx(
            [1 / 3] * 3, abs=0.05
        )


def test_the_steps_and_the_layouts_of_a_seed_draw_apart(small: Dataset) -> None:
    found = drawn(small, points=(ALONE,), seeds=(0, 1)).records(ALONE.name)
    ways = {place: [] for place in {(d.episode, d.seed) for d in found}}
    for d in found:
        ways[d.episode, d.seed].append(d.action)
    assert len({tuple(way) for way in ways.values()}) > len(ways) / 2
    assert any(len(set(way)) > 1 for way in ways.values())


def test_conditions_prompts_and_models_share_the_draw(small: Dataset) -> None:
    """An ego that hears nobody, under any condition, and another answer with the same tie."""
    made = [
        drawn(small, points=(ALONE, DEAF), seeds=(0, 1, 2)),
        drawn(small, points=(ALONE, DEAF), seeds=(2, 0, 1), prompt="v4"),
        drawn(small, says([0.34, 0.34, 0.34]), points=(DEAF, ALONE), seeds=(0, 1, 2)),
    ]
    ways = [
        {(d.scene, d.seed): d.action for d in one.records(point.name)}
        for one in made
        for point in (ALONE, DEAF)
    ]
    assert len(set(ways[0].values())) == 3
    assert all(way == ways[0] for way in ways)


def test_first_takes_the_most_careful_as_runs_without_the_setting_did(small: Dataset) -> None:
    tied = drawn(small, points=(ALONE, OVER_6G), ties="first").records(ALONE.name)
    assert {d.action for d in tied} == {"SLOWER"}


class Tied:
    """Says that all actions are alike: to the ego's questions, and to those of helpers."""

    def complete(self, requests: list[Request]) -> list[Completion]:
        return [
            Completion(r.id, says([1 / 3] * 3, r.role), None, None, "stop", None, 1) for r in requests
        ]  # fmt: skip

    def identity(self) -> dict[str, Any]:
        return {"engine": "tied"}


TIED = replace(cards.resolve("proxy"), name="tied", engine="tied")


@pytest.fixture
def tied(monkeypatch: pytest.MonkeyPatch) -> Card:
    """Card of a model that says that all actions are alike."""
    opens = f"{__name__}:open_tied"
    monkeypatch.setitem(
        registry.ENGINES._loaded, "tied", replace(registry.BUILT_IN["proxy"], opens=opens)
    )
    return TIED


def open_tied(card: Card, **_: Any) -> Tied:
    return Tied()


@pytest.mark.slow
def test_a_frozen_episode_is_the_driven_one(tied: Card, small: Dataset, tmp_path: Path) -> None:
    how: dict[str, Any] = {"points": (ALONE,), "seeds": (0, 1, 2)}
    frozen = run(with_ego(spec_of(small, **how), card=tied), tmp_path / "frozen").out
    live = live_spec_of("proxy", len(small.episodes), small.manifest.seed, **how)
    driven = run(with_ego(live, card=tied), tmp_path / "driven").out
    ways = [
        [(d.scene, d.seed, d.step, d.action) for d in decisions(out)] for out in (frozen, driven)
    ]
    assert len({action for *_, action in ways[0]}) == 3
    assert sorted(ways[0]) == sorted(ways[1])
    ends = [
        [(e.episode, e.seed, e.success, e.time_s) for e in read(out).episodes]
        for out in (frozen, driven)
    ]
    assert ends[0] == ends[1]


@pytest.mark.exhaustive
def test_a_study_of_a_run_draws_as_the_run_did(tied: Card, small: Dataset, tmp_path: Path) -> None:
    for ties in ("drawn", "first"):
        out = run(
            with_ego(spec_of(small, points=(ALONE, OVER_6G), ties=ties), card=tied), tmp_path / ties
        ).out
        stored = ReplayedRun(out)
        settings = [Setting(point.name, point, stored.vehicles) for point in (ALONE, OVER_6G)]
        for point, [walked] in zip(
            (ALONE, OVER_6G), stored.walked(settings, stored.seeds), strict=True
        ):
            ends = [e.success for e in stored.run.episodes if e.condition == point.name]
            assert walked.ends["success_rate"].ravel().tolist() == ends


@pytest.mark.slow
def test_a_run_without_the_setting_took_the_first(
    tied: Card, small: Dataset, tmp_path: Path, harness: Any
) -> None:
    """It is read, found finished, studied and replayed as such."""
    spec = with_ego(spec_of(small, points=(ALONE,), ties="first"), card=tied)
    old = run(spec, tmp_path / "old").out
    record = msgspec.json.decode((old / "run.json").read_bytes())
    assert record.pop("ties") == "first"
    del record["digests"]  # which such runs have not
    (old / "run.json").write_bytes(msgspec.json.encode(record))
    assert read(old).manifest.settings.ties == "first"
    assert ReplayedRun(old).spec.ties == "first"
    assert finished(spec, old).manifest.settings.ties == "first"
    with pytest.raises(UserError, match="ties"):
        finished(spec.changed(ties="drawn"), old)
    again = tmp_path / "again"
    options = (
        "--dataset",
        small.path,
        "--prompt",
        "v2",
        "--condition",
        ALONE.name,
        "--seeds",
        "0:2",
    )
    assert harness("eval", "--model", f"replay:{old}", *options, "--quiet", "--out", again)[0] == 0
    assert same_decisions(old, again)
    assert read(again).manifest.settings.ties == "first"


@pytest.mark.parametrize("ties", ["drawn", "first"])
def test_the_command_that_repeats_a_run_falls_alike(ties: str, small: Dataset) -> None:
    assert ("--ties first" in " ".join(words(spec_of(small, ties=ties).settings))) == (
        ties == "first"
    )


def test_another_word_is_refused_in_one_line(
    small: Dataset, harness: Callable[..., tuple[int, str, str]]
) -> None:
    with pytest.raises(UserError, match=r"--ties random: give drawn or first"):
        spec_of(small, ties="random")
    assert harness("eval", "--ties", "") == (2, "", "harness: --ties : give drawn or first\n")
