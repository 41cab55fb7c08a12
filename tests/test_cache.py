"""The completion cache: what is asked again and what is not,
and that nothing depends on the file.
"""

import json
import multiprocessing
import sqlite3
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from evaluating import Scripted, failed, made, same_decisions, spec_of
from former import SCENARIO
from hypothesis import given
from hypothesis import strategies as st
from misbehaving import Server, completion, serving
from run_on_disk import UNTIMED, answers_of

from harness.backends import cards
from harness.backends.base import Completion, Request
from harness.backends.cache import NOT_IN_KEY, Cached, CompletionFile, cached, default_file, key
from harness.backends.card import Latency
from harness.backends.registry import open_backend
from harness.coordination.named_points import POINTS
from harness.core.files import digest
from harness.core.image import Image
from harness.dataset.load import Dataset, load
from harness.evaluate.agent import Agent
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.lifecycle import Evaluated
from harness.evaluate.run import evaluate
from harness.evaluate.spec import Spec
from harness.prompts import versions as prompts
from harness.prompts.decision import Question

ACTIONS = ("SLOWER", "IDLE", "FASTER")
BASE = Request("00000-0/v1", "ego", ({"role": "user", "content": "Scene"},), ACTIONS, 64)
# One other value for every field of a request.
CHANGED: dict[str, Any] = {
    "id": "00000-1/v1",
    "role": "helper",
    "messages": ({"role": "user", "content": "Another scene"},),
    "actions": ("SLOWER", "IDLE"),
    "question": Question("Scene", "What now?", {"SLOWER": None, "IDLE": None, "FASTER": None}),
    "orders": (({"role": "user", "content": "The same in another order"},),),
    "flips": (({"role": "user", "content": "The list reversed"},),),
    "max_tokens": 65,
    "placeholders": ("max 12 words",),
    "form": "recommendation",
    "answer": "constrained",
    "extension": "{}",
    "sums": "divide",
    "thinking": True,
    "reasons_first": True,
    "temperature": 0.7,
    "sample": 1,
    "timed": True,
    "agent": 1,
    "image": Image(np.zeros((2, 4, 3), dtype=np.uint8)),
    "view": {"nodes": []},
    "truth": {"nodes": []},
    "scenario": SCENARIO,
}
# Nor is the question: who is asked it has it in the prompt.
READ_BY_NO_MODEL = (
    "id",
    "question",
    "flips",
    "timed",
    "agent",
    "sums",
    "placeholders",
    "reasons_first",
    "view",
    "truth",
    "scenario",
)


class Talker(Scripted):
    """A scripted language model, whose prompt is its messages as JSON."""

    def __init__(self, lines: dict[str, str | Completion] | None = None, **identity: Any) -> None:
        super().__init__(lines or {})
        self.name = {"engine": "talker", **identity}
        self.several: Sequence[str] = ()

    def rendered(self, requests: Sequence[Request]) -> list[str]:
        return [json.dumps(request.messages) for request in requests]

    def identity(self) -> dict[str, Any]:
        return self.name


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "cache" / "completions.sqlite"


# -- what is in the key ----------------------------------------------------------------------------


def test_engines_of_packages_that_state_the_same_of_themselves_answer_each_for_itself(
    file: Path,
) -> None:
    one, other = (Talker(), Talker())
    Cached(one, file, "engine a of package x").complete([BASE])
    [done] = Cached(other, file, "engine b of package x").complete([BASE])
    assert not done.cached
    [again] = Cached(other, file, "engine b of package x").complete([BASE])
    assert again.cached


def test_every_field_of_a_request_is_in_the_key_or_named_with_a_reason() -> None:
    names = {f.name for f in fields(Request)}
    assert set(CHANGED) == names, "a new field: say here what another value of it would be"
    assert set(NOT_IN_KEY) < names
    for name, value in CHANGED.items():
        other = replace(BASE, **{name: value})
        same = key({}, "prompt", other) == key({}, "prompt", BASE)
        assert same == (name in NOT_IN_KEY), name


@pytest.mark.parametrize("name", sorted(set(CHANGED) - set(READ_BY_NO_MODEL)))
def test_a_question_that_differs_in_anything_the_model_reads_is_asked(
    name: str, file: Path
) -> None:
    talker = Talker()
    Cached(talker, file).complete([BASE])
    [again] = Cached(talker, file).complete([BASE])
    [other] = Cached(talker, file).complete([replace(BASE, **{name: CHANGED[name]})])
    assert (again.cached, other.cached, len(talker.asked)) == (True, False, 2)


