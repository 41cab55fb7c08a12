"""What a stranger's dataset, settings or channel may say of a stream, and what comes of it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from evaluating import scenes_of
from msgspec import structs

from harness.coordination.named_points import named_point
from harness.core.arrays import Floats
from harness.core.errors import UserError
from harness.dataset.load import Dataset, Earlier, Scene
from harness.extensions.streams.congestion import settled
from harness.extensions.streams.services import Services
from harness.radio.profiles import CHANNELS
from harness.radio.wrapped import busy_ratio
from harness.world.state import WorldState

ITS_G5: Any = type(CHANNELS["its-g5"])


def in_state(scene: Scene, before: Scene | None, **changes: Any) -> Scene:
    """The scene as a dataset might state it, after another one."""
    record = structs.replace(scene.record, state=structs.replace(scene.state, **changes))
    return Scene(record, before=Earlier(before))


def second(dataset: Dataset) -> tuple[Scene, Scene]:
    """A scene, and the one before it."""
    scene = next(scene for scene in scenes_of(dataset) if scene.before())
    before = scene.before()
    assert before
    return scene, before


@pytest.mark.parametrize("time_s", [-1.0, 0.0, 2e3, 1e6])
def test_scenes_of_other_times_are_refused_in_one_line(small: Dataset, time_s: float) -> None:
    """Looks go ten times a second, so that a far time would make a program look for ever."""
    scene, before = second(small)
    for channel in (replace(CHANNELS["6g"]), CHANNELS["its-g5"]):
        with pytest.raises(UserError, match=r"of \d+ s at most; build the dataset again$") as error:
            Services(0.1, 0.0, channel).heard(
                small.scenario, [in_state(scene, before, time_s=time_s)]
            )
        assert "\n" not in str(error.value)


def renamed(state: WorldState, old: str, new: str) -> dict[str, Any]:
    vehicles = []
    for v in state.vehicles:
        vehicles.append(structs.replace(v, id=new) if v.id == old else v)
    return {"vehicles": tuple(vehicles)}


def test_an_ego_that_becomes_another_is_refused_and_a_helper_that_does_sends_nothing(
    small: Dataset,
) -> None:
    scene, before = second(small)
    stream = Services(0.1, 0.0, CHANNELS["its-g5"])
    other = renamed(scene.state, scene.state.ego.id, "v99")
    with pytest.raises(UserError, match="has another ego than the one before it"):
        stream.heard(small.scenario, [in_state(scene, before, **other)])
    helper = scene.state.helpers[0].id
    [texts] = stream.heard(
        small.scenario, [in_state(scene, before, **renamed(scene.state, helper, "v77"))]
    )
    assert "v77" not in texts


def test_intervals_are_whole_microseconds_as_their_keys_are() -> None:
    """Else two conditions could share keys, and what is asked would depend on which is first."""
    alike = [named_point(f"6g:stream=cpm,stream_interval_s=0.123456{n}").stream for n in (1, 4)]
    assert alike[0] == alike[1]
    assert isinstance(alike[0], Services)
    assert alike[0].interval_s == 0.123456


def test_a_delay_at_which_all_is_dropped_is_refused() -> None:
    assert named_point("6g:stream=cpm,stream_delay_s=1.9").stream
    with pytest.raises(UserError, match=r"stream_delay_s is 50.*seconds from 0 to below 2"):
        named_point("6g:stream=cpm,stream_delay_s=50")


# A channel of a package: what it gets it cannot write to, and what it returns is checked.


@dataclass(frozen=True)
class Strange(ITS_G5):
    lose: Callable[[Any], Any] = lambda site: np.zeros(site.sight.shape)
    busy: Any = 0.1
    packet_time_s: Any = 0.001

    def loss(self, site: Any, shadow: Floats, bits: Any) -> Any:
        return self.lose(site)

    def busy_ratio(self) -> Any:
        return self.busy

    def message_s(self, bits: Any) -> Any:
        return self.packet_time_s


def write(site: Any) -> Floats:
    site.xy_m[:] = 0.0
    return np.zeros(site.sight.shape)


def fall(site: Any) -> Floats:
    raise TypeError("boom")


@pytest.mark.parametrize(
    ("lose", "reason"),
    [
        (write, "read-only"),
        (fall, "TypeError: boom"),
        (lambda site: np.full(site.sight.shape, np.nan), "a loss that is no probability"),
        (lambda site: np.full(site.sight.shape, 2.0), "a loss that is no probability"),
        (lambda site: np.full(site.sight.shape, 0.5j), "not numbers"),
        (lambda site: np.zeros(3), "shape"),
        (lambda site: "much", "losses"),
    ],
)
def test_a_packages_channel_cannot_write_or_lose_the_impossible(
    small: Dataset, lose: Callable[[Any], Any], reason: str
) -> None:
    stream = Services(0.1, 0.0, Strange(lose=lose))
    with pytest.raises(UserError, match=f"channel Strange of test_hostile_streams .*{reason}"):
        stream.heard(small.scenario, scenes_of(small))


def test_what_a_packages_channel_loses_is_lost(small: Dataset) -> None:
    scenes = scenes_of(small)
    for lost, channel in ((0.0, Strange()), (1.0, Strange(lose=lambda s: np.ones(s.sight.shape)))):
        heard = Services(0.1, 0.0, channel).heard(small.scenario, scenes)
        assert any(heard) == (lost < 1)


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"busy": "often"}, "ValueError"),
        ({"busy": 2.0}, "a busy ratio of 2"),
        ({"packet_time_s": np.zeros(2)}, "TypeError"),
        ({"packet_time_s": -1.0}, "a time on air of -1 s"),
        ({"packet_time_s": math.nan}, "a time on air of nan s"),
    ],
)
def test_a_packages_channel_has_a_load_and_a_time_on_air(
    settings: dict[str, Any], reason: str
) -> None:
    with pytest.raises(UserError, match=reason) as error:
        settled(Strange(**settings), "adaptive", "strange")
    assert "\n" not in str(error.value)


def test_a_busy_ratio_may_be_unknown() -> None:
    assert math.isnan(busy_ratio(Strange(busy=math.nan)))
    assert busy_ratio(Strange()) == 0.1
