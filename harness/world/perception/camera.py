"""Render the pictures of a vehicle's cameras: the front above the rear, each 120° wide.

Both are pinhole cameras at the vehicle's centre, where the rays of its sensors start as well
(`rays`). A vehicle that the sensors do not report owns no pixel, and a column of pixels sees past a
vehicle only what is higher. A frame is a pure function of the state, so datasets store none.

Everything is a box on a flat road: what is on the far side of a lower one shows above it. Heights,
paint and lamps are declared for this harness; light and weather are those of
`harness.world.ambient`.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.ops import substring

from harness.core import noise
from harness.core.arrays import Floats, Pixels
from harness.core.image import Image
from harness.world.ambient import AMBIENTS, DAY, Ambient, Colour, sun_rad
from harness.world.perception.rays import meetings, turned
from harness.world.perception.sensors import HALF_FIELD_RAD, detect
from harness.world.road import NORTH
from harness.world.scenario import Scenario
from harness.world.state import BROAD, HEIGHTS_M, VehicleState, WorldState

Places = NDArray[np.int16]
Lit = NDArray[np.bool_]

SIZE_PX = (512, 256)  # width and height of both cameras' pictures together
EYE_M = 1.4  # height of a camera above the road
BUILDING_M = 6.0
HORIZON = 0.36  # share of a camera's rows that are above the horizon
# reach of the ground map from the origin (grass beyond), and its cell size
REACH_M, CELL_M = 160.0, 0.2
BLOCK = 32  # cells of the map along a side of what is judged at once
LINE_M = 0.4  # width of a painted line
DASH_M, GAP_M = 3.0, 4.5
NOBODY = -1
KEPT = 64  # cached frames, 0.65 MB each

GLARE = (255, 247, 224)
GRASS, ASPHALT, PAINT = (106, 128, 82), (92, 94, 98), (236, 236, 230)
WALL, BRICK = (182, 166, 142), (150, 132, 108)
ROWS, COLUMNS = 32, 48  # resolution of the paint on a wall
GLASS, TYRE, PLATE = (38, 48, 60), (28, 28, 30), (226, 226, 220)
SKIN, TROUSERS, HELMET = (198, 152, 124), (58, 62, 84), (40, 40, 44)
HEADLAMP, AMBER = (250, 246, 222), (255, 170, 20)
REAR_LAMP, BRAKE_LAMP = (128, 22, 26), (255, 36, 32)
# No coat has the colour of a lamp.
COATS = (
    (36, 74, 140),
    (226, 228, 230),
    (56, 58, 62),
    (146, 150, 156),
    (44, 102, 70),
    (196, 176, 138),
)
FRONT, RIGHT, REAR, LEFT = range(4)  # walls of a vehicle, as `VehicleState.corners` has them
SHADE = np.array([0.96, 0.80, 0.88, 0.72])
LAMPS = AMBIENTS[DAY]  # lamps fade with distance as by day


class Frame(Image):
    """Hold a picture of a vehicle's cameras, with the ids of the vehicles and buildings in it.

    `pixels` are (height, width, 3), red, green and blue from 0 to 255. `owners`, (height, width),
    has for each pixel the index in `ids`, the ids of vehicles and buildings, of what it shows; -1
    for road, grass and sky.
    """

    def __init__(self, pixels: Pixels, owners: Places, ids: tuple[str, ...]) -> None:
        super().__init__(pixels)
        self.owners, self.ids = owners, ids

    def boxes(self) -> dict[str, list[tuple[int, int, int, int]]]:
        """Return the bounding boxes of each visible vehicle and building, by its id.

        A box is left, top, right and bottom in pixels of the whole picture, right and bottom
        exclusive. There is one for each half of the picture, front or rear, that shows the object.
        """
        half, boxes = len(self.owners) // 2, dict[str, list[tuple[int, int, int, int]]]()
        for place, name in enumerate(self.ids):
            for top in (0, half):
                rows, columns = np.nonzero(self.owners[top : top + half] == place)
                if len(rows):
                    box = columns.min(), top + rows.min(), columns.max() + 1, top + rows.max() + 1
                    boxes.setdefault(name, []).append(
                        (int(box[0]), int(box[1]), int(box[2]), int(box[3]))
                    )
        return boxes


def frame(
    scenario: Scenario, state: WorldState, viewer_id: str, size_px: tuple[int, int] = SIZE_PX
) -> Frame:
    """Render the front and rear cameras of one vehicle as one picture, the front above the rear.

    `viewer_id` is the id of that vehicle in `state`, a moment of an episode of `scenario`, and
    `size_px` the picture's width and height, the height even. Vehicles that its sensors do not
    report are not drawn.
    """
    width, height = size_px
    viewer = state.vehicle(viewer_id)
    ambient = scenario.parameters.light
    reported = detect(state, viewer, scenario.parameters)
    boxes = [_vehicle(state, state.vehicle(d.id)) for d in reported]
    boxes += [_building(b.id, b.corners()) for b in state.buildings]
    halves, owners = list[Pixels](), list[Places]()
    for turned_rad in (0.0, np.pi):  # the front camera, and the rear one
        half, of_half = _half(scenario, viewer, boxes, turned_rad, width, height // 2)
        if ambient.glare_rad:
            sun = sun_rad(state.episode_seed) - viewer.heading_rad
            half = _dazzling(half, sun - turned_rad, ambient)
        halves.append(half)
        owners.append(of_half)
    names = tuple(box.name for box in boxes)
    return Frame(np.concatenate(halves), np.concatenate(owners), names)


@dataclass(frozen=True, eq=False)
class Sight(Image):
    """Hold a picture of a vehicle's cameras that is rendered when its pixels are read.

    Until then it has no pixels. It is pickled as a plain picture with pixels.
    """

    scenario: Scenario  # the scenario of the state, whose road is drawn
    state: WorldState  # the moment of an episode that is shown: all vehicles and buildings
    viewer_id: str  # id of the vehicle whose cameras these are
    size_px: tuple[int, int]  # width and height of the picture, pixels

    @property
    def frame(self) -> Frame:
        """Return the rendered picture, with the id of what each pixel shows."""
        return _drawn(self.scenario, self.state, self.viewer_id, self.size_px)

    @property
    def pixels(self) -> Pixels:
        return self.frame.pixels

    def __reduce__(self) -> tuple[type[Image], tuple[Pixels]]:
        return Image, (self.pixels,)


_drawn = lru_cache(maxsize=KEPT)(frame)


@dataclass(frozen=True)
class Box:
    """Describe a vehicle or building, to be drawn, as a box with painted walls.

    Wall k goes from corner k to the next one. Each of the four has a grid of `ROWS` x `COLUMNS`
    patches of paint; some are lamps.
    """

    name: str  # id of the vehicle or building
    # its corners on the ground, (4, 2), m to the east and south of the road's origin
    corners: Floats
    height_m: float  # height above the road, m
    walls: Pixels  # paint on its walls, (4, ROWS, COLUMNS, 3): red, green and blue of each patch
    lamps: Lit  # which of these patches are lamps that shine, (4, ROWS, COLUMNS)


def focal_px(width: int) -> float:
    """Return the focal length, in pixels, of a camera whose pictures are `width` pixels wide."""
    return width / 2 / math.tan(HALF_FIELD_RAD)


def _half(
    scenario: Scenario,
    viewer: VehicleState,
    boxes: list[Box],
    turned_rad: float,
    width: int,
    rows: int,
) -> tuple[Pixels, Places]:
    """Render pixels and owners of one camera, (rows, width, ...)."""
    eye, focal = np.array([viewer.x_m, viewer.y_m]), focal_px(width)
    heading = viewer.heading_rad + turned_rad
    ahead = np.array([np.cos(heading), np.sin(heading)])
    right = np.array([-np.sin(heading), np.cos(heading)])
    # A column's ray has a component of 1 m ahead, so that its parameter is the depth in metres.
    across = (np.arange(width) + 0.5 - width / 2) / focal
    rays = ahead + across[:, None] * right
    below = np.arange(0.5, rows) - HORIZON * rows  # the horizon
    ambient = scenario.parameters.light
    pixels = _background(scenario, eye, rays, below)
    owners = np.full((rows, width), NOBODY, dtype=np.int16)
    if not boxes:
        return pixels, owners
    t, along = meetings(eye, rays, np.array([box.corners for box in boxes]))
    t, along = t.reshape(width, -1, 4), along.reshape(width, -1, 4)
    wall = t.argmin(axis=2)
    depth = np.take_along_axis(t, wall[..., None], axis=2)[..., 0]
    along = np.take_along_axis(along, wall[..., None], axis=2)[..., 0]
    heights = np.array([box.height_m for box in boxes])
    walls = np.array([box.walls for box in boxes])
    lamps = np.array([box.lamps for box in boxes])
    near_first = np.argsort(depth, axis=1, kind="stable")
    is_there = np.isfinite(np.take_along_axis(depth, near_first, axis=1))
    up_to_m = np.where(is_there, heights[near_first], 0.0)
    nearer_m = np.pad(np.maximum.accumulate(up_to_m, axis=1), ((0, 0), (1, 0)))[:, :-1]
    # All boxes are higher than the camera, so one shows only if it is higher than all nearer ones.
    for place, shows in reversed(list(zip(near_first.T, (up_to_m > nearer_m).T, strict=True))):
        columns = np.flatnonzero(shows)
        if not len(columns):
            continue
        box = place[columns]
        z, side, u = (a[columns, box] for a in (depth, wall, along))
        height_m = EYE_M - below[:, None] * z / focal  # above the road, of each pixel
        row, column = np.nonzero((height_m >= 0) & (height_m < heights[box]))
        onward = np.minimum(u * COLUMNS, COLUMNS - 1).astype(int)
        shades = SHADE[side, None, None] * walls[box, side, :, onward]
        # A strip for each column, from the road up.
        strips = np.where(
            lamps[box, side, :, onward][..., None],
            _hazy(shades, z[:, None], LAMPS),
            _hazy(ambient.light * shades, z[:, None], ambient),
        ).astype(np.uint8)
        up = (height_m[row, column] * (ROWS / heights[box])[column]).astype(int)
        at = row * width + columns[column]
        pixels.reshape(-1, 3)[at] = strips[column, up]
        owners.reshape(-1)[at] = box[column]
    return pixels, owners


def _vehicle(state: WorldState, v: VehicleState) -> Box:
    """Return the box of a vehicle with its lamps; the colour of its coat tells nothing about it."""
    coat = COATS[int(noise.uniforms((1,), "coat", state.episode_seed, v.id)[0] * len(COATS))]
    return Box(
        v.id, v.corners(), HEIGHTS_M[v.kind], *_vehicle_walls(v.kind, coat, v.indicator, v.braking)
    )


@lru_cache(maxsize=256)
def _vehicle_walls(
    kind: str, coat: Colour, indicator: str | None, braking: bool
) -> tuple[Pixels, Lit]:
    """Paint the walls of a vehicle from the road up;
    return them and which parts are shining lamps.
    """
    walls = np.empty((4, ROWS, COLUMNS, 3), dtype=np.uint8)
    walls[:] = coat
    if kind in BROAD:
        _paint_body(walls, kind)
    else:
        _paint_person(walls, kind)
    walls[:, : max(1, ROWS // 16)] = TYRE  # its shadow
    dark = walls.copy()
    if kind != "pedestrian":
        _paint_lamps(walls, BRAKE_LAMP if braking else REAR_LAMP, kind in BROAD)
    if indicator in ("left", "right"):
        # the front wall begins at the left, the rear one at the right
        to_right = indicator == "right"
        _paint(walls[FRONT], (0.44, 0.58, 0.0, 0.16), AMBER, to_right)
        _paint(walls[REAR], (0.50, 0.64, 0.0, 0.16), AMBER, not to_right)
        _paint(walls[RIGHT if to_right else LEFT], (0.30, 0.45, 0.0, 0.08), AMBER, not to_right)
    return walls, (walls != dark).any(axis=-1)


def _paint_body(walls: Pixels, kind: str) -> None:
    """Paint the windows and wheels of a car, van or truck."""
    low, high = {"car": (0.55, 0.92), "van": (0.52, 0.86), "truck": (0.45, 0.72)}[kind]
    # of the length, from the front, that has windows
    cab = {"car": 0.80, "van": 0.28, "truck": 0.20}[kind]
    side = (low, high, 0.06 if kind != "car" else 0.18, cab)
    _paint(walls[FRONT], (low, high, 0.08, 0.92), GLASS)
    _paint(walls[REAR], (low, high, 0.12, 0.88), GLASS if kind == "car" else PLATE)
    for wall, mirrored in ((walls[RIGHT], False), (walls[LEFT], True)):
        _paint(wall, side, GLASS, mirrored)
        for at in (0.10, 0.74):
            _paint(wall, (0.0, 0.30 if kind == "car" else 0.22, at, at + 0.16), TYRE, mirrored)


def _paint_person(walls: Pixels, kind: str) -> None:
    """Paint a pedestrian, or who rides a bicycle or motorcycle, in a coat, and the wheels."""
    for wall in walls:
        _paint(wall, (0.0, 0.46, 0.0, 1.0), TROUSERS)
        _paint(wall, (0.84, 1.0, 0.25, 0.75), HELMET if kind == "motorcycle" else SKIN)
    if kind == "pedestrian":
        return
    for wall in (walls[FRONT], walls[REAR]):
        _paint(wall, (0.0, 0.40, 0.40, 0.60), TYRE)
    for wall in (walls[RIGHT], walls[LEFT]):
        for start in (0.0, 0.60):
            _paint(wall, (0.0, 0.40, start, start + 0.40), TYRE)


def _paint_lamps(walls: Pixels, rear: Colour, pair: bool) -> None:
    """Paint the lamps ahead, and those behind in the colour `rear`: a pair of each, or one."""
    ahead, behind = ((0.04, 0.20), (0.02, 0.20)) if pair else ((0.40, 0.50), (0.40, 0.50))
    for mirrored in (False, True):
        _paint(walls[FRONT], (0.30, 0.44, *ahead), HEADLAMP, mirrored)
        _paint(walls[REAR], (0.30, 0.50, *behind), rear, mirrored)


def _building(name: str, corners: Floats) -> Box:
    return Box(name, corners, BUILDING_M, *_building_walls())


@lru_cache(maxsize=1)
def _building_walls() -> tuple[Pixels, Lit]:
    """Paint the walls of a building from the ground up, without lamps."""
    walls = np.empty((4, ROWS, COLUMNS, 3), dtype=np.uint8)
    walls[:] = WALL
    walls[:, ::6] = BRICK
    return walls, np.zeros(walls.shape[:-1], dtype=bool)


def _paint(
    wall: Pixels, part: tuple[float, float, float, float], colour: Colour, mirrored: bool = False
) -> None:
    """Paint a rectangle, given by shares of the wall's height and length (bottom, top, start,
    end).
    """
    bottom, top, start, end = part
    if mirrored:
        start, end = 1 - end, 1 - start
    wall[
        round(bottom * ROWS) : round(top * ROWS), round(start * COLUMNS) : round(end * COLUMNS)
    ] = colour


def _background(scenario: Scenario, eye: Floats, rays: Floats, below: Floats) -> Pixels:
    """Render sky and ground, (rows, width, 3)."""
    ambient = scenario.parameters.light
    pixels = np.empty((len(below), len(rays), 3), dtype=np.uint8)
    sky = int(np.count_nonzero(below <= 0))
    up = (below[:sky] / below[0])[:, None]
    pixels[:sky] = (up * np.array(ambient.sky) + (1 - up) * np.array(ambient.haze))[:, None]
    depth_m = EYE_M * focal_px(len(rays)) / below[sky:]
    ground = _ground_map(scenario)

    def cell(axis: int) -> NDArray[np.int32]:
        """Return the map's cell of each pixel along an axis, (rows, width)."""
        place_m = np.multiply.outer(depth_m, rays[:, axis]) + (eye[axis] + REACH_M)
        cells: NDArray[np.int32] = (place_m / CELL_M).astype(np.int32).clip(0, len(ground) - 1)
        return cells

    # Of each row.
    colours = _hazy(ambient.light * np.array([GRASS, ASPHALT, PAINT]), depth_m[:, None], ambient)
    what = ground[cell(1), cell(0)] + 3 * np.arange(len(depth_m))[:, None]
    pixels[sky:] = colours.astype(np.uint8).reshape(-1, 3)[what]
    return pixels


