"""The settings `edge` and `edge_*` of a condition: a roadside unit, an antenna beside the road."""

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, ClassVar

from msgspec import Meta

from harness.coordination.contents import INTENTS
from harness.coordination.parts import ActsOn, Part, Text, wrong
from harness.core.arrays import Floats
from harness.core.config import Seconds
from harness.core.errors import unknown
from harness.extensions.roadside.unit import Relay, by_unit
from harness.radio.channel import Antenna, Channel, Draws, Links, Physical
from harness.radio.consulted import Consulted

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint

NONE, RELAY, FUSION = "none", "relay", "fusion"
EDGES = (NONE, RELAY, FUSION)
Place = Annotated[float, Meta(ge=-10_000, le=10_000, description="metres from -10000 to 10000")]


class Roadside(Part, frozen=True, kw_only=True):
    """Hold the settings of a roadside unit: what it does, where it stands and how fast it is.

    A roadside unit is an antenna beside the road. The settings belong to an operating point, which
    has those of radio, asking and fusion. The conflict zone is where the vehicles' paths meet.
    `behind` is the setting after which they stand in records, and `of_radio` says that they mean
    nothing without a radio.
    """

    behind: ClassVar[str] = "helper_rounds"
    of_radio: ClassVar[bool] = True

    # what a unit beside the road does: `relay` sends replies once more; `fusion` asks the helpers
    # for the ego and fuses; `none` is no unit. With the constant model a relay has no place.
    edge: Text = NONE
    # seconds from the end of what the unit receives to the start of what it sends: processing and
    # backhaul. The default is declared: a unit that has nothing to wait for.
    edge_delay_s: Seconds = 0.0
    # m to the east of the centroid of the conflict zone; 0 and 0 is a gantry above it
    edge_x_m: Place = 0.0
    edge_y_m: Place = 0.0  # m to the south of it
    # height of the unit's antenna above the ground, m; by default that of TR 37.885, table 6.1.4-1,
    # a roadside unit.
    edge_antenna_m: Annotated[float, Meta(ge=1, le=100, description="metres from 1 to 100")] = 5.0

    def check(self) -> None:
        if self.edge not in EDGES:
            raise unknown("edge", self.edge, EDGES)

    @property
    def acts_on(self) -> Collection[ActsOn]:
        if self.edge != FUSION:
            return ()
        return (ActsOn("edge", FUSION, (INTENTS,), "none or relay"),)

    def check_with(self, point: "OperatingPoint") -> None:
        if self.edge == FUSION and point.asks_again:
            allowed = f"none or relay where {point.asks_twice}: a unit has no model"
            raise wrong("edge", FUSION, allowed)

    def idle(self, setting: str) -> str | None:
        if setting != "edge" and self.edge == NONE:
            return "it has no roadside unit (edge is none)"
        return None

    def carried(self, point: "OperatingPoint", channel: Channel) -> Channel:
        if self.edge == NONE or point.radio.profile is None:
            return channel
        if isinstance(channel, Physical):
            relays = self.edge == RELAY
            return Relay(channel, self._antenna, self.edge_delay_s) if relays else channel
        of_profile = f"channel profile {point.radio.profile}"
        if self.edge == FUSION:
            raise wrong("edge", FUSION, f"none or relay: links of {of_profile} have no places")
        if not hasattr(channel, "roadside_edge"):
            raise wrong("edge", RELAY, f"left out: {of_profile} has no such setting")
        plain = Roadside()
        for key in self.__struct_fields__[1:]:
            value = getattr(self, key)
            if value != getattr(plain, key):
                raise wrong(key, value, f"left out: links of {of_profile} have no places")
        return replace(channel, roadside_edge=True)

    @property
    def antennas(self) -> Collection[Antenna]:
        return () if self.edge == NONE else (self._antenna,)

    def ask(
        self,
        point: "OperatingPoint",
        links: Links,
        draws: Draws,
        ready: Callable[[Floats], Floats],
        left_s: Floats,
    ) -> Consulted | None:
        if self.edge != FUSION or point.physical is None:
            return None
        return by_unit(
            point.physical, self._antenna, self.edge_delay_s, links, draws, ready, left_s
        )

    @property
    def _antenna(self) -> Antenna:
        return Antenna(self.edge_x_m, self.edge_y_m, self.edge_antenna_m)
