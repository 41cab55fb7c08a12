"""A run killed at any moment and resumed has the bytes of one that never was."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from evaluating import FILES, run, same_files, spec_of, walked, with_ego
from killed_run import PLACES, TREES_AT_ONCE, WALKS_AT_ONCE, at, killed_at, spec_to_kill
from msgspec.structs import replace
from run_on_disk import answers_of, change
from tiers import some

from harness.backends import cards
from harness.backends.base import Backend, Completion, Request
from harness.backends.registry import open_backend
from harness.core.errors import UserError
from harness.core.files import alone
from harness.core.formats import CONFIG
from harness.core.process import Stop
from harness.core.progress import Progress
from harness.dataset.load import Dataset, load
from harness.evaluate.kept_answers import MORE_FOLLOWS, read_kept
from harness.evaluate.latency import PAPER
from harness.evaluate.run import _check_measured, evaluate, read_or_evaluate
from harness.evaluate.spec import Spec
from harness.runs.run_parts import write_part

Once = Callable[[str, Callable[[Path], object]], Path]
RESULT = {*FILES, "run.json", "run.toml", "sources"}


@pytest.fixture(scope="module")
def killed(small_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("killed")
    script = Path(__file__).with_name("killed_run.py")
    subprocess.run([sys.executable, str(script), str(small_path), str(folder)], check=True)
    return folder


@pytest.fixture
def in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A layout is a part of a run, and a seed a walk."""
    monkeypatch.setattr("harness.evaluate.run.TREES_AT_ONCE", TREES_AT_ONCE)
    monkeypatch.setattr("harness.evaluate.run.WALKS_AT_ONCE", WALKS_AT_ONCE)


@pytest.fixture(scope="module")
def to_kill(small_path: Path) -> Spec:
    return spec_to_kill(load(small_path, limit=2))


@pytest.fixture(scope="module")
def whole(to_kill: Spec, once: Once) -> Path:
    """The run in one part that nobody kills."""
    return once("whole-of-killed", lambda out: run(to_kill, out))


@pytest.mark.exhaustive
def test_killed_before_any_change_of_the_disk_and_resumed_it_is_the_same_run(
    killed: Path, to_kill: Spec, in_parts: None
) -> None:
    outs = sorted(killed.glob("at-*"), key=lambda p: int(p.name[3:]))
    assert len(outs) > 20
    begun = [out for out in outs if not (out / "run.json").exists()]
    assert 10 < len(begun) < len(outs), "kills before the end, and while the work is cleared away"
    for out in outs:
        _becomes_whole(out, killed / "whole", to_kill)


@pytest.mark.exhaustive
def test_killed_at_any_time_and_resumed_it_is_the_same_run(
    killed: Path, to_kill: Spec, in_parts: None
) -> None:
    for out in sorted(killed.glob("after-*")):
        _becomes_whole(out, killed / "whole", to_kill)


SOME = ("between two parts", "while a part is written", "while the work is cleared away")


