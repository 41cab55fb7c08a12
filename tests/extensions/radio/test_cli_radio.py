"""`harness radio` as typed, and physical radios from the command line to the page."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from evaluating import run as evaluate
from evaluating import spec_of

from harness.cli.terminal import attributes
from harness.coordination.named_points import named_point
from harness.dataset.load import Dataset
from harness.extensions.radio.its_g5 import ItsG5
from harness.radio.channel import Physical
from harness.radio.profiles import CHANNELS

Said = tuple[int, str, str]
PHYSICAL = [name for name in ("mode4", "mode2", "its-g5") if isinstance(CHANNELS[name], Physical)]


def test_list_says_what_each_radio_rests_on(harness: Callable[..., Said]) -> None:
    code, out, _ = harness("radio", "list")
    assert code == 0
    assert "v2x · constant · assumed" in out
    assert "mode4 · lte-v2x-mode4 · modelled" in out
    assert max(map(len, out.splitlines())) <= 80
    listed = json.loads(harness("radio", "list", "--json")[1])
    assert {"6g", "v2x", "density-coupled", *PHYSICAL} <= {profile["name"] for profile in listed}
    assert all(profile["source"] for profile in listed)


@pytest.mark.slow
def test_a_wrong_file_stands_in_the_list_and_keeps_no_other_from_its_command(
    harness: Callable[..., Said], tmp_path: Path
) -> None:
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "channels").mkdir()
    (tmp_path / "channels/bad.toml").write_text("model = [\n")
    lines = harness("radio", "list")[1].splitlines()
    assert "channels/bad.toml" in lines[lines.index("bad · wrong") + 1]
    rows = {row["name"]: row for row in json.loads(harness("radio", "list", "--json")[1])}
    assert "channels/bad.toml" in rows["bad"]["error"]
    assert "error" not in rows["mode4"]
    code, _, err = harness("radio", "show", "bad")
    assert (code, err.count("\n")) == (2, 1)
    assert "channels/bad.toml" in err
    assert harness("radio", "crowd")[0] == 0


@pytest.mark.parametrize("name", PHYSICAL)
def test_show_has_settings_sources_and_the_reach(harness: Callable[..., Said], name: str) -> None:
    code, out, err = harness("radio", "show", name)
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 80
    assert "source: " in out
    assert "density_per_km = 100\n" in out
    told = json.loads(harness("radio", "show", f"{name}:density_per_km=0", "--json")[1])
    assert told["busy_ratio"] == 0
    reach = told["reception"]
    for sight in ("clear", "vehicle", "building"):
        assert np.all(np.diff(reach[sight]) <= 1e-12), "the farther the less"
    for clear, vehicle, building in zip(
        *(reach[s] for s in ("clear", "vehicle", "building")), strict=True
    ):
        assert clear >= vehicle - 1e-6
        assert vehicle >= building - 1e-6


def test_show_has_both_percentiles_of_a_tables_latency(
    harness: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "channels").mkdir()
    parts = {
        "spread": "latency_p50_ms,latency_p95_ms\n0,1,10,20\n100,1,30,90\n",
        "mean": "latency_ms\n0,1,5\n",
    }
    for name, rows in parts.items():
        (tmp_path / f"channels/{name}.csv").write_text(f"distance_m,reception,{rows}")
        (tmp_path / f"channels/{name}.toml").write_text(
            'model = "trace"\ndescription = "x"\nsource = "x"\nstatus = "assumed"\n'
            f'[parameters]\nfile = "{name}.csv"\n'
        )
    lines = [line.split("  ") for line in harness("radio", "show", "spread")[1].splitlines()]
    rows_of = {
        line[0]: [cell.strip() for cell in line[1:] if cell] for line in lines if len(line) > 3
    }
    assert rows_of["latency p50 / p95, ms"][0] == "in sight"
    assert rows_of["50 m"] == ["20.0 / 55.0"] * 3
    told = json.loads(harness("radio", "show", "spread", "--json")[1])["latency_ms"]
    assert told["clear"]["p50"][:4] == pytest.approx([12, 14, 20, 30])
    assert told["building"]["p95"][-1] == pytest.approx(90), "beyond the last row its latency holds"
    assert "latency p50" not in harness("radio", "show", "mean")[1]
    assert json.loads(harness("radio", "show", "mean", "--json")[1])["latency_ms"] is None


@pytest.mark.slow
def test_show_says_where_settings_leave_what_the_source_tried(harness: Callable[..., Said]) -> None:
    said = "density_per_km = 1000 is outside what its model was held against, 100 to 300."
    assert said in " ".join(harness("radio", "show", "mode4:density_per_km=1000")[1].split())
    assert "outside" not in harness("radio", "show", "mode4")[1]


@pytest.mark.slow
def test_check_draws_messages_on_the_curve_and_holds_it_against_others(
    harness: Callable[..., Said],
) -> None:
    rows = '10,0.97,"power_dbm=20,rate_hz=20",they\n100,0.5,"power_dbm=20,rate_hz=20",they\n10,0.9,,they\n'
    Path("theirs.csv").write_text(f"distance_m,reception,configuration,source\n{rows}")
    code, out, err = harness(
        "radio", "check", "mode4", "-n", "400", "--against", "theirs.csv", "--out", "m.svg"
    )
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 80
    assert "power_dbm=20,rate_hz=20       2" in out
    assert "2 curves, " in out
    assert "wrote m.svg" in out
    assert "others' curves, %" in Path("m.svg").read_text()
    told = json.loads(harness("radio", "check", "mode4", "-n", "2000", "--json")[1])
    for point in told["messages"]:
        assert point["crossing"]["low"] - 0.02 <= point["model"] <= point["crossing"]["high"] + 0.02
        assert point["round_trip"]["value"] <= point["crossing"]["value"]


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", PHYSICAL)
def test_check_says_how_long_a_receiver_waits_for_the_next_packet(
    harness: Callable[..., Said], name: str
) -> None:
    """The mean wait is about 1 / (rate x reception);
    less where little arrives, as shadowing has spells.
    """
    told = json.loads(harness("radio", "check", name, "-n", "2000", "--json")[1])
    assert 0.05 < told["busy_ratio"] < 0.5
    for wait in told["waits"]:
        mean, p95, alone = wait["mean_s"]["value"], wait["p95_s"]["value"], wait["independent_s"]
        if mean is None:
            assert alone is None or alone > 2.0, "a tenth of a trip"
            continue
        assert mean < 1.08 * alone
        assert mean > 0.92 * alone or alone > 0.2
        assert p95 >= 0.1


@pytest.mark.slow
def test_who_sends_often_is_heard_sooner(harness: Callable[..., Said]) -> None:
    often = json.loads(harness("radio", "check", "mode4:rate_hz=50", "-n", "500", "--json")[1])[
        "waits"
    ][0]
    assert 0.02 < often["mean_s"]["value"] < 0.05


def test_a_curve_of_mode_2_has_settings_of_its_own(harness: Callable[..., Said]) -> None:
    settings = {
        "numerology": "2", "mcs": "7", "subchannel_blocks": "10", "packet_bytes": "190",
        "density_per_km": "200", "rate_hz": "20", "power_dbm": "20", "t2_slots": "20", "transmissions": "2",
    }  # fmt: skip
    configuration = ",".join(f"{key}={value}" for key, value in settings.items())
    Path("nr.csv").write_text(
        f'distance_m,reception,configuration\n50,.9,"{configuration}"\n50,0.9,\n'
    )
    code, out, err = harness(
        "radio", "check", "mode2", "-n", "200", "--against", "nr.csv", "--json"
    )
    assert (code, err) == (0, "")
    own, usual = (curve["mean_difference"] for curve in json.loads(out)["curves"])
    there = json.loads(harness("radio", "show", f"mode2:{configuration}", "--json")[1])
    assert own == pytest.approx(abs(there["reception"]["clear"][2] - 0.9), abs=0.1)
    assert own != usual


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("show", "mode5"), "unknown operating point 'mode5'; did you mean"),
        (("show", "mode4:density=3"), "did you mean one of density_coupled, density_per_km?"),
        (
            ("show", "mode4:density_per_km=-1"),
            "density_per_km = -1.0; allowed: a number from 0 to 10000",
        ),
        (("show", "single-local"), "has no channel; `harness radio list` shows"),
        (("check", "6g"), "loses the same at every distance"),
        (("check", "mode4", "--out", "x.gif"), "known: .pdf, .png, .svg"),
        (
            ("check", "mode4", "--against", "bad.csv"),
            "bad.csv, line 3: reception is '1.9'; it must be a share from 0 to 1",
        ),
        (("check", "mode4", "--against", "other.csv"), "did you mean 'rate_hz'"),
        (
            ("check", "mode4", "--against", "theirs.csv"),
            "has no column distance_m or reception; its first line names Distance (m), PRR, and "
            "may name",
        ),
        (("check", "mode4", "--against", "named.csv"), "did you mean 'configuration'?"),
        (
            ("check", "mode4", "--against", "trace.xml"),
            "its first line names <fcd-export>, and may name",
        ),
        (("check", "mode4", "--against", "no.csv"), "no.csv: cannot be read as a table"),
    ],
)
def test_a_mistake_is_one_line(
    harness: Callable[..., Said], arguments: tuple[str, ...], says: str
) -> None:
    Path("bad.csv").write_text("distance_m,reception\n10,0.9\n20,1.9\n")
    Path("other.csv").write_text("distance_m,reception,configuration\n10,0.9,rat_hz=10\n")
    Path("theirs.csv").write_text("Distance (m),PRR\n20,1.0\n")
    Path("named.csv").write_text("distance_m,reception,configuratoin\n20,1.0,\n")
    Path("trace.xml").write_text("<fcd-export>\n<timestep/>\n</fcd-export>\n")
    code, out, err = harness("radio", *arguments)
    assert (code, out) == (2, "")
    assert says in err
    assert err.count("\n") == 1


@pytest.fixture(scope="module")
def done(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    points = tuple(map(named_point, ("single-local", "6g", "mode4:density_per_km=1000", "its-g5")))
    return evaluate(spec_of(small, points=points), tmp_path_factory.mktemp("radios") / "run").out


@pytest.mark.exhaustive
def test_a_sweep_over_a_radios_setting_gives_what_a_run_at_it_gives(
    harness: Callable[..., Said], done: Path
) -> None:
    over = (
        "--over",
        "density_per_km",
        "--grid",
        "100,1000",
        "--condition",
        "mode4",
        "--out",
        "swept",
    )
    assert harness("study", "sweep", done, *over, "--quiet") == (0, "", "")
    swept = pd.read_csv("swept/conditions.csv")
    run = pd.read_csv(done / "summary.csv")
    of_run = run[
        (run.condition == "mode4:density_per_km=1000") & (run.metric == "success_rate")
    ].value
    at = swept[
        (swept.value_of_variable == 1000) if "value_of_variable" in swept else swept.value == 1000
    ]
    assert at[at.metric == "success_rate"]["mean"].tolist() == pytest.approx(of_run.tolist())


@pytest.mark.slow
def test_a_run_warns_of_a_radio_that_its_source_never_tried(
    harness: Callable[..., Said], done: Path
) -> None:
    said = (
        "mode4:density_per_km=1000: density_per_km = 1000 is outside what its model was held "
        "against"
    )
    assert harness("report", done, "--out", "page.html")[0] == 0
    assert said in Path("page.html").read_text()


@pytest.mark.exhaustive
def test_a_sweep_refuses_a_run_whose_radio_has_changed_since(
    harness: Callable[..., Said], small: Dataset, tmp_path: Path
) -> None:
    Path("swarmdrive.toml").touch()
    Path("channels").mkdir()
    mine = Path("channels/mine.toml")
    text = (
        'model = "its-g5"\ndescription = "x"\nsource = "x"\nstatus = "assumed"\n'
        "[parameters]\ndensity_per_km = 50\n"
    )
    mine.write_text(text)
    run = evaluate(spec_of(small, points=(named_point("mine"),)), tmp_path / "run").out
    assert (
        harness("study", "sweep", run, "--over", "rate_hz", "--grid", "10", "--condition", "mine")[
            0
        ]
        == 0
    )
    mine.write_text(text.replace("50", "60"))
    code, _, err = harness(
        "study", "sweep", run, "--over", "rate_hz", "--grid", "10", "--condition", "mine"
    )
    assert code == 2
    assert "channel profile mine has changed since; restore it or run again" in err


@pytest.mark.slow
def test_a_run_keeps_the_table_that_a_profile_names(
    small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("swarmdrive.toml").touch()
    Path("channels").mkdir()
    for name in ("near", "far"):
        Path(f"channels/{name}.csv").write_text("distance_m,reception\n0,1\n400,0\n")
        Path(f"channels/{name}.toml").write_text(
            'model = "trace"\ndescription = "x"\nsource = "x"\nstatus = "assumed"\n'
            f'[parameters]\nfile = "{name}.csv"\n'
        )
    points = (named_point("near"), named_point("far"))
    run = evaluate(spec_of(small, points=points, seeds=(0,)), tmp_path / "run").out
    kept = {file.name: file.read_text() for file in (run / "sources/channels").iterdir()}
    assert kept == {file.name: file.read_text() for file in Path("channels").iterdir()}


@pytest.mark.exhaustive
def test_no_messages_is_a_control_of_a_physical_radio_too(
    harness: Callable[..., Said], done: Path
) -> None:
    code, out, _ = harness(
        "study", "sweep", done, "--over", "loss", "--grid", "1", "--condition", "its-g5", "--json"
    )
    assert code == 0
    run = pd.read_csv(done / "summary.csv")
    alone = run[(run.condition == "single-local") & (run.metric == "success_rate")].value
    row = next(row for row in json.loads(out) if row["metric"] == "success_rate")
    assert row["mean"] == pytest.approx(alone.iloc[0])


@dataclass(frozen=True)
class OfAPackage(ItsG5):
    """A radio that is described as packages did before 0.3.

    Attributes:
        header_bytes: none, since
            nothing lies below.
    """

    header_bytes: int = 0
    curve: str = "11p-goubet"


def test_what_a_field_means_is_said_beside_it_above_it_or_in_the_docstring():
    shipped, package = attributes(ItsG5), attributes(OfAPackage)
    assert shipped["packet_bytes"] == "size of a background packet."
    assert (
        shipped["header_bytes"] == "bytes that the layers below add to a packet and to a message."
    )
    assert package["header_bytes"] == "none, since nothing lies below."
    assert package["curve"] == shipped["curve"]
    assert "rate_hz" in shipped
