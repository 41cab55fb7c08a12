"""`harness model device`: what fits the window by declared or real tokens;
a profile beside times.
"""

import json
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from evaluating import course, run, spec_of
from msgspec.structs import replace
from run_on_disk import Row, made_up

from harness.coordination.named_points import POINTS
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.extensions.devices import profiles
from harness.extensions.devices.fit import answers_of, declared, fits, held
from harness.runs import folder
from harness.runs.answer_times import times

Said = tuple[int, str, str]


@pytest.fixture(scope="module")
def alone(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the model that ships, each answer asked alone."""
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    out = tmp_path_factory.mktemp("runs") / "alone"
    points = (POINTS["6g"],)
    few = course(small, steps=1).of_episodes([0, 1])
    run(spec_of(few, "swarm-tiny", points=points, seeds=(0,), batch_size=1), out)
    return out


def test_written_json_does_not_fit_200_ms_on_an_orin_and_a_read_out_does(
    harness: Callable[..., Said],
) -> None:
    """300 / 2687.9 + 40 / 50.7 s; joules at 60 W, which is an upper bound."""
    code, out, _ = harness(
        "model", "device", "show", "agx-orin", "--device-model", "qwen3-4b", "--json"
    )
    readout, written = json.loads(out)["fits"]
    assert code == 0
    seconds = 300 / 2687.9 + np.array([1, 40]) / 50.7
    assert [readout["ms"], written["ms"]] == pytest.approx(1000 * seconds)
    assert [readout["joules"]["value"], written["joules"]["value"]] == pytest.approx(60 * seconds)
    assert [readout["in_time"]["value"], written["in_time"]["value"]] == [1, 0]
    options = ("--device-model", "qwen3-4b", "--answer-tokens", "4")
    code, out, _ = harness("model", "device", "show", "agx-orin", *options)
    assert "qwen3-4b written 300 + 4 191 yes 11.43" in " ".join(out.split())
    assert "J: modelled (60 W over the rate: the module's cap by its data sheet: an upper" in out


def test_what_is_not_known_is_said(harness: Callable[..., Said]) -> None:
    code, out, _ = harness("model", "device", "show", "h200")
    assert code == 0
    assert "llama-3.1-8b  readout   300 + 1  unknown    unknown  unknown" in out
    assert "J: unknown, since nobody states them" in out
    _, out, _ = harness("model", "device", "show", "h200", "--json")
    assert json.loads(out)["fits"][0]["ms"] is None


@pytest.mark.slow
def test_a_runs_own_tokens(alone: Path, harness: Callable[..., Said]) -> None:
    told, device = folder.read(alone), profiles.load("agx-orin")
    row = profiles.find_row(device, "qwen3-0.6b")
    as_read_out, as_written = fits(device, [row], answers_of(told), 0.2)
    egos = [a for a in told.answers if a.role == "ego"]
    took = [a.prompt_tokens / 17277.3 + a.completion_tokens / 162.5 for a in egos]
    assert as_written.answer == "json"
    assert as_written.seconds == pytest.approx(np.median(took))
    assert as_written.in_time.value == np.mean(np.array(took) <= 0.2)
    assert (as_read_out.output_tokens, as_read_out.in_time.value) == (1, 1)
    code, out, _ = harness("model", "device", "show", "agx-orin", "--run", alone)
    assert code == 0
    assert f"n = {len(egos)} answers of swarm-tiny for the ego" in " ".join(out.split())


@pytest.mark.slow
def test_a_profile_is_held_against_a_run(alone: Path, harness: Callable[..., Said]) -> None:
    told = folder.read(alone)
    egos = [a for a in told.answers if a.role == "ego"]
    device = profiles.load("laptop-cpu")
    found = {(each.role, each.what): each for each in held(device, device.rows[0], told)}
    answer = found["ego", "seconds"]
    assert answer.measured.value == pytest.approx(np.median([a.seconds for a in egos]))
    assert answer.measured.n == len(egos)
    assert answer.measured.low <= answer.measured.value <= answer.measured.high
    assert answer.stated == pytest.approx(
        np.median([a.prompt_tokens / 45000 + a.completion_tokens / 3830 for a in egos])
    )
    prefill = found["helper", "prefill_tokens_per_s"]
    asked = [a for a in told.answers if a.role == "helper"]
    assert prefill.measured.value == pytest.approx(
        np.median([a.prompt_tokens / a.first_token_s for a in asked])
    )
    assert prefill.stated == 45000
    code, out, _ = harness("model", "device", "check", "laptop-cpu", alone)
    assert code == 0
    assert "laptop-cpu says" in out
    code, out, _ = harness(
        "model", "device", "check", "agx-orin", alone, "--device-model", "qwen3-4b", "--json"
    )
    assert [
        each["stated"] for each in json.loads(out) if each["what"] == "decode_tokens_per_s"
    ] == [50.7] * 2


def test_every_profile_is_listed(harness: Callable[..., Said]) -> None:
    code, out, _ = harness("model", "device", "list")
    assert code == 0
    assert [line.split(" ·")[0] for line in out.splitlines()[::2]] == profiles.names()
    _, out, _ = harness("model", "device", "list", "--json")
    assert [each["name"] for each in json.loads(out)] == profiles.names()


def test_a_run_without_times_or_tokens_is_refused(small: Dataset, tmp_path: Path) -> None:
    run(spec_of(small, "proxy", points=(POINTS["single-local"],)), tmp_path / "proxy")
    told = folder.read(tmp_path / "proxy")
    device = profiles.load("laptop-cpu")
    with pytest.raises(UserError, match="has no token counts"):
        answers_of(told)
    with pytest.raises(
        UserError, match="no answer that was asked alone and timed; run it with --batch-size"
    ):
        held(device, device.rows[0], told)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("show", "desk"), "unknown device profile 'desk'; known: agx-orin, "),
        (
            ("show", "thor", "--window-ms", "0"),
            "--window-ms 0 is out of range; give more than 0, to 60000",
        ),
        (
            ("show", "thor", "--window-ms", "nan"),
            "--window-ms nan is out of range; give more than 0",
        ),
        (
            ("show", "thor", "--prompt-tokens", "0"),
            "--prompt-tokens 0 is out of range; give 1 to 1000000",
        ),
        (("show", "thor", "--device-model", "3b"), "unknown model of device profile thor '3b'"),
        (
            ("show", "agx-orin", "--device-model", "0b"),
            "or a size such as 3b, which the nearest one is scaled",
        ),
        (("show", "thor", "--run", "nowhere"), "nowhere"),
        (("check", "thor", "nowhere"), "nowhere"),
    ],
)
def test_mistakes_are_one_line(
    options: tuple[str, ...], says: str, harness: Callable[..., Said]
) -> None:
    code, out, err = harness("model", "device", *options)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert says in err


def test_the_law_of_weights_is_off_by_less_than_a_factor_of_1_6() -> None:
    """Between neighbouring rows of the profiles that declare it."""
    for device in map(profiles.load, profiles.names()):
        for one, other in zip(device.rows, device.rows[1:], strict=False):
            if not device.scaling or "vl" in one.model + other.model:
                continue
            for left, right in ((one, other), (other, one)):
                scaled = profiles.find_row(replace(device, rows=(left,)), f"{right.billions:g}b")
                for rate in profiles.RATES:
                    off = getattr(scaled, rate).value / getattr(right, rate).value
                    assert 1 / 1.6 < off < 1.6


def test_declared_tokens_are_read_out_or_written() -> None:
    told = declared(300, 40)
    assert {kind: n.tolist() for kind, n in told.output.items()} == {
        "readout": [1.0],
        "written": [40.0],
    }


def test_times_of_answers_are_over_recordings(tmp_path: Path) -> None:
    """Of a run's own page, and of what a device would take."""
    device, found = profiles.load("laptop-cpu"), {}
    row = device.rows[0]
    for size in (0, 2, 24):
        made = made_up(tmp_path / str(size), episode=partial(cut, size=size), episodes=24)
        whole = folder.read(made)
        timed = [replace(answer, **clock(answer.scene)) for answer in whole.answers]
        whole.__dict__["answers"] = timed
        ego = times(timed, whole.grid.episodes, whole.clusters)["ego"]
        [seconds, *_] = held(device, row, whole)
        [_, written] = fits(device, [row], answers_of(whole), 0.2)
        found[size] = ego.median_ci_s, (seconds.measured.low, seconds.measured.high), written
    (own, rates, alone), (dozen, _, of_dozen), (of_one, of_one_rate, single) = found.values()
    assert own is not None
    assert dozen is not None
    assert dozen[1] - dozen[0] > own[1] - own[0]
    assert rates == pytest.approx(own)
    assert of_one is None
    assert math.isnan(of_one_rate[0])
    assert (single.joules.value, single.in_time.value) == (alone.joules.value, alone.in_time.value)
    assert math.isnan(single.joules.low)
    assert single.in_time.low < of_dozen.in_time.low < alone.in_time.low


def cut(row: Row, size: int) -> None:
    if size:
        row["cluster"] = f"street {row['episode'] // size}"


def clock(scene: str) -> dict[str, float]:
    """Layouts of one recording take alike, twelve of them from 0.1 to 0.21 s."""
    place = int(scene.partition("-")[0]) // 2
    return {
        "seconds": (10 + place) / 100, "first_token_s": 0.05, "token_s": 0.01,
        "prompt_tokens": 100 + 10 * place, "completion_tokens": 20 + place // 6,
    }  # fmt: skip
