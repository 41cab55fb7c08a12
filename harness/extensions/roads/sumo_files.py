"""Scenes of SUMO: a net, the positions that it wrote (FCD), sizes of vehicle types, buildings.

https://sumo.dlr.de/docs/Networks/SUMO_Road_Networks.html and
https://sumo.dlr.de/docs/Simulation/Output/FCDOutput.html: there x and y are the middle of the front
bumper, and an angle is a compass's, in degrees. No package of SUMO is needed.
"""

import math
from array import array
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from harness.core.arrays import Floats
from harness.core.errors import UserError, printable
from harness.extensions.roads.scene import (
    MOST_HOUSES,
    MOST_LANES,
    MOST_ROWS,
    MOST_TRACKS,
    House,
    Lane,
    Scene,
    Track,
    step_of,
)
from harness.extensions.roads.sources import (
    distinct,
    elements,
    few_enough,
    name_of,
    no_use,
    once,
    sha256_of,
    starts,
    stem_of,
    sum_up,
    tracks_of,
)

NET, POSITIONS = "net", "fcd-export"
FURTHER = {"additional", "routes"}  # roots of files with buildings and types of vehicles
LANE_WIDTH_M = 3.2  # where a net states none: SUMO's default
# Length and width by a type's class where it states none:
# https://sumo.dlr.de/docs/Vehicle_Type_Parameter_Defaults.html (SUMO 1.28).
SIZES_M = {
    "passenger": (5.0, 1.8),
    "private": (5.0, 1.8),
    "taxi": (5.0, 1.8),
    "hov": (5.0, 1.8),
    "evehicle": (5.0, 1.8),
    "vip": (5.0, 1.8),
    "authority": (5.0, 1.8),
    "army": (5.0, 1.8),
    "custom1": (5.0, 1.8),
    "custom2": (5.0, 1.8),
    "emergency": (6.5, 2.16),
    "delivery": (6.5, 2.16),
    "truck": (7.1, 2.4),
    "trailer": (16.5, 2.55),
    "bus": (12.0, 2.5),
    "coach": (14.0, 2.6),
    "motorcycle": (2.2, 0.9),
    "moped": (2.1, 0.8),
    "bicycle": (1.6, 0.65),
    "pedestrian": (0.215, 0.478),
}
KINDS = {
    "emergency": "van",
    "delivery": "van",
    "truck": "truck",
    "trailer": "truck",
    "bus": "truck",
    "coach": "truck",
    "motorcycle": "motorcycle",
    "moped": "motorcycle",
    "bicycle": "bicycle",
    "pedestrian": "pedestrian",
}
# SUMO's own types, and their classes.
TYPES = {
    "DEFAULT_VEHTYPE": "passenger",
    "DEFAULT_PEDTYPE": "pedestrian",
    "DEFAULT_BIKETYPE": "bicycle",
    "DEFAULT_TAXITYPE": "taxi",
}
# What has a position, and its type where none is stated.
ROAD_USERS = {"vehicle": "DEFAULT_VEHTYPE", "person": "DEFAULT_PEDTYPE"}
NO_LANES = {"walkingarea", "crossing"}
UNKNOWN_TYPE = "not left out, but taken for a car of 5 m, since no file states its type:"
FAR_M = 1000.0  # from a net, where no vehicle of it can be


class VehicleType(NamedTuple):
    """Hold what a type of vehicles says of each: its class, and its size where it states one."""

    vehicle_class: str
    length_m: float
    width_m: float


class Map(NamedTuple):
    """Hold what does not move: lanes by id, buildings, and whether there are traffic lights."""

    lanes: dict[str, Lane]
    houses: tuple[House, ...]
    lights: bool
    left_out: dict[str, int]


def scenes(*paths: Path) -> Iterator[Scene]:
    """Yield a scene for each file of positions, all on the one net that is given with them.

    Other files may have buildings (polygons whose type begins with `building`) and types of
    vehicles. Raises UserError if the net or positions are missing, or a file is broken.
    """
    roots = {path: root_of(path) for path in paths}
    positions = [path for path, root in roots.items() if root == POSITIONS]
    if not positions:
        raise UserError(
            "no file has the positions of SUMO's vehicles; give one that SUMO wrote: "
            "`sumo --fcd-output FILE`"
        )
    net, further = map_of(*paths), [path for path, root in roots.items() if root in FURTHER]
    types = _types_of(further)
    for path in positions:
        yield _scene(path, net, types)


