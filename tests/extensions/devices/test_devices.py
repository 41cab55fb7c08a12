"""Device profiles: what a token takes and costs, played by hand;
who is in time follows from it alone.
"""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from evaluating import Scripted, course, live_spec_of, run, same_decisions, says, spec_of, sure
from hypothesis import given
from hypothesis import strategies as st

from harness.backends.base import Completion, Request
from harness.coordination.coordinate import coordinate
from harness.coordination.intents import Intents
from harness.coordination.named_points import CLOUD, POINTS, named_point
from harness.coordination.operating_point import OperatingPoint
from harness.core.errors import Unanswered, UserError
from harness.core.files import digest
from harness.dataset.load import Dataset
from harness.evaluate import run as evaluation
from harness.extensions.devices import profiles
from harness.extensions.devices.profiles import Constant, Device, DeviceRow, Speed
from harness.extensions.devices.timer import Computer, answer_j, answer_s, transmit_watts
from harness.radio.channel import Draws
from harness.runs import folder
from harness.runs.decisions import COLUMNS
from harness.runs.metrics import METRICS
from harness.runs.timers import added_columns


def known(value: float) -> Constant:
    return Constant(value, "measured", "my desk")


DESK = Device(
    name="desk", description="A desk.", power_mode="all", load_watts=known(50), idle_watts=known(5),
    transmit_dbm=known(30), amplifier_efficiency=known(0.5),
    rows=(
        DeviceRow(
            model="swarm-tiny", billions=0.0005, precision="F16", batch_size=1,
            prefill_tokens_per_s=known(1000), decode_tokens_per_s=known(100),
            joules_per_prompt_token=known(0.01), joules_per_output_token=known(1),
        ),
        DeviceRow(
            model="big", billions=4, precision="F16", batch_size=1,
            prefill_tokens_per_s=known(500), decode_tokens_per_s=known(10),
        ),
        DeviceRow(
            model="half", billions=8, precision="F16", batch_size=1, decode_tokens_per_s=known(10)
        ),
    ),
)  # fmt: skip


# -- one decision by hand --------------------------------------------------------------------------

ALONE = OperatingPoint.of("single-local", None)
CLEAR = OperatingPoint.of("clear", "v2x", loss=0.0, window_s=0.6)  # serial, 25 ms a slot, 10 Mbit/s
AGAIN = CLEAR.changed(name="again", consensus="ego-prompt")


class Counted(Scripted):
    """An ego reads 100 tokens and writes 10, a helper 200 and 5, and a fusion call 300 and 10."""

    def _say(self, request: Request) -> Completion:
        said = super()._say(request)
        counts = (
            (300, 10) if "+" in request.id else (100, 10) if request.role == "ego" else (200, 5)
        )
        return (
            said
            if said.error
            else replace(said, prompt_tokens=counts[0], completion_tokens=counts[1])
        )


@pytest.fixture
def counted(
    small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., folder.Run]:
    """A run of one decision point in which the ego is unsure, with the tokens of `Counted`."""
    one = course(small, 1, {"00001-0": {}}, drives={"00001-0": "SLOWER"})
    lines = {"00001-0/v1": says([0.3, 0.4, 0.3])}
    lines |= {f"00001-0/v{n}": sure("SLOWER", "helper") for n in (2, 3, 4)}

    def made(
        *points: OperatingPoint, more: dict[str, Any] | None = None, **options: Any
    ) -> folder.Run:
        monkeypatch.setattr(
            evaluation, "open_backend", lambda *_, **__: Counted({**lines, **(more or {})})
        )
        options = {"timer": Computer(DESK), "points": points, "seeds": (0,), **options}
        out = tmp_path / digest([point.name for point in points])[:8]
        run(spec_of(one, "swarm-tiny", **options), out)
        return folder.read(out)

    return made


