"""Reception from a table: read, interpolated, refused, and driven through the seam."""

import hashlib
import math
import os
from pathlib import Path

import numpy as np
import pytest

from harness.core.errors import UserError
from harness.core.files import sha256_file
from harness.extensions.radio.reception import curves_of
from harness.extensions.radio.trace import Trace, from_profile, read
from harness.radio.channel import BUILDING, CLEAR, VEHICLE, Channel, Draws, Links, Site
from harness.radio.fading import Trips
from harness.radio.profiles import CHANNELS
from harness.radio.wrapped import heard_s

PLAIN = "distance_m,reception\n300,0.2\n100,0.8\n"
SIGHTED = (
    "distance_m,reception,sight,latency_ms\n"
    "0,1.0,clear,4\n200,0.9,clear,8\n0,0.8,vehicle,4\n200,0.4,vehicle,4\n0,0.5,building,4\n50,0,building,4\n"
)


def table(tmp_path: Path, text: str = PLAIN) -> Path:
    path = tmp_path / "run.csv"
    path.write_text(text, encoding="utf-8")
    return path


def load(path: Path, **settings: object) -> Trace:
    return from_profile(
        {"file": path.name, **settings}, path.parent, "channel file mine.toml [parameters]"
    )


def sites(distances_m: list[float], sight: list[int]) -> Site:
    there = np.stack([np.array([0.0, *distances_m]), np.zeros(1 + len(distances_m))], axis=-1)
    return Site(there, np.array(sight), np.zeros(len(sight)), np.full((len(sight), 2), np.nan))


def test_reception_is_on_straight_lines_between_rows_held_before_them_and_zero_after(tmp_path):
    trace = load(table(tmp_path))
    at = np.array([0.0, 100.0, 150.0, 300.0, 301.0])
    assert trace.reception(at).tolist() == pytest.approx([0.8, 0.8, 0.65, 0.2, 0.0])
    held = load(table(tmp_path), beyond="held")
    assert held.reception(at).tolist() == pytest.approx([0.8, 0.8, 0.65, 0.2, 0.2])
    assert trace.receptions.file == "run.csv"
    assert trace.receptions.sha256 == hashlib.sha256(PLAIN.encode()).hexdigest()
    assert math.isnan(trace.busy_ratio())


@pytest.mark.parametrize("nothing", ["", "nan", " NaN "])
def test_what_never_arrives_needs_no_latency(nothing: str, tmp_path: Path) -> None:
    """Half of the messages at 75 m arrive; they take as long as those at 50 m."""
    rows = f"0,0,{nothing}\n10,1,3\n50,1,5\n100,0,{nothing}\n"
    trace = load(table(tmp_path, f"distance_m,reception,latency_ms\n{rows}"))
    assert [p.latency_s for p in trace.receptions.points] == pytest.approx(
        [0.003, 0.003, 0.005, 0.005]
    )
    sight = "clear,vehicle,building"
    rows = "".join(
        f"{d},{r},{w},{t}\n" for w in sight.split(",") for d, r, t in ((0, w != "building", 7),)
    )
    rows = rows.replace("0,True,", "0,1,").replace("0,False,building,7", f"0,0,building,{nothing}")
    walled = load(table(tmp_path, f"distance_m,reception,sight,latency_ms\n{rows}"))
    assert [p.latency_s for p in walled.receptions.points] == [0.007] * 3
    none = load(table(tmp_path, f"distance_m,reception,latency_ms\n0,0,{nothing}\n"), latency_s=0.1)
    assert none.receptions.points[0].latency_s is None


def test_what_stands_between_has_a_curve_of_its_own_and_an_unknown_place_none(tmp_path):
    trace = load(table(tmp_path, SIGHTED))
    assert trace.reception(np.array([100.0])).tolist() == pytest.approx([0.95]), (
        "clear, if nothing is said"
    )
    site = sites([100.0, 100.0, 25.0, np.nan], [CLEAR, VEHICLE, BUILDING, CLEAR])
    loss = trace.loss(site, np.zeros(4), 800.0)
    assert loss[:3].tolist() == pytest.approx([0.05, 0.4, 0.75])
    assert np.isnan(loss[3])


