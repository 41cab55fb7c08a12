"""Frozen is driven: a walk through a layout's tree ends, and gets there,
as driving that layout does.

That holds for every episode whose decisions act in the frame of the dataset's lag. The reference
drivers' all do. Over 6G a decision that waits for a lost or a slow reply acts later, and one answer
of twenty of `proxy-faulty` is 0.4 s late: such episodes are left out, and counted. Over a physical
radio it shows that both worlds have the same places, shadowing and packets.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import former
import numpy as np
import pytest
from evaluating import live_spec_of, run, spec_of
from tiers import some

from harness.coordination.contents import CONTENTS, of_any_model
from harness.coordination.named_points import POINTS, named_point
from harness.coordination.operating_point import OperatingPoint
from harness.core.resources import DATASET
from harness.dataset.load import Dataset, find, load
from harness.evaluate.live_world import LiveSource
from harness.radio.profiles import CHANNELS
from harness.report.caveats import unmeasured
from harness.runs import folder
from harness.runs.folder import Run
from harness.world.drivers import DRIVERS

ALONE, OVER_6G = POINTS["single-local"], POINTS["6g"]
CONTENT = {
    name: named_point(f"6g:content={name}")
    for name, content in CONTENTS.items()
    if not content.of_agents
}
WITHOUT_WORDS = tuple(CONTENT[name] for name in of_any_model())
SPOKEN = [point for point in CONTENT.values() if point not in WITHOUT_WORDS]
PHYSICAL = [named_point(name) for name in ("its-g5",) if name in CHANNELS.usable()]
SAME = (
    "layout_seed", "danger", "success", "failure", "time_s", "delay_s", "partner", "striker", "fault",
    "least_gap_m", "hard_brakings", "other_crashes", "decisions", "messages", "trigger_rate", "latency_ms",
    "deadline_misses",
)  # fmt: skip

Place = tuple[str, int, int]  # condition, seed and episode


def told(of: Run) -> dict[Place, tuple[list[Any], list[tuple[Any, ...]]]]:
    """How each episode ended, and what was decided at which decision points on the way."""
    way = defaultdict(list)
    for d in of.decisions.records(0, len(of.decisions)):
        way[d.condition, d.seed, d.episode].append(
            (d.step, d.scene, d.action, d.fused, d.latency_ms)
        )
    return {
        (place := (e.condition, e.seed, e.episode)): (
            [getattr(e, name) for name in SAME],
            sorted(way[place]),
        )
        for e in of.episodes
    }


def few_or_many(*case: Any, layouts: tuple[int, int]) -> Iterator[Any]:
    """A case on a few layouts, and one on many where everything is tested."""
    few, many = layouts
    # The rules of the other drivers are parts of the full-view driver's.
    if case[0] not in ("brake", "cruise", "local-view"):
        yield pytest.param(*case, few, marks=pytest.mark.slow)
    yield pytest.param(*case, many, marks=pytest.mark.exhaustive)


def many(*case: Any) -> Any:
    """A case of what few layouts show by other models and radios already."""
    return pytest.param(*case, marks=pytest.mark.exhaustive)


def off_lag(of: Run) -> set[Place]:
    """Episodes in which some decision took other than the lag's frames."""
    decisions = of.decisions.records(0, len(of.decisions))
    return {(d.condition, d.seed, d.episode) for d in decisions if d.off_lag}


@pytest.mark.parametrize(
    ("model", "points", "seeds", "least", "layouts"),
    [
        *(
            case
            for driver in DRIVERS
            for case in few_or_many(driver, (ALONE,), (0,), 1.0, layouts=(3, 40))
        ),
        *few_or_many("proxy", (ALONE, OVER_6G), (0, 1), 0.8, layouts=(2, 20)),
        *few_or_many("proxy", WITHOUT_WORDS, (0,), 0.8, layouts=(2, 20)),
        *(many("proxy", (point,), (0, 1), 0.5, 20) for point in PHYSICAL),
        many("proxy-faulty", (ALONE, OVER_6G), (0, 1), 0.4, 20),
        *(many("swarm-tiny-six", (point,), (0,), 0.8, 3) for point in SPOKEN),
    ],
)
def test_what_the_tree_says_is_what_driving_gives(
    tmp_path: Path,
    model: str,
    points: Sequence[OperatingPoint],
    seeds: Sequence[int],
    least: float,
    layouts: int,
) -> None:
    """Both by default. `least` is the share of episodes that is not left out, at least."""
    spoken = set(points) <= set(SPOKEN)
    frozen = load(find(DATASET), layouts)
    how: dict[str, Any] = {"points": points, "seeds": seeds}
    if set(points) & {*CONTENT.values()}:  # the ego's second answer would come after the lag
        how |= {"latency": "ego=0.145,helper=0.145,fusion=0", "prompt": "v12" if spoken else "v2"}
    source = LiveSource(frozen.manifest.seed, len(frozen.episodes))
    driven = replace(live_spec_of(model, **how), source=source)
    walked, drove = (
        folder.read(run(spec, tmp_path / name).out)
        for spec, name in ((spec_of(frozen, model, **how), "walked"), (driven, "drove"))
    )
    left_out, expected, found = off_lag(walked), told(drove), told(walked)
    assert found.keys() == expected.keys()
    assert len(left_out) <= (1 - least) * len(found)
    for place in found.keys() - left_out:
        assert found[place] == expected[place], place


CONFLICTS = ("least_ttc_s", "short_ttc", "least_pet_s", "short_pet")


@pytest.mark.parametrize(
    "model", some(["proxy"], exhaustive=["cruise", "full-view", "brake", "local-view"])
)
def test_conflicts_in_a_tree_are_those_of_driving(
    tmp_path: Path, small: Dataset, model: str
) -> None:
    """Of each decision and episode, on a tree that is built today; the shipped ones are older."""
    how: dict[str, Any] = {"points": (ALONE,), "seeds": (0,)}
    driven = live_spec_of(model, len(small.episodes), small.manifest.seed, **how)
    walked, drove = (
        folder.read(run(spec, tmp_path / name).out)
        for spec, name in ((spec_of(small, model, **how), "walked"), (driven, "drove"))
    )
    assert not off_lag(walked)
    for e, expected in zip(walked.episodes, drove.episodes, strict=True):
        assert [getattr(e, name) for name in CONFLICTS] == [
            getattr(expected, name) for name in CONFLICTS
        ]
        assert e.failure != "collision" or (e.least_ttc_s, e.least_pet_s) == (0.0, 0.0)
    for name in ("ttc_s", "pet_s", "short_ttc", "short_pet"):
        np.testing.assert_array_equal(walked.decisions[name], drove.decisions[name])
    assert walked.score(ALONE.name, "short_ttc_rate") == drove.score(ALONE.name, "short_ttc_rate")
    if model != "brake":
        assert any(e.least_ttc_s for e in walked.episodes)
        assert any(e.least_pet_s is not None for e in walked.episodes)


def test_what_an_older_tree_does_not_hold_is_unknown_and_said(tmp_path: Path) -> None:
    older = folder.read(
        run(spec_of(load(find(former.DATASET), 2), "cruise"), tmp_path / "older").out
    )
    assert {getattr(e, name) for e in older.episodes for name in CONFLICTS} == {None}
    assert np.isnan(older.decisions["short_ttc"]).all()
    assert not {s.metric for s in older.scores} & {
        "least_ttc_s",
        "short_ttc_rate",
        "short_ttc_decision_rate",
    }
    assert [s for s in unmeasured(older) if "Time to collision" in s and "dataset is older" in s]
