"""The form of a frozen dataset: what its manifest and its decision points hold, and the JSON Schemas of both.

What is typed here is enforced when a dataset is built and read, and published beside it as JSON Schema.
"""

import re
from collections.abc import Iterable
from functools import lru_cache
from types import GenericAlias
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, field

from harness.world.scenario import Scenario
from harness.world.state import Kind, Part, indicator

FILE_NAME = "^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"  # of a dataset and of its files: never a path
LAST_EPISODE, LAST_SEED = 99_999, 2**31 - 1

# No metre, second or share comes near these bounds; infinity and thousand-digit integers do not pass them.
Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
Count = Annotated[int, Meta(ge=0, le=1_000_000)]
Episode = Annotated[int, Meta(ge=0, le=LAST_EPISODE)]
Seed = Annotated[int, Meta(ge=0, le=LAST_SEED + LAST_EPISODE)]
Text = Annotated[str, Meta(max_length=200)]
FileName = Annotated[str, Meta(pattern=FILE_NAME)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
VehicleId = Annotated[str, Meta(pattern="^v[1-9][0-9]?$")]


class Closed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A record with these members and no other."""


class Vehicle(Closed, frozen=True):
    """`harness.world.state.VehicleState` in a file."""

    id: VehicleId
    kind: Kind
    part: Part
    x_m: Number
    y_m: Number
    heading_rad: Number
    speed_mps: Number
    approach: str
    route: str
    crashed: bool


class Building(Closed, frozen=True):
    """A box that blocks sight; its walls in metres."""

    id: Annotated[str, Meta(pattern="^b[1-9]$")]
    west_m: Number
    north_m: Number
    east_m: Number
    south_m: Number


class Beacon(Closed, frozen=True):
    """`harness.world.state.Beacon` in a file."""

    sender: VehicleId
    time_s: Number
    arrives_s: Number
    x_m: Number
    y_m: Number
    heading_rad: Number
    speed_mps: Number
    target_speed_mps: Number | None
    heard_by: list[VehicleId]


class State(Closed, frozen=True):
    """`harness.world.state.WorldState` in a file."""

    scenario: str
    episode_seed: Seed
    step: Count
    time_s: Number
    target_speed_mps: Number
    vehicles: Annotated[list[Vehicle], Meta(min_length=1)]
    buildings: list[Building]
    beacons: list[Beacon] = []


class Viewer(Closed, frozen=True):
    """The viewer itself."""

    speed_mps: Number
    lane: str
    zone_m: Number


class Ego(Closed, frozen=True):
    """The ego, in the viewer's frame."""

    id: VehicleId
    speed_mps: Number
    target_speed_mps: Number
    zone_m: Number
    forward_m: Number
    left_m: Number
    age_s: Number = 0.0


class Node(Closed, frozen=True):
    """A vehicle that the viewer's sensors report."""

    id: VehicleId
    type: Literal["vehicle", "car", "truck"]
    forward_m: Number
    left_m: Number
    heading_deg: Number | None
    speed_mps: Number
    range_rate_mps: Number | None
    lane: str
    indicator: str | None
    sensors: list[Literal["camera", "lidar", "radar"]]


class Point(Closed, frozen=True):
    """A place in the viewer's frame."""

    forward_m: Number
    left_m: Number


class EgoArrival(Closed, frozen=True):
    """How far the ego is from a conflict; no time where it stands."""

    arc_m: Number
    time_s: Number | None


class Arrival(EgoArrival, frozen=True):
    """How far another vehicle is from a conflict, and how fast it is."""

    speed_mps: Number


class Conflict(Closed, frozen=True):
    """A vehicle whose path crosses the ego's."""

    vehicle: VehicleId = field(name="with")
    sector: str
    route: str
    point: Point
    ego: EgoArrival
    other: Arrival


class SectorSeen(Closed, frozen=True):
    """How much of a sector is in sight, and what hides the rest."""

    sector: str
    seen_share: Number
    occluded: bool
    by: list[str]


class Graph(Closed, frozen=True):
    """What one viewer knows."""

    viewer: VehicleId
    role: Literal["ego", "helper"]
    step: Count
    itself: Viewer = field(name="self")
    ego: Ego
    nodes: list[Node]
    conflicts: list[Conflict]
    sectors: list[SectorSeen]


class Outcome(Closed, frozen=True):
    """What an action leads to."""

    result: Literal["cleared", "collision", "time_out", "off_road"]
    time_s: Number
    partner: VehicleId | None
    striker: Literal["ego", "other", "both", "neither", None]
    fault: Literal["ego", "other", None]
    least_gap_m: Number
    other_crashes: Count


class Road(Closed, frozen=True):
    """What the scenario says of its road."""


class Danger(Closed, frozen=True):
    """The vehicle that the layout sends against the ego, if any."""

    sector: str | None
    vehicle: VehicleId | None


class Lead(Closed, frozen=True):
    """The action that was taken when the episode was frozen, and who chose it."""

    action: str
    reason: Literal["cruise", "local-view", "full-view", "random", "guard"]


class Snapshot(Closed, frozen=True):
    """What the simulator needs beyond the state to go on from here."""

    frame: Count
    sections: list[Count]
    speed_index: Count


class Record(Closed, frozen=True):
    """A decision point: one line of `scenes.jsonl`. `record_type` has the names of a scenario's places."""

    scene: Annotated[str, Meta(pattern="^[0-9]{5}-[0-9]$")]
    episode: Episode
    episode_seed: Seed
    step: Count
    road: Road
    danger: Danger
    behaviour: Lead
    state: State
    graphs: dict[VehicleId, Graph]
    distance_m: dict[VehicleId, Number]
    outcomes: dict[str, Outcome]
    snapshot: Snapshot
    range_m: dict[VehicleId, Number] = {}


class Manifest(Closed, frozen=True):
    """`manifest.json`: what a dataset was built from, and the sha256 of every file."""

    format: Literal["swarmdrive-dataset/1"]
    name: FileName
    scenario: Text
    actions: Annotated[list[Text], Meta(min_length=2, extra_json_schema={"uniqueItems": True})]
    parameters: dict[str, bool | Number | list[Number]]
    behaviour: dict[str, Number]
    episodes: Annotated[int, Meta(ge=1, le=LAST_EPISODE + 1)]
    decisions: Annotated[int, Meta(ge=1, le=1_000_000)]
    seed: Annotated[int, Meta(ge=0, le=LAST_SEED)]
    versions: dict[str, Text]
    files: Annotated[dict[FileName, Sha256], Meta(extra_json_schema={"required": ["scenes.jsonl"]})]

    def number(self, parameter: str) -> float:
        """A scenario parameter that is one number."""
        value = self.parameters[parameter]
        if isinstance(value, list):
            raise TypeError(f"{parameter} is a list")
        return value


@lru_cache(maxsize=8)
def record_type(scenario: Scenario) -> type[Record]:
    """`Record` with the approaches, routes, sectors and facts of the scenario's road."""
    road = scenario.road()
    approach = _choice(approach for approach, _ in road.paths)
    route = _choice(route for _, route in road.paths)
    sector = _choice(road.sectors)
    signal = _choice([*(r for _, r in road.paths if indicator(r) == r), "off"])
    section = Annotated[int, Meta(ge=0, le=max(len(path.lanes) for path in road.paths.values()) - 1)]
    vehicle = _narrowed(Vehicle, approach=approach, route=route)
    graph = _narrowed(
        Graph,
        nodes=_list(_narrowed(Node, indicator=signal | None)),
        conflicts=_list(_narrowed(Conflict, sector=sector, route=route)),
        sectors=_list(_narrowed(SectorSeen, sector=sector)),
    )
    kind: type[Record] = _narrowed(
        Record,
        road=_narrowed(Road, **{k: str if isinstance(v, str) else Number for k, v in road.facts.items()}),
        danger=_narrowed(Danger, sector=sector | None),
        state=_narrowed(State, vehicles=Annotated[_list(vehicle), Meta(min_length=1)]),
        graphs=GenericAlias(dict, (VehicleId, graph)),
        snapshot=_narrowed(Snapshot, sections=_list(section)),
    )
    return kind


def _choice(names: Iterable[str]) -> Any:
    unique = list(dict.fromkeys(names))
    pattern = f"^({'|'.join(map(re.escape, unique))})$"
    return Annotated[str, Meta(pattern=pattern, extra_json_schema={"enum": unique})]


def _list(kind: Any) -> Any:
    return GenericAlias(list, (kind,))


def _narrowed(kind: type[Closed], /, **fields: Any) -> Any:
    """The kind, some of whose members are of a narrower type."""
    return msgspec.defstruct(kind.__name__, fields.items(), bases=(kind,), frozen=True)


def record_schema(scenario: Scenario) -> dict[str, Any]:
    """JSON Schema of one line of `scenes.jsonl`."""
    schema, actions = _published(record_type(scenario), "decision point"), scenario.actions
    schema["$defs"]["Lead"]["properties"]["action"] = {"enum": list(actions)}
    outcomes = schema["$defs"]["Record"]["properties"]["outcomes"]
    outcomes |= {"propertyNames": {"enum": list(actions)}, "required": sorted(actions)}
    return schema


def manifest_schema() -> dict[str, Any]:
    """JSON Schema of `manifest.json`."""
    return _published(Manifest, "dataset manifest")


def _published(kind: type[Closed], title: str) -> dict[str, Any]:
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, "title": title, **msgspec.json.schema(kind)}
