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
    age_s: Number  # age of the beacon that this is known from; 0 if it is the truth
    zone_m: Number
    forward_m: Number
    left_m: Number
    route: str | UnsetType | None = UNSET


class Node(Closed, frozen=True):
    """Describe a vehicle that the viewer's sensors report, or that it knows only by beacons."""

    id: VehicleId
    type: Literal["vehicle", Kind]
    forward_m: Number
    left_m: Number
    heading_deg: WholeNumber | Number | None
    speed_mps: Number
    range_rate_mps: Number | None
    lane: str
    indicator: str | None
    sensors: tuple[str, ...]  # sensors that report it; `v2x` if only its beacons do
    braking: bool | UnsetType | None = UNSET


class AgedNode(Node, frozen=True):
    """Describe a vehicle that is known by a message about an earlier time, carried on since."""

    age_s: Number = 0.0  # since it was seen


class Point(Closed, frozen=True):
    """A place in the viewer's frame."""

    forward_m: Number
    left_m: Number


class EgoArrival(Closed, frozen=True):
    """How far the ego is from a conflict; no time where it stands."""

    arc_m: Number  # distance to go along the path; negative once past
    time_s: Number | None  # time to get there at the present speed


class Arrival(EgoArrival, frozen=True):
    """How far another vehicle is from a conflict, how fast it is,
    and whether it is seen to brake.
    """

    speed_mps: Number
    braking: bool | UnsetType | None = UNSET


class Conflict(Closed, frozen=True):
    """Describe where another vehicle's path meets the ego's path, or one to which it may change."""

    vehicle: VehicleId = field(name="with")
    sector: str  # approach of the other vehicle's path
    route: str  # route of the other vehicle's path
    point: Point
    ego: EgoArrival
    other: Arrival
    kind: Meeting | UnsetType = UNSET
    lane: Side | UnsetType = UNSET  # which of the ego's paths it concerns; `own` is the present one

    @property
    def meets(self) -> bool:
        """Return whether the paths cross or merge, rather than run along the same lane."""
        return self.kind in (UNSET, "crossing", "merging")


class Sector(Closed, frozen=True):
    """Describe how much of one direction that danger can come from is in the viewer's sight.

    `by` has the ids of the vehicles and buildings that hide the rest.
    """

    sector: str
    seen_share: Number
    occluded: bool
    by: tuple[str, ...]


class SceneGraph(Closed, frozen=True):
    """Hold what one viewer knows of a scene."""

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
        """Return the vehicles that the viewer's sensors report, not those known by beacons."""
        return tuple(node for node in self.nodes if node.sensors != BY_BEACON)

    @property
    def seen(self) -> tuple[str, ...]:
        """Return the ids of the vehicles that the viewer's sensors report."""
        return tuple(node.id for node in self.sensed)

    @property
    def occluded(self) -> tuple[str, ...]:
        """Return the names of the sectors of which the viewer sees less than half.

        A sector is a direction that danger can come from.
        """
        return tuple(sector.sector for sector in self.sectors if sector.occluded)

    @property
    def all_in_sight(self) -> tuple[Sector, ...]:
        """Return the graph's sectors as a viewer that sees all of each would list them.

        A sector is a direction that danger can come from.
        """
        return tuple(Sector(sector.sector, 1.0, False, ()) for sector in self.sectors)

    def blinded(self) -> "SceneGraph":
        """Return the graph as a viewer without sensors has it: no vehicles, no sector in sight.

        A sector is a direction that danger can come from. It keeps the viewer itself and the ego,
        which is known by its beacon.
        """
        unseen = tuple(Sector(sector.sector, 0.0, True, ()) for sector in self.sectors)
        return msgspec.structs.replace(self, nodes=(), conflicts=(), sectors=unseen)

    def plain(self) -> dict[str, Any]:
        """Return the graph as dicts and lists, by the names in files, for templates of prompts.

        Members that are `UNSET`, as those that a scenario does not have, are left out.
        """
        plain: dict[str, Any] = msgspec.to_builtins(self, order="sorted")
        for node in plain["nodes"]:
            node["sensors"] = list(node["sensors"])
        for sector in plain["sectors"]:
            sector["by"] = list(sector["by"])
        return plain | {name: list(plain[name]) for name in ("nodes", "conflicts", "sectors")}