def test_seconds_and_joules_of_one_decision_by_hand(counted: Callable[..., folder.Run]) -> None:
    told = counted(ALONE, CLEAR, AGAIN, CLOUD)
    d = told.decisions
    names = (
        "latency_ms",
        "messages",
        "reply_bits",
        "inference_j",
        "helpers_j",
        "radio_mj",
        "waiting_j",
    )
    of = {name: dict(zip(d.labels("condition"), d[name].tolist(), strict=True)) for name in names}
    # The ego: 100 / 1000 + 10 / 100 s, and 100 x 0.01 + 10 x 1 J. A helper: 0.2 + 0.05 s, 2 + 5 J.
    assert of["latency_ms"]["single-local"] == pytest.approx(200)
    assert of["inference_j"]["single-local"] == pytest.approx(11)
    assert of["messages"]["clear"] == 3
    # The helpers have their answers 50 ms after the ego asks; then three slots, one after the
    # other.
    bits = of["reply_bits"]["clear"]
    exchange_ms = 250 + 3 * 25 + bits / 10e6 * 1000
    assert of["latency_ms"]["clear"] == pytest.approx(exchange_ms, abs=1e-3)
    assert of["inference_j"]["clear"] == pytest.approx(11 + 3 * 7)
    assert of["helpers_j"]["clear"] == pytest.approx(3 * 7)
    # 30 dBm are 1 W, of an amplifier that radiates half of what it draws 2 W.
    assert of["radio_mj"]["clear"] == pytest.approx(2 * (400 + bits) / 10e6 * 1000, abs=1e-6)
    assert of["waiting_j"]["clear"] == pytest.approx(5 * (exchange_ms - 200) / 1000, abs=1e-5)
    # A fusion call: 0.3 + 0.1 s and 3 + 10 J on top, during which the ego does not wait.
    assert of["latency_ms"]["again"] == pytest.approx(exchange_ms + 400, abs=1e-3)
    assert of["inference_j"]["again"] == pytest.approx(11 + 3 * 7 + 13)
    assert of["waiting_j"]["again"] == pytest.approx(of["waiting_j"]["clear"], abs=1e-5)
    # What a cloud's computer takes nobody says; the car's waits for it.
    assert np.isnan(of["inference_j"]["cloud"])
    assert of["waiting_j"]["cloud"] == pytest.approx(5 * 0.51)


def test_helpers_that_infer_before_they_are_asked_cost_energy_unasked(
    counted: Callable[..., folder.Run],
) -> None:
    """All in the radius think from the start; on demand only the one that is asked."""
    one = CLEAR.changed(name="one", max_helpers=1)
    demand, narrow = (
        one.changed(name="demand", on_demand=True),
        CLEAR.changed(name="narrow", radius_m=0.5),
    )
    sure_ego = CLEAR.changed(name="sure", tau_nats=5.0)
    told = counted(ALONE, CLEAR, one, demand, narrow, sure_ego)
    d = told.decisions
    messages, helpers_j = (dict(zip(d.labels("condition"), d[name].tolist(), strict=True))
                           for name in ("messages", "helpers_j"))  # fmt: skip
    assert messages == {
        "single-local": 0,
        "clear": 3,
        "one": 1,
        "demand": 1,
        "narrow": 0,
        "sure": 0,
    }
    assert helpers_j == {
        "single-local": 0,
        "clear": 21,
        "one": 21,
        "demand": 7,
        "narrow": 0,
        "sure": 21,
    }


def test_a_message_takes_a_frame_at_least(counted: Callable[..., folder.Run]) -> None:
    radio = named_point("mode4")
    framed = msgspec.structs.replace(DESK, frame_ms=known(1.5))
    told = counted(CLEAR, radio, timer=Computer(framed))
    d = told.decisions
    mj, airtime_ms = (dict(zip(d.labels("condition"), d[name].tolist(), strict=True))
                      for name in ("radio_mj", "airtime_ms"))  # fmt: skip
    # A request and three replies at 2 W; Mode 4 has slots of its own, and 23 dBm.
    assert mj["clear"] == pytest.approx(4 * 1.5 * 2)
    assert mj["mode4"] == pytest.approx(airtime_ms["mode4"] * 10**-0.7 / 0.5, rel=1e-4)


