"""One still of a driven episode: from above,
and as the cameras of the ego and of one helper see it.

Words are drawn when they change, what lies on the ground each time:
the view from above follows the action.
"""

from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import chain

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.text import Text
from matplotlib.textpath import TextPath

from harness.core.arrays import Floats, Pixels
from harness.core.errors import printable
from harness.evaluate.replay import ReplayedEpisode
from harness.extensions.media.stills import Still, Turn
from harness.report.drawing.artists import body, named, roads, scale_m, shade, sight, walls
from harness.report.drawing.colours import BAD, BUILDING_NAME, GOOD, GREY, INK, LATE, LIGHT, ROLES
from harness.report.drawing.colours import actions as colours_of
from harness.report.drawing.geometry import View, north_up, shape_of
from harness.report.drawing.labels import covered, cut
from harness.world.perception.camera import SIZE_PX, frame
from harness.world.state import Building, VehicleState, WorldState

SIDE_IN, HEIGHT_IN, DPI = 5.0, 6.2, 90
WIDTH, HEIGHT = SIZE_PX
CAMERA_IN, CAPTION_PX = WIDTH / DPI, 23
NAME_PT = 7.0
SIDES = np.array(
    [[0, 1], [0, -1], [1, 0], [-1, 0], [1, 1], [-1, 1], [1, -1], [-1, -1]], dtype=float
)
GAPS_PT = (3.5, 13.0, 23.0, 35.0)  # between a vehicle and its name