def _hazy(colours: Floats, depth_m: Floats, ambient: Ambient) -> Floats:
    """Fade colours towards the haze by their distance."""
    clear = np.exp(-depth_m / ambient.fades_m)[..., None]
    return np.asarray(clear * colours + (1 - clear) * np.array(ambient.haze))


def _dazzling(pixels: Pixels, sun_rad: float, ambient: Ambient) -> Pixels:
    """Add glare to one camera's pixels, with the sun at this angle to the right of its axis."""
    width = pixels.shape[1]
    off = turned(np.arctan((np.arange(width) + 0.5 - width / 2) / focal_px(width)) - sun_rad)
    clear = (1 - np.exp(-((off / ambient.glare_rad) ** 2)))[:, None]
    return np.asarray(clear * pixels + (1 - clear) * np.array(GLARE)).astype(np.uint8)


@lru_cache(maxsize=8)
def _ground_map(scenario: Scenario) -> Pixels:
    """Map the ground in cells of `CELL_M`, (y, x) from the north-west:
    0 grass, 1 asphalt, 2 paint.
    """
    ground = scenario.road().ground_within(REACH_M)
    middles = (np.arange(round(2 * REACH_M / CELL_M)) + 0.5) * CELL_M - REACH_M
    edges = [shapely.Polygon(edge * NORTH) for edge in ground.outlines]
    marks = [dash for mark in ground.marks for dash in _dashes(shapely.LineString(mark * NORTH))]
    marks += [shapely.LineString(stop * NORTH) for stop in ground.stops]
    surface = np.zeros((len(middles), len(middles)), dtype=np.uint8)
    sides = np.asarray(middles, dtype=np.float64).reshape(-1, BLOCK)
    blocks = surface.reshape(len(sides), BLOCK, len(sides), BLOCK).swapaxes(1, 2)  # a view of it
    for edge in edges:  # the area inside of two edges is an island and no road
        row, column, inside = _inside(edge, sides)
        blocks[row, column] ^= inside
    for line in (*marks, *(edge.exterior for edge in edges)):
        row, column, inside = _inside(line.buffer(LINE_M / 2, cap_style="flat"), sides)
        blocks[row, column] = np.where(inside & (blocks[row, column] > 0), 2, blocks[row, column])
    # grass, since look-ups beyond the map are clipped to its edge
    surface[[0, -1]] = surface[:, [0, -1]] = 0
    return surface


