"""One still of a driven episode: from above, and as the cameras of the ego and of one helper see it.

What moves is drawn over a ground that was drawn once.
"""

from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import lru_cache

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch, Polygon, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.textpath import TextPath

from harness.core.errors import printable
from harness.core.image import Pixels
from harness.evaluate.replay import Played, Still
from harness.report.drawing.colours import BAD, GOOD, GREY, INK, LATE, ROLES
from harness.report.drawing.colours import actions as colours_of
from harness.report.drawing.geometry import VIEW_M, north_up
from harness.report.drawing.ground import TEXT_PT, ground
from harness.report.drawing.scene import style_of
from harness.world.perception.camera import SIZE_PX, frame
from harness.world.state import Building, VehicleState, WorldState

SIDE_IN, BARS_IN, DPI = 5.0, 1.2, 90
WIDTH, HEIGHT = SIZE_PX
CAMERA_IN, CAPTION_PX = WIDTH / DPI, 23
PT_PER_M = SIDE_IN * 72 / (2 * VIEW_M)


class Canvas:
    """A figure whose fixed parts are drawn once; what moves is drawn over a copy of them."""

    def __init__(self, played: Played, buildings: Iterable[Building]) -> None:
        self.played, self.actions = played, played.scenario.actions
        height, width = SIDE_IN + BARS_IN, SIDE_IN + CAMERA_IN
        self.figure = Figure(figsize=(width, height), dpi=DPI)
        place = 0.0, BARS_IN / height, SIDE_IN / width, SIDE_IN / height
        self.axes = ground(self.figure, place, played.scenario, buildings)
        self.bars = self.figure.add_axes((3.1 / width, 0.28 / height, 1.75 / width, 0.8 / height))
        self.bars.set(xlim=(0, 1), ylim=(len(self.actions) - 0.5, -0.5), xticks=[0, 0.5, 1])
        self.bars.set_yticks(range(len(self.actions)), labels=self.actions, size=7)
        self.bars.tick_params(labelsize=6, length=2)
        self.lines = [self.figure.text(0.1 / width, (0.9 - 0.22 * n) / height, "", size=8) for n in range(4)]
        self.lines[0].set_text(f"episode {played.episode}, seed {played.seed}")
        self.lines[1].set_text(printable(played.condition, 34))
        self.captions = [
            self.figure.text(
                (SIDE_IN + 0.06) / width, 1 - (top + CAPTION_PX - 7) / (height * DPI), "", size=8
            )
            for top in (0, CAPTION_PX + HEIGHT)
        ]
        self.canvas = FigureCanvasAgg(self.figure)
        self.canvas.draw()  # type: ignore[no-untyped-call]
        self.fixed = self.canvas.copy_from_bbox(self.figure.bbox)  # type: ignore[no-untyped-call]

    def picture(self, still: Still, seen: dict[str, list[str]]) -> Pixels:
        """One still, with what each viewer saw when the decision began."""
        self.canvas.restore_region(self.fixed)  # type: ignore[no-untyped-call]
        ego = still.state.ego
        self._over(*_sight(still.state, seen))
        for vehicle in still.state.vehicles:
            self._over(_vehicle(vehicle, vehicle.id in (*seen[ego.id], ego.id)))
        attackers = {message.sender for message in still.decision.messages if message.attacker}
        self._over(_names(still.state.vehicles, attackers))
        self._over(*_messages(self.played, still))
        for bar in _bars(still, self.actions):
            self.bars.add_artist(bar)
            self.bars.draw_artist(bar)
            bar.remove()
        slow = ", thinking (slowed)" if still.open else ""
        self.lines[2].set_text(f"{still.state.time_s:5.2f} s, ego {ego.speed_mps:4.1f} m/s{slow}")
        decision = f"decision {still.decision.action} at {still.decision.acts_at_s:.2f} s"
        self.lines[3].set(text=still.outcome or decision, weight="bold" if still.outcome else "normal")
        viewers = _watched(still.state, seen)
        for viewer, caption in zip(viewers, self.captions, strict=False):
            whose = "ego" if viewer == ego.id else "helper"
            caption.set_text(f"cameras of {printable(viewer)}, {whose}: front above, rear below")
        for line in (*self.lines[2:], *self.captions[: len(viewers)]):
            self.figure.draw_artist(line)
        pixels = np.ascontiguousarray(np.asarray(self.canvas.buffer_rgba())[..., :3])  # type: ignore[no-untyped-call]
        for n, viewer in enumerate(viewers):
            top = CAPTION_PX + n * (CAPTION_PX + HEIGHT)
            pixels[top : top + HEIGHT, -WIDTH:] = frame(self.played.scenario, still.state, viewer).pixels
        return pixels

    def _over(self, *artists: Artist) -> None:
        for artist in artists:
            self.axes.add_artist(artist)
            self.axes.draw_artist(artist)
            artist.remove()