class Canvas:
    """Draw the stills of one episode, the pictures of its video, on one figure.

    It is made from the replayed episode, the buildings beside the road, and the ids of the agents
    (vehicles that decide for themselves), the ego first; call `picture` once a still. Parts that do
    not change are drawn only once.
    """

    def __init__(
        self, played: ReplayedEpisode, buildings: Sequence[Building], agents: Sequence[str]
    ) -> None:
        self.played, self.actions, self.buildings = played, played.scenario.actions, buildings
        height, width = HEIGHT_IN, SIDE_IN + CAMERA_IN
        self.figure = Figure(figsize=(width, height), dpi=DPI)
        above = SIDE_IN * shape_of(played.scenario)
        below = self.below = height - above
        self.axes = self.figure.add_axes((0.0, below / height, SIDE_IN / width, above / height))
        self.axes.set(xticks=[], yticks=[], facecolor=LIGHT["ground"], autoscale_on=False)
        self.roads, self.walls = list(roads(played.scenario)), list(walls(buildings))
        for artist in (*self.roads, *self.walls):
            self.axes.add_artist(artist)
        several = len(agents) > 1
        rows, long = (agents, 1.2) if several else (self.actions, 1.75)
        self.bars = self.figure.add_axes(
            (3.1 / width, 0.28 / height, long / width, (below - 0.4) / height)
        )
        self.bars.set(xlim=(0, 1), ylim=(len(rows) - 0.5, -0.5), xticks=[0, 0.5, 1])
        self.bars.set_yticks(range(len(rows)), labels=list(map(printable, rows)), size=7)
        self.bars.tick_params(labelsize=6, length=2)
        self.lines = [
            self.figure.text(0.1 / width, (below - 0.4 - 0.22 * n) / height, "", size=8)
            for n in range(4)
        ]
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
        self.fixed = self.worded = self._copy()
        self.words: tuple[object, ...] = ()
        self.sides: dict[str, int] = {}

    def picture(self, still: Still, seen: dict[str, list[str]], view: View) -> Pixels:
        """Return the pixels of one still, (height, width, 3): red, green and blue, 0 to 255.

        `seen` has, by viewer, the ids of the vehicles that it saw when the decision began; `view`
        is the part of the world to show from above, in metres.
        """
        viewers = _watched(still.state, seen)
        self._words(still, viewers)
        self._above(still, seen, view)
        pixels = np.ascontiguousarray(np.asarray(self.canvas.buffer_rgba())[..., :3])  # type: ignore[no-untyped-call]
        for n, viewer in enumerate(viewers):
            top = CAPTION_PX + n * (CAPTION_PX + HEIGHT)
            pixels[top : top + HEIGHT, -WIDTH:] = frame(
                self.played.scenario, still.state, viewer
            ).pixels
        return pixels

    def _words(self, still: Still, viewers: Sequence[str]) -> None:
        """The policy and what is said of it, drawn again if it is not as in the last still;
        and the time.
        """
        turns, ego = list(still.turns.values()), still.state.ego
        decision = turns[0].decision
        ending = still.outcome or f"decision {decision.action} at {decision.acts_at_s:.2f} s"
        if len(turns) > 1:
            ending = still.outcome or f"{len(turns)} agents decide"
        words = (
            ending,
            *((turn.decision.step, turn.open, turn.outcome) for turn in turns),
            *viewers,
        )
        if words != self.words:
            self.words = words
            self.canvas.restore_region(self.fixed)  # type: ignore[no-untyped-call]
            for bar in (
                _shares(turns, self.actions) if len(turns) > 1 else _bars(turns[0], self.actions)
            ):
                self.bars.add_artist(bar)
                self.bars.draw_artist(bar)
                bar.remove()
            self.lines[3].set(text=ending, weight="bold" if still.outcome else "normal")
            for viewer, caption in zip(viewers, self.captions, strict=False):
                whose = "agent" if viewer in still.turns and len(turns) > 1 else "helper"
                whose = "ego" if viewer == ego.id and len(turns) == 1 else whose
                caption.set_text(
                    f"cameras of {printable(viewer)}, {whose}: front above, rear below"
                )
            for line in (self.lines[3], *self.captions[: len(viewers)]):
                self.figure.draw_artist(line)
            self.worded = self._copy()
        self.canvas.restore_region(self.worded)  # type: ignore[no-untyped-call]
        thinking = [
            f"{printable(agent)} " if len(turns) > 1 else ""
            for agent, turn in still.turns.items()
            if turn.open
        ]
        speed = f", ego {ego.speed_mps:4.1f} m/s" if len(turns) == 1 else ""
        slow = f", {''.join(thinking)}thinking (slowed)" if thinking else ""
        self.lines[2].set_text(f"{still.state.time_s:5.2f} s{speed}{slow}")
        self.figure.draw_artist(self.lines[2])

    def _above(self, still: Still, seen: dict[str, list[str]], view: View) -> None:
        low, high = view.edges
        self.axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        ego, draw = still.state.ego, self.axes.draw_artist
        draw(self.axes.patch)
        for road in self.roads:
            draw(road)
        if len(still.turns) == 1:
            self._over(shade(still.state, ego))
        for wall in self.walls:
            draw(wall)
        pt_per_m = SIDE_IN * 72 / view.width_m
        self._over(_buildings(self.buildings, view, pt_per_m))
        for viewer, ids in seen.items():
            colour = ROLES["ego" if viewer in still.turns else "helper"]
            self._over(sight(still.state, viewer, ids, colors=colour, linewidths=0.6, alpha=0.5))
        seen_ids = {*still.turns, *chain.from_iterable(seen[agent] for agent in still.turns)}
        for vehicle in still.state.vehicles:
            look = "ego" if vehicle.id in still.turns else vehicle.part
            self._over(
                body(
                    vehicle,
                    "danger" if vehicle.id == still.danger else look,
                    vehicle.id not in seen_ids,
                )
            )
        self._over(*_messages(self.played, still), *self._names(still, view, pt_per_m))
        for spine in self.axes.spines.values():
            draw(spine)
        start, foot = 0.1, self.below - 0.14  # not in the picture, and so over nobody
        long_m = scale_m(view)
        long_in = long_m / view.width_m * SIDE_IN
        beside = np.array([start + long_in + 0.08, foot - 0.035])
        words = _moved(_outline(f"{long_m} m, north is up"), beside, 1 / 72)
        at = self.figure.dpi_scale_trans
        bar = Line2D([start, start + long_in], [foot, foot], color=INK, linewidth=1.5, transform=at)
        for artist in (bar, PathPatch(words, facecolor=INK, edgecolor="none", transform=at)):
            artist.set_figure(self.figure)
            self.figure.draw_artist(artist)

    def _names(self, still: Still, view: View, pt_per_m: float) -> Iterator[Artist]:
        """Every vehicle's id and speed beside it, over nobody:
        where it was in the last still if it can.
        """
        inside = [v for v in still.state.vehicles if view.holds(north_up(np.array([v.x_m, v.y_m])))]
        decisions = {agent: turn.decision for agent, turn in still.turns.items()}
        attackers = {
            m.sender for decision in decisions.values() for m in decision.messages if m.attacker
        }
        taken = [_around(v) for v in still.state.vehicles]
        outlines, leaders = list[Outline](), list[Floats]()
        for v in inside:
            action = (
                f" {decisions[v.id].action}" if v.id in decisions and len(decisions) > 1 else ""
            )
            text = f"{v.id} {v.speed_mps:.0f} m/s{action}{' attacks' if v.id in attackers else ''}"
            outline, size = _outline(text), _size(text) / pt_per_m
            box = _around(v)
            at, reach = box.mean(axis=0), (box[1] - box[0]) / 2
            gaps = np.repeat(GAPS_PT, len(SIDES))[:, None] / pt_per_m
            places = at + np.tile(SIDES, (len(GAPS_PT), 1)) * (reach + size / 2 + gaps)
            ahead = np.abs(
                SIDES @ north_up(np.array([np.cos(v.heading_rad), np.sin(v.heading_rad)]))
            )
            cost = np.tile(0.3 * ahead, len(GAPS_PT)) + np.repeat(
                np.arange(len(GAPS_PT)), len(SIDES)
            )
            half = size / 2 + 1.0 / pt_per_m
            cost += 100 * covered(places, half, taken) + 100 * (cut(places, half, view) > 0)
            if v.id in self.sides:
                cost[self.sides[v.id]] -= 0.9
            best = self.sides[v.id] = int(cost.argmin())
            place = places[best]
            taken.append(np.array([place - half, place + half]))
            outlines.append(_moved(outline, place - size / 2, 1 / pt_per_m))
            if best >= len(SIDES):
                leaders.append(np.array([at, at.clip(place - size / 2, place + size / 2)]))
        yield LineCollection(leaders, colors=INK, linewidths=0.5)
        if outlines:
            every = Outline.make_compound_path(*outlines)
            yield PathPatch(
                every, facecolor="white", edgecolor="white", linewidth=2.0, joinstyle="round"
            )
            yield PathPatch(every, facecolor=INK, edgecolor="none")

    def _copy(self) -> object:
        return self.canvas.copy_from_bbox(self.figure.bbox)  # type: ignore[no-untyped-call]

    def _over(self, *artists: Artist) -> None:
        for artist in artists:
            self.axes.add_artist(artist)
            self.axes.draw_artist(artist)
            artist.remove()


