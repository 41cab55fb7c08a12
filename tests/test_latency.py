"""Where inference times come from, and that how fast a machine is changes no row of a run."""

import json
import os
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec
import pytest
from evaluating import Scripted, run, says, scenes_of, spec_of, with_ego
from run_on_disk import answers_of

from harness.backends.base import Completion, Request
from harness.backends.card import Card
from harness.backends.card import Latency as CardLatency
from harness.backends.cards import resolve
from harness.coordination.named_points import POINTS, named_point
from harness.core import work
from harness.core.config import LONGEST_S
from harness.core.errors import Unanswered
from harness.dataset.load import Dataset
from harness.evaluate import run as evaluation
from harness.evaluate import timing
from harness.evaluate.agent import Agent
from harness.evaluate.latency import PAPER, as_declared, chosen_latency, declared
from harness.evaluate.timing import IDLE, measured
from harness.prompts import versions
from harness.report.notes import pace
from harness.runs import folder
from harness.runs.answer_times import times
from harness.runs.records import Latency, Times

pytestmark = pytest.mark.usefixtures("svg_alone")

LANGUAGE_MODEL = "swarm-tiny"
ROWS = ("decisions.parquet", "episodes.csv", "summary.csv")


# -- which one counts ------------------------------------------------------------------------------


def test_the_paper_counts_unless_a_card_or_the_user_declares_a_time() -> None:
    prompt, nobody = versions.load("v2"), [Scripted({})]
    silent = [Agent(resolve(LANGUAGE_MODEL), prompt)]
    latency = CardLatency("card", 0.03, "measured: my car, today")
    fast = [Agent(replace(resolve(LANGUAGE_MODEL), latency=latency), prompt)]
    of_card = Latency("card", "measured: my car, today", 0.03, 0.03, 0.03)
    assert chosen_latency(None, silent, nobody) == chosen_latency("paper", silent, nobody) == PAPER
    assert (PAPER.ego_s, PAPER.helper_s, PAPER.fusion_s) == (0.145, 0.145, 0.145)
    assert chosen_latency(None, fast, nobody) == chosen_latency("card", fast, nobody) == of_card
    cited = CardLatency("cited", 0.012, "cited: its makers, their computer; never run here")
    elsewhere = [Agent(replace(resolve(LANGUAGE_MODEL), latency=cited), prompt)]
    # another computer's time counts by name alone
    assert chosen_latency(None, elsewhere, nobody) == PAPER
    assert chosen_latency("card", elsewhere, nobody) == Latency(
        "card", cited.basis, 0.012, 0.012, 0.012
    )
    assert chosen_latency("paper", fast, nobody) == PAPER
    assert chosen_latency("measured", fast, nobody) is None
    told = chosen_latency("ego=0.2,helper=0.1", fast, nobody)
    assert told == Latency("declared", "declared: --latency ego=0.2,helper=0.1", 0.2, 0.1, 0.2)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("ego=0.171", (0.171, 0.171, 0.171)),
        ("ego=0.171,helper=0.164", (0.171, 0.164, 0.171)),
        ("fusion=0.2,helper=0,ego=5e-05", (5e-05, 0.0, 0.2)),
    ],
)
def test_what_is_left_out_takes_as_long_as_the_ego(text: str, seconds: tuple[float, ...]) -> None:
    said = declared(text)
    assert (said.ego_s, said.helper_s, said.fusion_s) == seconds
    again = declared(as_declared(said))
    assert (again.ego_s, again.helper_s, again.fusion_s) == seconds


