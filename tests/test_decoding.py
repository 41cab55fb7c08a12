"""The three answer modes, held to naive forwards of a real tiny Qwen3:
uncached, unbatched, whole.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("transformers", reason="needs the transformers extra")

import tiny_qwen3
import torch
from evaluating import scenes_of, spec_of
from hypothesis import given, settings
from hypothesis import strategies as st
from run_on_disk import UNTIMED

from harness.backends import decoding
from harness.backends.base import AnswerMode, Completion, Request
from harness.backends.cards import resolve
from harness.backends.chat import Chat, HubTokenizer
from harness.backends.decoding import Decoding
from harness.backends.language_model import LanguageModel
from harness.backends.registry import open_backend
from harness.backends.transformers.engine import TransformersEngine
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.evaluate.requests import requests
from harness.parsing.parse import parse
from harness.prompts import readout

pytestmark = pytest.mark.slow  # a whole file, for `make quick` not to import torch

ACTIONS = ("SLOWER", "IDLE", "FASTER")
LANES = ("LANE_LEFT", "IDLE", "LANE_RIGHT")
MODES: tuple[AnswerMode, ...] = ("json", "constrained", "readout")
BATCH = 8


@pytest.fixture(scope="module")
def backend(tmp_path_factory: pytest.TempPathFactory) -> LanguageModel:
    folder = tiny_qwen3.build(tmp_path_factory.mktemp("models") / "tiny-qwen3")
    opened = open_backend(resolve(str(folder)), batch_size=4, device="cpu")
    assert isinstance(opened, LanguageModel)
    return opened


def ask(
    i: int,
    answer: AnswerMode = "json",
    role: Any = "ego",
    actions: tuple[str, ...] = ACTIONS,
    **options: Any,
) -> Request:
    """Scene i, asked by a viewer of some role; helpers have another system prompt."""
    messages: Any = (
        {"role": "system", "content": f"You are the {role} and drive with care at every crossing."},
        {"role": "user", "content": f"Scene {i * 'x'}: truck {i * 7} m"},
    )
    if answer == "readout":
        messages = readout.letter_chat(messages, actions)
    options = {"max_tokens": 12 if answer == "json" else 80, **options}
    return Request(f"s{i}/{role}", role, messages, actions, answer=answer, **options)


def engine_of(backend: LanguageModel) -> TransformersEngine:
    assert isinstance(backend.engine, TransformersEngine)
    return backend.engine


def prompt_of(backend: LanguageModel, request: Request) -> list[int]:
    return backend.chat.encode(backend.chat.render(request.messages, thinking=request.thinking))


def naive(backend: LanguageModel, ids: Sequence[int]) -> Any:
    """Logits of the next token, by one forward over everything."""
    with torch.inference_mode():
        return engine_of(backend).model(torch.tensor([list(ids)])).logits[0, -1]


def best(backend: LanguageModel, ids: Sequence[int], texts: Sequence[str]) -> str:
    """Which of some texts that are one token each is the likeliest to come next."""
    tokens = [token for text in texts for token in backend.chat.encode(text)]
    assert len(tokens) == len(texts)
    return texts[int(naive(backend, ids)[tokens].argmax())]


# -- json ------------------------------------------------------------------------------------------


def test_free_text_is_what_generate_says_greedily(backend: LanguageModel) -> None:
    from transformers import GenerationConfig

    engine = engine_of(backend)
    engine.model.generation_config = config = GenerationConfig(
        do_sample=False, eos_token_id=list(engine.stops), pad_token_id=0, max_new_tokens=24
    )
    requests = [ask(i, max_tokens=24) for i in range(12)]
    lengths = set()
    for request, completion in zip(requests, backend.complete(requests), strict=True):
        ids = torch.tensor([prompt_of(backend, request)])
        out = engine.model.generate(
            ids, attention_mask=torch.ones_like(ids), generation_config=config
        )
        said = out[0, ids.shape[1] :].tolist()
        stopped = said[-1] in engine.stops
        assert completion.text == backend.chat.decode(said[:-1] if stopped else said)
        assert completion.completion_tokens == len(said)
        assert completion.finish_reason == ("stop" if stopped else "length")
        lengths.add(len(said))
    assert len(lengths) > 2, "answers of one length would not show that rows leave their batch"


@pytest.mark.exhaustive
def test_what_is_guessed_saves_forwards_and_changes_no_answer(small: Dataset) -> None:
    """On the model that ships, whose texts have a shape that can be guessed."""
    opened = open_backend(resolve("swarm-tiny", "transformers"), batch_size=BATCH, device="cpu")
    assert isinstance(opened, LanguageModel)
    asked = list(requests(spec_of(small, "swarm-tiny"), scenes_of(small)))[:BATCH]
    asked += [replace(request, max_tokens=9) for request in asked[:3]]
    alone = [opened.complete([request])[0] for request in asked]
    forwards: list[object] = []
    hook = engine_of(opened).model.register_forward_pre_hook(lambda *_: forwards.append(None))
    together = opened.complete(asked[:BATCH])
    hook.remove()
    together += opened.complete(asked[BATCH:])
    untimed = [replace(c, batch_size=1, **UNTIMED) for c in (*together, *alone)]
    assert untimed[: len(asked)] == untimed[len(asked) :]
    assert len({c.text for c in alone}) > BATCH / 2
    assert len(forwards) < 0.8 * max(c.completion_tokens or 0 for c in alone)


# -- times -----------------------------------------------------------------------------------------


class Ticking:
    """An engine by a clock of its own:
    half a second to read a prompt, a tenth to go on by some tokens.
    """

    def __init__(self, engine: TransformersEngine) -> None:
        self._engine = engine
        self.now_s = 0.0

    def begin(self, prompts: Sequence[Sequence[int]], exact: Sequence[int] = ()) -> Any:
        session = self._engine.begin(prompts, exact)
        self.now_s += 0.5
        go_on = session.advance

        def advance(chunks: Sequence[Sequence[int]]) -> None:
            self.now_s += 0.1
            go_on(chunks)

        session.advance = advance  # type: ignore[method-assign]
        return session

    def __getattr__(self, name: str) -> Any:
        return getattr(self._engine, name)


@pytest.mark.parametrize(
    ("answer", "seconds", "first_token_s", "token_s"),
    [
        # Each of four tokens but the last is read before the next is chosen.
        ("json", 0.8, 0.5, 0.1),
        # Before each of six digits what is fixed is read, the digit before it among that.
        ("constrained", 1.1, 0.6, 0.1),
        ("readout", 0.5, 0.5, None),
    ],
)
def test_the_first_token_is_there_when_the_model_has_chosen_it(
    backend: LanguageModel, answer: AnswerMode, seconds: float, first_token_s: float, token_s: float | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    engine = Ticking(engine_of(backend))
    monkeypatch.setattr(decoding, "time", SimpleNamespace(perf_counter=lambda: engine.now_s))
    timed = LanguageModel(engine, 4)
    [one] = timed.complete([ask(3, answer, max_tokens=4 if answer == "json" else 80)])
    assert one.finish_reason == ("length" if answer == "json" else "stop")
    assert (one.seconds, one.first_token_s, one.token_s) == pytest.approx(
        (seconds, first_token_s, token_s)
    )
    both = timed.complete([ask(i, answer) for i in (3, 4)])
    assert {(c.batch_size, c.seconds, c.first_token_s, c.token_s) for c in both} == {
        (2, None, None, None)
    }


# -- constrained -----------------------------------------------------------------------------------


@pytest.mark.parametrize("i", [0, 3, 8])
def test_each_digit_is_the_likeliest_of_ten(backend: LanguageModel, i: int) -> None:
    request = ask(i, "constrained")
    ids = prompt_of(backend, request)
    digits: list[int] = []
    written = 0
    for opening in ('{"action_distribution":{"SLOWER":0.', ',"IDLE":0.', ',"FASTER":0.'):
        ids += backend.chat.encode(opening)
        two = ""
        for _ in range(2):
            two += best(backend, ids, "0123456789")
            ids += backend.chat.encode(two[-1])
        digits.append(int(two))
        written += len(backend.chat.encode(opening)) + 2
    said = [d / 100 for d in digits]
    [completion] = backend.complete([request])
    assert json.loads(completion.text) == {
        "action_distribution": dict(zip(ACTIONS, said, strict=True))
    }
    assert completion.completion_tokens == written + len(backend.chat.encode("}}"))
    assert completion.finish_reason == "stop"


def test_a_lane_is_chosen_where_the_lanes_part(backend: LanguageModel) -> None:
    """By hand: which label begins best, and only then which lane."""
    left, _, right = (backend.chat.encode(label) for label in LANES)
    shared = next(i for i, (a, b) in enumerate(zip(left, right, strict=False)) if a != b)
    assert shared > 0, "labels that share no token would show nothing"
    lanes = set()
    for i in range(12):
        request = ask(i, "constrained", "helper", LANES, form="recommendation")
        ids = prompt_of(backend, request)
        ids += backend.chat.encode('{"evidence":"","risk":"')
        starts = [backend.chat.encode(risk)[0] for risk in ("low", "medium", "high")]
        risk = ("low", "medium", "high")[int(naive(backend, ids)[starts].argmax())]
        ids += backend.chat.encode(risk + '","recommended_maneuver":"')
        idle = backend.chat.encode("IDLE")[0]
        logits = naive(backend, ids)
        maneuver = "IDLE"
        if logits[left[0]] > logits[idle]:
            logits = naive(backend, ids + left[:shared])
            maneuver = "LANE_LEFT" if logits[left[shared]] > logits[right[shared]] else "LANE_RIGHT"
        [completion] = backend.complete([request])
        said = json.loads(completion.text)
        assert (said["risk"], said["recommended_maneuver"], said["evidence"]) == (
            risk,
            maneuver,
            "",
        )
        lanes.add(maneuver)
    assert len(lanes) > 1


def test_an_answer_that_does_not_fit_its_bound_is_the_users_to_know(backend: LanguageModel) -> None:
    fits = backend.complete([ask(1, "constrained", max_tokens=25)])[0]
    assert fits.completion_tokens == 25
    with pytest.raises(
        UserError, match=r"constrained ego answer takes 25 tokens, and 24 are allowed; raise"
    ):
        backend.complete([ask(1, "constrained", max_tokens=24)])


# -- readout ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("i", [0, 3, 8])
def test_the_letters_probabilities_are_the_answer(backend: LanguageModel, i: int) -> None:
    request = ask(i, "readout")
    letters = [backend.chat.encode(letter)[0] for letter in "ABC"]
    p = naive(backend, prompt_of(backend, request)).double().softmax(-1)[letters]
    [completion] = backend.complete([request])
    said = json.loads(completion.text)["action_distribution"]
    assert [said[a] for a in ACTIONS] == pytest.approx((p / p.sum()).tolist(), abs=1e-5)
    assert completion.label_mass == pytest.approx(float(p.sum()), rel=1e-4)
    assert (completion.completion_tokens, completion.finish_reason) == (1, "stop")


def test_scenes_with_more_and_fewer_actions_are_read_out_together(backend: LanguageModel) -> None:
    few, many = (
        ask(2, "readout"),
        ask(2, "readout", actions=("SLOWER", "IDLE", "FASTER", *LANES[::2])),
    )
    together = backend.complete([few, many])
    assert [c.batch_size for c in together] == [2, 2]
    same([backend.complete([r])[0] for r in (few, many)], together)
    assert [len(json.loads(c.text)["action_distribution"]) for c in together] == [3, 5]


def test_a_read_out_needs_room_for_one_token(backend: LanguageModel) -> None:
    request = ask(4, "readout")
    tokens = len(prompt_of(backend, request))
    context = engine_of(backend).context_tokens
    try:
        engine_of(backend).context_tokens = tokens + 1
        assert backend.complete([request])[0].error is None
        engine_of(backend).context_tokens = tokens
        assert f"{tokens + 1} tokens > {tokens}" in str(backend.complete([request])[0].error)
    finally:
        engine_of(backend).context_tokens = context


class Said:
    """A session of one sequence, with these probabilities of tokens."""

    def __init__(self, p: dict[int, float]) -> None:
        self.p, self.asked = p, [0]

    def log_probs(self, tokens: Sequence[int]) -> Any:
        self.asked = list(tokens)
        return torch.tensor([[math.log(self.p[token]) for token in tokens]], dtype=torch.float64)

    def close(self) -> None:
        """Nothing is held."""


def test_a_letter_counts_in_all_of_its_spellings() -> None:
    """A 1/4 + 1/4, B 1/8 in one spelling, C 1/16 + 1/32 + 1/32: 4, 1 and 1 parts of 3/4."""
    ids = {"\n": [0], "\nA": [0, 1], "\nB": [0, 2], "\nC": [0, 3]}
    spellings = {"A": [1, 11], "B": [2], "C": [13, 3, 23]}
    session = Said({1: 1 / 4, 11: 1 / 4, 2: 1 / 8, 3: 1 / 16, 13: 1 / 32, 23: 1 / 32})
    chat = SimpleNamespace(
        name="spelt", encode=ids.__getitem__, spellings=lambda letters: spellings
    )
    engine: Any = SimpleNamespace(chat=chat, begin=lambda prompts, exact: session)
    [answer] = Decoding(engine).answer([ask(0, "readout")], [[[5, 6]]])
    assert json.loads(answer.text)["action_distribution"] == pytest.approx(
        dict(zip(ACTIONS, (4 / 6, 1 / 6, 1 / 6), strict=True)), abs=1e-6
    )
    assert answer.label_mass == pytest.approx(3 / 4)
    assert session.asked == [1, 2, 3, 11, 13, 23]


def test_one_spelling_alone_is_read_out_to_the_last_bit_as_ever() -> None:
    p = {1: 0.3, 2: 0.2, 3: 0.1}
    chat = SimpleNamespace(
        name="plain", encode=lambda text: [0, *("ABC".index(x) + 1 for x in text[1:])],
        spellings=lambda letters: {x: [] for x in letters},
    )  # fmt: skip
    engine: Any = SimpleNamespace(chat=chat, begin=lambda prompts, exact: Said(p))
    [answer] = Decoding(engine).answer([ask(0, "readout")], [[[5, 6]]])
    log_p = [math.log(x) for x in p.values()]
    weights = [math.exp(x - max(log_p)) for x in log_p]
    assert answer.text == readout.answer_json(ACTIONS, weights)
    assert answer.label_mass == math.exp(max(log_p)) * sum(weights)


@pytest.mark.parametrize(
    ("texts", "decoder"),
    [
        (
            ["A", "\u0120A", "\u0120\u0120A", "\u010aB", "B", "AB", "a", "A.", "\u0120a"],
            "ByteLevel",
        ),
        (["A", "\u2581A", "\u2581\u2581A", "<0x42>", "B", "AB", "a", "A.", "<0x43>"], "Metaspace"),
    ],
)
def test_the_spellings_of_a_letter_are_found_in_any_vocabulary(
    texts: list[str], decoder: str
) -> None:
    from tokenizers import Tokenizer, decoders, models
    from transformers import PreTrainedTokenizerFast

    made = Tokenizer(models.WordLevel({text: n for n, text in enumerate(texts)}, unk_token="a"))
    made.decoder = (
        decoders.ByteLevel() if decoder == "ByteLevel"
        else decoders.Sequence([decoders.ByteFallback(), decoders.Metaspace(), decoders.Fuse()])
    )  # fmt: skip
    hub = PreTrainedTokenizerFast(tokenizer_object=made, chat_template="{{ messages }}")
    chat = Chat("any", HubTokenizer(hub))
    found = chat.spellings("ABC")
    assert {letter: sorted(ids) for letter, ids in found.items()} == {
        "A": [0, 1, 2], "B": [3, 4], "C": [8] if decoder == "Metaspace" else [],
    }  # fmt: skip


@pytest.mark.parametrize(
    "encode", [lambda text: [1] * len(text), lambda text: list(text.encode("utf-16"))]
)
def test_letters_that_are_no_single_tokens_are_refused(encode: Any) -> None:
    engine: Any = SimpleNamespace(chat=SimpleNamespace(subject="model 'odd'", encode=encode))
    with pytest.raises(
        UserError, match=r"'odd'.* no single token for each of the letters ABC; use --answer"
    ):
        Decoding(engine).room(ask(0, "readout"))


# -- all of them -----------------------------------------------------------------------------------


def same(one: Sequence[Completion], other: Sequence[Completion]) -> None:
    """Equal but for company: a read-out's numbers may differ by what float32 rounds."""
    for a, b in zip(one, other, strict=True):
        alone: Any = {**UNTIMED, "batch_size": 1, "text": "", "label_mass": None}
        assert replace(a, **alone) == replace(b, **alone)
        if a.label_mass is None:
            assert a.text == b.text
        else:
            assert b.label_mass == pytest.approx(a.label_mass, rel=1e-4)
            p, q = (json.loads(c.text)["action_distribution"] for c in (a, b))
            assert p == pytest.approx(q, abs=1e-5)