def _inside(
    area: shapely.Geometry, sides: Floats
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Return the blocks that an area touches, by row and column,
    and which of each one's cells lie in it.

    `sides` are the middles of the cells along each side of the map, block by block,
    (blocks, BLOCK) m.
    """
    west, north, east, south = area.bounds
    columns = np.flatnonzero((sides[:, -1] >= west) & (sides[:, 0] <= east))
    rows = np.flatnonzero((sides[:, -1] >= north) & (sides[:, 0] <= south))
    column, row = (block.ravel() for block in np.meshgrid(columns, rows))
    boxes = shapely.box(sides[column, 0], sides[row, 0], sides[column, -1], sides[row, -1])
    shapely.prepare(area)
    touched = shapely.intersects(area, boxes)
    column, row, boxes = column[touched], row[touched], boxes[touched]
    inside = np.ones((len(boxes), BLOCK, BLOCK), dtype=bool)
    part = ~shapely.contains_properly(area, boxes)
    inside[part] = shapely.contains_xy(
        area, sides[column[part], None, :], sides[row[part], :, None]
    )
    return row, column, inside


def _dashes(line: shapely.LineString) -> list[shapely.Geometry]:
    starts = np.arange(0.0, line.length, DASH_M + GAP_M)
    return [substring(line, s, min(s + DASH_M, line.length)) for s in starts]
