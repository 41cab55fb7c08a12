"""What a vehicle's cameras see: nothing that its sensors do not,
and everything else where it is.
"""

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from harness.core.errors import UserError
from harness.core.image import Image
from harness.core.resources import folder
from harness.dataset.load import Dataset, load
from harness.world import scenarios
from harness.world.ambient import AMBIENTS, sun_rad
from harness.world.perception import camera
from harness.world.perception.camera import (
    AMBER,
    BRAKE_LAMP,
    EYE_M,
    HORIZON,
    SIZE_PX,
    Frame,
    focal_px,
    frame,
)
from harness.world.perception.graph import scene_graph
from harness.world.perception.rays import sweep
from harness.world.perception.sensors import HALF_FIELD_RAD, LEAST_RAYS, detect
from harness.world.state import HEIGHTS_M, SIZES_M, VehicleState, WorldState

DATASETS = sorted(path.parent.name for path in Path(folder("datasets")).glob("*/manifest.json"))
WIDTH, HEIGHT = SIZE_PX
FOCAL_PX = focal_px(WIDTH)
FEW, MANY = 2, 12  # decision points of a dataset, four viewers each
# The latest dataset of each scenario stands for those before it: only layouts and numbers are
# others there.
LATEST = sorted({name.rpartition("-v")[0]: name for name in DATASETS}.values())
ROAD = scenarios.get("hard-brake-ahead")


SOME = [pytest.param((name, FEW), marks=pytest.mark.slow, id=name) for name in LATEST[::3]]
EVERY = [
    pytest.param((name, MANY), marks=pytest.mark.exhaustive, id=f"{name}-{MANY}-moments")
    for name in DATASETS
]


@pytest.fixture(scope="module", params=[*SOME, *EVERY])
def played(request: pytest.FixtureRequest) -> tuple[Dataset, list[tuple[WorldState, str]]]:
    """A dataset that ships, and moments of it."""
    name, scenes = request.param
    dataset = load(folder("datasets") / name)
    return dataset, moments(dataset, scenes)


def moments(dataset: Dataset, scenes: int) -> list[tuple[WorldState, str]]:
    """Some decision points, those that only errors lead to among them, and their viewers."""
    drawn = np.random.default_rng(0).choice(len(dataset.forest.ids), scenes, replace=False)
    chosen = dataset.scenes([dataset.forest.ids[n] for n in sorted(drawn)])
    return [(scene.state, viewer) for scene in chosen for viewer in scene.viewers]


def test_a_hidden_vehicle_changes_no_pixel(played: tuple[Dataset, list[tuple[WorldState, str]]]):
    hidden = 0
    dataset, shown = played
    for state, viewer in shown:
        eye = state.vehicle(viewer)
        reported = {d.id for d in detect(state, eye, dataset.scenario.parameters)} | {viewer}
        without = replace(state, vehicles=tuple(v for v in state.vehicles if v.id in reported))
        hidden += len(state.vehicles) - len(without.vehicles)
        seen = frame(dataset.scenario, state, viewer)
        assert seen.boxes().keys() <= reported | {b.id for b in state.buildings}
        assert seen.sha256 == frame(dataset.scenario, without, viewer).sha256
    assert hidden


def test_a_vehicle_in_sight_and_in_the_field_owns_pixels(
    played: tuple[Dataset, list[tuple[WorldState, str]]],
):
    owners = 0
    dataset, shown = played
    for state, viewer in shown:
        eye = state.vehicle(viewer)
        seen, view = frame(dataset.scenario, state, viewer).boxes(), sweep(state, eye)
        off = np.abs((view.bearing_rad - eye.heading_rad + np.pi / 2) % np.pi - np.pi / 2)
        for d in detect(state, eye, dataset.scenario.parameters):
            if np.count_nonzero(off[view.hits[d.id]] < HALF_FIELD_RAD) >= LEAST_RAYS:
                owners += 1
                assert d.id in seen, (state.episode_seed, state.step, viewer, d.id)
    assert owners


def test_a_frame_is_the_same_every_time_and_another_for_another_viewer():
    state, viewer = moments(load(folder("datasets") / DATASETS[0]), 1)[0]
    of = scenarios.get(state.scenario)
    pixels = frame(of, state, viewer).pixels
    assert pixels.shape == (HEIGHT, WIDTH, 3)
    assert np.array_equal(pixels, frame(of, state, viewer).pixels)
    assert frame(of, state, viewer).sha256 != frame(of, state, state.helpers[-1].id).sha256


