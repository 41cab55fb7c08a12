"""The numbers of a scene graph by name, as arrays take them."""

from collections.abc import Iterator

import numpy as np

from harness.world.road import Road
from harness.world.scene_graph import SceneGraph

INDICATORS = {"off": 0.0, "left": 1.0, "right": 2.0}
BY_SIZE = {
    "pedestrian": -1.5,
    "bicycle": -1.0,
    "motorcycle": -0.5,
    "car": 0.0,
    "van": 0.5,
    "truck": 1.0,
}


def numbers(graph: SceneGraph, road: Road) -> Iterator[tuple[str, float | None]]:
    """Yield what one vehicle knows of a scene as numbers, for models that learn from vectors.

    They are pairs of name and value, None where it is unknown: of the ego, of each lane and of each
    direction of danger in the scene graph. All graphs of one `road` give the same names in the same
    order, so the values form a feature vector. Units are in the names, such as `ego speed_mps`.
    """
    for name in ("speed_mps", "target_speed_mps", "zone_m"):
        yield f"ego {name}", getattr(graph.ego, name)
    lanes = sorted({role for path in road.paths.values() for role in path.roles})
    for lane in (*lanes, "off-lane"):
        nodes = [node for node in graph.nodes if node.lane == lane]
        node = min(nodes, key=lambda n: float(np.hypot(n.forward_m, n.left_m)), default=None)
        yield f"{lane}: vehicles", float(len(nodes))
        for name in ("forward_m", "left_m", "speed_mps", "heading_deg", "range_rate_mps"):
            yield f"{lane}: nearest {name}", getattr(node, name, None)
        yield f"{lane}: nearest kind", BY_SIZE.get(node.type) if node else None
        yield f"{lane}: nearest indicator", INDICATORS.get((node and node.indicator) or "")
        yield f"{lane}: nearest sensors", float(len(node.sensors) if node else 0)
    seen = {sector.sector: sector for sector in graph.sectors}
    for name in road.sectors:
        yield f"{name}: seen_share", seen[name].seen_share
        yield f"{name}: hidden by", float(len(seen[name].by))
        arrivals = [conflict.other for conflict in graph.conflicts if conflict.sector == name]
        first = min(arrivals, key=lambda arrival: arrival.arc_m, default=None)
        yield f"{name}: conflicts", float(len(arrivals))
        for number in ("arc_m", "time_s", "speed_mps"):
            yield f"{name}: first conflict {number}", getattr(first, number, None)