def root_of(path: Path) -> str:
    """Return the name of a file's root element."""
    return next(elements(path, lambda tag: False)).tag


def map_of(*paths: Path) -> Map:
    """Return the map of the one net among these files, with the buildings of the others."""
    nets = [path for path in paths if root_of(path) == NET]
    if len(nets) != 1:
        names = " and ".join(printable(net.name, 80) for net in nets[:2])
        are = f"{names} are nets of SUMO" if nets else "no file is a net of SUMO"
        raise UserError(f"{are}; give one, such as my.net.xml, with the others")
    houses: list[House] = []
    left_out: dict[str, int] = {}
    for path in paths:
        if root_of(path) in FURTHER:
            houses += _houses(path, left_out)
    net = _Net(nets[0])
    try:
        few_enough(len(houses), MOST_HOUSES, "buildings")
        for element in elements(nets[0], {"edge", "connection"}.__contains__):
            net.take(element)
        lanes = {lane.id: lane for lane in net.finished()}
    except (ValueError, TypeError) as error:
        raise no_use(nets[0], f"{net.place}: {error}") from None
    for reason, amount in net.left_out.items():
        sum_up(left_out, reason, amount)
    return Map(lanes, tuple(houses), net.lights, left_out)


class _Net:
    """Gather the lanes of a net, which are complete once all of it was read."""

    def __init__(self, path: Path) -> None:
        self.path, self.place, self.left_hand = path, "its root", False
        self.lanes: dict[str, dict[str, Any]] = {}
        self.edges: dict[str, list[str]] = {}  # ids of an edge's lanes, by their index
        self.empty: set[str] = set()  # lanes without length, past which others lead on
        self.connections: list[tuple[str, str, str, str, str]] = []
        self.lights = False
        self.left_out: dict[str, int] = {}

    def take(self, element: Element) -> None:
        key = element.get("id", element.get("from", ""))
        self.place = f"{element.tag} {printable(key, 60)}"
        if element.tag == NET:
            self.left_hand = element.get("lefthand") in ("1", "true")
        elif element.tag == "edge" and element.get("function") not in NO_LANES:
            self._edge(key, element)
        elif element.tag == "connection":
            ends = ("from", "fromLane", "to", "toLane", "via")
            start, start_lane, end, end_lane, via = (element.get(name, "") for name in ends)
            self.connections.append((start, start_lane, end, end_lane, via))
            self.lights |= element.get("tl") is not None

    def _edge(self, key: str, element: Element) -> None:
        lanes = sorted(element.iterfind("lane"), key=lambda lane: int(lane.get("index", "0")))
        once(self.edges, key, "edges", self.path)
        self.edges[key] = [lane.get("id", "") for lane in lanes]
        for lane in lanes:
            if not _for_cars(lane):
                sum_up(self.left_out, "lane that is not for cars")
                continue
            name = lane.get("id", "")
            once(self.lanes, name, "lanes", self.path)
            points = distinct(_points(lane.get("shape", "")))
            if len(points) < 2:  # as netconvert makes them within small junctions
                sum_up(self.left_out, "lane without length")
                self.empty.add(name)
                continue
            self.lanes[name] = {
                "points": points,
                "width_m": float(lane.get("width", LANE_WIDTH_M)),
                "limit_mps": float(lane.get("speed", "nan")),
            }
            few_enough(len(self.lanes), MOST_LANES, "lanes")

    def finished(self) -> Iterator[Lane]:
        """Yield all lanes, with what lies beside and after them."""
        after = self._successors()
        for edge in self.edges.values():
            for index, key in enumerate(edge):
                if key in self.lanes:
                    inner = edge[index + 1] if index + 1 < len(edge) else None
                    outer = edge[index - 1] if index else None
                    left, right = (outer, inner) if self.left_hand else (inner, outer)
                    yield self._lane(key, tuple(after.get(key, ())), left, right)

    def _lane(
        self, key: str, successors: tuple[str, ...], left: str | None, right: str | None
    ) -> Lane:
        facts = self.lanes[key]
        limit_mps = facts["limit_mps"] if facts["limit_mps"] > 0 else None
        return Lane(
            key,
            facts["points"],
            facts["width_m"],
            limit_mps,
            successors,
            left if left in self.lanes else None,
            right if right in self.lanes else None,
        )

    def _successors(self) -> dict[str, dict[str, None]]:
        """Return on which lanes each lane leads, by the connections, in their order."""
        after: dict[str, dict[str, None]] = {}
        here = self.lanes.keys() | self.empty
        for start, start_lane, end, end_lane, via in self.connections:
            begin, goal = self._at(start, start_lane), via or self._at(end, end_lane)
            if begin in here and goal in here and begin != goal:
                after.setdefault(begin, {})[goal] = None
        return {key: dict.fromkeys(self._past(key, after)) for key in self.lanes}

    def _past(self, key: str, after: Mapping[str, Mapping[str, None]]) -> Iterator[str]:
        """Yield the lanes that a lane leads on to, past one without length."""
        for goal in after.get(key, ()):
            if goal in self.lanes:
                yield goal
            else:
                yield from (next_one for next_one in after.get(goal, ()) if next_one in self.lanes)

    def _at(self, edge: str, index: str) -> str:
        lanes = self.edges.get(edge, ())
        return lanes[int(index)] if index.isdecimal() and int(index) < len(lanes) else ""


