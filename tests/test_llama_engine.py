"""The llama.cpp engine, played on a real tiny Qwen3 with random weights,
exported to a GGUF file.
"""

import json
import os
import shutil
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("transformers", reason="needs the transformers extra")
pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")

import tiny_qwen3
from evaluating import scenes_of, spec_of
from hypothesis import given, settings
from hypothesis import strategies as st
from test_transformers_engine import COMMIT, REQUESTS, ask, open_tiny, said

from harness.backends import registry
from harness.backends.base import Request
from harness.backends.card import Card, Latency
from harness.backends.gguf_export import export
from harness.backends.language_model import LanguageModel
from harness.backends.llama_cpp.backend import LlamaBackend
from harness.backends.llama_cpp.engine import LlamaEngine, LlamaSession, open_here
from harness.backends.llama_cpp.model import LlamaModel
from harness.backends.registry import missing, open_backend
from harness.backends.weights import check_digest, find_gguf, sha256_weights
from harness.core import resources
from harness.core.arrays import Floats
from harness.core.errors import UserError
from harness.core.files import sha256_bytes, sha256_file
from harness.dataset.load import Dataset
from harness.evaluate.requests import requests
from harness.prompts import readout

pytestmark = pytest.mark.slow  # a whole file, for `make quick` not to import torch