def test_a_reply_comes_after_the_latency_of_its_distance_if_both_messages_cross(tmp_path):
    """At 100 m .95 cross in 6 ms. Draws are probabilities of loss that are just passed and just
    not.
    """
    trace = load(table(tmp_path, SIGHTED))
    assert isinstance(trace, Channel)
    asked = np.array([True, True, False])
    links = Links(
        asked, np.array([0.15, 0.2, np.nan]), np.full(3, np.nan), np.full(3, 800.0), asked, asked, 400.0,
        sites([100.0, 100.0, np.nan], [CLEAR] * 3),
    )  # fmt: skip
    draws = Draws(
        np.full((3, 2), 0.5), np.full(3, 0.5), Trips(np.array(0), np.array(0), np.array(0), 1)
    )
    object.__setattr__(draws, "packet", np.array([[0.06, 0.06], [0.06, 0.04], [0.9, 0.9]]))
    assert heard_s(trace, trace.request(400.0, draws), links, draws)[:2] == pytest.approx(
        [0.006, 0.006]
    )
    up, delay_s, loss, airtime_s = trace.deliver(links, draws)
    assert up[:2].tolist() == [True, False]
    assert delay_s.tolist() == pytest.approx([0.156, 0.206, np.inf])
    assert loss[0] == pytest.approx(0.05)
    assert np.isnan(airtime_s).all()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("distance_m\n1\n", "run.csv: has no column reception"),
        (
            "distance_m,reception,loss\n1,1,0\n",
            "'loss'; known: distance_m, latency_ms, latency_p50_ms",
        ),
        ("distance_m,reception\n", "has no rows; give reception at one distance at least"),
        (
            "distance_m,reception\n1,1\n2,1.2\n",
            "line 3: reception is '1.2'; it must be a share from 0 to 1",
        ),
        (
            "distance_m,reception\nfar,1\n",
            "line 2: distance_m is 'far'; it must be metres, 0 to 1000000",
        ),
        ("distance_m,reception\n1,nan\n", "line 2: reception is 'nan'"),
        ("distance_m,reception\n1\n", "line 2: has other columns than the first line"),
        ("distance_m,reception\n1,1,1\n", "line 2: has other columns than the first line"),
        ("distance_m,reception\n1,1\n1,0.5\n", "distance_m 1 stands there twice"),
        (
            "distance_m,reception,sight\n1,1,wall\n",
            "line 2: sight is 'wall'; it must be clear, vehicle, building",
        ),
        (
            "distance_m,reception,sight\n1,1,clear\n",
            "has no row of sight 'vehicle'; with sight it needs clear",
        ),
        (
            "distance_m,reception,latency_ms\n1,1,\n",
            "line 2: latency_ms is ''; it must be milliseconds, 0 to",
        ),
        ("distance_m,reception,latency_ms\n1,0.1,nan\n", "it may be blank where reception is 0"),
        ("distance_m,reception,latency_ms\n1,0,soon\n", "line 2: latency_ms is 'soon'"),
        (
            "distance_m,reception,latency_ms\n1,1,-4\n",
            "line 2: latency_ms is '-4'; it must be milliseconds",
        ),
    ],
)
def test_a_bad_table_is_refused_in_one_line(tmp_path, text, says):
    with pytest.raises(UserError) as refused:
        read(table(tmp_path, text))
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_table_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"none\.csv: cannot be read as a table"):
        load(tmp_path / "none.csv")