def _for_cars(lane: Element) -> bool:
    """Return whether passenger cars may be on a lane."""
    allowed = lane.get("allow", "").split()
    refused = lane.get("disallow", "").split()
    if allowed:
        return "all" in allowed or "passenger" in allowed
    return "all" not in refused and "passenger" not in refused


def _points(text: str) -> Floats:
    """Return the points of a text such as `0,1.5 20,1.5`, (n, 2) m; heights are not read."""
    points = [point.split(",")[:2] for point in text.split()]
    return np.array(points, dtype=float).reshape(-1, 2)


def _houses(path: Path, left_out: dict[str, int]) -> Iterator[House]:
    """Yield the buildings among the polygons of a file."""
    taken: dict[str, object] = {}
    for element in elements(path, lambda tag: False):
        if element.tag != "poly" or not element.get("type", "").startswith("building"):
            continue
        key = element.get("id", "")
        if element.get("geo") in ("1", "true"):
            sum_up(left_out, "building in degrees of longitude and latitude")
            continue
        once(taken, key, "polygons", path)
        taken[key] = None
        try:
            outline = _points(element.get("shape", ""))
        except ValueError as error:
            raise no_use(path, f"poly {printable(key, 60)}: {error}") from None
        if len(outline) > 1 and (outline[0] == outline[-1]).all():
            outline = outline[:-1]
        if len(outline) > 2:
            yield House(key, outline)


def _types_of(paths: Iterable[Path]) -> dict[str, VehicleType]:
    """Return the types of vehicles that files state, by id, with SUMO's own."""
    types = {key: _type(key, {"vClass": of_class}) for key, of_class in TYPES.items()}
    for path in paths:
        for element in elements(path, {"vTypeDistribution", "vType"}.__contains__):
            for each in element.iter("vType"):
                key = each.get("id", "")
                try:
                    types[key] = _type(key, each.attrib)
                except ValueError as error:
                    raise no_use(path, f"vType {printable(key, 60)}: {error}") from None
    return types


def _type(key: str, attributes: Mapping[str, str]) -> VehicleType:
    usual = "pedestrian" if key == "DEFAULT_PEDTYPE" else "passenger"
    of_class = attributes.get("vClass", usual)
    length_m, width_m = SIZES_M.get(of_class, (0.0, 0.0))
    size = float(attributes.get("length", length_m)), float(attributes.get("width", width_m))
    return VehicleType(of_class, *size)