def _watched(state: WorldState, seen: dict[str, list[str]]) -> list[str]:
    """The ego, and the helper that saw most of whom the ego did not see."""
    ego = state.ego.id
    helpers = [v.id for v in state.vehicles if v.id in seen and v.id != ego]
    more = {helper: len({*seen[helper]} - {*seen[ego], ego, helper}) for helper in helpers}
    return [ego, *sorted(helpers, key=lambda helper: -more[helper])[:1]]


def _sight(state: WorldState, seen: dict[str, list[str]]) -> Iterator[Artist]:
    at = {v.id: north_up(np.array([v.x_m, v.y_m])) for v in state.vehicles}
    for viewer, ids in seen.items():
        colour = ROLES["ego" if viewer == state.ego.id else "helper"]
        there = [other for other in ids if viewer in at and other in at]  # traffic may have left since
        lines = [np.array([at[viewer], at[other]]) for other in there]
        yield LineCollection(lines, colors=colour, linewidths=0.6, alpha=0.5)


def _vehicle(vehicle: VehicleState, known: bool) -> Artist:
    """Filled if the ego knew of it when its last decision began."""
    style = style_of(vehicle.part, not known)
    if known and vehicle.crashed:
        style["facecolor"] = BAD
    return Polygon(north_up(vehicle.corners()), **style)


def _names(vehicles: Iterable[VehicleState], attackers: Collection[str]) -> Artist:
    """Every vehicle's id beside it, as one outline, which costs a fifth of as many texts."""
    at = north_up(np.array([(v.x_m, v.y_m) for v in vehicles])) + 2.5
    outlines = [_outline(f"{v.id} attacks" if v.id in attackers else v.id) for v in vehicles]
    moved = [Outline(o.vertices + place, o.codes) for o, place in zip(outlines, at, strict=True)]
    return PathPatch(Outline.make_compound_path(*moved), facecolor=INK, edgecolor="none")


@lru_cache
def _outline(name: str) -> Outline:
    return TextPath((0.0, 0.0), name, size=TEXT_PT / PT_PER_M)


def _messages(played: Played, still: Still) -> Iterator[Artist]:
    """Each reply on its way from its helper to the ego; one that was lost goes half of it.

    Where each answer has a time of its own, a reply is drawn from the decision's start.
    """
    latency = played.manifest.latency
    sent_s = max(latency.ego_s or 0.0, *latency.helper_times_s(), 0.0)
    ego = still.state.ego
    there = {v.id for v in still.state.vehicles}
    for message in still.decision.messages if still.open else ():
        if message.sender not in there:
            continue
        end_s = (message.arrival_ms or still.decision.latency_ms or 0.0) / 1000
        share = np.clip((still.since_s - sent_s) / max(end_s - sent_s, 1e-9), 0.0, 1.0)
        lost = not message.delivered
        share = min(share, 0.5) if lost else share
        helper = still.state.vehicle(message.sender)
        path = north_up(np.array([[helper.x_m, helper.y_m], [ego.x_m, ego.y_m]]))
        place = path[0] + share * (path[1] - path[0])
        yield Line2D(*path.T, color=GREY, linewidth=0.8, linestyle=":")
        if still.since_s >= sent_s:
            colour = BAD if lost else GOOD if message.on_time else LATE
            yield Line2D(place[:1], place[1:], marker="X" if lost else "o", color=colour, markersize=6)


def _bars(still: Still, actions: Sequence[str]) -> Iterator[Artist]:
    """The policy of the last decision, pale until it is ready."""
    decision, colours = still.decision, colours_of(actions)
    for n, (action, p) in enumerate(zip(actions, decision.fused, strict=True)):
        width = 1.4 if action == decision.action else 0.3
        pale = 0.35 if still.open else 1.0
        yield Rectangle(
            (0.0, n - 0.4), p, 0.8, facecolor=colours[action], alpha=pale, edgecolor=INK, linewidth=width
        )