def test_a_trace_without_places_is_refused(tmp_path):
    trace, one = load(table(tmp_path)), np.ones(1)
    with pytest.raises(UserError, match="a physical radio needs vehicles that are somewhere"):
        trace.deliver(Links(one > 0, one, one, one, one > 0, one > 0), Draws(np.ones((1, 2)), one))
    assert isinstance(trace, Trace)


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ({}, "has no file; add it"),
        ({"file": 7}, "has no file; add it"),
        ({"file": "nowhere.csv"}, "cannot be read as a table"),
        ({"file": "\x1b[31mred.csv"}, r"\x1b[31mred.csv: cannot be read as a table"),
        ({"file": "run.csv", "beyond": "on"}, "known: held, zero"),
        ({"file": "run.csv", "latency_s": -1}, "latency_s = -1; allowed: seconds, 0 or more"),
        ({"file": "run.csv", "latency": 1}, "did you mean 'latency_s'?"),
    ],
)
def test_a_mistake_in_a_profile_is_one_line(tmp_path, parameters, says):
    table(tmp_path)
    with pytest.raises(UserError) as error:
        from_profile(parameters, tmp_path, "mine.toml [parameters]")
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_a_table_that_was_changed_is_read_again_in_the_same_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though its profile was not, and the table has its size and its time."""
    (tmp_path / "channels").mkdir()
    (tmp_path / "swarmdrive.toml").touch()
    monkeypatch.chdir(tmp_path)
    csv = table(tmp_path / "channels")
    facts = "model = 'trace'\ndescription = 'x'\nsource = 'x'\nstatus = 'measured'\n"
    parameters = "[parameters]\nfile = 'run.csv'\nlatency_s = 0.01\n"
    Path("channels/mine.toml").write_text(facts + parameters)
    before, written = CHANNELS.record("mine")["parameters"]["receptions"], csv.stat()
    csv.write_text(PLAIN.replace("0.2", "0.1"))
    os.utime(csv, ns=(written.st_atime_ns, written.st_mtime_ns))
    after = CHANNELS.record("mine")["parameters"]["receptions"]
    assert before["sha256"] != after["sha256"] == sha256_file(csv)


@pytest.mark.parametrize("file", ["../secret.csv", "/etc/passwd", "link.csv"])
def test_a_profile_names_no_file_that_lies_elsewhere(file: str, tmp_path: Path) -> None:
    (tmp_path / "channels").mkdir()
    (tmp_path / "secret.csv").write_text("sk-secret,reception\n1,1\n")
    (tmp_path / "channels/link.csv").symlink_to(tmp_path / "secret.csv")
    with pytest.raises(UserError, match="lies elsewhere; put it beside the profile"):
        from_profile({"file": file, "latency_s": 0.01}, tmp_path / "channels", "profile")


@pytest.mark.parametrize("distance_m", ["inf", "nan", "-5", "far", "", "1e300"])
def test_a_bad_cell_of_somebody_elses_curve_is_named(tmp_path: Path, distance_m: str) -> None:
    path = table(tmp_path, f"distance_m,reception\n10,.9\n{distance_m},0.5\n")
    with pytest.raises(UserError) as refused:
        curves_of(path)
    assert str(refused.value) == (
        f"{path}, line 3: distance_m is {distance_m!r}; it must be metres, 0 to 1000000"
    )


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("10,1.2", "line 2: reception is '1.2'; it must be a share from 0 to 1"),
        ("10", "line 2: has other columns than the first line"),
        ("10,0.9,7", "line 2: has other columns than the first line"),
    ],
)
def test_a_bad_row_of_somebody_elses_curve_is_named(tmp_path: Path, row: str, says: str) -> None:
    with pytest.raises(UserError) as refused:
        curves_of(table(tmp_path, f"distance_m,reception\n{row}\n"))
    assert says in str(refused.value)
    [curve] = curves_of(table(tmp_path, "distance_m,reception,configuration\n10,.9,rate_hz=10\n"))
    assert (curve.configuration, curve.source, curve.reception.tolist()) == (
        "rate_hz=10",
        "run.csv",
        [0.9],
    )
