"""Pictures through llama.cpp: a real tiny Qwen3-VL with random weights,
held to the engine transformers.
"""

import json
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiers import some

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("transformers", reason="needs the transformers extra")
pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
try:
    import llama_cpp.mtmd_cpp  # noqa: F401
except OSError:
    pytest.skip("needs a llama-cpp-python that reads pictures", allow_module_level=True)

import tiny_vl
from hypothesis import given, settings
from hypothesis import strategies as st
from test_eyes import drawn

from harness.backends.base import Request
from harness.backends.card import Card, Latency
from harness.backends.gguf_export import export, projector_of
from harness.backends.llama_cpp.engine import LlamaEngine, open_here
from harness.backends.llama_cpp.model import LlamaModel
from harness.backends.llama_cpp.projector import Projector
from harness.backends.registry import missing, open_backend
from harness.backends.vision import Vision
from harness.backends.weights import find_gguf
from harness.core.arrays import Floats
from harness.core.errors import UserError
from harness.core.files import sha256_file
from harness.core.image import Image

pytestmark = pytest.mark.slow  # a whole file, for `make quick` not to import torch

# llama.cpp rounds pixels, their patches' weights and GELU to half precision, in files of any
# precision; the weights here are so large that two pictures differ by a hundred times as much.
ROUNDED, APART = 0.02, 1.0
VISION = Vision(320, 224, patch_px=16, merge=2, least_px=65536, most_px=1 << 24)
TOKENS = 70
A, B, C = (drawn(seed, VISION.size_px) for seed in (1, 2, 3))
Prompt = Sequence[int | Image]


