"""The nouns of a scene graph: what one viewer knows of a scene, in its own frame.

The frame has metres forward and to the left, and headings in degrees counter-clockwise. Lanes,
sectors and conflicts are named from the *ego's* seat for every viewer, since helpers judge what the
ego should do. `harness.world.perception.graph` makes a graph of a state. A member that is `UNSET`
is not in the file.
"""

from typing import Annotated, Any, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType, field

from harness.world.fields import Closed, Count, Kind, Number, Side, VehicleId

WholeNumber = Annotated[int, Meta(ge=-1_000_000, le=1_000_000)]
Role = Literal["ego", "helper"]
Meeting = Literal["crossing", "merging", "ahead", "behind", "oncoming"]
BY_BEACON = ("v2x",)  # the source of a vehicle that is known by its beacons alone


class Viewer(Closed, frozen=True):
    """The viewer itself."""

    speed_mps: Number
    lane: str
    zone_m: Number
    type: Kind | UnsetType | None = UNSET


class Ego(Closed, frozen=True):
    """The ego, in the viewer's frame."""

    id: VehicleId
    speed_mps: Number
    target_speed_mps: Number
    age_s: Number
    zone_m: Number
    forward_m: Number
    left_m: Number
    route: str | UnsetType | None = UNSET


class Node(Closed, frozen=True):
    """A vehicle that the viewer's sensors report, or that sends beacons out of their sight."""

    id: VehicleId
    type: Literal["vehicle", "car", "van", "truck"]
    forward_m: Number
    left_m: Number
    heading_deg: WholeNumber | Number | None
    speed_mps: Number
    range_rate_mps: Number | None
    lane: str
    indicator: str | None
    sensors: tuple[str, ...]
    braking: bool | UnsetType | None = UNSET


class Point(Closed, frozen=True):
    """A place in the viewer's frame."""

    forward_m: Number
    left_m: Number


class EgoArrival(Closed, frozen=True):
    """How far the ego is from a conflict; no time where it stands."""

    arc_m: Number
    time_s: Number | None


class Arrival(EgoArrival, frozen=True):
    """How far another vehicle is from a conflict, how fast it is,
    and whether it is seen to brake.
    """

    speed_mps: Number
    braking: bool | UnsetType | None = UNSET


class Conflict(Closed, frozen=True):
    """A vehicle whose path meets the ego's: the one it is on, or one beside, `lane`."""

    vehicle: VehicleId = field(name="with")
    sector: str
    route: str
    point: Point
    ego: EgoArrival
    other: Arrival
    kind: Meeting | UnsetType = UNSET
    lane: Side | UnsetType = UNSET

    @property
    def meets(self) -> bool:
        """Whether the paths cross or merge; else both are on one."""
        return self.kind in (UNSET, "crossing", "merging")


class Sector(Closed, frozen=True):
    """How much of a sector is in sight, and what hides the rest."""

    sector: str
    seen_share: Number
    occluded: bool
    by: tuple[str, ...]


class SceneGraph(Closed, frozen=True):
    """What one viewer knows."""

    viewer: VehicleId
    role: Role
    step: Count
    itself: Viewer = field(name="self")
    ego: Ego
    nodes: tuple[Node, ...]
    conflicts: tuple[Conflict, ...]
    sectors: tuple[Sector, ...]

    @property
    def sensed(self) -> tuple[Node, ...]:
        """The vehicles that its sensors report."""
        return tuple(node for node in self.nodes if node.sensors != BY_BEACON)

    @property
    def seen(self) -> tuple[str, ...]:
        """Ids of the vehicles that its sensors report."""
        return tuple(node.id for node in self.sensed)

    @property
    def occluded(self) -> tuple[str, ...]:
        """Names of the sectors that count as occluded."""
        return tuple(sector.sector for sector in self.sectors if sector.occluded)

    @property
    def all_in_sight(self) -> tuple[Sector, ...]:
        """Its sectors as whoever sees all of each would list them."""
        return tuple(Sector(sector.sector, 1.0, False, ()) for sector in self.sectors)

    def blinded(self) -> "SceneGraph":
        """Return the graph of a viewer without sensors,
        who knows only itself and the ego's beacon.
        """
        unseen = tuple(Sector(sector.sector, 0.0, True, ()) for sector in self.sectors)
        return msgspec.structs.replace(self, nodes=(), conflicts=(), sectors=unseen)

    def plain(self) -> dict[str, Any]:
        """Return what templates read: mappings and lists without the members that are not in the
        file.
        """
        plain: dict[str, Any] = msgspec.to_builtins(self, order="sorted")
        for node in plain["nodes"]:
            node["sensors"] = list(node["sensors"])
        for sector in plain["sectors"]:
            sector["by"] = list(sector["by"])
        return plain | {name: list(plain[name]) for name in ("nodes", "conflicts", "sectors")}