def _watched(state: WorldState, seen: dict[str, list[str]]) -> list[str]:
    """Return the ego, and the helper that saw most of whom the ego did not see."""
    ego = state.ego.id
    helpers = [v.id for v in state.vehicles if v.id in seen and v.id != ego]
    more = {helper: len({*seen[helper]} - {*seen[ego], ego, helper}) for helper in helpers}
    return [ego, *sorted(helpers, key=lambda helper: -more[helper])[:1]]


def _around(vehicle: VehicleState) -> Floats:
    corners = north_up(vehicle.corners())
    return np.array([corners.min(axis=0), corners.max(axis=0)])


def _buildings(buildings: Iterable[Building], view: View, pt_per_m: float) -> Artist:
    """Their names, each in the corner of what is seen of it."""
    inside = np.array([3.0, -3.0 - NAME_PT]) / pt_per_m
    names = named(buildings, view, NAME_PT / pt_per_m)
    moved = [_moved(_outline(name), inside + at, 1 / pt_per_m) for name, *at in names]
    every = Outline.make_compound_path(*moved) if moved else Outline(np.empty((0, 2)))
    return PathPatch(every, facecolor=BUILDING_NAME, edgecolor="none")


def _moved(outline: Outline, to: Floats, scale: float) -> Outline:
    return Outline(np.asarray(outline.vertices) * scale + to, outline.codes)


