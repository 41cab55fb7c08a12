"""One intersection, placed by hand: the ego's graph, a helper's, and what the helpers say."""

from typing import Any

ACTIONS = ("SLOWER", "IDLE", "FASTER")

TRUCK = {
    "id": "v4", "type": "truck", "forward_m": 21.4, "left_m": -3.9, "heading_deg": 180, "speed_mps": 0.0,
    "range_rate_mps": -14.0, "lane": "approach-oncoming", "indicator": "left", "sensors": ["camera", "radar"],
}  # fmt: skip
CAR = {
    "id": "v2", "type": "car", "forward_m": 30.2, "left_m": 18.6, "heading_deg": -90, "speed_mps": 9.8,
    "range_rate_mps": -16.1, "lane": "approach-left", "indicator": "off", "sensors": ["lidar"],
}  # fmt: skip
ECHO = {
    "id": "v9", "type": "vehicle", "forward_m": -40.0, "left_m": 0.4, "heading_deg": None, "speed_mps": 13.7,
    "range_rate_mps": None, "lane": "approach-own", "indicator": None, "sensors": ["radar"],
}  # fmt: skip
FAR = {**CAR, "id": "v12", "forward_m": 88.0, "lane": "exit-ahead"}

COMING = {
    "with": "v2", "sector": "left", "route": "straight", "point": {"forward_m": 27.9, "left_m": 0.0},
    "ego": {"arc_m": 27.9, "time_s": 2.0}, "other": {"arc_m": 18.6, "time_s": 1.9, "speed_mps": 9.8},
}  # fmt: skip
STANDING = {
    "with": "v4", "sector": "oncoming", "route": "left", "point": {"forward_m": 33.0, "left_m": 0.0},
    "ego": {"arc_m": 33.0, "time_s": 2.4}, "other": {"arc_m": 6.5, "time_s": None, "speed_mps": 0.0},
}  # fmt: skip


def graph(
    role: str, nodes: list[dict[str, Any]], conflicts: list[dict[str, Any]], hidden: bool = False
) -> dict[str, Any]:
    """The ego is v1, 28 m before its first conflict point; the helper is v3, waiting on the right arm."""
    helper = role == "helper"
    away = {"forward_m": 25.0, "left_m": 31.5} if helper else {"forward_m": 0.0, "left_m": 0.0}
    return {
        "viewer": "v3" if helper else "v1",
        "role": role,
        "step": 2,
        "self": {
            "speed_mps": 0.0 if helper else 13.9,
            "lane": "approach-right" if helper else "approach-own",
            "zone_m": 30.1,
        },
        "ego": {"id": "v1", "speed_mps": 13.9, "target_speed_mps": 14.0, "zone_m": 30.1, **away},
        "nodes": nodes,
        "conflicts": conflicts,
        "sectors": [
            {"sector": "left", "seen_share": 0.2 if hidden else 1.0, "occluded": hidden,
             "by": ["b2", "v4"] if hidden else []},
            {"sector": "right", "seen_share": 0.87, "occluded": False, "by": ["b1"]},
            {"sector": "oncoming", "seen_share": 1.0, "occluded": False, "by": []},
        ],
    }  # fmt: skip


MESSAGES = (
    {"sender": "v3", "evidence": "v2 from left 19 m before the ego's path.", "risk": "high",
     "intent": (0.9, 0.05, 0.05), "recommended_maneuver": "SLOWER", "confidence": 0.9},
    {"sender": "v5", "evidence": "Nothing on the ego's path; hidden: left.", "risk": "low",
     "intent": (0.2, 0.7, 0.1), "recommended_maneuver": "IDLE", "confidence": 0.7},
)  # fmt: skip

CASES: dict[str, tuple[dict[str, Any], tuple[dict[str, Any], ...]]] = {
    "ego-empty": (graph("ego", [], []), ()),
    "ego-occluded": (graph("ego", [TRUCK, CAR, ECHO, FAR], [COMING, STANDING], hidden=True), ()),
    "ego-standing": (graph("ego", [TRUCK], [STANDING]), ()),
    "ego-messages": (graph("ego", [TRUCK, CAR, ECHO, FAR], [COMING], hidden=True), MESSAGES),
    "helper-empty": (graph("helper", [], []), ()),
    "helper-occluded": (graph("helper", [TRUCK, CAR, ECHO, FAR], [COMING], hidden=True), ()),
    "helper-standing": (graph("helper", [TRUCK], [STANDING]), ()),
}