VOCABULARY = 375


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint with its weights as F32 and F16 in GGUF files."""
    folder = tiny_qwen3.build(tmp_path_factory.mktemp("models") / "tiny-qwen3")
    export(folder, folder / "F32.gguf", "F32")
    export(folder, folder / "F16.gguf", "F16")
    return folder


@pytest.fixture(scope="module")
def theirs(tiny: Path) -> Any:
    """What transformers makes of the same checkpoint."""
    return open_tiny(tiny)


@pytest.fixture(scope="module")
def backend(tiny: Path) -> LlamaBackend:
    return open_gguf(tiny / "F32.gguf")


@pytest.fixture(scope="module")
def engine(tiny: Path) -> LlamaEngine:
    return engine_of(tiny / "F32.gguf")


def card_of(weights: Path, **fields: Any) -> Card:
    latency = Latency("paper", None, "b")
    return Card("tiny", "llama-cpp", "d", latency, **{"weights": str(weights), **fields})


def open_gguf(file: Path, batch_size: int = 8, **options: str) -> LlamaBackend:
    opened = open_backend(card_of(file), batch_size=batch_size, **options)
    assert isinstance(opened, LlamaBackend)
    return opened


def opened_here(file: Path, batch_size: int = 8) -> LanguageModel:
    """The same in this process, which takes no second to start;
    the child's errors are those of here.
    """
    return open_here(card_of(file), file, None, batch_size)


def engine_of(file: Path, places: int = 8) -> LlamaEngine:
    return LlamaEngine(card_of(file), file, LlamaModel("tiny", file, "cpu"), places)


def naive(theirs: Any, sequences: list[list[int]]) -> Floats:
    """Log-probabilities of the next token,
    by a forward of transformers from scratch for each sequence.
    """
    import torch

    with torch.no_grad():
        logits = [
            theirs.engine.model(torch.tensor([ids])).logits[0, -1].double() for ids in sequences
        ]
    found: Floats = torch.log_softmax(torch.stack(logits), -1).numpy()
    return found


def next_of(session: LlamaSession) -> Floats:
    return session.log_probs(range(VOCABULARY))


PROMPTS = [[1, 7, 8, *range(20, 20 + n), 9] for n in (4, 11, 1, 30, 17)]
TOKENS = st.lists(st.integers(0, VOCABULARY - 1), max_size=5)


# -- what goes in ----------------------------------------------------------------------------------


@pytest.mark.parametrize("prompt", ["v1", "v2"])
def test_every_prompt_of_an_episode_is_the_same_text_and_the_same_tokens(
    engine: LlamaEngine, theirs: Any, small: Dataset, prompt: str
) -> None:
    asked = list(requests(spec_of(small, prompt=prompt), scenes_of(small)))[::5]
    assert len(asked) > 9
    for thinking in (False, True):
        for request in asked:
            text = engine.chat.render(request.messages, thinking=thinking)
            assert text == theirs.chat.render(request.messages, thinking=thinking)
            ids = engine.chat.encode(text)
            assert ids == theirs.chat.encode(text)
            assert engine.chat.decode(ids) == theirs.chat.decode(ids)


@given(st.text(st.characters(codec="utf-8")))
def test_any_text_is_the_same_tokens(engine: LlamaEngine, theirs: Any, text: str) -> None:
    assert engine.chat.encode(text) == theirs.chat.encode(text)


@given(st.lists(st.integers(0, VOCABULARY - 1), max_size=12))
def test_any_tokens_are_the_same_text(engine: LlamaEngine, theirs: Any, ids: list[int]) -> None:
    assert engine.chat.decode(ids) == theirs.chat.decode(ids)


def test_special_tokens_are_read_whole_and_thoughts_stay_in_the_text(engine: LlamaEngine) -> None:
    ids = engine.chat.encode("<|im_start|>a<think>b</think><|im_end|>")
    assert len(ids) == 6
    assert engine.chat.decode(ids) == "a<think>b</think>"


# -- logits ----------------------------------------------------------------------------------------


def test_f32_says_what_transformers_says_to_the_fifth_digit(
    engine: LlamaEngine, theirs: Any
) -> None:
    session = engine.begin(PROMPTS)
    np.testing.assert_allclose(next_of(session), naive(theirs, PROMPTS), atol=1e-4)
    session.close()


def test_f16_says_nearly_so(tiny: Path, theirs: Any) -> None:
    session = engine_of(tiny / "F16.gguf").begin(PROMPTS)
    np.testing.assert_allclose(next_of(session), naive(theirs, PROMPTS), atol=0.2)


def test_argmax_is_of_all_tokens_or_of_those_listed_and_the_lowest_id_wins_a_tie(
    engine: LlamaEngine, theirs: Any
) -> None:
    session = engine.begin(PROMPTS[:3])
    best = naive(theirs, PROMPTS[:3])
    assert session.argmax([None, [9, 300, 3], [5]]) == [
        best[0].argmax(),
        max((3, 9, 300), key=best[1].__getitem__),
        5,
    ]
    session._logits[0, [40, 12, 77]] = 99.0
    assert session.argmax([None, [1], [1]])[0] == 12
    assert session.argmax([[77, 40], [1], [1]])[0] == 40
    session.close()


@settings(max_examples=25)
@given(st.data())
def test_whatever_way_sequences_go_it_is_as_if_each_were_read_from_scratch(
    engine: LlamaEngine, theirs: Any, data: st.DataObject
) -> None:
    head = data.draw(TOKENS)
    sequences = data.draw(st.lists(TOKENS.map(lambda t: [*head, *t, 3]), min_size=1, max_size=5))
    with closing(engine.begin(sequences)) as session:
        for _ in range(data.draw(st.integers(0, 3))):
            if data.draw(st.booleans()):
                chunks = [data.draw(TOKENS) for _ in sequences]
                session.advance(chunks)
                sequences = [old + new for old, new in zip(sequences, chunks, strict=True)]
            else:
                places = data.draw(st.permutations(range(len(sequences))))[
                    : data.draw(st.integers(1, 5))
                ]
                session.keep(places)
                sequences = [sequences[place] for place in places]
            np.testing.assert_allclose(next_of(session), naive(theirs, sequences), atol=1e-3)
    assert sorted(engine._free) == list(range(8))


def test_a_beginning_kept_from_before_changes_nothing_and_is_not_computed_again(
    tiny: Path, theirs: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = engine_of(tiny / "F32.gguf")
    computed: list[int] = []
    call = engine.context._call

    def counted(token: Any, *rest: Any) -> int:
        computed.append(len(token))
        return call(token, *rest)

    monkeypatch.setattr(engine.context, "_call", counted)
    system, helper = list(range(3, 103)), list(range(200, 300))
    for asked, tokens in [
        ([[*system, 5, 6], [*system, 7]], 100 + 3),
        ([[*system, 8], [*system, 9, 9]], 3),
        ([[*system, 5, 6]], 2),
        ([[*helper, 5, 6]], 102),
        ([[*system[:90], 5], [*system[:90], 6]], 2),
        ([[*helper, 5, 7], [*helper, 8]], 3),
        # asked again alone, it is read again: else its time would be no answer's
        ([[*helper, 5, 6]], 102),
        ([[*system, 5], [*helper, 9], [*system, 6], [*helper, 7, 8]], 5),  # a batch with both
    ]:
        computed.clear()
        session = engine.begin(asked)
        np.testing.assert_allclose(next_of(session), naive(theirs, asked), atol=1e-4)
        session.close()
        assert sum(computed) == tokens
    assert len(engine.context.tokens) == 2, "two beginnings are kept, and no sequence"


def test_memory_grows_with_the_sequences_and_nothing_is_lost(tiny: Path, theirs: Any) -> None:
    engine = engine_of(tiny / "F32.gguf")
    sequences = [[*range(3, 103), i] for i in range(8)]
    session, other = engine.begin(sequences[:7]), engine.begin(sequences[7:])
    room = engine.context._room
    for step in range(18):
        chunks = [[(step * 31 + i * 7 + j) % VOCABULARY for j in range(25)] for i in range(7)]
        session.advance(chunks)
        sequences[:7] = [old + new for old, new in zip(sequences, chunks, strict=False)]
    assert engine.context._room > room
    np.testing.assert_allclose(next_of(session), naive(theirs, sequences[:7]), atol=1e-4)
    other.advance([[5]])
    np.testing.assert_allclose(next_of(other), naive(theirs, [[*sequences[7], 5]]), atol=1e-4)


def test_tokens_that_are_none_fail_and_the_next_prompts_do_not(tiny: Path, theirs: Any) -> None:
    engine = engine_of(tiny / "F32.gguf")
    with pytest.raises(RuntimeError, match=r"llama_decode returned -1: .*token"):
        engine.begin([[1, 2], [VOCABULARY, 2]])
    session = engine.begin(PROMPTS)
    np.testing.assert_allclose(next_of(session), naive(theirs, PROMPTS), atol=1e-4)
    with pytest.raises(ValueError, match="4 prompts for 3 free places"):
        engine.begin(PROMPTS[:4])


# -- answers ---------------------------------------------------------------------------------------


def in_mode(request: Request, answer: Any) -> Request:
    messages = request.messages
    if answer == "readout":
        messages = readout.letter_chat(messages, request.actions)
    return replace(request, answer=answer, messages=messages, max_tokens=32)


@pytest.mark.parametrize("answer", ["json", "constrained", "readout"])
def test_in_every_mode_it_answers_as_transformers_does(
    backend: LlamaBackend, theirs: Any, answer: str
) -> None:
    asked = [in_mode(request, answer) for request in REQUESTS]
    ours, hers = backend.complete(asked), theirs.complete(asked)
    assert {c.finish_reason for c in ours} <= {"stop", "length"}
    if answer == "readout":
        for mine, other in zip(ours, hers, strict=True):
            assert json.loads(mine.text)["action_distribution"] == pytest.approx(
                json.loads(other.text)["action_distribution"], abs=1e-4
            )
            assert mine.label_mass == pytest.approx(other.label_mass, rel=1e-3)
    else:
        assert said(ours) == said(hers)
        assert len({c.text for c in ours}) > 5, "answers that are all alike would show nothing"


@pytest.mark.parametrize("batch_size", [1, 3])
def test_a_batch_says_what_each_request_alone_would(
    tiny: Path, backend: LlamaBackend, batch_size: int
) -> None:
    other = opened_here(tiny / "F32.gguf", batch_size)
    assert said(other.complete(REQUESTS)) == said(backend.complete(REQUESTS))


def test_seconds_belong_to_an_answer_that_was_asked_alone(backend: LlamaBackend) -> None:
    [alone] = backend.complete(REQUESTS[:1])
    assert (alone.batch_size, alone.seconds is not None) == (1, True)
    assert {c.seconds for c in backend.complete(REQUESTS[:3])} == {None}


def test_a_prompt_that_leaves_no_room_is_an_error_and_its_neighbours_are_answered(
    backend: LlamaBackend,
) -> None:
    first, over, last = backend.complete([ask(0), ask(1, text="truck " * 600), ask(2)])
    assert "context overflow" in str(over.error)
    assert said([first, last]) == said(backend.complete([ask(0), ask(2)]))


def test_the_cards_bound_on_the_context_comes_first(tiny: Path) -> None:
    backend = open_backend(card_of(tiny / "F32.gguf", context_tokens=30))
    assert "tokens > 30" in str(backend.complete([ask(0)])[0].error)


def test_its_chat_can_be_asked_from_here(backend: LlamaBackend, theirs: Any) -> None:
    text = backend.chat.render(ask(0).messages, thinking=True)
    assert text == theirs.chat.render(ask(0).messages, thinking=True)
    assert (backend.chat.thinking, backend.chat.template) == ("switch", theirs.chat.template)
    assert backend.chat.encode(text) == theirs.chat.encode(text)
    assert backend.chat.decode(backend.chat.encode("14 m")) == "14 m"
    assert backend.chat.bos == 0


# -- what a user can get wrong ---------------------------------------------------------------------


def rename(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    assert len(old) == len(new)
    return lambda data: data.replace(old, new)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (
            lambda data: data[:-1000],
            "does not load: .*corrupted or incomplete.*download the file again",
        ),
        (lambda data: data[:100], "does not load"),
        (lambda data: b"", "does not load: .*magic"),
        (lambda data: b"PK" + data, "does not load: .*invalid magic characters"),
        (
            rename(b"token_embd.weight", b"token_embX.weight"),
            "does not load: .*token_embd.weight' not found",
        ),
        (
            rename(b"tokenizer.chat_template", b"tokenizer.chat_templatX"),
            "no chat template; give .*instruct",
        ),
        (rename(b"{%- endfor %}", b"{%- endfro %}"), r"its chat template is no Jinja \(.*endfro"),
        (rename(b"qwen3", b"qwen0"), "does not load: .*unknown model architecture: 'qwen0'"),
    ],
)
def test_a_spoilt_file_is_one_line_with_what_and_where(
    tiny: Path, tmp_path: Path, spoil: Callable[[bytes], bytes], said: str
) -> None:
    file = tmp_path / "spoilt.gguf"
    file.write_bytes(spoil((tiny / "F32.gguf").read_bytes()))
    with pytest.raises(UserError, match=f"'tiny'.*{said}") as caught:
        opened_here(file)
    assert "\n" not in str(caught.value)


def test_a_vocabulary_without_weights_is_refused() -> None:
    file = Path(__file__).parents[2] / "shared" / "tokenizer" / "qwen2-vocab-only.gguf"
    if not file.is_file():
        pytest.skip("needs Qwen's own vocabulary")
    with pytest.raises(UserError, match=r"does not load: .*token_embd.weight' not found"):
        open_gguf(file)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dtype": "float32"}, "dtype 'float32'; a GGUF file has its own: leave it out"),
        ({"batch_size": 0}, "batch size 0; allowed: 1 or more"),
    ],
)
def test_an_option_that_cannot_be_names_what_can(tiny: Path, options: Any, message: str) -> None:
    with pytest.raises(UserError, match=message):
        open_gguf(tiny / "F32.gguf", **options)


def test_what_cannot_be_is_said_in_the_child_as_well(tiny: Path) -> None:
    with pytest.raises(UserError, match=r"device 'cuda:7'; llama.cpp as it is built here has: cpu"):
        open_gguf(tiny / "F32.gguf", device="cuda:7")
    with pytest.raises(UserError, match=r"'tiny'.*does not load"):
        open_gguf(tiny / "config.json")
    with pytest.raises(UserError, match=r"batch size 10000; llama.cpp takes 253 at most"):
        open_gguf(tiny / "F32.gguf", batch_size=10_000)


def test_without_the_package_it_says_how_to_get_it(
    tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(registry, "find_spec", lambda name: None)
    card = card_of(tiny / "F32.gguf")
    assert missing(card) == "llama-cpp-python"
    with pytest.raises(UserError, match=r"pip install 'swarmdrive-harness\[llama-cpp\]'"):
        open_backend(card)


# -- where it lies, and what it is -----------------------------------------------------------------


def test_a_file_is_found_by_its_path_beside_the_cards_or_in_a_folder(
    tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resources, "folder", lambda kind: tiny.parent)
    for card in (
        card_of(tiny / "F32.gguf"),
        card_of(Path("tiny-qwen3/F32.gguf")),
        card_of(Path("tiny-qwen3"), file="F32.gguf"),
    ):
        assert find_gguf(card) == tiny / "F32.gguf"
        assert missing(card) is None


def test_a_file_that_is_nowhere_says_what_to_give_or_to_run(tmp_path: Path) -> None:
    gone = card_of(tmp_path / "gone.gguf")
    with pytest.raises(UserError, match=r"no file .*gone\.gguf; give the path of a \.gguf file"):
        open_backend(gone)
    assert missing(gone) == "weights"
    with pytest.raises(UserError, match="give the path"):
        open_backend(card_of(tmp_path, file="gone.gguf"))
    hub = replace(gone, weights="nobody/no-such-model", file="m-Q4_K_M.gguf", revision="v9")
    with pytest.raises(UserError, match="run `harness model pull tiny`"):
        open_backend(hub)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda part: None, None),
        (lambda part: part.write_bytes(b"other weights"), "is not what its card says"),
        (lambda part: part.unlink(), r"no file .*m-00002-of-00002\.gguf, of the model's 2 files"),
        (lambda part: (part.unlink(), os.mkfifo(part)), r"no file .*m-00002-of-00002\.gguf"),
    ],
)
def test_a_file_that_was_split_is_known_by_all_of_it(
    tmp_path: Path, spoil: Callable[[Path], object], said: str | None
) -> None:
    first, second = (tmp_path / f"m-0000{part}-of-00002.gguf" for part in (1, 2))
    first.write_bytes(b"what llama.cpp opens, ")
    second.write_bytes(b"and what that opens")
    card = card_of(first, sha256=sha256_bytes(first.read_bytes() + second.read_bytes()))
    spoil(second)
    if said is None:
        assert check_digest(card, find_gguf(card)) == first
        assert sha256_weights(first) == card.sha256
        return
    with pytest.raises(UserError, match=said) as caught:
        check_digest(card, find_gguf(card))
    assert "\n" not in str(caught.value)


def test_a_file_in_the_hubs_cache_is_known_by_its_commit(
    tiny: Path, backend: LlamaBackend, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    repository = tmp_path / "models--tiny--qwen3-GGUF"
    (repository / "snapshots" / COMMIT).mkdir(parents=True)
    shutil.copy(tiny / "F32.gguf", repository / "snapshots" / COMMIT)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(COMMIT)
    card = replace(card_of(tiny), weights="tiny/qwen3-GGUF", file="F32.gguf")
    assert missing(card) is None
    opened = open_backend(card)
    identity = opened.identity()
    assert (identity["revision"], identity["file_sha256"]) == (COMMIT, None)
    assert said(opened.complete(REQUESTS)) == said(backend.complete(REQUESTS))


def test_a_file_of_ones_own_is_known_by_its_content_and_by_what_reads_it(
    tiny: Path, backend: LlamaBackend
) -> None:
    identity = backend.identity()
    assert json.loads(json.dumps(identity)) == identity
    assert identity["file_sha256"] == sha256_file(tiny / "F32.gguf")
    assert [identity[key] for key in ("engine", "dtype", "kv_cache", "device", "revision")] == [
        "llama-cpp", "F32", "F32", "cpu", None,
    ]  # fmt: skip
    other = open_gguf(tiny / "F16.gguf").identity()
    assert {key for key in identity if identity[key] != other[key]} == {
        "weights", "file_sha256", "dtype", "kv_cache",
    }  # fmt: skip
    card = card_of(tiny / "F32.gguf", system="first-user")
    assert open_backend(card).identity() == {**identity, "system_text": "first-user"}


def test_nothing_is_said_on_stderr(tiny: Path, capfd: pytest.CaptureFixture[str]) -> None:
    opened = open_gguf(tiny / "F32.gguf")
    assert opened.complete([ask(0)])[0].error is None
    with pytest.raises(UserError, match="does not load"):
        open_gguf(tiny / "config.json")
    opened.close()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("answer", ["json", "constrained", "readout"])
def test_weights_that_are_no_numbers_are_an_error_of_the_engine_and_no_answer(
    answer: str, tmp_path: Path
) -> None:
    folder = tiny_qwen3.spoil(tiny_qwen3.build(tmp_path / "tiny"), 1234.5)  # an export refuses NaN
    file = folder / "F32.gguf"
    export(folder, file, "F32")
    marked, spoilt = (np.float32(value).tobytes() for value in (1234.5, np.nan))
    file.write_bytes(file.read_bytes().replace(marked, spoilt))
    for completion in opened_here(file).complete(
        [replace(r, answer=answer, max_tokens=80) for r in REQUESTS[:2]]
    ):
        assert completion.text == ""
        assert "the logits are no numbers" in str(completion.error)