def vehicle(name: str, x_m: float, y_m: float = 0.0, **others: Any) -> VehicleState:
    """A car on the motorway, heading east."""
    approach, route = ROAD.road().ego
    stated: dict[str, Any] = {"kind": "car", "part": "other", "heading_rad": 0.0, "speed_mps": 20.0}
    stated |= {"approach": approach, "route": route}
    return VehicleState(
        **{"id": name, "crashed": False, "x_m": x_m, "y_m": y_m, **stated, **others}
    )


def seen_by_the_first(*vehicles: VehicleState, ambient: str = "day") -> Frame:
    state = WorldState(ROAD.name, 0, 0, 0.0, 20.0, vehicles, ())
    return frame(scenarios.get(f"{ROAD.name}:ambient={ambient}"), state, vehicles[0].id)


def test_a_car_is_where_and_as_large_as_a_pinhole_shows_it():
    # Its rear wall is 20 m ahead and 2 m wide; its middle 4 m to the right.
    of = seen_by_the_first(vehicle("v1", 0.0), vehicle("v2", 22.5, 4.0))
    [(left, top, right, bottom)] = of.boxes()["v2"]
    # Its left side shows as well, from 3 m to the right, 25 m ahead.
    assert left == pytest.approx(WIDTH / 2 + FOCAL_PX * 3 / 25, abs=1)
    assert right == pytest.approx(WIDTH / 2 + FOCAL_PX * 5 / 20, abs=1)
    horizon = HORIZON * HEIGHT / 2
    assert bottom == pytest.approx(horizon + FOCAL_PX * EYE_M / 20, abs=1)
    assert top == pytest.approx(horizon - FOCAL_PX * (1.5 - EYE_M) / 20, abs=1)


@pytest.mark.parametrize("kind", ["bicycle", "motorcycle", "pedestrian"])
def test_who_is_narrow_is_as_large_as_a_pinhole_shows_it(kind: str) -> None:
    length, width = SIZES_M[kind]
    of = seen_by_the_first(vehicle("v1", 0.0), vehicle("v2", 8 + length / 2, kind=kind))
    [(left, top, right, bottom)] = of.boxes()["v2"]
    assert right - left == pytest.approx(FOCAL_PX * width / 8, abs=1)
    assert bottom - top == pytest.approx(FOCAL_PX * HEIGHTS_M[kind] / 8, abs=1)


def test_what_is_behind_is_in_the_lower_half():
    of = seen_by_the_first(vehicle("v1", 0.0), vehicle("v2", -20.0))
    [(_, top, _, _)] = of.boxes()["v2"]
    assert top >= HEIGHT // 2


def test_a_truck_shows_above_a_car_only_if_a_ray_reaches_it():
    hidden = seen_by_the_first(
        vehicle("v1", 0.0), vehicle("v2", 12.0), vehicle("v3", 40.0, kind="truck")
    )
    assert set(hidden.boxes()) == {"v2"}
    beside = seen_by_the_first(
        vehicle("v1", 0.0), vehicle("v2", 12.0), vehicle("v3", 40.0, 4.0, kind="truck")
    )
    [(_, car_top, car_right, _)], [(truck_left, truck_top, _, _)] = (
        beside.boxes()["v2"],
        beside.boxes()["v3"],
    )
    assert truck_top < car_top
    assert truck_left <= car_right


def columns_of(of: Frame, colour: tuple[int, int, int]) -> np.ndarray:
    """Columns in which a lamp is lit, however the air dims it."""
    towards = of.pixels.astype(float) - np.array(camera.LAMPS.haze)
    wanted = np.array(colour) * camera.SHADE[camera.REAR] - np.array(camera.LAMPS.haze)
    along = (towards @ wanted) / np.linalg.norm(towards, axis=2).clip(1e-9) / np.linalg.norm(wanted)
    return np.unique(np.nonzero((along > 0.995) & (of.owners >= 0))[1])


