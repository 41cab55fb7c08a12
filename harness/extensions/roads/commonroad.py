"""Scenes of CommonRoad: XML files of the versions 2018b and 2020a.

Format: Althoff, Koschi, Manzinger, CommonRoad: Composable benchmarks for motion planning on roads,
IV 2017, and the XML documentation of those versions. Positions are centres of vehicles, times are
numbers of steps.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from harness.core.arrays import Floats
from harness.core.errors import printable
from harness.extensions.roads.scene import MOST_LANES, MOST_TRACKS, House, Lane, Scene, Track
from harness.extensions.roads.sources import (
    distinct,
    elements,
    few_enough,
    name_of,
    no_use,
    number,
    once,
    sha256_of,
    stem_of,
    sum_up,
    tracks_of,
)

ROOT, VERSIONS = "commonRoad", ("2018b", "2020a")
KINDS = {
    "car": "car",
    "taxi": "car",
    "priorityVehicle": "car",
    "parkedVehicle": "car",
    "truck": "truck",
    "bus": "truck",
    "bicycle": "bicycle",
    "motorcycle": "motorcycle",
    "pedestrian": "pedestrian",
}
HOUSES = {"building", "pillar"}
# Signs that limit speed, whose value is in m/s: of Germany, China and Zamunda, of its zones, of the
# USA, of Spain, of Belgium, of Russia.
LIMITS = {"274", "274.1", "R2-1", "r301", "R301", "C43", "3.24"}
OBSTACLES = {"obstacle", "staticObstacle", "dynamicObstacle", "environmentObstacle"}
WANTED = {"lanelet", "trafficSign", *OBSTACLES}
Shape = tuple[Floats, float, float]  # its outline (n, 2) in its own frame, length and width, m


class Map(NamedTuple):
    """Hold what does not move: lanes by id, buildings, and whether there are traffic lights."""

    lanes: dict[str, Lane]
    houses: tuple[House, ...]
    lights: bool


def scenes(*paths: Path) -> Iterator[Scene]:
    """Yield the scene of each file.

    Road users of a kind that none is made of are left out, and counted in `Scene.left_out`. Raises
    UserError for a file that is none, or is broken.
    """
    for path in paths:
        yield _read(path)


def map_of(path: Path) -> Map:
    """Return the map of a file, whoever moves there."""
    scene = _read(path)
    return Map(dict(scene.lanes), scene.houses, scene.lights)


def _read(path: Path) -> Scene:
    file = _File(path)
    try:
        for element in elements(path, WANTED.__contains__):
            file.take(element)
        return file.scene()
    except (ValueError, TypeError) as error:
        raise no_use(path, f"{file.place}: {error}") from None


class _File:
    """Gather what a file has, element by element."""

    def __init__(self, path: Path) -> None:
        self.path, self.name, self.step_s, self.place = path, "", 0.0, "its root"
        self.lanelets: dict[str, Element] = {}
        self.limits: dict[str, float] = {}  # m/s, by the id of a sign
        self.tracks: dict[str, Track] = {}
        self.standing: dict[str, tuple[str, Element]] = {}
        self.houses: list[House] = []
        self.lights = False
        self.left_out: dict[str, int] = {}

    def take(self, element: Element) -> None:
        """Take in the root, or one child of it."""
        key = element.get("id", "")
        self.place = f"{element.tag} {printable(key, 40)}"
        if not self.step_s:
            self._root(element)
        elif element.tag == "lanelet":
            once(self.lanelets, key, "lanelets", self.path)
            self.lanelets[key] = element
            few_enough(len(self.lanelets), MOST_LANES, "lanelets")
        elif element.tag == "trafficSign":
            self._sign(key, element)
        elif element.tag == "trafficLight":
            self.lights = True
        elif element.tag in OBSTACLES:
            self._obstacle(key, element)
        elif element.tag == "phantomObstacle":
            sum_up(self.left_out, "phantom obstacle")

    def _root(self, element: Element) -> None:
        version = element.get("commonRoadVersion", "")
        if element.tag != ROOT or version not in VERSIONS:
            raise ValueError(f"version {version!r}; allowed: {' or '.join(VERSIONS)}")
        self.name = element.get("benchmarkID") or stem_of(self.path)
        self.step_s = float(element.get("timeStepSize", "nan"))
        if not 0.001 <= self.step_s <= 10:
            raise ValueError(f"timeStepSize {self.step_s:g}; allowed: 0.001 to 10 s")

    def _sign(self, key: str, element: Element) -> None:
        for sign in element.iter("trafficSignElement"):
            if (sign.findtext("trafficSignID") or "").strip() in LIMITS:
                limit = number(sign, "additionalValue")
                if limit > 0:
                    self.limits[key] = limit

    def _obstacle(self, key: str, element: Element) -> None:
        once(self.tracks, key, "obstacles", self.path)
        once(self.standing, key, "obstacles", self.path)
        few_enough(len(self.tracks) + len(self.standing), MOST_TRACKS, "obstacles")
        kind = (element.findtext("type") or "").strip()
        role = (element.findtext("role") or element.tag).strip()
        if kind in HOUSES:
            self._house(key, element)
        elif kind not in KINDS:
            sum_up(
                self.left_out, f"{printable(kind, 30) or 'no kind'} (a kind that none is made of)"
            )
        elif role.startswith("static"):
            self.standing[key] = (KINDS[kind], element)
        elif element.find("trajectory") is None:
            sum_up(self.left_out, f"{kind} without a trajectory")
        else:
            self._moving(key, KINDS[kind], element)

    def _house(self, key: str, element: Element) -> None:
        outline, _, _ = _shape(element.find("shape"))
        state = element.find("initialState")
        if state is not None:
            x_m, y_m, heading_rad, _ = _pose(state)
            middle = np.array([x_m, y_m])
            outline = _turned(outline, float(np.nan_to_num(heading_rad))) + middle
        self.houses.append(House(key, outline))

    def _moving(self, key: str, kind: str, element: Element) -> None:
        states = [*element.iterfind("initialState"), *element.iterfind("trajectory/state")]
        steps = [_exact(state.find("time")) for state in states]
        poses = np.array([_pose(state) for state in states])
        size_m = _shape(element.find("shape"))[1:]
        time_s = np.array(steps) * self.step_s
        for track in tracks_of(key, kind, size_m, time_s, poses, self.step_s):
            once(self.tracks, track.id, "obstacles", self.path)
            self.tracks[track.id] = track

    def scene(self) -> Scene:
        """Return the scene of all that was taken in."""
        if not self.step_s:
            raise ValueError("it is empty")
        lanes = {}
        for key, element in self.lanelets.items():
            self.place = f"lanelet {printable(key, 40)}"
            lanes[key] = _lane(key, element, self.lanelets, self.limits, self.left_out)
        self._stand()
        return Scene(
            name_of(self.name),
            self.path.name,
            sha256_of(self.path),
            self.lights,
            self.tracks,
            lanes,
            tuple(self.houses),
            self.left_out,
        )

    def _stand(self) -> None:
        """Make tracks of what never moves: it is there from the first to the last of all times."""
        begin_s = min([track.begin_s for track in self.tracks.values()], default=0.0)
        end_s = max([track.end_s for track in self.tracks.values()], default=0.0)
        time_s = np.array(sorted({begin_s, end_s}))
        for key, (kind, element) in self.standing.items():
            self.place = f"obstacle {printable(key, 40)}"
            state = element.find("initialState")
            if state is None:
                raise ValueError("it has no initialState")
            x_m, y_m, heading_rad, _ = _pose(state)
            pose = [x_m, y_m, float(np.nan_to_num(heading_rad)), 0.0]
            _, length_m, width_m = _shape(element.find("shape"))
            poses = np.repeat([pose], len(time_s), axis=0)
            self.tracks[key] = Track(key, kind, length_m, width_m, time_s, poses)


def _exact(element: Element | None) -> float:
    """Return a number that is exact, or the middle of an interval; NaN without one."""
    if element is None:
        return float("nan")
    exact = number(element, "exact")
    if exact == exact:
        return exact
    return (number(element, "intervalStart") + number(element, "intervalEnd")) / 2


def _points(element: Element | None) -> Floats:
    """Return the points of an element, (n, 2) m; z, where there is one, is not read."""
    if element is None:
        return np.empty((0, 2))
    points = [(number(point, "x"), number(point, "y")) for point in element.iterfind("point")]
    return np.array(points, dtype=float).reshape(-1, 2)


def _pose(state: Element) -> tuple[float, float, float, float]:
    """Return the x_m, y_m, heading_rad and speed_mps of a state; the last two NaN where unknown.

    An uncertain position is the middle of its shape.
    """
    position = state.find("position")
    exact = _points(position)
    if len(exact):
        x_m, y_m = exact[0]
    elif position is not None and len(position):
        outline, _, _ = _shape(position)
        x_m, y_m = (outline.min(axis=0) + outline.max(axis=0)) / 2
    else:
        raise ValueError("a state has no position")
    heading_rad = _exact(state.find("orientation"))
    return float(x_m), float(y_m), heading_rad, _exact(state.find("velocity"))


def _turned(points: Floats, angle_rad: float) -> Floats:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]))


def _shape(element: Element | None) -> Shape:
    """Return an outline around its own middle, and its length and width along its own axes, m."""
    outlines = []
    for part in () if element is None else element:
        if part.tag == "rectangle":
            half = np.array([number(part, "length"), number(part, "width")]) / 2
            if (half <= 0).any():
                raise ValueError("its rectangle has a length or width that is not above 0")
            corners = half * [[1, 1], [-1, 1], [-1, -1], [1, -1]]
            turn = number(part, "orientation")
            outlines.append(_turned(corners, 0.0 if turn != turn else turn) + _middle(part))
        elif part.tag == "circle":
            angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
            around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
            radius_m = number(part, "radius")
            if radius_m <= 0:
                raise ValueError(f"its circle has radius {radius_m:g}; allowed: above 0")
            outlines.append(radius_m * around + _middle(part))
        elif part.tag == "polygon":
            outlines.append(_points(part))
    if not outlines:
        raise ValueError("it has no shape: a rectangle, circle or polygon")
    outline = np.concatenate(outlines)
    length_m, width_m = np.ptp(outline, axis=0)
    return outline, float(length_m), float(width_m)


def _middle(part: Element) -> Floats:
    centre = part.find("center")
    if centre is None:
        return np.zeros(2)
    return np.array([number(centre, "x"), number(centre, "y")])


def _lane(
    key: str,
    element: Element,
    lanelets: Mapping[str, Element],
    limits: Mapping[str, float],
    left_out: dict[str, int],
) -> Lane:
    """Return a lanelet as a lane, and count what it names that is no other lanelet of the file."""
    left, right = _points(element.find("leftBound")), _points(element.find("rightBound"))
    if min(len(left), len(right)) < 2:
        raise ValueError("a bound has fewer than two points")
    if len(left) != len(right):
        right = _spaced(right, len(left))
    width_m = float(np.median(np.hypot(*(left - right).T)))
    successors = [each.get("ref", "") for each in element.iterfind("successor")]
    after = [other for other in successors if _is_other(other, key, lanelets, left_out)]
    signs = [each.get("ref", "") for each in element.iterfind("trafficSignRef")]
    stated_mps = [number(element, "speedLimit"), *(limits.get(sign, np.nan) for sign in signs)]
    limits_mps = [limit for limit in stated_mps if limit > 0]
    return Lane(
        key,
        distinct((left + right) / 2),
        width_m,
        min(limits_mps, default=None),
        tuple(dict.fromkeys(after)),
        _beside(key, element.find("adjacentLeft"), lanelets, left_out),
        _beside(key, element.find("adjacentRight"), lanelets, left_out),
    )


def _spaced(line: Floats, n: int) -> Floats:
    """Return n points at equal distances along a line."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    at = np.linspace(0, along[-1], n)
    return np.stack([np.interp(at, along, line[:, 0]), np.interp(at, along, line[:, 1])], axis=1)


def _beside(
    key: str,
    element: Element | None,
    lanelets: Mapping[str, Element],
    left_out: dict[str, int],
) -> str | None:
    """Return the id of the lanelet beside one, if it leads the same way and is in the file."""
    if element is None or element.get("drivingDir") != "same":
        return None
    other = element.get("ref", "")
    return other if _is_other(other, key, lanelets, left_out) else None


def _is_other(
    name: str, key: str, lanelets: Mapping[str, Element], left_out: dict[str, int]
) -> bool:
    """Return whether a lanelet names another one of the file; count it if it does not."""
    is_other = name in lanelets and name != key
    if not is_other:
        sum_up(left_out, "lanelet that is named and not in the file")
    return is_other
