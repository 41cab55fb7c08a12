"""Pictures of scenes."""

import io
from xml.etree import ElementTree

import numpy as np
import pytest
from evaluating import scenes_of
from hypothesis import example, given, settings
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread

from harness.core.errors import UserError
from harness.report.drawing.colours import ROLES
from harness.report.drawing.geometry import View
from harness.report.drawing.labels import Labels
from harness.report.drawing.pictures import styled
from harness.report.drawing.scene import draw


def picture(scene, format="svg", viewer=None):
    out = io.BytesIO()
    draw(scene, out, format, viewer)
    return out.getvalue()


def texts(svg):
    return [t.text for t in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")]


@pytest.mark.slow
@pytest.mark.parametrize("format", ["svg", "png"])
def test_one_scene_gives_one_picture_byte_for_byte(dataset, tmp_path, format):
    draw(scenes_of(dataset)[3], tmp_path / "scene", format)
    assert (tmp_path / "scene").read_bytes() == picture(scenes_of(dataset)[3], format)


@pytest.mark.slow
@pytest.mark.parametrize("every", [22, pytest.param(1, marks=pytest.mark.exhaustive)])
def test_every_vehicle_is_labelled_with_id_and_kind_and_the_file_stays_light(dataset, every):
    for scene in scenes_of(dataset)[::every]:
        for viewer in scene.viewers:
            svg = picture(scene, viewer=viewer)
            assert len(svg) <= 40_000
            assert {f"{v.id} {v.kind}" for v in scene.state.vehicles} <= set(texts(svg))


@pytest.mark.slow
def test_what_the_viewer_does_not_see_is_labelled_hidden(dataset):
    scene = scenes_of(dataset)[2]
    for viewer in scene.viewers:
        seen = {node.id for node in scene.graphs[viewer].nodes} | {viewer}
        unseen = [v for v in scene.state.vehicles if v.id not in seen]
        assert unseen
        assert sum(text.endswith("hidden") for text in texts(picture(scene, viewer=viewer))) == len(
            unseen
        )


def test_conflict_points_say_when_the_ego_and_the_other_are_there(dataset):
    scene, conflict = next(
        (s, conflict)
        for s in scenes_of(dataset) for conflict in s.graphs["v1"].conflicts
        if conflict.ego.time_s and conflict.other.time_s
    )  # fmt: skip
    ego, other = conflict.ego.time_s, conflict.other.time_s
    assert f"v1 in {ego:.1f} s, {conflict.vehicle} in {other:.1f} s" in texts(picture(scene))


@pytest.mark.slow
def test_the_ego_from_the_south_is_in_the_lower_half_because_north_is_up(dataset):
    pixels = imread(io.BytesIO(picture(scenes_of(dataset)[0], "png")))[..., :3]
    height = len(pixels)
    ego = np.abs(pixels - to_rgb(ROLES["ego"])).max(axis=-1) < 0.02
    rows = np.flatnonzero(ego.any(axis=1))
    above_the_legend = rows[rows < 0.92 * height]
    assert len(above_the_legend)
    assert above_the_legend.min() > height / 2


def test_who_is_no_viewer_and_what_is_no_format_is_refused_with_what_is_allowed(dataset):
    with pytest.raises(
        UserError,
        match=r"unknown viewer of scene 00000-0-[0-9a-f]{12} 'v9'.* known: v1, v2, v3, v4",
    ):
        picture(scenes_of(dataset)[0], viewer="v9")
    with pytest.raises(UserError, match=r"unknown picture format 'bmp'.* known: pdf, png, svg"):
        picture(scenes_of(dataset)[0], format="bmp")


def test_a_hostile_scene_id_is_text_in_the_picture(dataset):
    hostile = '</text><script>alert("$x^2$")</script>\u202e\n'
    svg = picture(scenes_of(dataset)[0].changed(scene=hostile))
    tags = {element.tag.rpartition("}")[2] for element in ElementTree.fromstring(svg).iter()}
    assert "script" not in tags
    assert any("<script>" in text for text in texts(svg))
    assert b"\xe2\x80\xae" not in svg


@styled
def placed(points):
    """Boxes (n, 2, 2) in pixels of labels at the points, and of the axes."""
    figure = Figure(figsize=(6, 6))
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(-80, 80), ylim=(-80, 80))
    labels = Labels(axes, pt_per_m=6 * 72 / 160, size_pt=6.5, view=View(-80.0, -80.0, 160.0, 160.0))
    for n, point in enumerate(points):
        labels.add(np.array(point), 2.5, f"v{n + 1} truck\nhelper, hidden", bold=n == 0)
    labels.place()
    boxes = [text.get_window_extent(canvas.get_renderer()).get_points() for text in axes.texts]
    return np.array(boxes), axes.get_window_extent().get_points()


@pytest.mark.slow
@settings(max_examples=30)
@given(st.lists(st.tuples(*[st.floats(-79, 79)] * 2), min_size=2, max_size=7))
@example([(19.0, 56.0), (40.0, 77.0), (70.0, 74.0), (71.0, 71.0)])  # a corner with little room
def test_labels_cover_no_other_label_and_stay_in_the_picture(points):
    boxes, frame = placed(points)
    for n, box in enumerate(boxes):
        assert np.all(box[0] >= frame[0])
        assert np.all(box[1] <= frame[1])
        for other in boxes[n + 1 :]:
            assert np.any((box[1] <= other[0]) | (other[1] <= box[0]))