def test_the_same_question_from_another_place_of_a_run_is_answered_under_its_own_id(
    file: Path,
) -> None:
    talker = Talker()
    Cached(talker, file).complete([BASE])
    [again] = Cached(talker, file).complete([replace(BASE, id="00007-3/v1")])
    assert (again.request_id, again.cached) == ("00007-3/v1", True)


@pytest.mark.slow
def test_another_model_in_any_respect_is_asked(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="needs the transformers extra")
    import tiny_qwen3

    folder = tiny_qwen3.build(tmp_path / "tiny")
    identity = open_backend(cards.resolve(str(folder)), device="cpu").identity()
    assert {"engine", "weights", "revision", "files_sha256", "dtype", "device"} <= set(identity)
    assert {"transformers", "torch", "chat_template_sha256"} <= set(identity)
    base = key(identity, "prompt", BASE)
    assert key(dict(reversed(identity.items())), "prompt", BASE) == base
    for name in identity:
        assert key({**identity, name: "other"}, "prompt", BASE) != base, name
    assert key({**identity, "new": None}, "prompt", BASE) != base
    assert key(identity, "prompt, as another template writes it", BASE) != base


# -- what comes out --------------------------------------------------------------------------------


def test_what_was_answered_is_not_asked_again_and_the_order_holds(file: Path) -> None:
    asked = [
        replace(BASE, id=f"s{i}/v1", messages=({"role": "user", "content": f"Scene {i}"},))
        for i in range(6)
    ]
    lines = {f"s{i}/v1": f"answer {i}" for i in range(6)}
    first = Talker(dict(lines))
    Cached(first, file).complete(asked[1:4])
    second = Talker(dict(lines))
    done = Cached(second, file).complete(asked)
    assert second.asked == ["s0/v1", "s4/v1", "s5/v1"]
    assert [(c.request_id, c.text) for c in done] == list(lines.items())
    assert [c.cached for c in done] == [False, True, True, True, False, False]


def test_an_answer_from_the_cache_has_all_but_its_times(file: Path) -> None:
    times: Any = {"seconds": 0.7, "first_token_s": 0.3, "token_s": 0.1}
    said = Completion(
        BASE.id, "x", 12, 5, "length", batch_size=1, label_mass=0.5, retries=2, **times
    )
    assert Cached(Talker({BASE.id: said}), file).complete([BASE]) == [said]
    [again] = Cached(Talker(), file).complete([BASE])
    assert again == replace(said, **dict.fromkeys(times), retries=0, cached=True)


def test_errors_are_asked_again(file: Path) -> None:
    for _ in range(2):
        talker = Talker({BASE.id: failed(BASE.id, "out of memory")})
        assert [c.error for c in Cached(talker, file).complete([BASE])] == ["out of memory"]
        assert talker.asked == [BASE.id]
    assert not Cached(Talker(), file).complete([BASE])[0].cached