def test_lamps_show_what_a_vehicle_does():
    def ahead(**others: Any) -> Frame:
        return seen_by_the_first(vehicle("v1", 0.0), vehicle("v2", 12.0, kind="van", **others))

    assert not len(columns_of(ahead(), BRAKE_LAMP))
    lit = columns_of(ahead(braking=True), BRAKE_LAMP)
    assert lit.min() < WIDTH / 2 < lit.max()
    assert not len(columns_of(ahead(), AMBER))
    assert columns_of(ahead(route="left"), AMBER).max() < WIDTH / 2
    assert columns_of(ahead(route="right"), AMBER).min() > WIDTH / 2


def test_a_motorcycle_has_lamps_and_a_bicycle_and_a_pedestrian_signal_nothing():
    def lit(kind: str, braking: bool) -> list[bool]:
        there = vehicle("v2", 8.0, kind=kind, braking=braking, route="left")
        of = seen_by_the_first(vehicle("v1", 0.0), there)
        return [len(columns_of(of, colour)) > 0 for colour in (BRAKE_LAMP, AMBER)]

    assert lit("motorcycle", braking=True) == [True, True]
    assert lit("bicycle", braking=False) == lit("pedestrian", braking=False) == [False, False]


def reported(ambient: str, *others: VehicleState) -> dict[str, bool]:
    """Whether the camera is among the sensors that the first vehicle has of each other one."""
    state = WorldState(ROAD.name, 0, 0, 0.0, 20.0, (vehicle("v1", 0.0, part="ego"), *others), ())
    graph = scene_graph(scenarios.get(f"{ROAD.name}:ambient={ambient}"), state, "v1")
    return {node.id: "camera" in node.sensors for node in graph.nodes}


def test_bad_light_takes_range_from_the_camera_and_from_no_other_sensor():
    near, far = vehicle("v2", 25.0, -2.0), vehicle("v3", 50.0, 4.0)
    assert reported("day", near, far) == {"v2": True, "v3": True}
    assert reported("night", near, far) == {"v2": True, "v3": False}
    assert reported("fog", near, far) == {"v2": True, "v3": False}
    assert reported("fog", vehicle("v2", 31.0)) == {"v2": False}


def test_a_low_sun_takes_what_is_before_it_alone():
    sun = sun_rad(0)
    before, beside = (
        vehicle(name, 30 * np.cos(sun + off), 30 * np.sin(sun + off))
        for name, off in (("v2", 0.0), ("v3", 0.6))
    )
    by_day = reported("day", before, beside)
    assert reported("glare", before, beside) == {"v2": False, "v3": by_day["v3"]}


@pytest.mark.parametrize("ambient", AMBIENTS)
def test_contrast_falls_with_distance_as_the_air_says(ambient):
    def contrast(name: str, x_m: float) -> float:
        of = seen_by_the_first(vehicle("v1", 0.0), vehicle(name, x_m, kind="van"), ambient=ambient)
        [(left, top, right, bottom)] = of.boxes()[name]
        coat = of.pixels[bottom - round(0.3 * (bottom - top)), (left + right) // 2].astype(float)
        return float(np.abs(coat - AMBIENTS[ambient].haze).sum())

    clearest = max((f"v{n}" for n in range(2, 12)), key=lambda name: contrast(name, 23.25))
    measured = contrast(clearest, 43.25) / contrast(clearest, 23.25)  # 20 m farther
    assert measured == pytest.approx(np.exp(-20 / AMBIENTS[ambient].fades_m), abs=0.02)


def test_lamps_shine_at_night():
    ahead = vehicle("v2", 30.0, kind="van", braking=True)
    assert seen_by_the_first(vehicle("v1", 0.0), ahead, ambient="night").pixels[..., 0].max() > 200


def test_a_light_that_there_is_not_is_refused():
    with pytest.raises(
        UserError, match="ambient is dusk; it must be day or night or rain or fog or glare"
    ):
        scenarios.get("occluded-intersection:ambient=dusk")


def test_a_picture_is_a_png_of_the_same_pixels():
    image = pytest.importorskip("PIL.Image")
    pixels = seen_by_the_first(vehicle("v1", 0.0), vehicle("v2", 12.0)).pixels
    read = image.open(BytesIO(Image(pixels).png()))
    assert np.array_equal(np.asarray(read), pixels)
    assert read.mode == "RGB"
