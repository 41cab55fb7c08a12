"""The schema of a frozen dataset: the types of its manifest, trees and decision points.

The types are enforced when a dataset is built and read; states and scene graphs have theirs in
`harness.world`. They are published beside it as JSON Schema, with their docstrings.
"""

import re
from collections.abc import Iterable
from functools import lru_cache
from types import GenericAlias
from typing import Annotated, Any, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType

from harness.core.files import digest
from harness.core.seeds import LAST_EPISODE, LAST_SEED, Purpose
from harness.world.conflict_measures import HORIZON_S
from harness.world.fields import Closed, Count, Number, Seed, VehicleId
from harness.world.scenario import Scenario
from harness.world.scene_graph import Conflict, Node, SceneGraph, Sector
from harness.world.state import ActionsTaken, Snapshot, VehicleState, WorldState, indicator

FILE_NAME = "^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"  # names of a dataset and its files; never a path
LAYOUTS = "layouts.zip"

Episode = Annotated[int, Meta(ge=0, le=LAST_EPISODE)]
Text = Annotated[str, Meta(max_length=200)]
FileName = Annotated[str, Meta(pattern=FILE_NAME)]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
Seconds = Annotated[float, Meta(ge=0, le=HORIZON_S)]
SceneId = Annotated[str, Meta(pattern="^[0-9]{5}-[0-9]-[0-9a-f]{12}$")]


def scene_id(episode: int, state: WorldState) -> str:
    """Return a decision point's id, `<episode>-<step>-<digest>`; equal states have equal ids."""
    return f"{episode:05d}-{state.step}-{digest(msgspec.to_builtins(state))[:12]}"


class Road(Closed, frozen=True):
    """Facts about the scenario's road: texts, and numbers with the unit in the name."""


class Danger(Closed, frozen=True):
    """The vehicle that the layout sends against the ego, if any."""

    sector: str | None
    vehicle: VehicleId | None


class Record(Closed, frozen=True):
    """A decision point as a line of `<episode>/<step>.jsonl`; it has state and scene graphs.

    `record_type` narrows it to a scenario's names of paths and sectors.
    """

    scene: SceneId  # `<episode>-<step>-<digest>`
    episode: Episode  # number of the episode
    episode_seed: Seed  # seed of its layout
    step: Count  # index of the decision about to be taken
    danger: Danger  # the vehicle that the layout sends against the ego, if any
    state: WorldState  # the state of everything, seen or not
    graphs: dict[VehicleId, SceneGraph]  # what each viewer knows, by its id
    # distance of each viewer to the conflict zone, as the ego knows it
    distance_m: dict[VehicleId, Number]
    range_m: dict[VehicleId, Number]  # distance of each helper to the ego, as the ego knows it
    # what the scenario says of its road; like the next, in datasets only
    road: dict[str, str | Number] | UnsetType = UNSET
    # what the simulator needs beyond the state to go on from here
    snapshot: Snapshot | UnsetType = UNSET


class RecordOfActions(Record, frozen=True):
    """A decision point of a world that is played elsewhere; its snapshot is the actions so far."""

    snapshot: ActionsTaken | UnsetType = UNSET  # type: ignore[assignment]


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
        ttc_s: least time to collision on the way;
            None where none was near, unset in older datasets.
        pet_s: least post-encroachment time of arrivals on the way; as `ttc_s`.
    """

    actions: Annotated[list[Text], Meta(min_length=1)]
    to: Count | None
    end: End | None
    least_gap_m: Number
    hard_brakings: Count
    other_crashes: Count
    ttc_s: Seconds | UnsetType | None = UNSET
    pet_s: Seconds | UnsetType | None = UNSET


class Branching(Closed, frozen=True):
    """A decision point in its tree: what each reference driver does there,
    and where actions lead.
    """

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
    """`manifest.json`: what a dataset was built from,
    and the sha256 of every file and of every tree.

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
    # of traffic from elsewhere: where it is from, and on what terms
    source: Annotated[str, Meta(max_length=1000)] = ""
    licence: Annotated[str, Meta(max_length=1000)] = ""


