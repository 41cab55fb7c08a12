"""Simulate traffic with SUMO: one run from a seed, with what one vehicle is told to do.

A run is a function of the files, the seed and the commands alone. SUMO can save and load its state,
but what follows is another drive than without (2.4 to 25 m off after 6 s), so a run always begins
anew. From the time that matters on nobody dawdles (sigma 0): SUMO draws dawdling by lane, so that a
vehicle which brakes would change others that cannot see it.
"""

import atexit
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, tostring

import numpy as np

from harness.core.errors import UserError, one_line, printable
from harness.core.extras import need
from harness.core.files import canonical_bytes, sha256_bytes
from harness.extensions.roads import sumo_files
from harness.extensions.roads.scene import Track
from harness.extensions.roads.sources import elements, no_use
from harness.extensions.roads.sumo_files import KINDS, Map, centres

STEP_S = 0.1
MOST_VEHICLES = 2000  # at one time
CHANGES_S = 0.5  # the ego is held to a lane so long: beyond the next node lanes may count otherwise
RUNS_KEPT = 128
# The ego keeps to its own accelerations, and minds nobody: bits 2 and 4 of SUMO's speed mode, and
# 32, no right of way in a crossing; and it changes lane only when it is told, at once.
SPEED_MODE, LANE_CHANGE_MODE = 38, 0
# Elements that move nothing to a file, load no other file, and start no device.
IN_NETS = (
    "net location type restriction edge lane neigh param stopOffset junction request connection "
    "prohibition roundabout tlLogic phase"
)
IN_ROUTES = (
    "routes additional vTypeDistribution vType routeDistribution route flow vehicle trip stop "
    "person personFlow walk"
)
IN_BUILDINGS = "additional poly location param"
NET_FILE, ROUTES_FILE, BUILDINGS_FILE = "net.xml", "routes.xml", "buildings.xml"
ROUTES_TOO = "routes", "additional"  # routes may stand in an additional file
OPTIONS = {
    "--step-length": f"{STEP_S}",
    "--xml-validation": "never",
    "--xml-validation.net": "never",
    "--xml-validation.routes": "never",
    "--collision.action": "none",  # the harness says who collides
    "--time-to-teleport": "-1",
    "--lanechange.duration": "2",
    "--no-step-log": "true",
    "--no-warnings": "true",
    "--duration-log.disable": "true",
}


class Command(NamedTuple):
    """Say what the ego is told at a time: a speed to aim for, and to change lane or not."""

    time_s: float
    speed_mps: float
    to_left: int  # by so many lanes; to the right if negative


class Inputs(NamedTuple):
    """Hold a net, routes and buildings whose elements were checked, as SUMO reads them."""

    net: bytes
    routes: bytes
    buildings: bytes = b""  # empty without any

    @property
    def files(self) -> dict[str, bytes]:
        """Return the content of each file by its name in a folder."""
        files = {NET_FILE: self.net, ROUTES_FILE: self.routes}
        return files | ({BUILDINGS_FILE: self.buildings} if self.buildings else {})

    @property
    def digest(self) -> str:
        """Return the hex SHA-256 of all files."""
        digests = {name: sha256_bytes(content) for name, content in self.files.items()}
        return sha256_bytes(canonical_bytes(digests))


def inputs_of(net: Path, routes: Path, buildings: Path | None = None) -> Inputs:
    """Read a net, routes and buildings; refuse what makes SUMO read or write another file."""
    polygons = _plain(buildings, IN_BUILDINGS, "additional") if buildings else b""
    return Inputs(_plain(net, IN_NETS, "net"), _plain(routes, IN_ROUTES, "routes"), polygons)


def kept_inputs(folder: Path) -> Inputs:
    """Read the files of `Inputs` from a folder that holds them by their names."""
    buildings = folder / BUILDINGS_FILE
    parts = folder / NET_FILE, folder / ROUTES_FILE, buildings if buildings.is_file() else None
    return inputs_of(*parts)


def _plain(path: Path, allowed: str, root: str) -> bytes:
    """Return a file of XML as SUMO is given it: what was read of it, and no more."""
    children: list[Element] = []
    whole = Element(root)
    for n, element in enumerate(elements(path)):
        if n == 0 and element.tag != root and (root, element.tag) != ROUTES_TOO:
            raise no_use(path, f"its root is {printable(element.tag, 40)}, not {root}")
        for each in element.iter():
            _refuse(path, each, allowed)
        if n == 0:
            whole.attrib.update(element.attrib)
        else:
            children.append(element)
    whole.extend(children)
    return tostring(whole)


def _refuse(path: Path, element: Element, allowed: str) -> None:
    """Refuse an element that is not allowed, and drop attributes with a namespace.

    A traffic light that senses vehicles may write a file, too.
    """
    what = printable(element.tag, 40)
    if element.tag not in allowed.split():
        raise no_use(path, f"{what} is no part of a plain net or plain routes")
    is_plain = element.get("type", "static") == "static" and element.find("param") is None
    if element.tag == "tlLogic" and not is_plain:
        raise no_use(path, "a traffic light is not static, or has a param")
    for name in list(element.attrib):
        if ":" in name or name == "xmlns":
            del element.attrib[name]
        elif "file" in name.lower() or name in ("href", "output"):
            raise no_use(path, f"{what} names a file by {printable(name, 40)}")


def version() -> str:
    """Return SUMO's version, such as `1.28.0`. Raises UserError if it is not installed."""
    return str(_sumo().getVersion()[1]).removeprefix("SUMO ")


