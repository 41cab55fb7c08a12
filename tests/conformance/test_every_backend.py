"""What holds for every backend that can run here:
the contract of `harness.backends.base.Backend`.
"""

import json
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import get_args

import pytest
from evaluating import run, scenes_of, spec_of
from misbehaving import Asked, completion, read_out, serving

from harness.backends import cards
from harness.backends.answers_file import AnswersFile, Question
from harness.backends.base import AnswerMode, Backend, Completion, Request
from harness.backends.driver import REFERENCES
from harness.backends.gguf_export import export
from harness.backends.openai.constraint import broken
from harness.backends.registry import (
    BUILT_IN,
    capabilities,
    missing,
    missing_package,
    open_backend,
)
from harness.backends.registry import (
    ENGINES as REGISTERED,
)
from harness.core.files import digest
from harness.dataset.load import load
from harness.evaluate.requests import requests

Once = Callable[[str, Callable[[Path], object]], Path]


@dataclass(frozen=True)
class Case:
    """An opened backend and five requests that it can answer;
    helpers' too, where it answers for them.
    """

    backend: Backend
    asked: tuple[Request, ...]

    @cached_property
    def said(self) -> list[Completion]:
        """What is answered when all are asked at once."""
        return self.backend.complete(self.asked)


def model_free() -> list[str]:
    """Return the models that are rules, but for drivers that only worlds of their own have."""
    proxies = [name for name in cards.names() if cards.load(name).engine == "proxy"]
    return [*proxies, *REFERENCES]


WITH_WEIGHTS = [engine for engine in BUILT_IN if capabilities(engine).has_weights]
ADDED = [
    engine for engine in REGISTERED if engine not in BUILT_IN and capabilities(engine).has_weights
]
ENGINES = [
    *((name, "json") for name in (*model_free(), "replay", "answers-file")),
    *((engine, answer) for engine in ("openai", *WITH_WEIGHTS) for answer in get_args(AnswerMode)),
    *((engine, "decision") for engine in ("systemone", "decisions", "sparrow")),
]
CASES = [
    *(pytest.param(case, id="-".join(case)) for case in ENGINES),
    *(
        pytest.param((engine, answer), id=f"{engine}-{answer}", marks=pytest.mark.exhaustive)
        for engine in ADDED  # those of extensions, of which CI installs none
        for answer in get_args(AnswerMode)
    ),
]


def tiny_weights(folder: Path) -> None:
    """A checkpoint, which takes seconds of imports, and its GGUF file."""
    import tiny_qwen3

    tiny_qwen3.build(folder / "tiny", context_tokens=2048)
    export(folder / "tiny", folder / "tiny.gguf", "F32")
    export(folder / "tiny", folder / "tiny-f16.gguf", "F16")  # which engines of packages read, too


@pytest.fixture(scope="module", params=CASES)
def case(
    request: pytest.FixtureRequest,
    small_path: Path,
    once: Once,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Case]:
    folder = tmp_path_factory.mktemp("conformance")
    model, answer = request.param
    data = load(small_path, limit=1)
    if model == "replay":
        run(spec_of(data, seeds=(0,)), folder / "run")
        model = f"replay:{folder / 'run'}"
    if model in ADDED and (package := missing_package(model)):
        pytest.skip(f"needs {package}")
    engine = model
    if model in (*WITH_WEIGHTS, *ADDED):
        if find_spec("torch") is None or find_spec("transformers") is None:
            pytest.skip("needs the transformers extra")
        tiny = once("every-backend", tiny_weights)
    if model == "transformers":
        model = str(tiny / "tiny")
    if model == "sparrow":
        pytest.importorskip("sparrow_decider", reason="needs the sparrow extra")
        model = "sparrow-general"
    if model in ("openai", "systemone", "decisions"):
        with serving(answered) as there:
            card = cards.load(f"{model}-example")
            assert card.server is not None
            card = replace(card, server=replace(card.server, base_url=there.url))
            yield Case(
                open_backend(card, batch_size=3),
                tuple(requests(spec_of(data, card.name, answer=answer), scenes_of(data)[:5]))[:5],
            )
        return
    if model == "llama-cpp":
        if find_spec("llama_cpp") is None:
            pytest.skip("needs the llama-cpp extra")
        model = str(tiny / "tiny.gguf")
    if model in ADDED:
        model = str(tiny / "tiny-f16.gguf")
    if model == "answers-file":
        yield of_a_file(list(requests(spec_of(data), scenes_of(data)[:5]))[:5], folder / "a.jsonl")
        return
    spec = spec_of(data, model, answer=answer)
    asked = list(requests(spec, data.scenes(data.forest.ids[:1])))  # where every walk begins
    if answer == "json":  # the others take what they take
        asked = [replace(r, max_tokens=min(r.max_tokens, 4)) for r in asked]
    card = spec.ego.card
    device = "cpu" if card.engine in WITH_WEIGHTS else None
    if engine in ADDED:
        card = replace(card, engine=engine, dtype="float32")
    yield Case(open_backend(card, device=device, batch_size=3), tuple(asked[:5]))


def of_a_file(asked: list[Request], file: Path) -> Case:
    """Requests that a file of answers has, each with some words."""
    lines = {}
    for n, request in enumerate(asked):
        name = Question.of(request).id
        lines[name] = json.dumps({"id": name, "text": f"words {n}", "tokens": 2, "seconds": 0.1})
    file.write_text("\n".join(lines.values()))
    return Case(AnswersFile(file), tuple(asked))


