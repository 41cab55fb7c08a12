"""Every condition that can be typed runs, frozen and driven, or is refused in one line.

Conditions are drawn from the settings of all parts, those of extensions too. So what two of them
settle between each other is tried, whoever says it.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from driving import driven, spec
from evaluating import says, spec_of, walked
from hypothesis import example, given, settings
from hypothesis import strategies as st

from harness.backends.base import Completion, Request
from harness.coordination.contents import CONTENTS
from harness.coordination.encodings import ENCODINGS, JSON
from harness.coordination.named_points import named_point
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.part_settings import more_parts, typed_settings
from harness.coordination.parts import FALLBACKS
from harness.coordination.rules import names
from harness.coordination.schedules import SCHEDULES
from harness.core.errors import UserError
from harness.core.extensions import control_settings
from harness.dataset.load import Dataset, find, load
from harness.evaluate.live_world import LiveSource
from harness.evaluate.spec import Spec
from harness.radio.networks import names as networks
from harness.radio.profiles import CHANNELS
from harness.runs.decisions import Decisions
from harness.runs.records import Decision, Latency

Place = tuple[int, int]  # episode and seed
# What frozen scenes assume; a second answer would come after it.
AT_THE_LAG = Latency("card", "declared: for this test", 0.145, 0.145, 0.0)
NUMBERS = {bool: ("true", "false"), int: ("0", "1", "2"), float: ("0", "0.05", "0.5", "1", "40")}
WORDS: Mapping[str, Sequence[str]] = {
    "stream": ("none", "cam", "cpm", "cam+cpm"),
    "congestion": ("none", "reactive", "adaptive"),
    "edge": ("none", "relay", "fusion"),
    "encoding": (JSON, *ENCODINGS),
    "schedule": [name for name in SCHEDULES if SCHEDULES.is_ours(name)],
    "content": tuple(CONTENTS),
    "consensus": names(),
    "fallback": FALLBACKS,
    "round_trip": tuple(networks()),
    "messages": [setting.partition("=")[2] for setting in control_settings().values()],
    "defence": ("quoted", "schema", "majority", "quoted+schema+majority"),
}


@pytest.fixture(scope="module")
def two(two_path: Path) -> Dataset:
    return load(two_path)


class Sees:
    """Brakes where it sees somebody, goes on where it does not, and heeds what it hears."""

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        return [self._say(request) for request in requests]

    def _say(self, request: Request) -> Completion:
        told = "+" in request.id and "SLOWER" in str(request.messages)
        seen = told or bool(request.view.nodes)
        p = (0.6, 0.3, 0.1) if seen else (0.2, 0.5, 0.3)
        return Completion(request.id, says(p, request.role), None, None, "stop", None, 1)

    def identity(self) -> dict[str, Any]:
        return {"engine": "sees"}


def values_of(setting: str) -> Sequence[str]:
    """Return some values of a setting, as they are typed."""
    for kind in more_parts().values():
        if setting in kind.named:
            return tuple(kind.named[setting]())
    if setting in WORDS:
        return WORDS[setting]
    kinds = getattr(OperatingPoint.types()[setting], "__args__", (OperatingPoint.types()[setting],))
    number = next((kind for kind in kinds if kind in NUMBERS), None)
    assert number, f"give WORDS some values of {setting}"
    return NUMBERS[number]


SETTINGS = {setting: values for setting in typed_settings() if (values := values_of(setting))}


@dataclass(frozen=True)
class Typed:
    """A condition as it is typed: a channel, and settings beside it."""

    profile: str
    settings: Mapping[str, str]

    def __str__(self) -> str:
        beside = [f"{name}={value}" for name, value in self.settings.items()]
        return f"{self.profile}:{','.join(beside)}" if beside else self.profile

    def without(self, setting: str) -> "Typed":
        rest = {name: value for name, value in self.settings.items() if name != setting}
        return Typed(self.profile, rest)


@st.composite
def conditions(draw: st.DrawFn) -> Typed:
    profile = draw(st.sampled_from(sorted(CHANNELS.usable())))
    chosen = draw(st.lists(st.sampled_from(sorted(SETTINGS)), min_size=1, max_size=4, unique=True))
    return Typed(profile, {name: draw(st.sampled_from(SETTINGS[name])) for name in chosen})


def played(typed: Typed, dataset: Dataset) -> Spec | None:
    """Return an evaluation under a condition; None if it is refused.

    The line that refuses it names all settings without which it would not be.
    """
    spec, said = opened(typed, dataset)
    if spec:
        return spec
    while smaller := next(refused_without(typed, dataset), None):
        typed, said = smaller
    assert "\n" not in said
    line = said.replace(repr(str(typed)), "")
    assert all(setting in line for setting in typed.settings), said
    return None


def refused_without(typed: Typed, dataset: Dataset) -> Iterator[tuple[Typed, str]]:
    """Yield what is refused of a condition with a setting less, and the line that refuses it."""
    for setting in typed.settings:
        fewer = typed.without(setting)
        spec, line = opened(fewer, dataset)
        if spec is None:
            yield fewer, line


def opened(typed: Typed, dataset: Dataset) -> tuple[Spec | None, str]:
    """Return an evaluation under a condition; or None, and the line that refuses it."""
    try:
        point = named_point(str(typed))
        return spec_of(dataset, "swarm-tiny", "v12", points=(point,), seeds=(0,)), ""
    except UserError as error:
        return None, str(error)


def unknown_or_finite(decisions: Decisions) -> Iterator[str]:
    """Yield the columns with a number that is neither finite nor null."""
    for field in decisions.table.schema:
        if pa.types.is_floating(field.type):
            for value in decisions.table[field.name].to_pylist():
                if value is not None and not abs(value) < float("inf"):
                    yield field.name


def told(decisions: Decisions) -> tuple[dict[Place, list[Any]], set[Place]]:
    """What was decided in each episode, and the episodes in which a decision took longer than
    frozen scenes assume.
    """
    way: dict[Place, list[Any]] = {}
    late = set[Place]()
    for d in decisions.records(0, len(decisions)):
        place = d.episode, d.seed
        way.setdefault(place, []).append((d.step, d.scene, d.action, d.fused, d.latency_ms))
        if d.off_lag:
            late.add(place)
    return {place: sorted(steps) for place, steps in way.items()}, late


def rows(spec: Spec) -> list[Decision]:
    decisions = walked(spec, Sees()).decisions.rounded()
    return sorted(decisions.records(0, len(decisions)), key=lambda d: (d.episode, d.seed, d.step))


@pytest.mark.slow
def test_a_condition_is_played_or_refused_in_one_line(two: Dataset, tmp_path: Path) -> None:
    """What is played is the same twice, from the beginning and from where it was killed."""
    file = tmp_path / "answers.jsonl"

    @settings(max_examples=25)
    @given(typed=conditions(), kept=st.floats(0, 1))
    def holds(typed: Typed, kept: float) -> None:
        frozen = played(typed, two)
        if frozen is None:
            return
        file.unlink(missing_ok=True)
        once = walked(frozen, Sees(), kept=file)
        os.truncate(file, round(kept * file.stat().st_size))
        resumed = walked(frozen, Sees(), kept=file)
        assert resumed.decisions.table.equals(once.decisions.table)
        assert resumed.answers == once.answers
        assert not list(unknown_or_finite(once.decisions))

    holds()


@pytest.mark.slow
def test_an_episode_is_the_same_whatever_else_is_played() -> None:
    """On roads of SUMO, where layouts have two or three helpers of whom one leaves, or none."""
    crossing = load(find("sumo-crossing-v1"))
    whole = crossing.of_episodes(frozenset({0, 3, 6, 9, 12, 14, 29, 36}))

    @settings(max_examples=20)
    @given(typed=conditions(), number=st.sampled_from(whole.episodes))
    def holds(typed: Typed, number: int) -> None:
        spec = played(typed, whole)
        if spec is None or spec.points[0].elsewhere:
            return
        part = opened(typed, whole.of_episodes(frozenset({number})))[0]
        assert part
        expected = told(walked(spec, Sees()).decisions)[0]
        alone = told(walked(part, Sees()).decisions)[0]
        assert alone == {(number, 0): expected[number, 0]}

    holds()


@pytest.mark.slow
def test_a_condition_is_the_same_whatever_other_one_is_played(two: Dataset) -> None:
    @settings(max_examples=20)
    @given(typed=conditions(), other=conditions())
    def holds(typed: Typed, other: Typed) -> None:
        one, beside = played(typed, two), played(other, two)
        if one is None or beside is None or one.points[0].name == beside.points[0].name:
            return
        both = replace(one, points=(beside.points[0], one.points[0]))
        assert [d for d in rows(both) if d.condition == one.points[0].name] == rows(one)

    holds()


@pytest.mark.exhaustive
@pytest.mark.parametrize("clock", ["together", "apart"])
def test_a_condition_of_agents_is_the_same_whatever_other_one_is_played(clock: str) -> None:
    source = LiveSource(50_000, 1, f"all-way-crossing:agent_share=1,clock={clock}")

    def of_agents(*points: OperatingPoint) -> list[Decision]:
        live = replace(spec("swarm-tiny", points, (0,), prompt="v13"), source=source)
        decisions = driven(live, (0,), Sees(), AT_THE_LAG).decisions
        every = decisions.records(0, len(decisions))
        return [d for d in every if d.condition == points[-1].name]

    @settings(max_examples=15)
    @given(typed=conditions(), other=conditions())
    @example(Typed("6g", {"attack": "sybil"}), Typed("6g", {"content": "plan"}))
    def holds(typed: Typed, other: Typed) -> None:
        try:
            one, beside = named_point(str(typed)), named_point(str(other))
            if one.name != beside.name:
                assert of_agents(beside, one) == of_agents(one)
        except UserError:
            return

    holds()


@pytest.mark.slow
def test_a_rule_begins_to_remember_when_an_agent_first_decides() -> None:
    """Each of the agents decides first at a time of its own; layouts alone and together."""
    source = LiveSource(50_000, 2, "all-way-crossing:agent_share=1,clock=apart")
    point = named_point("6g:tau=0,consensus=trust")
    both = replace(spec("proxy", (point,), (0,), prompt="v4"), source=source)
    together = told(driven(both, (0, 1)).decisions)[0]
    for number in (0, 1):
        alone = told(driven(both, (number,)).decisions)[0]
        assert alone == {place: steps for place, steps in together.items() if place in alone}
    agents = {scene for steps in together.values() for _, scene, *_ in steps}
    assert len(agents) > 8


@pytest.mark.exhaustive
def test_a_condition_that_is_played_is_driven_alike(two: Dataset) -> None:
    @settings(max_examples=60)
    @given(typed=conditions())
    def holds(typed: Typed) -> None:
        frozen = played(typed, two)
        if frozen is None or frozen.points[0].elsewhere:
            return
        live = spec("swarm-tiny", frozen.points, (0,), prompt="v12", first_seed=two.manifest.seed)
        expected, late = told(walked(frozen, Sees(), AT_THE_LAG).decisions.rounded())
        drive = driven(live, range(len(two.episodes)), Sees(), AT_THE_LAG)
        for place, steps in told(drive.decisions)[0].items():
            assert place in late or steps == expected[place]

    holds()


@pytest.mark.exhaustive
@pytest.mark.parametrize("profile", ["6g", "mode2"])
def test_two_settings_go_together_or_a_line_names_both(two: Dataset, profile: str) -> None:
    for one, other in combinations(sorted(SETTINGS), 2):
        for value, beside in product(SETTINGS[one], SETTINGS[other]):
            played(Typed(profile, {one: value, other: beside}), two)