@pytest.fixture(scope="module", params=[(), (0,)], ids=["plain", "deepstack"])
def tiny(request: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tiny_vl.build(tmp_path_factory.mktemp("models") / "tiny", deepstack=request.param)
    export(folder, folder / "F32.gguf", "F32")
    return folder


@pytest.fixture(scope="module")
def theirs(tiny: Path) -> Any:
    """What transformers makes of the same checkpoint."""
    card = Card(
        "tiny", "transformers", "d", Latency("paper", None, "b"), weights=str(tiny), vision=VISION
    )
    return open_backend(card, device="cpu", dtype="float32")


@pytest.fixture
def engine(tiny: Path) -> LlamaEngine:
    return engine_of(tiny)


def card_of(folder: Path, **fields: Any) -> Card:
    given = {
        "weights": str(folder),
        "file": "F32.gguf",
        "projector": "mmproj-F32.gguf",
        "vision": VISION,
    }
    return Card("tiny", "llama-cpp", "d", Latency("paper", None, "b"), **{**given, **fields})


def engine_of(folder: Path, places: int = 4) -> LlamaEngine:
    file = folder / "F32.gguf"
    model = LlamaModel("tiny", file, "cpu")
    projector = Projector("tiny", projector_of(file), model, VISION)
    return LlamaEngine(card_of(folder), file, model, places, projector)


def tokens(engine: Any, prompt: Prompt) -> list[int]:
    return [
        t for part in prompt for t in (engine.look(part) if isinstance(part, Image) else [part])
    ]


def begin(engine: Any, *prompts: Prompt) -> Any:
    return engine.begin([tokens(engine, prompt) for prompt in prompts])


def naive(theirs: Any, prompts: Sequence[Prompt]) -> Floats:
    """Log-probabilities of the next token by transformers, from scratch for each prompt."""
    found = []
    for prompt in prompts:
        with closing(begin(theirs.engine, prompt)) as session:
            found.append(session.log_probs()[0])
    return np.stack(found)


SYSTEM = [1, *range(40, 44)]
START, END = 3, 4


def prompt(image: Image, *rest: int) -> Prompt:
    return [*SYSTEM, START, image, END, *rest]


# -- what the two engines say ----------------------------------------------------------------------


def test_after_a_picture_it_says_what_transformers_says(engine: LlamaEngine, theirs: Any) -> None:
    asked = [prompt(A, 80, 90), prompt(B, 80, 90), [*SYSTEM, 80, 90]]
    expected = naive(theirs, asked)
    found = begin(engine, *asked).log_probs()
    np.testing.assert_allclose(found[:2], expected[:2], atol=ROUNDED)
    np.testing.assert_allclose(found[2], expected[2], atol=1e-4)  # no picture, nothing rounded
    assert np.abs(found[0] - found[1]).max() > APART
    assert np.abs(found[0] - found[2]).max() > APART


def test_what_is_written_behind_a_picture_stands_where_transformers_puts_it(
    engine: LlamaEngine, theirs: Any
) -> None:
    session = begin(engine, prompt(A, 80), prompt(B, 81, 82))
    session.advance([[90, 91], [92]])
    session.advance([[], [93]])
    expected = naive(theirs, [prompt(A, 80, 90, 91), prompt(B, 81, 82, 92, 93)])
    np.testing.assert_allclose(session.log_probs(), expected, atol=ROUNDED)


def test_two_pictures_and_one_twice_in_a_prompt(engine: LlamaEngine, theirs: Any) -> None:
    asked = [[1, A, 50, B, 51], [1, B, 50, A, 51], [1, A, 50, A, 51]]
    expected = naive(theirs, asked)
    np.testing.assert_allclose(begin(engine, *asked).log_probs(), expected, atol=ROUNDED)


def test_a_batch_says_what_each_prompt_alone_would(engine: LlamaEngine, tiny: Path) -> None:
    asked = [prompt(A, 80), prompt(B, 80, 81), [*SYSTEM, 70], prompt(A, 82)]
    together = begin(engine, *asked).log_probs()
    for row, alone in zip(together, asked, strict=True):
        np.testing.assert_allclose(begin(engine_of(tiny), alone).log_probs()[0], row, atol=1e-3)


@pytest.fixture(scope="module")
def played(tiny: Path) -> LlamaEngine:
    return engine_of(tiny)


TEXT = st.lists(st.integers(10, 300), min_size=1, max_size=3)
SHOWN = st.sampled_from([A, B, C]).map(lambda image: [START, image, END])
PROMPT = st.lists(TEXT | SHOWN, min_size=1, max_size=4).map(
    lambda parts: [t for part in parts for t in part]
)


@settings(max_examples=12)
@given(st.lists(PROMPT, min_size=1, max_size=3), st.lists(PROMPT, max_size=2))
def test_texts_and_pictures_in_any_order_in_any_company(
    played: LlamaEngine, theirs: Any, prompts: list[Prompt], more: list[Prompt]
) -> None:
    with closing(begin(played, *prompts)) as session:
        for chunk in more:
            session.advance([tokens(played, chunk)] * len(prompts))
            prompts = [[*p, *chunk] for p in prompts]
        expected = naive(theirs, prompts)
        np.testing.assert_allclose(session.log_probs(), expected, atol=ROUNDED)


# -- answers ---------------------------------------------------------------------------------------


def question(n: int, image: Image | None, answer: Any, text: str = "Scene") -> Request:
    shown = {"image": "camera"} if image else {}
    return Request(
        id=f"s{n}/v1", role="ego", actions=("SLOWER", "IDLE", "FASTER"), max_tokens=64, answer=answer,
        messages=({"role": "system", "content": 
            "You drive."}, {"role": "user", "content": text, **shown}),
        image=image,
    )  # fmt: skip


@pytest.mark.parametrize("answer", some(["json"], exhaustive=["constrained", "readout"]))
def test_a_backend_answers_what_its_picture_shows(
    tiny: Path, theirs: Any, answer: str, capfd: pytest.CaptureFixture[str]
) -> None:
    asked = [
        question(0, A, answer),
        question(1, B, answer, "Another, longer"),
        question(2, None, answer),
    ]
    card = card_of(tiny)
    # one of the three, since a process takes longer to start than to answer
    in_a_child = answer == "readout"
    backend = (
        open_backend(card, batch_size=3)
        if in_a_child
        else open_here(card, find_gguf(card), None, 3)
    )
    together = backend.complete(asked)
    assert [c.error for c in together] == [None] * 3
    assert [c.prompt_tokens for c in together] == [c.prompt_tokens for c in theirs.complete(asked)]
    if answer == "readout":
        for ours, hers in zip(together, theirs.complete(asked), strict=True):
            p, q = (json.loads(c.text)["action_distribution"] for c in (ours, hers))
            assert p == pytest.approx(q, abs=ROUNDED)
    else:
        assert [backend.complete([request])[0].text for request in asked] == [
            c.text for c in together
        ]
    shown = [question(0, image, answer) for image in (A, B, C, A)]
    first, *others, same = (c.text for c in backend.complete(shown))
    assert first == same
    assert first not in others
    assert capfd.readouterr() == ("", ""), "llama.cpp has much to say of a projector"


@pytest.mark.exhaustive
def test_parity_is_measured_with_pictures_too(tiny: Path, theirs: Any) -> None:
    asked, letters = (
        [question(n, image, how) for n, image in enumerate((A, B))] for how in ("json", "readout")
    )
    compare = pytest.importorskip("harness.extensions.checkups.parity").compare
    compared = compare(theirs.engine.card, card_of(tiny), asked, letters, lambda done: None)
    found = {finding.what: finding for finding in compared.findings}
    assert found["F32: token ids equal"].measured == 1.0
    assert 1e-6 < found["F32: largest difference of a logit"].measured < ROUNDED
    assert found["F32: largest difference of a read-out"].measured < ROUNDED
    assert found["transformers: text equal in reversed batches of 8"].holds


def test_who_reads_pictures_with_which_projector_is_part_of_a_backends_identity(tiny: Path) -> None:
    identity = open_backend(card_of(tiny)).identity()
    assert identity["projector_sha256"] == sha256_file(tiny / "mmproj-F32.gguf")
    assert "projector" not in open_backend(card_of(tiny, projector=None, vision=None)).identity()


# -- what is computed once -------------------------------------------------------------------------


@pytest.fixture
def read(engine: LlamaEngine, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many tokens each call of llama.cpp reads."""
    counts: list[int] = []
    call = engine.context._call

    def counted(inputs: Any, *rest: Any) -> int:
        counts.append(len(inputs))
        return call(inputs, *rest)

    monkeypatch.setattr(engine.context, "_call", counted)
    return counts


@pytest.fixture
def encoded(engine: LlamaEngine, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The digest of each picture that is encoded."""
    digests: list[str] = []
    encode = engine._projector._encode

    def noted(image: Image) -> Any:
        digests.append(image.sha256)
        return encode(image)

    monkeypatch.setattr(engine._projector, "_encode", noted)
    return digests


def test_a_beginning_ends_before_or_behind_a_picture_and_is_not_read_again(
    engine: LlamaEngine, theirs: Any, read: list[int]
) -> None:
    head = len(SYSTEM) + 1
    for asked, count in [
        ([prompt(A, 80), prompt(B, 80, 81)], head + 2 * (TOKENS + 1) + 3),  # they share the head
        ([prompt(B, 82), prompt(C, 80)], 2 * (TOKENS + 1) + 2),
        ([prompt(C, 83, 84), prompt(C, 83, 85)], TOKENS + 2 + 2),  # and now a picture as well
        ([prompt(C, 83, 84, 86)], 2),
    ]:
        read.clear()
        session = begin(engine, *asked)
        np.testing.assert_allclose(session.log_probs(), naive(theirs, asked), atol=ROUNDED)
        session.close()
        assert sum(read) == count


def test_a_picture_is_encoded_once_unless_its_prompt_alone_is_asked_again(
    engine: LlamaEngine, encoded: list[str]
) -> None:
    same = Image(A.pixels.copy())
    for asked in (
        [prompt(A, 80), prompt(same, 81)],
        [prompt(A, 82), prompt(B, 80)],
        [prompt(A, 83, 84)],
    ):
        begin(engine, *asked).close()
    assert encoded == [A.sha256, B.sha256]
    begin(engine, prompt(A, 83)).close()
    assert encoded == [A.sha256, B.sha256, A.sha256]


def test_memory_grows_with_pictures_in_it_and_nothing_is_lost(
    engine: LlamaEngine, theirs: Any
) -> None:
    prompts = [prompt(image, 80) for image in (A, B, C)]
    session = begin(engine, *prompts)
    room = engine.context._room
    for step in range(20):
        chunks = [[(step * 31 + i * 7 + j) % 300 + 10 for j in range(25)] for i in range(3)]
        session.advance(chunks)
        prompts = [[*p, *chunk] for p, chunk in zip(prompts, chunks, strict=True)]
    assert engine.context._room > room
    np.testing.assert_allclose(session.log_probs(), naive(theirs, prompts), atol=ROUNDED)


def test_a_beginning_whose_picture_nobody_has_any_more_is_left_behind(engine: LlamaEngine) -> None:
    begin(engine, prompt(Image(A.pixels.copy()), 80)).close()
    assert len(engine.context.tokens) == 1
    engine._projector._pictures._encoded.clear()
    session = begin(engine, prompt(B, *range(100, 300)))
    session.advance([list(range(10, 310))])  # beyond the room there is
    lost, kept = engine.look(A)[0], engine.look(B)[0]
    held = list(engine.context.tokens.values())
    assert (sum(lost in each for each in held), sum(kept in each for each in held)) == (0, 2)


def test_its_tokens_are_negative_the_same_for_the_same_pixels_and_others_for_others(
    engine: LlamaEngine, tiny: Path
) -> None:
    seen = engine.look(A)
    assert len(set(seen)) == VISION.tokens == TOKENS
    assert max(seen) < 0
    assert seen == engine_of(tiny).look(Image(A.pixels.copy()))
    assert set(seen).isdisjoint(engine.look(B))


# -- what a user can get wrong ---------------------------------------------------------------------


def opened(card: Card) -> UserError:
    """What is wrong with a card's files, as it is found in this process."""
    with pytest.raises(UserError) as caught:
        open_here(card, find_gguf(card), None, 1)
    assert "\n" not in str(caught.value)
    return caught.value


def test_a_projector_that_is_not_there_is_named(tiny: Path) -> None:
    card = card_of(tiny, projector="mmproj-gone.gguf")
    assert f"no projector {tiny / 'mmproj-gone.gguf'}; put it beside" in str(opened(card))
    assert missing(card) == "weights"


def test_a_file_that_is_no_projector_is_named(tiny: Path) -> None:
    assert "with projector" in str(opened(card_of(tiny, projector="F32.gguf")))
    assert "config.json does not load" in str(opened(card_of(tiny, projector="config.json")))


def test_a_projector_of_another_model_is_refused(tiny: Path, tmp_path: Path) -> None:
    # as wide, but it gets features three times
    other = tiny_vl.build(tmp_path / "other", deepstack=[0, 1])
    export(other, other / "F32.gguf", "F32")
    (other / "mmproj-F32.gguf").write_bytes((tiny / "mmproj-F32.gguf").read_bytes())
    assert "mismatch between text model (n_embd = 96)" in str(opened(card_of(other)))


def test_a_card_that_counts_other_tokens_is_refused(tiny: Path) -> None:
    wrong = replace(VISION, merge=1, least_px=None, most_px=None)
    assert "makes 70 tokens of 320 x 224 pixels, and its card's [vision] 280" in str(
        opened(card_of(tiny, vision=wrong))
    )


def test_a_build_that_reads_no_pictures_says_how_to_get_one(
    tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "llama_cpp.mtmd_cpp", None)
    with pytest.raises(UserError, match="built here without what reads pictures; run `pip install"):
        engine_of(tiny)


def test_a_model_without_a_projector_takes_no_picture(tiny: Path) -> None:
    file = tiny / "F32.gguf"
    blind = LlamaEngine(card_of(tiny), file, LlamaModel("tiny", file, "cpu"), 1)
    with pytest.raises(ValueError, match="takes no pictures"):
        blind.look(A)
    assert blind.chat.image_token is None
    assert engine_of(tiny).chat.image_token == "<|image_pad|>"