REQUESTS = st.builds(
    ask,
    st.integers(0, 12),
    st.sampled_from(MODES),
    st.sampled_from(["ego", "helper"]),
    st.sampled_from([ACTIONS, LANES]),
    form=st.sampled_from(["distribution", "recommendation"]),
)


def company_changes_nothing(backend: LanguageModel, requests: list[Request]) -> None:
    together = backend.complete(requests)
    same([backend.complete([request])[0] for request in requests], together)


@settings(max_examples=4, deadline=None)
@given(st.lists(REQUESTS, max_size=4))
def test_company_never_changes_an_answer(backend: LanguageModel, requests: list[Request]) -> None:
    company_changes_nothing(backend, requests)


@pytest.mark.exhaustive
@settings(max_examples=60, deadline=None)
@given(st.lists(REQUESTS, max_size=7))
def test_much_company_never_changes_an_answer(
    backend: LanguageModel, requests: list[Request]
) -> None:
    company_changes_nothing(backend, requests)


@settings(max_examples=15, deadline=None)
@given(REQUESTS.filter(lambda r: r.answer != "json"))
def test_an_answer_that_is_not_free_text_is_wrong_in_its_sum_alone(
    backend: LanguageModel, request: Request
) -> None:
    [completion] = backend.complete([request])
    role = "ego" if request.answer == "readout" else request.role
    parsed = parse(completion.text, role=role, actions=request.actions, divides=request.divides)
    assert {*parsed.repairs} <= {"renormalised", "divided"}, parsed.detail
    assert parsed.verdict != "failed" or parsed.mass == 0
    if request.answer == "readout":
        assert parsed.verdict == "strict", parsed.detail
        assert math.isclose(parsed.mass or 0, 1, abs_tol=1e-6)
    assert (completion.label_mass is not None) == (request.answer == "readout")


def test_requests_that_are_answered_alike_share_a_batch(backend: LanguageModel) -> None:
    requests = [ask(i, mode) for i in range(3) for mode in MODES]
    assert [c.batch_size for c in backend.complete(requests)] == [3] * 9


@pytest.mark.parametrize("answer", MODES)
def test_weights_that_are_no_numbers_are_an_error_of_the_engine_and_no_answer(
    answer: AnswerMode, tmp_path: Path
) -> None:
    folder = tiny_qwen3.spoil(tiny_qwen3.build(tmp_path / "tiny"))
    broken = open_backend(resolve(str(folder)), batch_size=2, device="cpu")
    for said in broken.complete([ask(1, answer), ask(2, answer)]):
        assert (said.text, said.finish_reason) == ("", "error")
        assert said.error == (
            "ArithmeticError: the logits are no numbers; the weights are damaged, or too large for "
            "this dtype"
        )