@pytest.mark.parametrize(
    "text",
    ["", "mine", "0.1", "ego", "ego=", "ego=x", "ego=nan", "ego=-1", "ego=inf", f"ego={LONGEST_S + 1}",
     "helper=0.1", "ego=0.1,ego=0.2", "ego=0.1,", "ego=0.1,car=0.2", 
         "ego=0.1 helper=0.2", "ego=0.1\x1b[2J"],
)  # fmt: skip
def test_anything_else_is_one_line(text: str, harness: Callable[..., Any]) -> None:
    code, out, err = harness("eval", "--limit", "1", "--latency", text)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("harness: --latency '")
    assert "give card, measured, paper, or by role the seconds of one answer, 0 to 3600" in err
    assert (
        "such as ego=0.171,helper=0.164,fusion=0.2 (ego is needed; a role left out has its time)"
        in err
    )
    assert "\x1b" not in err


@pytest.mark.slow
def test_a_replay_keeps_its_runs_times_unless_others_are_declared(
    small: Dataset, tmp_path: Path
) -> None:
    first = run(spec_of(small, latency="ego=0.02,helper=0.01"), tmp_path / "run")
    replay = f"replay:{tmp_path / 'run'}"
    assert (
        run(spec_of(small, replay), tmp_path / "again").manifest.latency == first.manifest.latency
    )
    other = run(spec_of(small, replay, latency="ego=0.3"), tmp_path / "other").manifest.latency
    assert (other.ego_s, other.helper_s) == (0.3, 0.3)


# -- measured, by name -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("load", "said"),
    [
        (
            IDLE + 0.01,
            "the machine is busy (0.26 processes a core in the last minute; at most 0.25); wait",
        ),
        (
            None,
            "this system does not say how busy it is; declare times with --latency paper or ego=",
        ),
    ],
)
def test_a_busy_machine_measures_nothing(
    load: float | None, said: str, harness: Callable[..., Any], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(timing, "load_a_core", lambda: load)
    monkeypatch.setattr(
        evaluation, "open_backend", lambda *_, **__: pytest.fail("the model was opened")
    )
    for command in (["eval"], ["drive"], ["study", "closed-loop"]):
        code, out, err = harness(
            *command, "--model", LANGUAGE_MODEL, "--latency", "measured", "--quiet"
        )
        assert (code, out) == (2, "")
        assert err.startswith(f"harness: --latency measured: {said}")
        assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_system_without_a_load_average_is_none_that_is_idle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "getloadavg", lambda: (3.0, 0.0, 0.0))
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    assert timing.load_a_core() == 0.75

    def missing() -> None:
        raise OSError

    monkeypatch.setattr(os, "getloadavg", missing)
    assert timing.load_a_core() is None


class Clock(Scripted):
    """An ego takes 0.2 s, a helper 0.1 s and a fusion call 0.4 s,
    but for the completions written down.
    """

    def _say(self, request: Request) -> Completion:
        assert request.timed, "a server streams what is asked to be timed, and nothing else"
        done = super()._say(request)
        if request.id in self.lines:
            return done
        return replace(
            done, seconds=0.4 if "+" in request.id else 0.2 if request.role == "ego" else 0.1
        )


def test_a_measurement_is_the_median_of_good_answers_asked_alone(small: Dataset) -> None:
    """Of five egos one failed at once and one was tried twice: three count."""
    scenes = timing.spread_over(scenes_of(small))
    good = says((0.2, 0.6, 0.2))
    ids = [f"{scene.id}/v1" for scene in scenes]
    backend = Clock({
        ids[1]: Completion(ids[1], "", None, None, "error", 0.001, 1, "refused"),
        ids[2]: Completion(ids[2], good, None, None, "stop", 7.0, 1, retries=1),
        ids[3]: Completion(ids[3], good, None, None, "stop", 0.3, 1),
    })  # fmt: skip
    spec = spec_of(small, LANGUAGE_MODEL)
    latency = measured(spec, backend, scenes)
    helpers = sum(len(scene.viewers) - 1 for scene in scenes)
    assert (latency.ego_s, latency.helper_s, latency.fusion_s) == (0.2, 0.1, 0.4)
    ego = latency.sample["ego"]
    assert (ego.n, ego.median_s, ego.p5_s, ego.p95_s) == (3, 0.2, 0.2, 0.29)
    assert (latency.sample["helper"].n, latency.sample["merge"].n) == (helpers, len(scenes))
    assert latency.source == "measured"
    # Letters have no messages to fuse, and a role without a time has the ego's.
    readout = measured(with_ego(spec, answer="readout"), Clock({}), scenes)
    assert (readout.fusion_s, sorted(readout.sample)) == (0.2, ["ego", "helper"])