def plain_type(scenario: Scenario) -> type[Record]:
    """Return the type of a scenario's records that allows any names of paths and sectors."""
    return RecordOfActions if scenario.has_own_world else Record


@lru_cache(maxsize=8)
def record_type(scenario: Scenario) -> type[Record]:
    """Return `Record` with only the names allowed that the scenario's road has.

    These are the names of its approaches, routes, sectors and facts; any names where each layout
    has a road of its own.
    """
    if scenario.layouts is not None:
        return plain_type(scenario)
    road = scenario.road()
    approach = _choice(approach for approach, _ in road.paths)
    route = _choice(route for _, route in road.paths)
    sector = _choice(road.sectors)
    signal = _choice([*(r for _, r in road.paths if indicator(r) == r), "off"])
    section = Annotated[
        int, Meta(ge=0, le=max(len(path.lanes) for path in road.paths.values()) - 1)
    ]
    vehicle = _narrowed(VehicleState, approach=approach, route=route)
    sensors = Literal["camera", "lidar", "radar", "v2x"]
    graph = _narrowed(
        SceneGraph,
        nodes=_tuple(_narrowed(Node, indicator=signal | None, sensors=_tuple(sensors))),
        conflicts=_tuple(_narrowed(Conflict, sector=approach, route=route)),
        sectors=_tuple(_narrowed(Sector, sector=sector)),
    )
    kind: type[Record] = _narrowed(
        Record,
        road=_narrowed(
            Road, **{k: str if isinstance(v, str) else Number for k, v in road.facts.items()}
        ),
        danger=_narrowed(Danger, sector=sector | None),
        state=_narrowed(WorldState, vehicles=Annotated[_tuple(vehicle), Meta(min_length=1)]),
        graphs=GenericAlias(dict, (VehicleId, graph)),
        snapshot=ActionsTaken
        if scenario.has_own_world
        else _narrowed(Snapshot, sections=_tuple(section)),
    )
    return kind


def _choice(names: Iterable[str]) -> Any:
    unique = list(dict.fromkeys(names))
    pattern = f"^({'|'.join(map(re.escape, unique))})$"
    return Annotated[str, Meta(pattern=pattern, extra_json_schema={"enum": unique})]


def _tuple(kind: Any) -> Any:
    return GenericAlias(tuple, (kind, ...))


def _narrowed(kind: type[Closed], /, **fields: Any) -> Any:
    """Return a type with narrower types for some of its members."""
    return msgspec.defstruct(kind.__name__, fields.items(), bases=(kind,), frozen=True)


def record_schema(scenario: Scenario) -> dict[str, Any]:
    """Return the JSON Schema of a line of `<episode>/<step>.jsonl`: a decision point.

    Only the names of paths and sectors of `scenario` fit it.
    """
    return published(record_type(scenario), "decision point")


def tree_schema() -> dict[str, Any]:
    """Return the JSON Schema of `tree.json`: a layout's decision tree."""
    return published(Tree, "decision tree of a layout")


def manifest_schema() -> dict[str, Any]:
    """Return the JSON Schema of `manifest.json`: how a dataset was built."""
    return published(Manifest, "dataset manifest")


def published(kind: type[msgspec.Struct], title: str) -> dict[str, Any]:
    """Return the JSON Schema of a record, with its title; descriptions are the docstrings."""
    dialect = "https://json-schema.org/draft/2020-12/schema"
    schema = {"$schema": dialect, "title": title, **msgspec.json.schema(kind)}
    unwrapped: dict[str, Any] = _unwrapped(schema)
    return unwrapped


def _unwrapped(value: Any) -> Any:
    """Return a JSON Schema whose descriptions, which are docstrings, break no line behind a comma.

    Published files have had them so, whatever width the code's lines have.
    """
    if isinstance(value, dict):
        return {key: _unwrapped(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_unwrapped(each) for each in value]
    return re.sub(r"([,;])\n +", r"\1 ", value) if isinstance(value, str) else value
