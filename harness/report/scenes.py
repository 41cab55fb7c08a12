"""What a page knows of a scene itself: who is where, what each viewer sees, where each action leads."""

from collections.abc import Iterable
from typing import Any

import msgspec
import numpy as np

from harness.core.image import Image
from harness.dataset.forest import Forest
from harness.dataset.load import Scene
from harness.report.drawing.geometry import conflict_points
from harness.report.drawing.view import spots, view_of
from harness.report.library import picture
from harness.world.perception.camera import frame
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph
from harness.world.state import WorldState

# A camera's picture in a page: half as wide and high as a model is shown it, and in 32 shades of each colour.
FRAME_PX = 256, 128
SHADES, HALF_A_SHADE = np.uint8(0xF8), np.uint8(0x04)


def world(scenario: Scenario, scene: Scene, asked: Iterable[tuple[str, ...]]) -> dict[str, Any]:
    """Return what is where, in m to the east and to the north, and what each viewer sees of it.

    Of each viewer, too, the part that is shown of it: for whom the ego asked in each of some decisions.
    """
    state, danger = scene.state, scene.record.danger.vehicle
    zone_m, heard = scenario.road().zone_m, sorted({(), *asked})
    return {
        "time_s": round(state.time_s, 3),
        "vehicles": [
            {
                "id": v.id, "kind": v.kind, "part": "danger" if v.id == danger else v.part,
                "x": round(v.x_m, 2), "y": round(-v.y_m, 2), "heading": round(-v.heading_rad, 4),
                "length": v.length_m, "width": v.width_m, "speed": round(v.speed_mps, 2),
                "crashed": v.crashed,
            }
            for v in state.vehicles
        ],
        "buildings": [
            {"id": b.id, "corners": (b.corners() * [1.0, -1.0]).round(1).tolist()} for b in state.buildings
        ],
        "viewers": {
            viewer: {
                "role": graph.role,
                "seen": [*graph.seen],
                "occluded": [*graph.occluded],
                "conflicts": _conflicts(state, graph),
                "views": {
                    " ".join(ids): [round(view.west_m, 1), round(view.south_m, 1), round(view.width_m, 1)]
                    for ids in heard for view in [view_of(spots(state, zone_m, graph, (danger, *ids)))]
                },
            }
            for viewer, graph in scene.graphs.items()
        },
    }  # fmt: skip


def cameras(scenario: Scenario, scene: Scene) -> dict[str, Any]:
    """Of each viewer, what its cameras see and boxes around what its sensors list (`Frame.boxes`)."""
    shown = {}
    for viewer, graph in scene.graphs.items():
        seen = frame(scenario, scene.state, viewer, FRAME_PX)
        boxes = seen.boxes()
        shown[viewer] = {
            "size": FRAME_PX,
            "picture": picture(Image(seen.pixels & SHADES | HALF_A_SHADE).png(), "png"),
            "boxes": [[name, *box] for name in graph.seen for box in boxes.get(name, ())],
        }
    return shown


def _conflicts(state: WorldState, graph: SceneGraph) -> list[dict[str, Any]]:
    conflicts, points = conflict_points(state, graph)
    return [
        {"x": x, "y": y, "with": c.vehicle, "ego": c.ego.time_s, "other": c.other.time_s}
        for c, (x, y) in zip(conflicts, points.round(1).tolist(), strict=True)
    ]


def outcomes(forest: Forest, name: str) -> list[dict[str, Any]]:
    """Return what each action leads to at a decision point if the full-view driver takes the rest."""
    n = forest.place[name]
    last = forest.then_full_view[n]
    in_time = forest.succeeds(last, forest.tree[n])
    rows = zip(forest.actions, last.tolist(), in_time, forest.safe[n], forest.delay_s[n], strict=True)
    return [
        {**msgspec.to_builtins(end := forest.end(edge)), "action": action, "safe": bool(safe),
         "result": "late" if end.result == "cleared" and not success else end.result,
         "delay_s": None if np.isnan(delay_s) else round(float(delay_s), 3)}
        for action, edge, success, safe, delay_s in rows
    ]  # fmt: skip