@lru_cache(maxsize=1024)
def _outline(text: str) -> Outline:
    """Return a text's outline in points: as one shape, many cost a fifth of as many texts."""
    return TextPath((0.0, 0.0), text, size=NAME_PT)


@lru_cache(maxsize=1024)
def _size(text: str) -> Floats:
    return np.array([_outline(text).get_extents().x1, 0.75 * NAME_PT])


def _messages(played: ReplayedEpisode, still: Still) -> Iterator[Artist]:
    """Each reply on its way from its helper to who asked; one that was lost goes half of it.

    Where each answer has a time of its own, a reply is drawn from the decision's start.
    """
    latency = played.manifest.latency
    sent_s = max(latency.ego_s or 0.0, *latency.helper_times_s(), 0.0)
    there = {v.id for v in still.state.vehicles}
    open_turns = [(agent, turn) for agent, turn in still.turns.items() if turn.open]
    for agent, turn, message in ((a, t, m) for a, t in open_turns for m in t.decision.messages):
        if message.sender not in there:
            continue
        asker = still.state.vehicle(agent)
        end_s = (message.arrival_ms or turn.decision.latency_ms or 0.0) / 1000
        share = np.clip((turn.since_s - sent_s) / max(end_s - sent_s, 1e-9), 0.0, 1.0)
        lost = not message.delivered
        share = min(share, 0.5) if lost else share
        helper = still.state.vehicle(message.sender)
        path = north_up(np.array([[helper.x_m, helper.y_m], [asker.x_m, asker.y_m]]))
        place = path[0] + share * (path[1] - path[0])
        yield Line2D(*path.T, color=GREY, linewidth=0.8, linestyle=":")
        if turn.since_s >= sent_s:
            colour = BAD if lost else GOOD if message.on_time else LATE
            yield Line2D(
                place[:1], place[1:], marker="X" if lost else "o", color=colour, markersize=6
            )


def _bars(turn: Turn, actions: Sequence[str]) -> Iterator[Artist]:
    """Yield the policy of the last decision, pale until it is ready."""
    decision, colours = turn.decision, colours_of(actions)
    for n, (action, p) in enumerate(zip(actions, decision.fused, strict=True)):
        width = 1.4 if action == decision.action else 0.3
        pale = 0.35 if turn.open else 1.0
        yield Rectangle(
            (0.0, n - 0.4),
            p,
            0.8,
            facecolor=colours[action],
            alpha=pale,
            edgecolor=INK,
            linewidth=width,
        )


def _shares(turns: Sequence[Turn], actions: Sequence[str]) -> Iterator[Artist]:
    """Yield the policy of each agent's last decision as a row from slow to fast,
    and what it came to.
    """
    colours = list(colours_of(actions).values())
    for n, turn in enumerate(turns):
        starts = np.cumsum([0.0, *turn.decision.fused[:-1]])
        for start, p, colour in zip(starts.tolist(), turn.decision.fused, colours, strict=True):
            pale = 0.35 if turn.open or turn.outcome else 1.0
            yield Rectangle(
                (start, n - 0.4), p, 0.8, facecolor=colour, alpha=pale, edgecolor=INK, linewidth=0.3
            )
        words = turn.outcome.split(" at ")[0] or turn.decision.action
        yield Text(1.05, n, words, size=7, va="center", clip_on=False)