@given(text=st.text(st.characters(codec=None, exclude_categories=())))
def test_any_text_comes_back_as_it_was_said(
    text: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    store = CompletionFile(tmp_path_factory.getbasetemp() / "texts.sqlite")
    name = str(hash(text))
    said = Completion("", text, None, None, "stop", None, 1)  # which holds no lone surrogate
    store.add({name: said})
    assert store.find([name])[name].text == said.text
    assert said.text == text.encode("utf-8", "replace").decode()


def test_neither_prompt_nor_model_can_be_read_in_the_file(file: Path) -> None:
    Cached(Talker({BASE.id: "the answer"}, server="secret-host"), file).complete([BASE])
    [data] = [p.read_bytes() for p in file.parent.iterdir()]
    assert b"the answer" in data
    assert b"Scene" not in data
    assert b"secret-host" not in data


# Members that no engine gives; of the last two, one is too deep and one no object.
FORGED = [
    '{"text": 5}', '{"text": null}', '{"finish_reason": "error"}', '{"error": "x"}',
    '{"slow_s": -5.0}', '{"slow_s": 1e9}', '{"slow_s": "a"}', '{"completion_tokens": -9}',
    f'{{"prompt_tokens": '
    f'{10**400}}}', '{"label_mass": NaN}', '{"batch_size": "x"}', "[" * 10**5, "5",
]  # fmt: skip


@pytest.mark.parametrize("forged", FORGED, ids=lambda text: text[:25])
def test_an_answer_that_no_engine_gives_is_asked_again(
    forged: str, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Cached(Talker(), file).complete([BASE])
    with sqlite3.connect(file) as opened:
        [(good,)] = opened.execute("SELECT answer FROM completions")
        if forged.startswith("{"):
            forged = json.dumps({**json.loads(good), **json.loads(forged)})
        opened.execute("UPDATE completions SET answer = ?", [forged])
    opened.close()
    assert [c.cached for c in Cached(Talker(), file).complete([BASE])] == [False]
    assert "an answer is damaged" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["VIEW", "TRIGGER"])
def test_a_file_that_computes_is_left_alone(
    kind: str, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Cached(Talker(), file).complete([BASE])
    endless = (
        "WITH RECURSIVE r(key, answer) AS (SELECT '', '' UNION ALL SELECT * FROM r) SELECT * FROM r"
    )
    with sqlite3.connect(file) as opened:
        opened.executescript(
            f"DROP TABLE completions; CREATE VIEW completions AS {endless}"
            if kind == "VIEW"
            else "CREATE TRIGGER t BEFORE INSERT ON completions BEGIN SELECT 1; END"
        )
    opened.close()
    assert [c.cached for c in Cached(Talker(), file).complete([BASE])] == [False]
    assert "a view or a trigger" in capsys.readouterr().err


# -- the file is no more than a help ---------------------------------------------------------------


def test_a_deleted_file_is_an_empty_cache_also_while_a_run_goes_on(file: Path) -> None:
    talker = Talker()
    cached = Cached(talker, file)
    cached.complete([BASE])
    for path in file.parent.iterdir():
        path.unlink()
    file.parent.rmdir()
    assert [c.cached for c in cached.complete([BASE])] == [False]
    assert [c.cached for c in cached.complete([BASE])] == [True]


@pytest.mark.parametrize(
    "damage", ["no database", "torn", "another table", "no answer", "no folder"]
)
def test_a_file_that_gives_trouble_is_one_line_and_the_run_goes_on(
    damage: str, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Cached(Talker(), file).complete([replace(BASE, sample=i) for i in range(200)])
    if damage == "no database":
        file.write_bytes(b"thesis notes" * 1000)
    elif damage == "torn":
        file.write_bytes(file.read_bytes()[:5000])
    elif damage == "no folder":
        file.unlink()
        file.parent.rmdir()
        file.parent.write_text("a file")
    else:
        with sqlite3.connect(file) as open_file:
            open_file.execute(
                "UPDATE completions SET answer = '[1'"
                if damage == "no answer"
                else "ALTER TABLE completions RENAME COLUMN answer TO completion"
            )
        open_file.close()
    talker = Talker()
    cached = Cached(talker, file)
    for _ in range(2):
        assert [c.cached for c in cached.complete([BASE])] == [False]
    assert len(talker.asked) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith(f"harness: completion cache {file}: ")
    assert "delete the file" in said


def _write(path: str, first: int) -> None:
    cached = Cached(Talker(), Path(path))
    for i in range(first, first + 20):
        cached.complete([replace(BASE, sample=i), replace(BASE, sample=i + 20)])


@pytest.mark.exhaustive
def test_processes_that_write_at_once_lose_nothing(
    file: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    context = multiprocessing.get_context("fork")
    writers = [context.Process(target=_write, args=(str(file), 20 * n)) for n in range(4)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0] * 4
    assert capfd.readouterr().err == ""
    done = Cached(Talker(), file).complete([replace(BASE, sample=i) for i in range(100)])
    assert all(c.cached for c in done)


def test_the_file_lies_where_the_environment_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(tmp_path / "mine"))
    assert default_file() == tmp_path / "mine" / "completions.sqlite"
    monkeypatch.delenv("SWARMDRIVE_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    assert default_file() == tmp_path / "caches" / "swarmdrive-harness" / "completions.sqlite"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert default_file() == tmp_path / ".cache" / "swarmdrive-harness" / "completions.sqlite"


# -- runs ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("torch", reason="needs the transformers extra")
    import tiny_qwen3

    return tiny_qwen3.build(tmp_path_factory.mktemp("models") / "tiny", context_tokens=2048)


def tiny_run(tiny: Path, data: Dataset, out: Path, cache: Path | None, **options: Any) -> Evaluated:
    latency = Latency("card", 0.1, "declared: for this test")
    card = replace(cards.resolve(str(tiny)), max_new_tokens=6, latency=latency)
    points = tuple(POINTS.values())
    source = FrozenSource(data)
    ego, device = Agent(card, prompts.load("v2")), {"device": "cpu", "dtype": "float32"}
    spec = made(ego, source, points=points, seeds=(0,), **device, **options)
    return evaluate(spec, out, lambda done: None, cache)


@pytest.mark.exhaustive
def test_a_run_from_the_cache_is_the_run_that_was_asked(
    tiny: Path, small_path: Path, tmp_path: Path, file: Path
) -> None:
    data = load(small_path, limit=1)
    asked = tiny_run(tiny, data, tmp_path / "asked", None)
    first = tiny_run(tiny, data, tmp_path / "first", file)
    again = tiny_run(tiny, data, tmp_path / "again", file)
    # Decision points that a viewer cannot tell apart have one prompt, so a run meets its own
    # answers.
    alike = [
        [
            msgspec.structs.replace(a, batch_size=0, cached=False, **UNTIMED)
            for a in answers_of(tmp_path / name)
        ]
        for name in ("asked", "first")
    ]
    assert alike[0] == alike[1]
    for name in ("first", "again"):
        assert same_decisions(tmp_path / name, tmp_path / "asked")
    for table in ("summary.csv", "episodes.csv"):
        assert (tmp_path / "again" / table).read_bytes() == (
            tmp_path / "asked" / table
        ).read_bytes()
    count = len(answers_of(tmp_path / "asked"))
    assert all(a.cached for a in answers_of(tmp_path / "again"))
    assert (asked.manifest.cached_answers, again.manifest.cached_answers) == (0, count)
    assert first.manifest.cached_answers < count / 2

    file.unlink()
    spec = spec_of(data, f"replay:{tmp_path / 'again'}", seeds=(0,))
    evaluate(spec, tmp_path / "replayed", lambda done: None)
    assert answers_of(tmp_path / "replayed") == answers_of(tmp_path / "again")
    assert same_decisions(tmp_path / "replayed", tmp_path / "again")


def test_a_replay_takes_what_its_run_lacks_from_no_cache_but_the_one_that_it_is_given(
    proxy_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its model, to which a question goes that the run never asked."""
    files: list[Path | None] = []

    def noting(model: Any, card: Any, file: Path | None) -> Any:
        files.append(file)
        return Scripted({})

    monkeypatch.setattr("harness.backends.replay.cached", noting)
    card = cards.resolve(f"replay:{proxy_run}")
    for file in (None, tmp_path / "cache.sqlite"):
        replay = cached(open_backend(card), card, file)
        replay.complete([replace(BASE, id="00000-9-0/v1")])
    assert files == [None, tmp_path / "cache.sqlite"]


def asked_at(servers: Sequence[Server], file: Path) -> str:
    """The text that a card with a list of servers gets through the cache."""
    card = cards.load("openai-example")
    assert card.server is not None
    named = replace(card.server, base_url=tuple(there.url for there in servers))
    card = replace(card, weights="m", server=named)
    [answer] = cached(open_backend(card), card, file).complete([BASE])
    return answer.text


def saying(text: str) -> AbstractContextManager[Server]:
    return serving(lambda asked: asked.reply(completion(text)))


@pytest.mark.slow
def test_answers_of_a_strangers_server_are_not_those_of_ones_own(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both list the same model; a card that came from somewhere was run first."""
    with saying("evil") as evil, saying("good") as good, saying("better") as better:
        assert asked_at([evil], file) == asked_at([evil], file) == "evil"
        assert len(evil.asked) == 1
        assert asked_at([good], file) == "good"
        assert asked_at([good, better], file) == "good", "it is among today's"
        assert (len(good.asked), len(better.asked)) == (1, 0)
        assert asked_at([evil], file) == "evil", "nothing was replaced"
        monkeypatch.setenv("SWARMDRIVE_SAME_SERVERS", f"{good.url}, http://elsewhere*")
        assert asked_at([better], file) == "better", "one that the user does not name"
        monkeypatch.setenv("SWARMDRIVE_SAME_SERVERS", f"{good.url},{better.url[:-1]}*")
        assert asked_at([good], file) == "good"
        assert asked_at([better], file) == "good", "the user says that both serve the same"
        assert asked_at([evil], file) == "evil"
        assert len(better.asked) == 1
        monkeypatch.setenv("SWARMDRIVE_SAME_SERVERS", better.url)
        assert asked_at([better], file) == "better", (
            "the user says no more of what was kept of the other"
        )


def test_an_answer_is_kept_where_one_server_gave_it(file: Path) -> None:
    """The orders of a read-out's list may come from several, if one breaks down on the way."""
    for server, asked in ((None, [1, 1]), ("http://other/v1", [1, 1]), ("http://a/v1", [1, 0])):
        talker = Talker(
            {"00000-0/v1": Completion("00000-0/v1", "x", 1, 1, "stop", None, 1, server=server)}
        )
        talker.several = ("http://a/v1", "http://b/v1")
        for count in asked:
            before = len(talker.asked)
            Cached(talker, file).complete([BASE])
            assert len(talker.asked) - before == count


@pytest.mark.slow
def test_a_served_models_answers_are_kept_and_its_key_is_not(
    small_path: Path, tmp_path: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "sk-5ecret")
    data = load(small_path, limit=1)
    with serving(lambda asked: asked.reply(completion(digest(asked.body)))) as there:
        card = cards.load("openai-example")
        assert card.server is not None
        card = replace(card, server=replace(card.server, base_url=there.url))
        spec = Spec(
            Agent(card, prompts.load("v2")), FrozenSource(data), tuple(POINTS.values()), (0,)
        )
        manifests = [
            evaluate(spec, tmp_path / name, lambda done: None, file).manifest
            for name in ("first", "again")
        ]
    asked = len(answers_of(tmp_path / "first"))
    assert [m.cached_answers for m in manifests] == [0, asked]
    assert not any(b"5ecret" in path.read_bytes() for path in tmp_path.rglob("*") if path.is_file())


@pytest.mark.exhaustive
def test_a_gguf_files_answers_are_kept_too(small_path: Path, tmp_path: Path, file: Path) -> None:
    """Its prompts are rendered in another process."""
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    pytest.importorskip("torch", reason="needs the transformers extra")
    import tiny_qwen3

    from harness.backends import gguf_export

    folder = tiny_qwen3.build(tmp_path / "tiny", context_tokens=2048)
    gguf_export.export(folder, tmp_path / "tiny.gguf", "F32")
    card = replace(cards.resolve(str(tmp_path / "tiny.gguf")), max_new_tokens=6)
    source = FrozenSource(load(small_path, limit=1))
    spec = Spec(Agent(card, prompts.load("v2")), source, tuple(POINTS.values()), (0,))
    for name in ("first", "again"):
        done = evaluate(spec, tmp_path / name, lambda done: None, file)
    answers = answers_of(tmp_path / "again")
    assert done.manifest.cached_answers == len(answers)
    assert [a.raw for a in answers] == [a.raw for a in answers_of(tmp_path / "first")]


@pytest.mark.slow
def test_engines_without_a_language_model_are_not_cached(
    small: Dataset, tmp_path: Path, file: Path
) -> None:
    for model in ("proxy", "local-view"):
        card = cards.load(model)
        backend = open_backend(card)
        assert cached(backend, card, file) is backend
        evaluate(spec_of(small, model), tmp_path / model, lambda done: None, file)
    assert not file.exists()
    assert isinstance(cached(Talker(), cards.load("openai-example"), file), Cached)


@pytest.mark.parametrize(
    ("dtype", "asked_again"), [("float32", False), ("bfloat16", True), ("Q4_1", True)]
)
def test_a_batch_size_is_part_of_a_question_unless_weights_are_float32(
    dtype: str, asked_again: bool, file: Path
) -> None:
    class Rounded(Talker):
        batch_size = 8

        def identity(self) -> dict[str, Any]:
            return {**super().identity(), "dtype": dtype}

    Cached(Rounded(), file).complete([BASE])
    single = Rounded()
    single.batch_size = 1
    assert [c.cached for c in Cached(single, file).complete([BASE])] == [not asked_again]
    assert [c.cached for c in Cached(Rounded(), file).complete([BASE])] == [True]