def test_every_engine_that_a_card_may_name_is_tried_here() -> None:
    tried = {cards.load(name).engine for name in model_free()} | {
        engine for engine, _ in ENGINES if engine in BUILT_IN
    }
    assert tried == set(BUILT_IN)
    assert all(missing(cards.load(name)) is None for name in model_free())


def answered(asked: Asked) -> None:
    """A decent llama-server, whose answers depend on the question alone."""
    said = digest(asked.body)
    if asked.path == "/v1/systemone":
        [(name, question)] = asked.body["questions"].items()
        asked.reply(
            {
                "answers": {
                    name: {"type": "choice", "probabilities": shares(question["criteria"], said)}
                }
            }
        )
    elif asked.path == "/v1/decisions":
        [question] = asked.body["questions"]
        p = shares([choice["value"] for choice in question["choices"]], said)
        listed = [{"value": value, "probability": share} for value, share in p.items()]
        asked.reply(
            {"answers": [{"type": "choice", "name": question["name"], "probabilities": listed}]}
        )
    elif asked.body.get("logprobs"):
        asked.reply(read_out(("A", -0.5), (" B", -1.5 - int(said[0], 16)), ("C", -4.0)))
    elif "grammar" in asked.body:
        helper = '"evidence":"","risk":"low",' if "evidence" in asked.body["grammar"] else ""
        digits = f'"SLOWER":0.{said[:2].translate(DIGITS)},"IDLE":0.10,"FASTER":1.00'
        asked.reply(completion(f'{{{helper}"action_distribution":{{{digits}}}}}'))
    else:
        asked.reply(completion(said))


DIGITS = str.maketrans("abcdef", "012345")


def shares(options: Collection[str], said: str) -> dict[str, float]:
    """Shares of options that depend on the question alone."""
    weights = [1 + int(said[n], 16) for n in range(len(options))]
    return {option: weight / sum(weights) for option, weight in zip(options, weights, strict=True)}


def test_a_constrained_answer_keeps_to_the_schema(case: Case) -> None:
    """What any engine promises, as a server is held to it: JSON Schema, without blanks or not."""
    for r, c in zip(case.asked, case.said, strict=True):
        if r.answer == "constrained":
            assert c.error is None
            assert broken("generic", r, c.text, ended=True) is None
            assert " " not in c.text


def same(one: list[Completion], other: list[Completion]) -> None:
    """Equal texts; a read-out's numbers as far as they do not depend on how float32 is summed
    up.
    """
    for a, b in zip(one, other, strict=True):
        if a.label_mass is None:
            assert a.text == b.text
        else:
            p, q = (json.loads(c.text)["action_distribution"] for c in (a, b))
            assert p == pytest.approx(q, abs=1e-5)


def test_a_read_out_and_only_a_read_out_says_how_much_was_on_its_letters(case: Case) -> None:
    for r, c in zip(case.asked, case.said, strict=True):
        letters = "readout" in capabilities(case.backend.identity()["engine"]).answer_modes
        assert (c.label_mass is not None) == (r.bare and letters)
        assert c.label_mass is None or 0 < c.label_mass <= 1


def test_there_is_one_completion_a_request_in_the_order_asked(case: Case) -> None:
    for asked in (case.asked, case.asked[::-1], case.asked[2:3]):
        assert [c.request_id for c in case.backend.complete(asked)] == [r.id for r in asked]


def test_asking_nothing_gives_nothing(case: Case) -> None:
    assert case.backend.complete(()) == []


def test_each_completion_keeps_the_contract(case: Case) -> None:
    for c in case.said:
        assert c.finish_reason in ("stop", "length", "error")
        assert (c.error is None) == (c.finish_reason != "error")
        assert c.finish_reason == "error" or c.text, "these five are answered with some text"
        assert c.batch_size >= 1
        assert c.seconds is None or (c.batch_size == 1 and c.seconds > 0)
        assert c.first_token_s is None or (
            c.seconds is not None and 0 < c.first_token_s <= c.seconds
        )
        assert c.token_s is None or (c.first_token_s is not None and c.token_s > 0)
        assert c.prompt_tokens is None or c.prompt_tokens > 0
        least = (
            0
            if capabilities(case.backend.identity()["engine"]).answer_modes == ("decision",)
            else 1
        )
        assert c.completion_tokens is None or c.completion_tokens >= least, (
            "who only decides writes none"
        )


def test_an_engine_that_has_tokens_keeps_to_the_most_that_is_allowed(case: Case) -> None:
    for r, c in zip(case.asked, case.said, strict=True):
        if c.completion_tokens is not None:
            assert c.completion_tokens <= r.max_tokens


def test_asking_again_alone_or_in_other_company_gives_the_same_text(case: Case) -> None:
    first = case.said
    same(case.backend.complete(case.asked), first)
    same([case.backend.complete([r])[0] for r in case.asked], first)
    same(case.backend.complete(case.asked[::-1]), first[::-1])


def test_its_identity_is_json_and_stays_the_same(case: Case) -> None:
    identity = case.backend.identity()
    assert json.loads(json.dumps(identity, allow_nan=False)) == identity
    assert identity["engine"] in REGISTERED
    case.backend.complete(case.asked[:1])
    assert case.backend.identity() == identity