def test_a_runs_summary_has_the_energy_of_a_decision(counted: Callable[..., folder.Run]) -> None:
    """Asking costs energy because helpers think, not because they transmit."""
    told = counted(ALONE, CLEAR)
    energy = {c: told.score(c, "energy_j") for c in told.conditions}
    radio = told.score("clear", "radio_mj")
    assert energy["single-local"].value == pytest.approx(11)
    assert energy["clear"].value == pytest.approx(32 + radio.value / 1000)
    assert radio.value / 1000 < 0.001 * told.score("clear", "helpers_j").value
    manifest = told.manifest
    assert manifest.latency.source == "device"
    assert manifest.timer == Computer(DESK)
    assert manifest.latency.speeds == (Speed("swarm-tiny", 1000, 100, 0.01, 1),)


def test_a_run_states_its_computer_where_runs_always_did(
    counted: Callable[..., folder.Run],
) -> None:
    """Beside the table of settings and in it, and no table of extensions repeats it."""
    told = counted(ALONE, timer=Computer(DESK, "big"))
    stated = json.loads((told.path / "run.json").read_text())
    at = list(stated).index("latency_source")
    assert list(stated)[at : at + 4] == [
        "latency_source",
        "device_profile",
        "device_model",
        "settings",
    ]
    table = stated["settings"]
    assert (stated["device_profile"]["name"], stated["device_model"]) == ("desk", "big")
    assert (table["device_profile"], table["device_model"]) == ("desk", "big")
    assert "device_profile" not in table["extensions"]
    assert msgspec.json.decode(msgspec.json.encode(told.manifest.as_file())) == stated
    other = {**stated, "settings": {**table, "device_profile": "thor"}}
    (told.path / "run.json").write_text(json.dumps(other))
    with pytest.raises(UserError, match="have device_profile thor, and beside"):
        folder.read(told.path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"device_profile": {"name": "desk"}}, "missing required field"),
        ({"device_profile": {"name": ["desk"]}}, "is broken"),
        ({"latency": {"source": "device", "basis": "", "speeds": [{"model": "big"}]}}, "missing"),
        (
            {"latency": {"source": "sundial", "basis": "", "speeds": [1]}},
            "nothing of the name sund",
        ),
        ({"latency": {"source": "device", "basis": ""}}, "and else speeds"),
        ({"device_model": 3}, "is broken"),
    ],
)
def test_what_a_stranger_states_of_a_computer_is_held_to_its_types(
    change: dict[str, Any], says: str, counted: Callable[..., folder.Run]
) -> None:
    told = counted(ALONE, timer=Computer(DESK, "big"))
    stated = json.loads((told.path / "run.json").read_text()) | change
    for name in {"device_profile", "device_model"} & change.keys():
        value = change[name]
        stated["settings"][name] = value["name"] if isinstance(value, dict) else value
    (told.path / "run.json").write_text(json.dumps(stated))
    with pytest.raises(UserError, match=says) as error:
        folder.read(told.path)
    assert "\n" not in str(error.value)


def test_answers_take_as_long_as_the_profile_says(counted: Callable[..., folder.Run]) -> None:
    """Speeds that a file states otherwise, or of a profile that it does not state, are refused."""
    told = counted(ALONE, timer=Computer(DESK, "big"))
    stated = json.loads((told.path / "run.json").read_text())

    def reads(**change: Any) -> None:
        (told.path / "run.json").write_text(json.dumps({**stated, **change}))
        folder.read(told.path)

    [speed] = stated["latency"]["speeds"]
    for speeds in ([{**speed, "decode_tokens_per_s": 1e5}], [speed, speed]):
        with pytest.raises(UserError, match="other speeds than --device-profile makes"):
            reads(latency={**stated["latency"], "speeds": speeds})
    gone = {**stated["settings"], "device_profile": None, "device_model": None}
    with pytest.raises(UserError, match="nothing states what timed the answers"):
        reads(device_profile=None, device_model=None, settings=gone)


def test_a_profile_that_is_otherwise_than_here_is_named() -> None:
    """Under the name of one that ships a run can state any."""
    here = profiles.load("agx-orin")
    assert Computer(here).changed() is None
    forged = msgspec.structs.replace(here, description="mine")
    assert Computer(forged).changed() == (
        "run.json has device profile agx-orin otherwise than it is here"
    )