class _Rows:
    """Gather the rows of positions by road user."""

    def __init__(self) -> None:
        self.rows: dict[str, array[float]] = {}  # time, x, y, angle and speed, one after another
        self.types: dict[str, str] = {}
        self.left_out: dict[str, int] = {}
        self.n = 0
        self.clock: list[float] = []

    def take(self, tag: str, attributes: dict[str, str]) -> None:
        """Take in a time, or one who is there then."""
        if tag in ROAD_USERS:
            if attributes.get("vehicle"):  # a person who rides in it
                return
            key, now_s = attributes["id"], self.clock[-1]
            rows = self.rows.get(key)
            if rows is None:
                few_enough(len(self.rows) + 1, MOST_TRACKS, "road users")
                self.types[key] = attributes.get("type", ROAD_USERS[tag])
                rows = self.rows[key] = array("d")
            elif rows[-5] == now_s:
                raise ValueError(f"{printable(key, 60)} is twice at {now_s:g} s")
            x, y, angle, speed = (attributes[name] for name in ("x", "y", "angle", "speed"))
            rows.extend((now_s, float(x), float(y), float(angle), float(speed)))
            self.n += 1
        elif tag == "timestep":
            time_s = float(attributes["time"])
            if not math.isfinite(time_s) or (self.clock and time_s <= self.clock[-1]):
                raise ValueError(f"time {time_s:g} does not rise")
            self.clock.append(time_s)
            few_enough(self.n, MOST_ROWS, "poses")
        elif self.clock:
            sum_up(self.left_out, f"row of a {printable(tag, 30)}")


def _scene(path: Path, net: Map, types: Mapping[str, VehicleType]) -> Scene:
    rows = _Rows()
    try:
        starts(path, rows.take)
    except KeyError as error:
        raise no_use(path, f"a row has no {error.args[0]}") from None
    except IndexError:
        raise no_use(path, "a road user stands before the first timestep") from None
    if len(rows.clock) < 2:
        raise no_use(path, "it has fewer than two times")
    step_s = step_of(np.diff(rows.clock))
    tracks: dict[str, Track] = {}
    for key in list(rows.rows):
        values = np.array(rows.rows.pop(key)).reshape(-1, 5)
        if rows.types[key] not in types:
            sum_up(rows.left_out, f"{UNKNOWN_TYPE} {printable(rows.types[key], 30)}")
        kind = types.get(rows.types[key], types["DEFAULT_VEHTYPE"])
        if kind.vehicle_class not in SIZES_M:
            sum_up(rows.left_out, f"{printable(kind.vehicle_class, 30)} (a class of no road user)")
            continue
        size_m = kind.length_m, kind.width_m
        named = KINDS.get(kind.vehicle_class, "car")
        middles = centres(values[:, 1:], kind.length_m)
        for track in tracks_of(key, named, size_m, values[:, 0], middles, step_s):
            once(tracks, track.id, "road users", path)
            tracks[track.id] = track
    _refuse_degrees(path, tracks, net)
    for reason, amount in net.left_out.items():
        sum_up(rows.left_out, reason, amount)
    return Scene(
        name_of(stem_of(path)),
        path.name,
        sha256_of(path),
        net.lights,
        tracks,
        net.lanes,
        net.houses,
        rows.left_out,
    )


def centres(poses: Floats, length_m: float) -> Floats:
    """Return poses (n, 4) of centres, given x, y, degrees from north clockwise, and speed."""
    heading_rad = np.pi / 2 - np.radians(poses[:, 2])
    heading_rad = (heading_rad + np.pi) % (2 * np.pi) - np.pi
    ahead = np.stack([np.cos(heading_rad), np.sin(heading_rad)], axis=1)
    middles = poses[:, :2] - length_m / 2 * ahead
    return np.column_stack([middles, heading_rad, poses[:, 3]])


def _refuse_degrees(path: Path, tracks: Mapping[str, Track], net: Map) -> None:
    """Raise UserError where nobody is near the net: positions are of another, or in degrees."""
    points = np.concatenate([lane.points for lane in net.lanes.values()] or [np.zeros((1, 2))])
    low, high = points.min(axis=0) - FAR_M, points.max(axis=0) + FAR_M
    for track in tracks.values():
        if ((low <= track.poses[0, :2]) & (track.poses[0, :2] <= high)).all():
            return
    if tracks:
        raise no_use(
            path,
            "nobody is near the net; give the net that it was made with, and leave out "
            "--fcd-output.geo",
        )