@pytest.mark.parametrize(
    "place", some(SOME, exhaustive=[place for place in PLACES if place not in SOME])
)
def test_killed_at_one_place_of_each_kind_and_resumed_it_is_the_same_run(
    place: str, whole: Path, to_kill: Spec, in_parts: None, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    killed_at(to_kill, out, at(*PLACES[place]))
    done = {path.name for path in out.glob(".work/episodes-*") if path.is_dir()}
    assert len(done) == {
        "before anything": 0,
        "before it keeps its settings": 0,
        "while a part is written": 0,
        "between two parts": 1,
    }.get(place, 2)
    assert (out / "run.json").exists() == (place == "while the work is cleared away")
    _becomes_whole(out, whole, to_kill)


def test_a_finished_part_whose_answers_say_otherwise_than_their_texts_is_refused(
    to_kill: Spec, in_parts: None, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    killed_at(to_kill, out, at(*PLACES["between two parts"]))
    [file] = out.glob(".work/episodes-*/answers.jsonl")
    text = file.read_text()
    assert '"mass":1.0' in text
    file.write_text(text.replace('"mass":1.0', '"mass":0.9'))
    with pytest.raises(UserError, match="states another mass than its text says"):
        run(to_kill, out)


@pytest.mark.parametrize("forged", ["its tables", "its tables and seal", "all of another part"])
def test_a_finished_part_that_was_not_finished_here_is_walked_again(
    forged: str,
    whole: Path,
    to_kill: Spec,
    in_parts: None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whatever it states: another's key seals nothing, nor does one part's seal another part."""
    out = tmp_path / "run"
    killed_at(to_kill, out, at(*PLACES["before a table"]))
    part, other = sorted(out.glob(".work/episodes-*"))
    files = {file.name: file.read_bytes() for file in part.iterdir()}
    shutil.rmtree(part)
    if forged == "all of another part":
        shutil.copytree(other, part)
        shutil.copy(other.with_name(f"seal-{other.name}"), part.with_name(f"seal-{part.name}"))
    else:
        assert b",left,True," in files["episodes.csv"]
        files["episodes.csv"] = files["episodes.csv"].replace(b",left,True,", b",left,False,")
        with monkeypatch.context() as elsewhere:
            elsewhere.setenv("SWARMDRIVE_CACHE", str(tmp_path / "another"))
            seal = part.with_name(f"seal-{part.name}")
            of_user = seal.read_bytes()
            write_part(part, files)
        if forged == "its tables":
            seal.write_bytes(of_user)
    _becomes_whole(out, whole, to_kill)
    assert "has 1 finished part that nobody finished here with your key" in capsys.readouterr().err


def test_measured_times_of_a_stopped_run_were_measured_here(tmp_path: Path) -> None:
    record: Any = SimpleNamespace(latency=SimpleNamespace(source="measured"))
    (tmp_path / CONFIG).write_text('{"latency": 0.1}')
    _check_measured(tmp_path, tmp_path, record, resumes=False)
    _check_measured(tmp_path, tmp_path, record, resumes=True)
    (tmp_path / CONFIG).write_text('{"latency": 0.001}')
    with pytest.raises(UserError, match="times that were not measured here with your key"):
        _check_measured(tmp_path, tmp_path, record, resumes=True)


def sooner(row: dict[str, Any]) -> None:
    row["latency_ms"] = 1.0


@pytest.mark.parametrize("clears_away", [True, False])
def test_a_finished_run_from_which_work_goes_on_is_what_its_answers_make(
    clears_away: bool, proxy_run: Path, small: Dataset, tmp_path: Path
) -> None:
    """A run that was killed while its work was cleared away, and one of a study that goes on."""
    out = Path(shutil.copytree(proxy_run, tmp_path / "run"))

    def goes_on() -> object:
        if clears_away:
            (out / ".work").mkdir(exist_ok=True)
            return run(spec_of(small), out)
        return read_or_evaluate(spec_of(small), out, Progress(), None, open_backend)

    goes_on()
    change(out, decision=sooner)
    with pytest.raises(UserError, match=r"another latency_ms in .* than its answers make; delete"):
        goes_on()


@pytest.mark.exhaustive
def test_killed_between_two_walks_of_a_part_it_is_the_same_run(
    whole: Path, to_kill: Spec, in_parts: None, tmp_path: Path
) -> None:
    """As the second walk keeps its first answers, which the first did not need."""
    out = tmp_path / "run"
    killed_at(to_kill, out, at("fsync", "answers-2.jsonl"))
    asked = (out / ".work/answers.jsonl").read_bytes()
    assert 0 < len(asked) < len((whole / "answers.jsonl").read_bytes())
    assert list(out.glob(".work/episodes-*")) == []
    _becomes_whole(out, whole, to_kill)


def _becomes_whole(out: Path, whole: Path, spec: Spec) -> None:
    if not (out / "run.json").exists() or (out / ".work").exists():
        assert run(spec, out).manifest.seeds == (0, 1)
    assert same_files(out, whole), out.name
    assert {p.name for p in out.iterdir()} == RESULT, out.name


def unfinished(spec: Spec, out: Path, kept: bytes) -> Path:
    """A run whose process was killed when it had these answers."""

    class Killed(Stop):
        pass

    def die(done: int) -> None:
        raise Killed

    with pytest.raises(Killed):
        evaluate(spec, out, die)
    (out / ".work" / "answers.jsonl").write_bytes(kept)
    return out


@pytest.fixture(scope="module")
def answers(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """All answers of a run, as they are kept while it goes on."""
    spec, kept = spec_of(small), tmp_path_factory.mktemp("kept") / "answers.jsonl"
    walked(spec, open_backend(spec.ego.card), PAPER, kept)
    return kept.read_bytes()


@pytest.mark.parametrize(
    "torn", [300, *(pytest.param(n, marks=pytest.mark.exhaustive) for n in (1, 5, 20_000))]
)
def test_a_torn_last_line_is_dropped_and_asked_again(
    torn: int, proxy_run: Path, answers: bytes, small: Dataset, tmp_path: Path
) -> None:
    out = unfinished(spec_of(small), tmp_path / "torn", answers[:-torn])
    run(spec_of(small), out)
    assert same_files(out, proxy_run)


def test_what_follows_a_torn_line_can_be_read_again(
    answers: bytes, small: Dataset, tmp_path: Path
) -> None:
    """Killed twice: the answers of the second try stand on lines of their own."""
    kept, spec = tmp_path / "answers.jsonl", spec_of(small)
    kept.write_bytes(answers[:5000])
    walked(spec, open_backend(spec.ego.card), PAPER, kept)
    (tmp_path / "whole.jsonl").write_bytes(answers)
    assert read_kept(kept) == read_kept(tmp_path / "whole.jsonl")


@pytest.mark.slow
def test_a_torn_chunk_is_asked_again_as_a_whole(
    answers: bytes, small: Dataset, tmp_path: Path
) -> None:
    """Wherever it is torn, also between two lines:
    its batches must hold the same questions again.
    """
    spec, kept = spec_of(small), tmp_path / "answers.jsonl"
    lines = answers.splitlines(keepends=True)
    ends = [n for n, line in enumerate(lines, 1) if not line.endswith(MORE_FOLLOWS)]
    assert len(ends) > 2
    for count in (1, ends[0] - 1, ends[0], ends[0] + 1, ends[1] - 1):
        kept.write_bytes(b"".join(lines[:count]))
        whole = max([end for end in ends if end <= count], default=0)
        assert len(read_kept(kept)) == whole, count
        asked: list[int] = []
        walked(spec, Counting(open_backend(spec.ego.card), asked), PAPER, kept)
        assert kept.read_bytes() == answers
        kept_again = asked.pop(0) if whole else 0  # which the rule is asked, to compare
        assert kept_again == whole
        assert sum(asked) == len(lines) - whole


class Counting:
    """A backend that writes down how many requests it is asked at a time."""

    def __init__(self, backend: Backend, asked: list[int]) -> None:
        self._backend, self._asked = backend, asked

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        self._asked.append(len(requests))
        return self._backend.complete(requests)

    def identity(self) -> dict[str, Any]:
        return self._backend.identity()


def test_answers_that_are_all_there_are_not_asked_for_again(
    answers: bytes, small: Dataset, tmp_path: Path
) -> None:
    """One answer is altered by hand, not in what it says: it stays as it was kept."""
    marked = re.sub(rb'"batch_size":\d+', b'"batch_size":99', answers, count=1)
    assert marked != answers
    out = unfinished(spec_of(small), tmp_path / "run", marked)
    run(spec_of(small), out)
    assert b'"batch_size":99' in (out / "answers.jsonl").read_bytes()


FIRST_TURN = {
    "raw": "?",
    "status": "no_json",
    "finish_reason": "stop",
    "prompt_tokens": None,
    "completion_tokens": None,
    "seconds": None,
    "slow_s": 0.0,
}
SURE = '{"action_distribution": {"SLOWER": 1.0, "IDLE": 0.0, "FASTER": 0.0}}'


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("prompt_sha256", "0" * 64, "answer 00000-0-.* is to another prompt or picture than is"),
        ("raw", SURE, "answer 00000-0-.* is not what the rule here gives; delete that file"),
        ("slow_s", -0.1, "states a delay of -0.1 s, which no card of this run declares"),
        ("seconds", 0.5, "answer 00000-0-.* is not what the rule here gives; delete that file"),
        ("retries", 10**15, "answer 00000-0-.* is not what the rule here gives; delete that file"),
        ("prompt_tokens", -5, r"answers\.jsonl is damaged .*prompt_tokens"),
        ("agent", 1, "answer 00000-0-.* states another model than is asked there; delete that"),
        ("label_mass", 1.0, "states a label_mass, which only a read-out has"),
        ("flipped", False, "states a flipped, which only a read-out has"),
        ("first", FIRST_TURN, "states a repair turn, and the text before it calls for none"),
        ("first", FIRST_TURN | {"status": "bad_sum"}, "another status of its first turn than"),
        ("first", FIRST_TURN | {"slow_s": 2.0}, "states less slow_s than its first turn"),
    ],
)
def test_a_kept_answer_is_one_to_what_is_asked(
    name: str, value: object, said: str, answers: bytes, small: Dataset, tmp_path: Path
) -> None:
    first, *others = answers.splitlines(keepends=True)
    intent = {"intent": [1.0, 0.0, 0.0]} if name == "raw" else {}
    stated = {**json.loads(first), **intent, name: value}
    forged = json.dumps(stated).encode() + first[len(first.rstrip()) :]
    out = unfinished(spec_of(small), tmp_path / "run", b"".join([forged, *others]))
    with pytest.raises(UserError, match=said):
        run(spec_of(small), out)


def test_a_kept_answer_that_nothing_asks_for_is_left_out(
    answers: bytes, proxy_run: Path, small: Dataset, tmp_path: Path
) -> None:
    first = json.loads(answers.splitlines()[0])
    unasked = json.dumps({**first, "heard": ["v2!objects"], "role": "merge"}).encode() + b"\n"
    out = unfinished(spec_of(small), tmp_path / "run", answers + unasked)
    run(spec_of(small), out)
    assert same_files(out, proxy_run)


@pytest.mark.parametrize("line", [b"[1", b"\xff", b'{"scene": "\xae"}', b"[" * 100_000])
def test_damaged_answers_are_one_line(
    line: bytes, answers: bytes, small: Dataset, tmp_path: Path
) -> None:
    out = unfinished(spec_of(small), tmp_path / "run", line + b"\n" + answers)
    with pytest.raises(
        UserError, match=r"answers\.jsonl is damaged .*; delete that file, and its questions are"
    ):
        run(spec_of(small), out)


@pytest.mark.parametrize(
    ("other", "named"),
    [
        ({"seeds": (0, 2)}, "--seeds 0,1, and not with --seeds 0,2"),
        ({"batch_size": 3}, "--batch-size 8, and not with --batch-size 3"),
        ({"prompt": "v1"}, "--prompt v2, and not with --prompt v1"),
        ({"model": "cruise"}, "--model proxy, and not with --model cruise"),
        ({"points": ()}, "--condition .*, and not with no --condition"),
        ({"limit": 4}, "no --limit, and not with --limit 4"),
        (
            {"prompt": "v1", "seeds": (7,)},
            "--prompt v2 --seeds 0,1, and not with --prompt v1 --seeds 7:8",
        ),
    ],
)
@pytest.mark.parametrize("finished", [True, False])
def test_other_settings_are_refused_by_name_and_change_nothing(
    finished: bool,
    other,
    named: str,
    proxy_run: Path,
    answers: bytes,
    small: Dataset,
    tmp_path: Path,
) -> None:
    out = tmp_path / "run"
    if finished:
        shutil.copytree(proxy_run, out)
        (out / ".work").mkdir()
    else:
        unfinished(spec_of(small), out, answers[:5000])
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    with pytest.raises(UserError, match=f"was begun with {named}; repeat its settings, delete"):
        run(spec_of(small, **other), out)
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before


@pytest.mark.parametrize(
    "latency",
    [
        {"ego_s": 0.001, "helper_s": 0.001, "fusion_s": 0.001},
        {"source": "measured"},
        {"source": "declared"},
    ],
)
def test_a_resumed_run_has_the_latency_that_its_settings_say(
    latency: dict[str, Any], answers: bytes, small: Dataset, tmp_path: Path
) -> None:
    out = unfinished(spec_of(small), tmp_path / "stopped", answers)
    config = out / ".work" / "config.json"
    start = json.loads(config.read_text())
    config.write_text(json.dumps({**start, "latency": {**start["latency"], **latency}}))
    with pytest.raises(UserError, match="the run began with times of answers from"):
        run(spec_of(small), out)


@pytest.mark.parametrize("world", [None, [], "frozen"])
def test_a_begun_run_whose_world_is_damaged_is_another_run(
    world: Any, answers: bytes, small: Dataset, tmp_path: Path
) -> None:
    out = unfinished(spec_of(small), tmp_path / "run", answers[:5000])
    file = out / ".work" / CONFIG
    begun = json.loads(file.read_text())
    begun["settings"]["world"] = world
    file.write_text(json.dumps(begun))
    with pytest.raises(UserError, match=r"was begun with another .* of the world"):
        run(spec_of(small), out)


def test_a_run_that_was_stopped_while_it_tidied_up_asks_and_writes_nothing(
    small: Dataset, tmp_path: Path
) -> None:
    first = run(spec_of(small), tmp_path / "run")
    (tmp_path / "run" / ".work").mkdir()
    files = [p for p in (tmp_path / "run").iterdir() if p.is_file()]
    before = {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in files}
    again = run(spec_of(small), tmp_path / "run")
    assert {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in files} == before
    assert not (tmp_path / "run" / ".work").exists(), "tidy"
    assert replace(again.manifest, digests={}) == first.manifest
    assert list(again.scores) == list(first.scores)


def test_a_run_is_written_by_one_process_at_a_time(
    answers: bytes, small: Dataset, tmp_path: Path
) -> None:
    out = unfinished(spec_of(small), tmp_path / "run", answers[:5000])
    with (
        alone(out / ".work" / "lock"),
        pytest.raises(UserError, match=r"is being written by another process; wait for it"),
    ):
        run(spec_of(small), out)
    assert (out / ".work" / "answers.jsonl").read_bytes() == answers[:5000]
    run(spec_of(small), out)


@pytest.mark.exhaustive
def test_a_read_out_over_cyclic_orders_goes_on_where_it_was_killed(
    small: Dataset, tmp_path: Path
) -> None:
    pytest.importorskip("torch", reason="needs the transformers extra")
    card = cards.resolve("swarm-tiny", "transformers")
    spec = with_ego(spec_of(small.of_episodes([0])), card=card, answer="readout", letters="cyclic")
    kept = tmp_path / "answers.jsonl"
    walked(spec, open_backend(spec.ego.card, device="cpu"), PAPER, kept)
    lines = kept.read_bytes().splitlines(keepends=True)
    half = b"".join(lines[: len(lines) // 2])
    whole = run(spec, tmp_path / "whole")
    out = unfinished(spec, tmp_path / "killed", half + lines[len(lines) // 2][:40])
    resumed = run(spec, out)
    assert (out / "episodes.csv").read_bytes() == (whole.out / "episodes.csv").read_bytes()
    one, other = answers_of(whole.out), answers_of(out)
    assert len(one) > 6
    assert [a.id for a in one] == [a.id for a in other]
    # Batches are others from the middle on, and move a probability by its last stated digit.
    for was, now in zip(one, other, strict=True):
        assert was.intent == pytest.approx(now.intent, abs=3e-6)
        assert was.letter_share == pytest.approx(now.letter_share, abs=1e-4)
        assert was.follows_letter == now.follows_letter
    assert resumed.manifest.letters == "cyclic"