def test_without_a_device_profile_nothing_is_said_of_energy(
    counted: Callable[..., folder.Run],
) -> None:
    told = counted(ALONE, CLEAR, timer=None)
    assert told.score("clear", "energy_j") is None
    assert not {"inference_j", "radio_mj", "busy_ratio"} & set(
        told.path.joinpath("summary.csv").read_text()
    )
    assert np.isnan(told.decisions["inference_j"]).all()


def test_another_models_speed_is_said_plainly(counted: Callable[..., folder.Run]) -> None:
    """100 / 500 + 10 / 10 s; joules from 50 W over the rates: 100 x 0.1 + 10 x 5."""
    told = counted(ALONE, timer=Computer(DESK, "big"))
    assert told.manifest.latency.basis.startswith(
        "swarm-tiny's answers at the speed of big on desk (F16"
    )
    assert told.decisions["latency_ms"].tolist() == [1200]
    assert told.decisions["inference_j"].tolist() == [60]


def test_an_engines_error_is_no_answer_to_be_timed(counted: Callable[..., folder.Run]) -> None:
    broken = Completion("00001-0/v1", "", None, None, "error", None, 1, "it broke")
    with pytest.raises(Unanswered, match="it broke"):
        counted(ALONE, more={"00001-0/v1": broken})


class Undercounted(Scripted):
    """It states fewer tokens of its prompts than these can have."""

    def _say(self, request: Request) -> Completion:
        return replace(super()._say(request), prompt_tokens=0, completion_tokens=10)


@pytest.mark.parametrize("engine", [Scripted, Undercounted])
def test_tokens_that_nobody_counted_are_refused(
    engine: type[Scripted], small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "open_backend", lambda *_, **__: engine({}))
    with pytest.raises(
        UserError, match=r"/v1 has no token counts, so no device profile can time it; use"
    ):
        run(spec_of(small, "swarm-tiny", timer=Computer(DESK), points=(ALONE,)), tmp_path / "run")


def test_a_repair_turn_counts_with_its_tokens(counted: Callable[..., folder.Run]) -> None:
    """An answer of two turns has the tokens of both."""
    told = counted(ALONE)
    speed, [answer, *_] = told.manifest.latency.speeds[0], told.answers
    twice = msgspec.structs.replace(answer, prompt_tokens=250, completion_tokens=20)
    assert answer_s(speed, twice) == pytest.approx(0.25 + 0.2)
    assert answer_j(speed, twice) == pytest.approx(2.5 + 20)


def test_a_radio_sends_with_the_channels_power_where_it_has_one() -> None:
    assert transmit_watts(DESK, named_point("6g")) == pytest.approx(2.0)
    for radio in (
        "mode4:power_dbm=20",
        "mode4:power_dbm=20,loss=0.1",
        "mode4:power_dbm=20,edge=relay",
    ):
        assert transmit_watts(DESK, named_point(radio)) == pytest.approx(0.1 / 0.5)
    silent = msgspec.structs.replace(DESK, amplifier_efficiency=None)
    assert np.isnan(transmit_watts(silent, named_point("6g")))


def test_energy_that_is_not_known_is_refused_before_anything_is_asked(small: Dataset) -> None:
    shuffled = AGAIN.changed(messages="shuffled")
    with pytest.raises(UserError, match="condition again: energy is known of messages of the ego"):
        spec_of(small, "swarm-tiny", timer=Computer(DESK), points=(shuffled,))


def test_columns_and_metrics_of_energy_stand_behind_what_is_there() -> None:
    assert {*added_columns()} == {"inference_j", "helpers_j", "radio_mj", "waiting_j"}
    assert {*added_columns().values()} <= {*COLUMNS}
    names = list(METRICS.of_harness)
    at = names.index("busy_ratio")
    assert names[at + 1 : at + 5] == ["energy_j", "helpers_j", "radio_mj", "waiting_j"]


# -- what must always hold -------------------------------------------------------------------------

RATES = st.floats(1, 1e5)
COUNTS = st.integers(0, 4000)


@given(RATES, RATES, RATES, RATES, COUNTS, COUNTS, st.integers(0, 500), st.integers(0, 500))
def test_more_tokens_are_never_cheaper_or_sooner(
    prefill: float, decode: float, prompt_j: float, output_j: float, read: int, written: int, more: int,
    longer: int,
) -> None:  # fmt: skip
    speed = Speed("m", prefill, decode, prompt_j, output_j)
    for of in (profiles.seconds, profiles.joules):
        assert of(speed, read + more, written + longer) >= of(speed, read, written) >= 0


