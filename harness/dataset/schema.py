"""The schema of a frozen dataset: the types of its manifest, trees and decision points.

The types are enforced when a dataset is built and read. They are published beside it as JSON Schema, their
docstrings included, and released datasets pin those files: a docstring here is part of the format.
"""

import re
from collections.abc import Iterable
from functools import lru_cache
from types import GenericAlias
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, field

from harness.core.seeds import Purpose
from harness.world.scenario import Scenario
from harness.world.state import Kind, Part, indicator

FILE_NAME = "^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"  # names of a dataset and its files; never a path
LAST_EPISODE, LAST_SEED = 99_999, 2**31 - 1
LAYOUTS = "layouts.zip"

# No metre, second or share comes near these bounds, and infinity and huge integers do not pass them.
Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
Count = Annotated[int, Meta(ge=0, le=1_000_000)]
Episode = Annotated[int, Meta(ge=0, le=LAST_EPISODE)]
Seed = Annotated[int, Meta(ge=0, le=LAST_SEED + LAST_EPISODE)]
Text = Annotated[str, Meta(max_length=200)]
FileName = Annotated[str, Meta(pattern=FILE_NAME)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
VehicleId = Annotated[str, Meta(pattern="^v[1-9][0-9]?$")]
SceneId = Annotated[str, Meta(pattern="^[0-9]{5}-[0-9]-[0-9a-f]{12}$")]


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
    braking: bool = False


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
    interval_s: Number | None = None
    unmoved: Count = 0


class State(Closed, frozen=True):
    """`harness.world.state.WorldState` in a file."""

    scenario: str
    episode_seed: Seed
    step: Count
    time_s: Number
    target_speed_mps: Number
    vehicles: Annotated[list[Vehicle], Meta(min_length=1)]
    buildings: list[Building]
    beacons: list[Beacon]


class Viewer(Closed, frozen=True):
    """The viewer itself."""

    speed_mps: Number
    lane: str
    zone_m: Number
    type: Kind | None = None


class Ego(Closed, frozen=True):
    """The ego, in the viewer's frame."""

    id: VehicleId
    speed_mps: Number
    target_speed_mps: Number
    zone_m: Number
    forward_m: Number
    left_m: Number
    age_s: Number
    route: str | None = None


class Node(Closed, frozen=True):
    """A vehicle that the viewer's sensors report."""

    id: VehicleId
    type: Literal["vehicle", "car", "van", "truck"]
    forward_m: Number
    left_m: Number
    heading_deg: Number | None
    speed_mps: Number
    range_rate_mps: Number | None
    lane: str
    indicator: str | None
    sensors: list[Literal["camera", "lidar", "radar"]]
    braking: bool | None = None


class Point(Closed, frozen=True):
    """A place in the viewer's frame."""

    forward_m: Number
    left_m: Number


class EgoArrival(Closed, frozen=True):
    """How far the ego is from a conflict; no time where it stands."""

    arc_m: Number
    time_s: Number | None


class Arrival(EgoArrival, frozen=True):
    """How far another vehicle is from a conflict, how fast it is, and whether it is seen to brake."""

    speed_mps: Number
    braking: bool | None = None


class Conflict(Closed, frozen=True):
    """A vehicle whose path meets the ego's: the one it is on, or one beside, `lane`."""

    vehicle: VehicleId = field(name="with")
    sector: str
    route: str
    point: Point
    ego: EgoArrival
    other: Arrival
    kind: Literal["crossing", "merging", "ahead", "behind", "oncoming"] = "crossing"
    lane: Literal["own", "left", "right"] = "own"


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


class Road(Closed, frozen=True):
    """What the scenario says of its road."""


class Danger(Closed, frozen=True):
    """The vehicle that the layout sends against the ego, if any."""

    sector: str | None
    vehicle: VehicleId | None


class Snapshot(Closed, frozen=True):
    """What the simulator needs beyond the state to go on from here."""

    frame: Count
    sections: list[Count]
    speed_index: Count


class Taken(Closed, frozen=True):
    """What leads an environment from its seed to here again: the frame and the name of each action."""

    frame: Count
    taken: list[tuple[Count, Text]]


class Record(Closed, frozen=True):
    """A decision point: a line of `<episode>/<step>.jsonl`. `record_type` has a scenario's own names."""

    scene: SceneId
    episode: Episode
    episode_seed: Seed
    step: Count
    road: Road
    danger: Danger
    state: State
    graphs: dict[VehicleId, Graph]
    distance_m: dict[VehicleId, Number]
    range_m: dict[VehicleId, Number]
    snapshot: Snapshot | Taken


class End(Closed, frozen=True):
    """How an episode ended."""

    result: Literal["cleared", "collision", "time_out", "off_road"]
    time_s: Number
    partner: VehicleId | None
    striker: Literal["ego", "other", "both", "neither", None]
    fault: Literal["ego", "other", None]


class Edge(Closed, frozen=True):
    """Where actions lead that come to the same, and what happens on the way.

    Attributes:
        actions: meta-actions.
        to: place of the next decision point in the next level; None where the episode ends.
        end: how it ends; None where it goes on.
        least_gap_m: smallest distance to another vehicle's outline on the way.
        hard_brakings: times the ego begins to brake harder than 4 m/s² on the way.
        other_crashes: vehicles that crash without the ego on the way.
    """

    actions: Annotated[list[Text], Meta(min_length=1)]
    to: Count | None
    end: End | None
    least_gap_m: Number
    hard_brakings: Count
    other_crashes: Count


class Branching(Closed, frozen=True):
    """A decision point in its tree: what each reference driver does there, and where actions lead."""

    scene: SceneId
    drivers: dict[str, Text]
    edges: Annotated[list[Edge], Meta(min_length=1)]


class Tree(Closed, frozen=True):
    """Every course of a layout: `<episode>/tree.json` in `layouts.zip`.

    Attributes:
        episode: its number.
        episode_seed: seed of the layout.
        danger: the vehicle that the layout sends against the ego, if any.
        levels: decision points by step; the first level is the start alone.
        scenes_sha256: digest of each level's scenes, `<episode>/<step>.jsonl` in `layouts.zip`.
    """

    episode: Episode
    episode_seed: Seed
    danger: Danger
    levels: Annotated[list[list[Branching]], Meta(min_length=1, max_length=10)]
    scenes_sha256: list[Sha256]


class Manifest(Closed, frozen=True):
    """`manifest.json`: what a dataset was built from, and the sha256 of every file and of every tree.

    Of an environment it holds the whole configuration.
    """

    format: Literal["swarmdrive-dataset/2"]
    name: FileName
    scenario: Annotated[str, Meta(max_length=4000)]
    actions: Annotated[list[Text], Meta(min_length=2, extra_json_schema={"uniqueItems": True})]
    parameters: dict[str, bool | Number | Text | list[Number]]
    episodes: Annotated[int, Meta(ge=1, le=LAST_EPISODE + 1)]
    nodes: Annotated[int, Meta(ge=1, le=10_000_000)]
    seed: Annotated[int, Meta(ge=0, le=LAST_SEED)]
    purpose: Purpose
    versions: dict[str, Text]
    files: dict[FileName, Sha256]
    trees_sha256: list[Sha256]
    environment: dict[str, Any] | None = None


@lru_cache(maxsize=8)
def record_type(scenario: Scenario) -> type[Record]:
    """Return `Record` narrowed to the approaches, routes, sectors and facts of the scenario's road."""
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
        conflicts=_list(_narrowed(Conflict, sector=approach, route=route)),
        sectors=_list(_narrowed(SectorSeen, sector=sector)),
    )
    kind: type[Record] = _narrowed(
        Record,
        road=_narrowed(Road, **{k: str if isinstance(v, str) else Number for k, v in road.facts.items()}),
        danger=_narrowed(Danger, sector=sector | None),
        state=_narrowed(State, vehicles=Annotated[_list(vehicle), Meta(min_length=1)]),
        graphs=GenericAlias(dict, (VehicleId, graph)),
        snapshot=Taken if scenario.is_environment else _narrowed(Snapshot, sections=_list(section)),
    )
    return kind


def _choice(names: Iterable[str]) -> Any:
    unique = list(dict.fromkeys(names))
    pattern = f"^({'|'.join(map(re.escape, unique))})$"
    return Annotated[str, Meta(pattern=pattern, extra_json_schema={"enum": unique})]


def _list(kind: Any) -> Any:
    return GenericAlias(list, (kind,))


def _narrowed(kind: type[Closed], /, **fields: Any) -> Any:
    """Return a type with narrower types for some of its members."""
    return msgspec.defstruct(kind.__name__, fields.items(), bases=(kind,), frozen=True)


def record_schema(scenario: Scenario) -> dict[str, Any]:
    """Return the JSON Schema of one line of an `<episode>/<step>.jsonl`."""
    return _published(record_type(scenario), "decision point")


def tree_schema() -> dict[str, Any]:
    """Return the JSON Schema of a `tree.json`."""
    return _published(Tree, "decision tree of a layout")


def manifest_schema() -> dict[str, Any]:
    """Return the JSON Schema of `manifest.json`."""
    return _published(Manifest, "dataset manifest")


def _published(kind: type[Closed], title: str) -> dict[str, Any]:
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, "title": title, **msgspec.json.schema(kind)}
