"""One intersection, placed by hand: the ego's graph, a helper's, and what the helpers say."""

from collections.abc import Sequence
from typing import Any

from msgspec.structs import replace

from harness.world.scene_graph import (
    Arrival,
    Conflict,
    Ego,
    EgoArrival,
    Node,
    Point,
    Role,
    SceneGraph,
    Sector,
    Viewer,
)

ACTIONS = ("SLOWER", "IDLE", "FASTER")

TRUCK = Node(
    "v4", "truck", 21.4, -3.9, 180, 0.0, -14.0, "approach-oncoming", "left", ("camera", "radar")
)  # fmt: skip
CAR = Node("v2", "car", 30.2, 18.6, -90, 9.8, -16.1, "approach-left", "off", ("lidar",))
ECHO = Node("v9", "vehicle", -40.0, 0.4, None, 13.7, None, "approach-own", None, ("radar",))
FAR = replace(CAR, id="v12", forward_m=88.0, lane="exit-ahead")

COMING = Conflict(
    "v2", "left", "straight", Point(27.9, 0.0), EgoArrival(27.9, 2.0), Arrival(18.6, 1.9, 9.8)
)  # fmt: skip
STANDING = Conflict(
    "v4", "oncoming", "left", Point(33.0, 0.0), EgoArrival(33.0, 2.4), Arrival(6.5, None, 0.0)
)  # fmt: skip


def graph(
    role: Role, nodes: Sequence[Node], conflicts: Sequence[Conflict], hidden: bool = False
) -> SceneGraph:
    """The ego is v1, 28 m before its first conflict point;
    the helper is v3, waiting on the right arm.
    """
    helper = role == "helper"
    itself = Viewer(0.0, "approach-right", 30.1) if helper else Viewer(13.9, "approach-own", 30.1)
    ego = Ego("v1", 13.9, 14.0, 0.0, 30.1, *((25.0, 31.5) if helper else (0.0, 0.0)))
    sectors = (
        Sector("left", 0.2 if hidden else 1.0, hidden, ("b2", "v4") if hidden else ()),
        Sector("right", 0.87, False, ("b1",)),
        Sector("oncoming", 1.0, False, ()),
    )
    return SceneGraph(
        "v3" if helper else "v1", role, 2, itself, ego, (*nodes,), (*conflicts,), sectors
    )


MESSAGES = (
    {"sender": "v3", "evidence": "v2 from left 19 m before the ego's path.", "risk": "high",
     "intent": (0.9, 0.05, 0.05), "recommended_maneuver": "SLOWER", "confidence": 0.9},
    {"sender": "v5", "evidence": "Nothing on the ego's path; hidden: left.", "risk": "low",
     "intent": (0.2, 0.7, 0.1), "recommended_maneuver": "IDLE", "confidence": 0.7},
)  # fmt: skip

CASES: dict[str, tuple[SceneGraph, tuple[dict[str, Any], ...]]] = {
    "ego-empty": (graph("ego", [], []), ()),
    "ego-occluded": (graph("ego", [TRUCK, CAR, ECHO, FAR], [COMING, STANDING], hidden=True), ()),
    "ego-standing": (graph("ego", [TRUCK], [STANDING]), ()),
    "ego-messages": (graph("ego", [TRUCK, CAR, ECHO, FAR], [COMING], hidden=True), MESSAGES),
    "helper-empty": (graph("helper", [], []), ()),
    "helper-occluded": (graph("helper", [TRUCK, CAR, ECHO, FAR], [COMING], hidden=True), ()),
    "helper-standing": (graph("helper", [TRUCK], [STANDING]), ()),
}