@given(
    st.sampled_from(["v2x", "6g"]),
    st.lists(st.floats(0.01, 0.5), min_size=4, max_size=4),
    st.lists(st.floats(0.1, 1.0), min_size=4, max_size=4),
    st.booleans(),
)
def test_a_faster_device_never_decides_later(
    profile: str, seconds: list[float], shares: list[float], on_demand: bool
) -> None:
    """Whoever of the vehicles is faster, and whoever comes first on the medium then."""
    point = OperatingPoint.of("p", profile, loss=0.0, on_demand=on_demand)
    unsure = np.full(3, 1 / 3)

    def latency_s(inference_s: Any) -> float:
        intents = Intents(
            unsure, np.tile(unsure, (3, 1)), np.ones(3, dtype=bool), np.full(4, 10.0), np.full(3, 20.0),
            np.array([1000.0, 2000.0, 1500.0]), inference_s,
        )  # fmt: skip
        return float(
            coordinate(point, intents, Draws(np.full((3, 2), 0.5), np.full(3, 0.5))).latency_s
        )

    slow = np.array(seconds)
    assert latency_s(slow * np.array(shares)) <= latency_s(slow) + 1e-12


@pytest.mark.exhaustive
def test_batches_change_no_row(small: Dataset, tmp_path: Path) -> None:
    """Who is in time follows from tokens, not from how fast this machine is at the moment."""
    spec = spec_of(
        small,
        "swarm-tiny",
        limit=2,
        timer=Computer(profiles.load("agx-orin"), "qwen3-4b"),
    )
    for batch_size in (1, 8):
        run(spec.changed(batch_size=batch_size), tmp_path / str(batch_size))
    one, other = (tmp_path / str(batch_size) for batch_size in (1, 8))
    assert same_decisions(one, other)
    assert (one / "summary.csv").read_bytes() == (other / "summary.csv").read_bytes()
    assert not np.isnan(folder.read(one).decisions["inference_j"]).any()


@pytest.mark.slow
def test_a_read_out_writes_one_token(small: Dataset, tmp_path: Path) -> None:
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    orin, alone = Computer(profiles.load("agx-orin"), "qwen3-4b"), (ALONE,)
    spec = spec_of(
        small, "swarm-tiny", answer="readout", limit=1, timer=orin,
        points=alone,
    )  # fmt: skip
    run(spec, tmp_path / "run")
    told = folder.read(tmp_path / "run")
    assert {answer.completion_tokens for answer in told.answers} == {1}
    assert not told.decisions["deadline_missed"].any()


class Wordy(Scripted):
    """Says how many tokens it read and wrote, by the question."""

    def _say(self, request: Request) -> Completion:
        done = super()._say(request)
        return replace(
            done, prompt_tokens=100 + len(request.id), completion_tokens=9 + ord(request.id[-1])
        )