@lru_cache(maxsize=1)
def _sumo() -> Any:
    need("traffic of SUMO", "libsumo")
    os.environ.setdefault("LIBSUMO_AS_TRACI", "quiet")  # else it prints a warning about pyarrow
    try:
        import libsumo
    except ImportError as error:  # it imports packages of SUMO's that come apart from it
        raise UserError(
            f"libsumo cannot be imported ({one_line(error)}); run `pip install traci sumolib`"
        ) from None
    return libsumo


@lru_cache(maxsize=8)
def map_of(inputs: Inputs) -> Map:
    """Return the lanes and houses of inputs."""
    folder = _folder(inputs)
    return sumo_files.map_of(*[folder / name for name in inputs.files])


@lru_cache(maxsize=8)
def _folder(inputs: Inputs) -> Path:
    """Return a folder of this process with the files of inputs."""
    folder = Path(mkdtemp(prefix="harness-sumo-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for name, content in inputs.files.items():
        (folder / name).write_bytes(content)
    return folder


@lru_cache(maxsize=RUNS_KEPT)
def run(
    inputs: Inputs,
    seed: int,
    begin_s: float,
    end_s: float,
    ego: str | None = None,
    commands: tuple[Command, ...] = (),
) -> Mapping[str, Track]:
    """Return the road users of one run from `begin_s` to `end_s`, by id.

    Args:
        inputs: the net and the routes.
        seed: of SUMO's draws: who sets off when, and how fast he drives.
        begin_s: time from which on poses are kept.
        end_s: time of the last pose.
        ego: id of the vehicle that the commands are for.
        commands: what it is told, in the order of time, none before `begin_s`.

    Raises UserError if SUMO refuses the files, or there are too many vehicles.
    """
    sumo, folder = _sumo(), _folder(inputs)
    files = ["-n", str(folder / NET_FILE), "-r", str(folder / ROUTES_FILE)]
    options = [text for option in OPTIONS.items() for text in option]
    try:
        sumo.start(["sumo", *files, *options, "--seed", str(seed)])
        try:
            times = round(begin_s / STEP_S), round(end_s / STEP_S)
            return dict(_driven(sumo, *times, ego, commands))
        finally:
            sumo.close()
    except UserError:
        raise
    except Exception as error:
        raise UserError(f"SUMO cannot play these files: {one_line(error)}") from None


def _driven(
    sumo: Any, begin: int, end: int, ego: str | None, commands: Sequence[Command]
) -> Iterator[tuple[str, Track]]:
    due = {round(command.time_s / STEP_S): command for command in commands}
    watch, to_left = _Watch(sumo), 0
    if begin > 1:
        sumo.simulationStep((begin - 1) * STEP_S)
    for step in range(max(begin, 1), end + 1):
        command = due.get(step - 1)
        if (command or to_left) and ego in sumo.vehicle.getIDList():
            if command:
                _aim(sumo.vehicle, ego, command.speed_mps)
                to_left = command.to_left
            if to_left and _change(sumo, ego, to_left):
                to_left = 0
        sumo.simulationStep()
        watch.look(step * STEP_S)
    yield from watch.tracks()


def _aim(vehicles: Any, ego: str | None, speed_mps: float) -> None:
    """Tell the ego its speed, and to mind nobody."""
    vehicles.setSpeedMode(ego, SPEED_MODE)
    vehicles.setLaneChangeMode(ego, LANE_CHANGE_MODE)
    vehicles.setSpeed(ego, speed_mps)


def _change(sumo: Any, ego: str | None, to_left: int) -> bool:
    """Tell the ego to change lane; return whether that could be said: within a crossing it waits.

    Where there is no such lane, nothing is done. SUMO's lanes count to the left.
    """
    edge, lane = sumo.vehicle.getRoadID(ego), sumo.vehicle.getLaneIndex(ego) + to_left
    if edge.startswith(":"):
        return False
    if 0 <= lane < sumo.edge.getLaneNumber(edge):
        sumo.vehicle.changeLane(ego, lane, CHANGES_S)
    return True


class _Watch:
    """Gather the poses of everybody, time by time."""

    def __init__(self, sumo: Any) -> None:
        self.sumo = sumo
        self.times: dict[str, list[float]] = {}
        self.poses: dict[str, list[tuple[float, ...]]] = {}
        self.kinds: dict[str, tuple[str, float, float]] = {}

    def look(self, time_s: float) -> None:
        """Take in where everybody is; who is new does not dawdle."""
        for domain in (self.sumo.vehicle, self.sumo.person):
            ids = domain.getIDList()
            if len(ids) > MOST_VEHICLES:
                raise UserError(f"SUMO plays more than {MOST_VEHICLES} vehicles; let fewer set off")
            for key in ids:
                if key not in self.times:
                    self._meet(domain, key)
                self.times[key].append(time_s)
                x_m, y_m = domain.getPosition(key)[:2]
                pose = (x_m, y_m, domain.getAngle(key), domain.getSpeed(key))
                self.poses[key].append(pose)

    def _meet(self, domain: Any, key: str) -> None:
        named = KINDS.get(domain.getVehicleClass(key), "car")
        self.kinds[key] = named, domain.getLength(key), domain.getWidth(key)
        self.times[key], self.poses[key] = [], []
        if domain is self.sumo.vehicle:
            domain.setImperfection(key, 0.0)

    def tracks(self) -> Iterator[tuple[str, Track]]:
        for key, times in self.times.items():
            kind, length_m, width_m = self.kinds[key]
            poses = centres(np.array(self.poses[key]), length_m)
            yield key, Track(key, kind, length_m, width_m, np.array(times), poses)
