"""The settings `stream` and `stream_*` of a condition: what helpers send before anybody asks."""

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, cast

from msgspec import Meta

from harness.coordination.parts import Part, RunFacts, Text, wrong
from harness.core.errors import unknown
from harness.extensions.streams.congestion import NONE, RULES, Settled, settled
from harness.extensions.streams.inclusion import LONGEST_S, SHORTEST_S, interval_s
from harness.extensions.streams.sending import CAM, CPM
from harness.extensions.streams.services import KEPT_S, Services, heard_of
from harness.radio.channel import Channel, Physical
from harness.radio.constant import Radio
from harness.radio.wrapped import Wrapped, innermost

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint

STREAMS = (NONE, CAM, CPM, f"{CAM}+{CPM}")
Interval = Annotated[
    float,
    Meta(
        ge=SHORTEST_S,
        le=LONGEST_S,
        description=f"seconds from {SHORTEST_S:g} to {LONGEST_S:g} (ETSI TS 103 324)",
    ),
]


Delay = Annotated[
    float,
    Meta(
        ge=0,
        lt=KEPT_S,
        description=f"seconds from 0 to below {KEPT_S:g}, at which reports are dropped",
    ),
]


class Streams(Part, frozen=True, kw_only=True):
    """Hold the settings of what helpers send unasked: which messages, how often, and how late.

    They belong to an operating point, which has those of radio, asking and fusion. `behind` is the
    setting after which they stand in records, `of_ego` says that they matter to an ego that asks
    nobody, and `of_radio` that they mean nothing without a radio.
    """

    behind: ClassVar[str] = "helper_rounds"
    of_ego: ClassVar[bool] = True
    of_radio: ClassVar[bool] = True

    # what helpers send unasked, by the rules of standards: `cpm`, the objects that they see; `cam`,
    # their pose, in place of the scenario's beacons; or `cam+cpm`. The ego's model is then asked
    # with all that the ego has heard. `none` is nothing.
    stream: Text = NONE
    # seconds between two looks of a helper, and the least between two of its messages
    stream_interval_s: Interval = 0.1
    # seconds from a look to the ego's having its message, declared: sensors' tracking and access
    stream_delay_s: Delay = 0.05
    # rule by which all vehicles on the radio send less where it is busy, the background's too:
    # `reactive` or `adaptive` (ETSI TS 102 687), or `none`
    congestion: Text = NONE

    def check(self) -> None:
        if self.stream not in STREAMS:
            raise unknown("stream", self.stream, STREAMS)
        if self.congestion not in (NONE, *RULES):
            raise unknown("congestion", self.congestion, (NONE, *RULES))

    def check_with(self, point: "OperatingPoint") -> None:
        if self.stream == NONE:
            return
        if point.asks_again:
            raise wrong("stream", self.stream, f"{NONE} where {point.asks_twice}")
        if self.stream == CAM and point.rewrites.changes.of_attackers:
            allowed = f"one with {CPM} where helpers attack, since a CAM lists no objects"
            raise wrong("stream", self.stream, allowed)
        channel = point.channel
        if point.radio.profile is None or isinstance(channel, Physical):
            return
        if isinstance(channel, Radio) and channel.density_coupled:
            raise wrong("stream", self.stream, f"{NONE} where density_coupled is true")
        if not isinstance(channel, Radio):
            allowed = f"{NONE}: channel {point.radio.profile} does not tell a loss of one message"
            raise wrong("stream", self.stream, allowed)

    def idle(self, setting: str) -> str | None:
        if setting.startswith("stream_") and self.stream == NONE:
            return f"helpers send nothing unasked (stream is {NONE})"
        return None

    def obstacle(self, point: "OperatingPoint", run: RunFacts) -> str | None:
        if self.stream != NONE and run.several_decide:
            return f"stream={self.stream} is for one ego; leave out --agents"
        return None

    def carried(self, point: "OperatingPoint", channel: Channel) -> Channel:
        if self.congestion == NONE or point.radio.profile is None:
            return channel
        return with_rate(channel, 1 / self._settled(point, channel).interval_s)

    def _settled(self, point: "OperatingPoint", channel: Channel) -> Settled:
        name = f"congestion {self.congestion}: channel {point.radio.profile}"
        return settled(innermost(channel), self.congestion, name)

    def unasked(self, point: "OperatingPoint") -> Services | None:
        if self.stream == NONE or point.radio.profile is None:
            return None
        between_s, encoding = 0.0, point.radio.encoding
        if self.congestion != NONE:
            uncontrolled = point.changed(congestion=NONE).channel
            between_s = self._settled(point, uncontrolled).allowed_s
        # All that a station sends goes through one gate.
        kinds = tuple(self.stream.split("+"))
        every_s = interval_s(max(self.stream_interval_s, between_s * len(kinds)))
        return Services(every_s, self.stream_delay_s, point.channel, encoding, between_s, kinds)

    @classmethod
    def unasked_of(cls, text: str) -> Services | None:
        if not text.startswith((f"{CAM}:", f"{CPM}:")):
            return None
        _, every_s, _ = heard_of(text)[0]
        return Services(every_s)


def with_rate(channel: Channel, rate_hz: float) -> Channel:
    """Return a channel whose background sends `rate_hz` packets a second, within what wraps it."""
    if isinstance(channel, Wrapped):
        within: Any = with_rate(channel.channel, rate_hz)
        return replace(channel, channel=within)
    slower: Channel = replace(cast("Any", channel), rate_hz=rate_hz)
    return slower