@pytest.mark.exhaustive
def test_workers_count_a_models_tokens_as_one_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker is forked with the model that answers here."""
    monkeypatch.setattr(evaluation, "opened", lambda *_, **__: Wordy({}))
    monkeypatch.setattr(evaluation, "EPISODES_AT_ONCE", 1)
    spec = live_spec_of(
        "swarm-tiny", points=(POINTS["6g"],), seeds=(0,), batch_size=4,
        timer=Computer(profiles.load("agx-orin"), "qwen3-0.6b"),
    )  # fmt: skip
    one, other = (tmp_path / workers for workers in "12")
    for out in (one, other):
        evaluation.evaluate(spec, out, lambda done: None, workers=int(out.name))
    for name in ("decisions.parquet", "episodes.csv", "summary.csv"):
        assert (one / name).read_bytes() == (other / name).read_bytes()
    told = folder.read(one)
    assert not np.isnan(told.decisions["inference_j"]).any()


@pytest.mark.exhaustive
def test_workers_change_no_row(tmp_path: Path) -> None:
    """Each in a process of its own, as a user types it:
    a fork has none of an open engine's threads.
    """
    here = (
        "from harness import cli; from harness.evaluate import run; run.EPISODES_AT_ONCE = 1; "
        "cli.main()"
    )
    drive = (
        "drive",
        "--model",
        "swarm-tiny",
        "--episodes",
        "3",
        "--seeds",
        "0",
        "--condition",
        "6g",
    )
    on = ("--device-profile", "agx-orin", "--device-model", "qwen3-0.6b", "--quiet")
    for workers in "12":
        typed = (sys.executable, "-c", here, *drive, *on, "--workers", workers, "--out", workers)
        subprocess.run(typed, cwd=tmp_path, check=True)
    for name in ("decisions.parquet", "episodes.csv", "summary.csv"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


# -- files -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", profiles.names())
def test_every_profile_that_ships_says_what_each_number_is(name: str) -> None:
    device = profiles.load(name)
    for row in device.rows:
        each = dict(profiles.constants(device, row))
        if row.memory_gb and device.memory_gb:
            assert row.memory_gb.value < device.memory_gb.value
        if row.answer_ms:
            assert "Liquid AI" in row.answer_ms.source
            continue
        assert each["decode_tokens_per_s"] is not None
        assert all(c is None or c.source not in ("edge-llm", "silybench") for c in each.values())
        # Writing a token moves all weights, reading many at once does so once for all of them.
        if each["prefill_tokens_per_s"]:
            assert each["prefill_tokens_per_s"].value > each["decode_tokens_per_s"].value
    rated = [row for row in device.rows if not row.answer_ms]
    for smaller, larger in pairwise(rated):
        if smaller.billions < larger.billions and smaller.prefill_tokens_per_s:
            assert smaller.decode_tokens_per_s.value >= larger.decode_tokens_per_s.value


def test_what_nobody_states_is_not_known() -> None:
    thor = profiles.load("thor")
    speed = profiles.speed(thor, profiles.find_row(thor, "qwen3-4b"))
    assert profiles.seconds(speed, 300, 1) == pytest.approx(300 / 33029.8 + 1 / 73.4)
    assert np.isnan(profiles.joules(speed, 300, 1))
    h200 = profiles.load("h200")
    assert np.isnan(profiles.seconds(profiles.speed(h200, h200.rows[0]), 300, 1))


def test_a_decision_takes_what_its_maker_states_whatever_its_tokens(
    small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nano = profiles.load("orin-nano")
    speed = profiles.speed(nano, profiles.find_row(nano, "d1-3b"))
    assert profiles.seconds(speed, 300, 0) == profiles.seconds(speed, 3000, 40) == 0.05
    scaled = profiles.find_row(nano, "3b")
    assert "d1-3b" not in scaled.model
    assert scaled.memory_gb is not None
    assert scaled.memory_gb.value == pytest.approx(3 * 4.25 / 8, rel=0.01)
    # which counts no tokens
    monkeypatch.setattr(evaluation, "open_backend", lambda *_, **__: Scripted({}))
    out = tmp_path / "run"
    run(
        spec_of(small, "swarm-tiny", timer=Computer(nano, "d1-3b"), points=(ALONE,)),
        out,
    )
    told = folder.read(out)
    assert set(told.decisions["latency_ms"].tolist()) == {50.0}
    assert np.isnan(told.decisions["inference_j"]).all(), "nobody states its joules"


def test_a_row_has_an_answers_time_or_rates(project: Path) -> None:
    stated = 'batch_size = 1\nanswer_ms = { value = 5, status = "cited", source = "me" }'
    (project / "mine.toml").write_text(MINE.replace("batch_size = 1", stated))
    with pytest.raises(UserError, match="row of swarm-tiny: give answer_ms or rates, not both"):
        profiles.load("mine")


def test_a_size_is_scaled_from_the_nearest_row_where_the_profile_says_how() -> None:
    agx = profiles.load("agx-orin")
    row, near = profiles.find_row(agx, "5b"), profiles.find_row(agx, "qwen3-vl-4b")
    assert row.model == "5b from qwen3-vl-4b"
    assert row.decode_tokens_per_s.value == pytest.approx(near.decode_tokens_per_s.value * 4.4 / 5)
    assert row.decode_tokens_per_s.status == "modelled"
    with pytest.raises(
        UserError, match="unknown model of device profile desk '5b'; known: big, half, swarm"
    ):
        profiles.find_row(DESK, "5b")


MINE = """
description = "Mine."
power_mode = "15 W"
[sources]
me = "my desk, today"
[[rows]]
model = "swarm-tiny"
billions = 0.0005
precision = "F16"
batch_size = 1
prefill_tokens_per_s = { value = 4000, status = "measured", source = "me" }
decode_tokens_per_s = { value = 400, status = "measured", source = "me" }
"""


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "devices").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path / "devices"


def test_a_projects_profile_lies_beside_those_that_ship(project: Path) -> None:
    (project / "mine.toml").write_text(MINE)
    device = profiles.load("mine")
    assert {"mine", "agx-orin"} <= set(profiles.names())
    assert device.rows[0].decode_tokens_per_s == Constant(400, "measured", "my desk, today")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("value = 4000", "value = 0"), "value = 0; allowed: a number from 1e-09 to 1e+09"),
        (('status = "measured"', 'status = "felt"'), "unknown status in"),
        (("billions", "bilions"), "did you mean 'billions'?"),
        (('source = "me" }\ndecode', 'source = "" }\ndecode'), 
            "allowed: where the "
            "number comes from"),
        (('me = "my desk, today"', "me = 3"), "[sources]: give each source a name and a text"),
        (('model = "swarm-tiny"', 'model = 3'), "model = 3; allowed: a text"),
        (('model = "swarm-tiny"', 'model = "a\\u001b[2J"'),
            "model `a\\x1b[2J` has characters that nothing can show; rename it"),
        (('model = "swarm-tiny"', f'model = "{"a" * 101}"'), "; give 1 to 100 characters"),
        (('model = "swarm-tiny"', 'model = "a · b"'), "which stands between names; rename it"),
        (("batch_size = 1", "batch_size = 0"), "batch_size = 0; allowed: 1 or more"),
        (
            ("[[rows]]",
             '[amplifier_efficiency]\nvalue = 2\nstatus = "cited"\nsource = "me"\n[[rows]]'),
            "mine.toml: amplifier_efficiency is 2; give 1 at most",
        ),
    ],
)  # fmt: skip
def test_a_mistake_in_a_file_is_one_line(change: tuple[str, str], says: str, project: Path) -> None:
    (project / "mine.toml").write_text(MINE.replace(*change, 1))
    with pytest.raises(UserError) as error:
        profiles.load("mine")
    assert says in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--device-profile", "agx-ori"), 
            "unknown device profile 'agx-ori'; "
            "did you mean 'agx-orin'?"),
        (("--device-profile", "agx-orin"), 
            "unknown model of device profile "
            "agx-orin 'swarm-tiny'; known: d"),
        (("--device-profile", "agx-orin", "--device-model", "\x1b[2J"), 
            "unknown model of device profile"),
        *(
            (("--device-profile", "agx-orin", "--device-model", size), "unknown model of device profile")
            for size in ("0" * 400 + "3b", "9999999b", "٣b", "3b\\n", "x" * 10_000)
        ),
        (("--device-model", "qwen3-4b"), 
            "--device-model qwen3-4b is a "
            "device's row; give --device-pro"),
        (("--device-profile", "h200", "--device-model", "llama-3.1-8b"), 
            "states no prefill_tokens_per_s of"),
        (("--device-profile", "agx-orin", "--device-model", "qwen3-4b", "--latency", "paper"),
         "--device-profile agx-orin says how long answers take, as --latency paper does; give "
         "one of"),
        (("--device-profile", "agx-orin", "--device-model", "qwen3-4b", "--model", "proxy"),
         "--device-profile agx-orin: proxy is no language model and counts no tokens; leave it "
         "out"),
    ],
)  # fmt: skip
def test_what_cannot_be_timed_is_one_line(
    options: tuple[str, ...], says: str, harness: Callable[..., Any]
) -> None:
    code, out, err = harness("eval", "--limit", "1", "--model", "swarm-tiny", *options)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert says in err
    assert "\x1b" not in err
