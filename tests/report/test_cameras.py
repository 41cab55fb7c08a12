"""The cameras' pictures in a page, with boxes around what each viewer's sensors list."""

import base64
import json
import shutil
from io import BytesIO

import numpy as np
import pytest
from reading import details, packed
from run_on_disk import change, configure

from harness.core.resources import folder
from harness.dataset.load import load
from harness.report import decisions, library
from harness.report.details import cameras
from harness.report.page import render
from harness.report.runs import gather
from harness.runs.folder import read
from harness.world.perception.camera import frame
from harness.world.perception.sensors import detect

pytestmark = pytest.mark.slow
image = pytest.importorskip("PIL.Image", reason="needs the report extra")


def pixels(address):
    """What a browser shows of a picture that lies in the page."""
    kind, _, content = address.partition(",")
    assert kind == "data:image/png;base64"
    return np.asarray(image.open(BytesIO(base64.b64decode(content))))


def test_each_viewer_has_its_picture_and_boxes_around_what_its_sensors_list(run, dataset):
    opened = details(render(gather([run]), full=True))
    boxes = 0
    for name, detail in opened.items():
        state = dataset.scene(name).state
        assert list(detail["cameras"]) == list(detail["world"]["viewers"])
        for viewer, shown in detail["cameras"].items():
            seen = frame(dataset.scenario, state, viewer, tuple(shown["size"]))
            difference = pixels(shown["picture"]).astype(int) - seen.pixels
            assert np.abs(difference).max() < 8, "a shade and no more"
            eye = state.vehicle(viewer)
            listed = {d.id for d in detect(state, eye, dataset.scenario.parameters)}
            of = {id: found for id, found in seen.boxes().items() if id in listed}
            assert shown["boxes"] == [[id, *box] for id in of for box in of[id]]
            boxes += len(shown["boxes"])
    assert boxes > len(opened)


@pytest.fixture
def seeing(run, tmp_path):
    """The run, as if the ego had been shown its picture."""
    copy = shutil.copytree(run, tmp_path / "run")
    change(
        copy, answer=lambda a: a.update({"image_sha256": "0" * 64} if a["role"] == "ego" else {})
    )
    return copy


def test_only_the_page_of_models_that_see_has_pictures_unless_it_is_full(run, seeing):
    page = render(gather([run]))
    assert json.loads(packed(page, "index"))["framed"] == 0
    assert not any(detail["cameras"] for detail in details(page).values())
    assert all(detail["cameras"] for detail in details(render(gather([seeing]))).values())


def test_where_an_episode_was_lost_comes_first_if_a_page_cannot_have_all(seeing, monkeypatch):
    run = seeing
    lost, every = decisions.lost(read(run)), list(read(run).decisions.scenes)
    assert 1 < len(lost) < len(every) - 1
    for room in (len(lost) - 1, len(lost) + 1):
        monkeypatch.setattr(decisions, "FRAMES", 4 * room + 3)  # four viewers each
        page = render(gather([run]))
        with_pictures = {name for name, detail in details(page).items() if detail["cameras"]}
        assert len(with_pictures) == room == json.loads(packed(page, "index"))["framed"]
        assert with_pictures < set(lost) if room < len(lost) else set(lost) < with_pictures


@pytest.mark.parametrize("mode", ["own", "blank", "another"])
def test_an_answer_says_which_picture_its_prompt_had(seeing, mode, monkeypatch):
    """By what the run recorded: here of the ego alone. Few pictures lie in the page."""
    monkeypatch.setattr(decisions, "FRAMES", 4)
    configure(seeing, image=mode)
    for detail in details(render(gather([seeing]))).values():
        [of] = detail["runs"]
        assert {(a["role"], a.get("picture")) for a in of["answers"]} == {
            ("ego", mode),
            ("helper", None),
        }


@pytest.mark.exhaustive
def test_pictures_of_a_report_of_the_default_dataset_take_less_than_one_and_a_half_megabytes():
    dataset = load(folder("datasets") / "occluded-intersection-v2", limit=30)
    drawn = [cameras(dataset.scenario, scene) for scene in dataset.scenes(dataset.courses()[::20])]
    bytes_each = len(library.packed(drawn)) / sum(map(len, drawn))
    assert 1_000_000 < decisions.FRAMES * bytes_each < 1_500_000