def test_a_model_that_fails_has_no_times(small: Dataset) -> None:
    lines = {
        f"{s.id}/v1": Completion(f"{s.id}/v1", "", None, None, "error", 0.1, 1, "no")
        for s in scenes_of(small)
    }
    with pytest.raises(
        Unanswered, match=r"^no \(5 times\): no answer to 5 of 5 questions to the ego"
    ):
        measured(spec_of(small, LANGUAGE_MODEL), Clock(lines), timing.spread_over(scenes_of(small)))


# -- and what answers took decides nothing ---------------------------------------------------------


@pytest.mark.slow
def test_no_seconds_retries_or_batches_move_a_row(
    small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same words said slowly, at the third attempt, one by one, or at once in batches."""

    class Slow(Scripted):
        def _say(self, request: Request) -> Completion:
            return replace(super()._say(request), seconds=len(self.asked) / 7, retries=2)

    class First(Scripted):
        def _say(self, request: Request) -> Completion:
            return replace(super()._say(request), seconds=0.5)

    lines = {f"{s.id}/v1": says((0.3, 0.4, 0.3)) for s in scenes_of(small)}
    points = (*POINTS.values(), named_point("6g:consensus=ego-prompt"))
    found = []
    for name, backend, batch_size in (
        ("a", Scripted(lines), 8),
        ("b", Slow(lines), 1),
        ("c", First(lines), 3),
    ):
        monkeypatch.setattr(evaluation, "open_backend", lambda *_, backend=backend, **__: backend)
        spec = spec_of(small, LANGUAGE_MODEL, points=points, batch_size=batch_size)
        found.append(run(spec, tmp_path / name).manifest)
        assert same_rows(tmp_path / name, tmp_path / "a")
    assert [m.latency for m in found] == [PAPER] * 3
    assert [m.retries for m in found] == [0, 2 * len(answers_of(tmp_path / "b")), 0]
    assert found[0].answer_times == found[1].answer_times == {}, (
        "no time, or none of a first attempt"
    )
    egos = sum(answer.role == "ego" for answer in answers_of(tmp_path / "c"))
    assert found[2].answer_times["ego"] == Times(egos, 0.5, 0.5, 0.5)


def test_times_by_hand(small: Dataset, tmp_path: Path) -> None:
    run(spec_of(small), tmp_path / "run")
    one = answers_of(tmp_path / "run")[0]
    took = [msgspec.structs.replace(one, seconds=s / 100) for s in range(101)]
    assert times(took) == {"ego": Times(101, 0.5, 0.05, 0.95)}, (
        "of one episode: no interval over episodes"
    )


def test_times_to_the_first_token_and_of_each_after_it(small: Dataset, tmp_path: Path) -> None:
    """Ten episodes of one answer, of which the second half never told of tokens."""
    run(spec_of(small), tmp_path / "run")
    one = answers_of(tmp_path / "run")[0]
    took = [
        msgspec.structs.replace(
            one, scene=f"{n:05d}-0", seconds=0.1 * (1 + n), first_token_s=0.02 * (1 + n) if n < 5 else None,
            token_s=0.001 if n < 5 else None,
        )
        for n in range(10)
    ]  # fmt: skip
    [(role, found)] = times(took).items()
    first, token = found.first_token, found.token
    assert first is not None
    assert token is not None
    assert (role, found.n, found.median_s) == ("ego", 10, 0.55)
    assert (first.n, first.median_s, first.p5_s, first.p95_s) == (5, 0.06, 0.024, 0.096)
    for each in (found, first):
        assert each.median_ci_s is not None
        assert each.p95_ci_s is not None
        assert each.median_ci_s[0] < each.median_s < each.median_ci_s[1] <= each.p95_ci_s[1]
    assert token == Times(5, 0.001, 0.001, 0.001), "all alike: nothing is known of other episodes"


def test_a_replay_keeps_its_runs_times_to_first_token(
    small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Told(Scripted):
        def _say(self, request: Request) -> Completion:
            return replace(super()._say(request), seconds=0.5, first_token_s=0.3, token_s=0.01)

    with monkeypatch.context() as patch:
        patch.setattr(evaluation, "open_backend", lambda *_, **__: Told({}))
        first = run(spec_of(small, LANGUAGE_MODEL), tmp_path / "run").manifest
    again = run(spec_of(small, f"replay:{tmp_path / 'run'}"), tmp_path / "again").manifest
    ego = first.answer_times["ego"]
    assert again.answer_times == first.answer_times
    assert ego.first_token == Times(ego.n, 0.3, 0.3, 0.3)
    assert list(pace(folder.read(tmp_path / "again")))[:3] == [
        "ego: 60 % of the median answer is prefill (batch 1, measured where it ran)",
        f"  ego TTFT 300.0 ms, p95 300.0, n = {ego.n}",
        f"  ego TPOT 10.0 ms, p95 10.0, n = {ego.n}",
    ]


def test_answers_of_before_there_were_times_to_first_token_have_none(
    small: Dataset, tmp_path: Path
) -> None:
    run(spec_of(small), tmp_path / "run")
    file = tmp_path / "run/answers.jsonl"
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    old = [
        {k: v for k, v in line.items() if k not in ("first_token_s", "token_s")} for line in lines
    ]
    assert len(old[0]) == len(lines[0]) - 2
    file.write_text("".join(json.dumps(line) + "\n" for line in old))
    assert {(a.first_token_s, a.token_s) for a in answers_of(tmp_path / "run")} == {(None, None)}
    assert list(pace(folder.read(tmp_path / "run"))) == []


def same_rows(one: Path, other: Path) -> bool:
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in ROWS)


@contextmanager
def busy_machine() -> Iterator[None]:
    """A process a core that does nothing but work."""
    program = [sys.executable, "-c", "while True: pass"]
    busy = [subprocess.Popen(program) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def engine() -> str:
    for package, engine in (("llama_cpp", "llama-cpp"), ("torch", "transformers")):
        if find_spec(package):
            return engine
    return pytest.skip("needs the llama-cpp or the transformers extra")


COMMANDS = pytest.mark.parametrize(
    "command", [("eval", "--limit", "1"), ("drive", "--episodes", "1", "--workers", "1")]
)


@pytest.mark.exhaustive
@COMMANDS
def test_a_measured_run_repeated_from_its_manifest_on_a_busy_machine_has_the_same_rows(
    command: Sequence[str], engine: str, harness: Callable[..., Any], small_path: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Measured while idle; then twice under load:
    as it was asked, and each answer alone and timed.
    """
    monkeypatch.setattr(timing, "load_a_core", lambda: 0.0)
    is_measured((*command, "--engine", engine), "0:2", harness, small_path, tmp_path)
    with busy_machine():
        has_the_same_rows(harness, tmp_path)


class Slowing(Scripted):
    """Decides by the question. It takes longer at each, and times those that it was asked alone."""

    def __init__(self, before: int, batch_size: int) -> None:
        super().__init__({})
        self._before, self._batch_size = before, batch_size

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        company = min(self._batch_size, len(requests))
        seconds = (self._before + len(self.asked)) / 1000 + 0.01 if company == 1 else None
        return [replace(c, seconds=seconds, batch_size=company) for c in super().complete(requests)]

    def _say(self, request: Request) -> Completion:
        share = sum(map(ord, request.id)) % 5 / 10
        text = says((0.5 - share / 2, 0.5 - share / 2, share), request.role)
        return Completion(request.id, text, None, None, "stop", None, 1)


@pytest.mark.exhaustive
@COMMANDS
def test_a_measured_run_repeated_from_its_manifest_by_a_slower_model_has_the_same_rows(
    command: Sequence[str], harness: Callable[..., Any], small_path: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """As it was asked, and each answer alone and timed."""
    opened: list[Slowing] = []

    def opens(card: Card, device: Any, dtype: Any, batch_size: int) -> Slowing:
        opened.append(Slowing(sum(len(each.asked) for each in opened), batch_size))
        return opened[-1]

    for name in ("open_backend", "opened"):
        monkeypatch.setattr(evaluation, name, opens)
    monkeypatch.setattr(timing, "load_a_core", lambda: 0.0)
    is_measured(command, "0:2", harness, small_path, tmp_path)
    has_the_same_rows(harness, tmp_path)


@pytest.mark.slow
def test_a_measured_run_that_was_stopped_as_it_tidied_is_that_run(
    harness: Callable[..., Any], small_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its times bear a seal; without it nobody knows that they were measured here."""
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    monkeypatch.setattr(timing, "load_a_core", lambda: 0.0)
    typed = (
        "eval", "--model", LANGUAGE_MODEL, "--dataset", small_path, "--limit", "1", "--seeds", "0",
        "--latency", "measured", "--no-cache", "--quiet", "--out", tmp_path / "run",
    )  # fmt: skip
    with monkeypatch.context() as patch:
        patch.setattr(work, "tidy", lambda out: None)
        assert harness(*typed)[0] == 0
    kept = shutil.copytree(tmp_path / "run", tmp_path / "kept")
    assert harness(*typed)[0] == 0
    assert not (tmp_path / "run/.work").exists()
    (kept / ".work/seal-config.json").unlink()
    code, _, error = harness(*typed[:-1], kept)
    assert (code, error.count("\n")) == (2, 1)
    assert "states inference times that were not measured here with your key" in error


def is_measured(
    command: Sequence[str],
    seeds: str,
    harness: Callable[..., Any],
    small_path: Path,
    tmp_path: Path,
) -> None:
    data = ("--dataset", small_path) if command[0] == "eval" else ("--first-seed", "100")
    points = (
        "--condition",
        "single-local",
        "--condition",
        "6g",
        "--condition",
        "6g:consensus=ego-prompt",
    )
    code, _, err = harness(
        *command, *data, *points, "--model", LANGUAGE_MODEL, "--seeds", seeds, "--latency", "measured",
        "--no-cache", "--out", tmp_path / "run",
    )  # fmt: skip
    assert code == 0, err
    latency = json.loads((tmp_path / "run/run.json").read_text())["latency"]
    trials = 5 if command[0] == "eval" else 1
    assert (latency["source"], latency["sample"]["ego"]["n"]) == ("measured", trials)


def has_the_same_rows(harness: Callable[..., Any], tmp_path: Path) -> None:
    """Whether the command in the manifest makes the same run, in batches and one by one."""
    first = json.loads((tmp_path / "run/run.json").read_text())
    latency = first["latency"]
    program, *words = shlex.split(first["command"])
    stated = f"ego={latency['ego_s']},helper={latency['helper_s']},fusion={latency['fusion_s']}"
    assert words[words.index("--latency") + 1] == stated
    for name, other in (("again", ()), ("alone", ("--batch-size", "1"))):
        again = [*words, "--no-cache", *other, "--out", str(tmp_path / name)]
        assert (program, harness(*again)[0]) == ("harness", 0)
        assert same_rows(tmp_path / name, tmp_path / "run")
    times_of = json.loads((tmp_path / "alone/run.json").read_text())["answer_times"]
    said = answers_of(tmp_path / "alone")
    assert {role: t["n"] for role, t in times_of.items()} == Counter(a.role for a in said)
    # replies that a busy machine made late are not merged
    assert {"ego", "helper"} <= set(times_of)
    assert all(0 < t["p5_s"] <= t["median_s"] <= t["p95_s"] for t in times_of.values())
