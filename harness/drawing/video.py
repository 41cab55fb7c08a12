"""A driven episode from above, as a moving picture.

Thinking is shown slowly: a still a frame of 20 ms while a decision is open, else ten a second, all for the
same time. So messages can be seen to travel.
"""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from PIL import Image

from harness.drawing.ground import ground, north_up
from harness.drawing.pictures import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, VERMILLION, styled
from harness.drawing.scene import LOOKS
from harness.drive.replay import Played, Still, stills
from harness.files import write_whole
from harness.perception.graph import scene_graph
from harness.scenarios.occluded_intersection import ACTIONS
from harness.scene import VehicleState, WorldState

VIEW_M = 80.0
SIDE_IN, BARS_IN, DPI = 5.0, 1.2, 90
STILL_MS, LAST_MS = 100, 2500
TEXT_PT = 6.5
EYES = (BLUE, GREEN, PURPLE, ORANGE)  # of the ego and the helpers: lines to what each sees


def write_gif(played: Played, out: Path, progress: Callable[[int], None]) -> None:
    """Draw an episode into a GIF; `progress` is called for each still."""
    pictures: list[Image.Image] = []
    moment: WorldState | None = None
    seen: dict[str, list[str]] = {}
    for still in stills(played, progress):
        if still.seen != moment:
            moment = still.seen
            seen = {
                v.id: [node["id"] for node in scene_graph(moment, v.id)["nodes"]]
                for v in (moment.ego, *moment.helpers)
            }
        pictures.append(_picture(played, still, seen))
    durations = [STILL_MS] * (len(pictures) - 1) + [LAST_MS]
    data = io.BytesIO()
    pictures[0].save(
        data, "GIF", save_all=True, append_images=pictures[1:], duration=durations, loop=0, optimize=False
    )
    write_whole(out, data.getvalue())


@styled
def _picture(played: Played, still: Still, seen: dict[str, list[str]]) -> Image.Image:
    figure = Figure(figsize=(SIDE_IN, SIDE_IN + BARS_IN), dpi=DPI)
    height = SIDE_IN + BARS_IN
    axes = figure.add_axes((0.0, BARS_IN / height, 1.0, SIDE_IN / height))
    axes.set(xlim=(-VIEW_M, VIEW_M), ylim=(-VIEW_M, VIEW_M), xticks=[], yticks=[])
    ground(axes, still.state.buildings, VIEW_M, TEXT_PT)
    _sight(axes, still.state, seen)
    for vehicle in still.state.vehicles:
        _vehicle(axes, vehicle, vehicle.id in (*seen[still.state.ego.id], still.state.ego.id))
    _messages(axes, played, still)
    _bars(figure.add_axes((0.62, 0.28 / height, 0.35, 0.8 / height)), still)
    ego = still.state.ego
    slow = ", thinking (slow motion)" if still.open else ""
    lines = (
        f"episode {played.episode}, {played.condition}, seed {played.seed}",
        f"{still.state.time_s:5.2f} s, ego {ego.speed_mps:4.1f} m/s{slow}",
        still.outcome or f"decision {still.decision['action']} at {still.decision['acts_at_s']:.2f} s",
    )
    for n, line in enumerate(lines):
        bold = "bold" if n == 2 and still.outcome else "normal"
        figure.text(0.02, (BARS_IN - 0.3 - 0.25 * n) / height, line, size=8, weight=bold)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]  # type: ignore[no-untyped-call]
    return Image.fromarray(np.ascontiguousarray(pixels)).quantize(64, dither=Image.Dither.NONE)


def _sight(axes: Axes, state: WorldState, seen: dict[str, list[str]]) -> None:
    at = {v.id: north_up(np.array([v.x_m, v.y_m])) for v in state.vehicles}
    for colour, (viewer, ids) in zip(EYES, seen.items(), strict=True):
        for other in ids:
            axes.plot(*np.array([at[viewer], at[other]]).T, color=colour, linewidth=0.6, alpha=0.5)


def _vehicle(axes: Axes, vehicle: VehicleState, known: bool) -> None:
    """Filled if the ego knew of it when its last decision began."""
    style: dict[str, Any] = dict(LOOKS[vehicle.part])
    if vehicle.crashed:
        style["facecolor"] = VERMILLION
    if not known:
        style |= {"facecolor": "none", "linestyle": (0, (2, 1.2))}
        style.pop("hatch", None)
    axes.add_patch(Polygon(north_up(vehicle.corners()), **style, zorder=3))
    x, y = north_up(np.array([vehicle.x_m, vehicle.y_m]))
    axes.text(x + 2.5, y + 2.5, vehicle.id, size=TEXT_PT, clip_on=True, zorder=5)


def _messages(axes: Axes, played: Played, still: Still) -> None:
    """Each reply on its way from its helper to the ego; one that was lost goes half of it."""
    latency = played.config["latency"]["inference_s"]
    sent_s = max(latency.values())
    ego = still.state.ego
    for message in still.decision["messages"] if still.open else ():
        end_s = (message["arrival_ms"] or still.decision["latency_ms"]) / 1000
        share = np.clip((still.since_s - sent_s) / max(end_s - sent_s, 1e-9), 0.0, 1.0)
        lost = not message["delivered"]
        share = min(share, 0.5) if lost else share
        helper = still.state.vehicle(message["from"])
        path = north_up(np.array([[helper.x_m, helper.y_m], [ego.x_m, ego.y_m]]))
        place = path[0] + share * (path[1] - path[0])
        axes.plot(*path.T, color=GREY, linewidth=0.8, linestyle=":", zorder=6)
        if still.since_s >= sent_s:
            colour = VERMILLION if lost or not message["on_time"] else INK
            axes.plot(*place, marker="X" if lost else "o", color=colour, markersize=6, zorder=7)


def _bars(axes: Axes, still: Still) -> None:
    """The policy of the last decision, pale until it is ready."""
    decision = still.decision
    colours = [VERMILLION if action == decision["action"] else "#BBBBBB" for action in ACTIONS]
    axes.barh(range(len(ACTIONS)), decision["fused"], color=colours, alpha=0.35 if still.open else 1.0)
    axes.set(xlim=(0, 1), yticks=range(len(ACTIONS)), xticks=[0, 0.5, 1])
    axes.set_yticklabels(ACTIONS, size=7)
    axes.tick_params(labelsize=6, length=2)
    axes.invert_yaxis()
