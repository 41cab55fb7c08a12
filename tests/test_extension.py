"""What a prompt's `answer.json` adds: checked, filled in, sent to servers, read, and counted."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from corpus import ACTIONS
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.backends import cards
from harness.backends.base import Request
from harness.backends.openai.constraint import broken, constraint
from harness.backends.registry import open_backend
from harness.backends.skeleton import Skeleton
from harness.core import resources
from harness.core.errors import UserError
from harness.evaluate.agent import Agent
from harness.evaluate.answers import answer_of
from harness.parsing.parse import Status, parse
from harness.prompts import extension, versions
from harness.prompts.answer_schema import Shape, answer_schema, longest, number_texts, plainest
from harness.runs import folder

GAPS = {
    "reason": {"type": "string", "maxLength": 40},
    "clear": {"type": "boolean"},
    "gaps": {
        "type": "array", "maxItems": 3,
        "items": {"type": "object", "properties": {
            "of": {"type": "string", "enum": ["left", "right", "oncoming"]},
            "seconds": {"type": "number", "minimum": -10, "maximum": 10},
            "lanes": {"type": "array", "minItems": 1, "maxItems": 2,
                      "items": {"type": "integer", "minimum": 1, "maximum": 12}},
        }},
    },
}  # fmt: skip
EXTENSION = extension.read(json.dumps({"ego": GAPS, "helper": GAPS}), "answer.json")
EIGHTS = {"type": "integer", "minimum": 8, "maximum": 11}
NUMBERS = {
    "list": {"type": "array", "maxItems": 2, "items": {"type": "boolean"}},
    "all": {
        "type": "array",
        "maxItems": 2,
        "items": {"type": "array", "maxItems": 2, "items": EIGHTS},
    },
}
EXTENSION["numbers"] = extension.read(json.dumps({"ego": NUMBERS}), "answer.json")["ego"]
SHAPES = [
    Shape(role, ACTIONS, form, EXTENSION[role])
    for role, form in (("ego", "distribution"), ("ego", "maneuver"), ("helper", "distribution"))
] + [Shape("ego", ACTIONS, "distribution", EXTENSION["numbers"])]
EGO = SHAPES[0]
HALF = '"action_distribution":{"SLOWER":0.5,"IDLE":0.5,"FASTER":0}'


class Characters:
    """A tokenizer whose tokens are characters."""

    name, vocabulary = "characters", 300

    def encode(self, text: str) -> list[int]:
        return [ord(c) for c in text]

    def decode(self, ids: Any) -> str:
        return "".join(map(chr, ids))


CHARACTERS: Any = Characters()


def valid(shape: Shape, text: str) -> bool:
    schema = answer_schema(**shape._asdict())
    jsonschema.Draft202012Validator.check_schema(schema)
    return bool(jsonschema.Draft202012Validator(schema).is_valid(json.loads(text)))


def request(shape: Shape) -> Request:
    asked = Request("s/v1", "ego", (), ACTIONS, 999, answer="constrained")
    return asked.alike(role=shape.role, form=shape.form, extension=shape.extension)


def values(schema: Any) -> st.SearchStrategy[Any]:
    """Values that fit a schema, and some that nearly do."""
    if "enum" in schema:
        return st.sampled_from([*schema["enum"], "left of us"])
    match schema["type"]:
        case "string":
            return st.text(max_size=schema["maxLength"] + 1)
        case "boolean":
            return st.sampled_from([True, False, "true", None])
        case "array":
            return st.lists(values(schema["items"]), max_size=schema["maxItems"] + 1)
        case "object":
            return st.fixed_dictionaries({k: values(v) for k, v in schema["properties"].items()})
    bounds = [schema["minimum"], schema["maximum"], schema["maximum"] + 1, 2.5, True]
    return st.sampled_from(bounds)


# -- filled in -------------------------------------------------------------------------------------


@pytest.mark.slow
@settings(deadline=None, max_examples=15)
@given(st.sampled_from(SHAPES), st.randoms(use_true_random=False))
def test_whatever_a_model_chooses_fits_and_is_read(shape: Shape, random: Any) -> None:
    skeleton = Skeleton(CHARACTERS, shape)
    walk, ids = skeleton.walk(), []
    ask = next(walk)
    while True:
        assert ask.among == sorted(set(ask.among))
        ids += ask.forced
        try:
            ask = walk.send(random.choice(ask.among))
        except StopIteration as end:
            done = end.value
            break
    assert done.text.startswith(CHARACTERS.decode(ids))
    assert done.tokens == len(done.text) <= skeleton.most_tokens
    assert valid(shape, done.text), done.text
    parsed = parse(done.text, **shape._asdict(), divides=True)
    if parsed.status is not Status.BAD_SUM:  # all zeros
        assert parsed.extension == {
            k: v for k, v in json.loads(done.text).items() if k in shape.further
        }
        assert parsed.verdict != "failed"
    assert {*parsed.repairs} <= {"divided", "renormalised"}


def test_the_further_members_come_first_and_a_text_ends_where_it_must() -> None:
    extended = extension.read('{"ego":{"reason":{"type":"string","maxLength":3}}}', "answer.json")
    shape = Shape("ego", ("GO",), "distribution", extended["ego"])
    walk = Skeleton(CHARACTERS, shape).walk()
    assert "".join(map(chr, next(walk).forced)) == '{"reason":"'
    left = [walk.send(ord(c)) for c in "abc"]
    assert [chr(34) in map(chr, ask.among) for ask in left] == [True, True, False], (
        "then no room is left"
    )
    assert "".join(map(chr, left[-1].forced)) == 'c","action_distribution":{"GO":0.'
    assert "\\" not in map(chr, left[0].among)


@pytest.mark.parametrize(
    ("least", "most", "kind", "texts", "count"),
    [(0, 1, "number", ("0.00", "0.01"), 101), (-10, 10, "number", ("-10.0", "-9.9"), 201),
     (0.5, 80, "number", ("0.5", "0.6"), 796), (3, 5, "integer", ("3", "4"), 3),
     (0, 5000, "number", ("0", "10"), 501)],
)  # fmt: skip
def test_a_number_is_one_of_a_hundred_to_a_thousand(
    least: float, most: float, kind: str, texts: tuple[str, ...], count: int
) -> None:
    found = number_texts({"type": kind, "minimum": least, "maximum": most})
    assert (found[:2], len(found)) == (texts, count)
    assert all(least <= float(text) <= most for text in found)


# -- read ------------------------------------------------------------------------------------------


@pytest.mark.slow
@settings(deadline=None, max_examples=15)
@given(
    st.fixed_dictionaries({}, optional={k: values(v) for k, v in json.loads(EGO.extension).items()})
)
def test_strict_is_what_the_library_says_of_the_extended_schema(said: Any) -> None:
    text = f"{json.dumps(said)[:-1]}{',' if said else ''}{HALF}}}"
    parsed = parse(text, **EGO._asdict())
    assert parsed.intent == (0.5, 0.5, 0)
    assert (parsed.status is Status.STRICT) == valid(EGO, text)
    assert (
        (parsed.extension is None)
        == ("unfit_extension" in parsed.repairs)
        == (not valid(EGO, text))
    )


@pytest.mark.parametrize("said", ['"reason":"\\ud800"', '"reason":"a","reason":"b"', '"clear":NaN'])
def test_what_is_no_json_or_no_text_never_gets_into_a_file(said: str) -> None:
    rest = '"reason":"", ' if "reason" not in said else ""
    gaps = '"gaps":[],' + ('"clear":true,' if "clear" not in said else "")
    parsed = parse(f"{{{rest}{said},{gaps}{HALF}}}", **EGO._asdict())
    if "ud800" in said:
        assert parsed.extension["reason"] == "?"
    else:
        assert parsed.extension is None


def test_unasked_for_they_are_a_field_too_many() -> None:
    parsed = parse(f'{{"reason":"clear",{HALF}}}', role="ego", actions=ACTIONS)
    assert (parsed.repairs, parsed.extension) == (("extra_field",), None)


# -- servers ---------------------------------------------------------------------------------------


@pytest.mark.slow
@settings(deadline=None, max_examples=10)
@given(st.data(), st.sampled_from(SHAPES))
def test_what_a_server_is_sent_is_what_it_is_held_to(data: st.DataObject, shape: Shape) -> None:
    asked = request(shape)
    pattern = constraint("vllm", asked.shape)["structured_outputs"]["regex"]
    text = data.draw(st.from_regex(re.compile(pattern, re.ASCII), fullmatch=True))
    assert valid(shape, text)
    assert broken("vllm", asked, text, ended=True) is None
    at = data.draw(st.integers(0, len(text) - 1))
    for kind in ("vllm", "generic"):
        assert broken(kind, asked, text[:at], ended=False) is None, text[:at]
        changed = text[:at] + data.draw(st.sampled_from('0{}[]",.ax')) + text[at + 1 :]
        if broken(kind, asked, changed, ended=True) is None:
            assert valid(shape, changed)
            assert kind != "vllm" or re.fullmatch(pattern, changed)
    sent = constraint("generic", asked.shape)["response_format"]["json_schema"]["schema"]
    assert [*sent["properties"]][: len(shape.further)] == [*shape.further]
    assert broken("generic", asked, json.dumps(json.loads(text), indent=1), ended=True) is None


# -- a version -------------------------------------------------------------------------------------


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    shutil.copytree(resources.find("prompts", "v4"), tmp_path / "mine")
    (tmp_path / "mine/answer.json").write_text(
        json.dumps({"ego": GAPS, "helper": {"clear": GAPS["clear"]}})
    )
    return tmp_path


def test_a_version_says_what_it_adds_and_has_room_for_it(copied: Path) -> None:
    mine, plain = versions.load("mine", copied), versions.load("v4")
    assert mine.sha256 != versions.digest(
        {k: v for k, v in mine.files.items() if k != "answer.json"}
    )
    assert plain.extension == {}
    agent = Agent(cards.resolve("proxy"), mine)
    added = longest({"type": "object", "properties": json.loads(mine.extension["ego"])})
    assert agent.most_tokens("ego") == plain.max_answer_tokens["ego"] + added
    role: Any
    for role in versions.ROLES:
        shape = mine.shape(role, ACTIONS)
        assert agent.blank(role, ACTIONS).shape == shape
        assert Skeleton(CHARACTERS, shape).most_tokens - Skeleton(
            CHARACTERS, shape._replace(extension="")
        ).most_tokens <= (agent.most_tokens(role) - plain.max_answer_tokens[role])
        assert valid(shape, json.dumps(plainest(answer_schema(**shape._asdict()))))


@pytest.mark.exhaustive
@pytest.mark.parametrize("engine", ["transformers", "llama-cpp"])
def test_a_real_model_fills_in_what_a_version_adds(engine: str, copied: Path) -> None:
    pytest.importorskip({"transformers": "torch", "llama-cpp": "llama_cpp"}[engine])
    mine = versions.load("mine", copied)
    agent = Agent(cards.resolve("swarm-tiny", engine), mine, "constrained")
    messages = ({"role": "user", "content": "v3 from left, gap +1.2 s\nDistribution:"},)
    cases: Any = [("ego", 0.0), ("helper", 0.0), ("ego", 1.0)]
    asked = [
        agent.blank(role, ACTIONS).alike(id=f"s/{n}", messages=messages, temperature=t)
        for n, (role, t) in enumerate(cases)
    ]
    backend = open_backend(agent.card, batch_size=4)
    for question, completion in zip(asked, backend.complete(asked), strict=True):
        assert completion.error is None
        assert valid(question.shape, completion.text), completion.text
        assert completion.completion_tokens <= question.max_tokens
        answer: Any = answer_of(question, completion)
        assert {*answer.extension} == {*mine.shape(question.role, ()).further}
        assert answer.verdict != "failed"


@pytest.mark.slow
def test_the_pages_example_is_one_and_a_run_of_it_keeps_what_was_added(
    harness: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    page = (Path(__file__).parents[1] / "docs/prompts.md").read_text(encoding="utf-8")
    [example] = re.findall(r"```json\n(.*?)```", page, re.DOTALL)
    (tmp_path / resources.MARKER).touch()
    shutil.copytree(resources.find("prompts", "v4"), tmp_path / "prompts/mine")
    (tmp_path / "prompts/mine/answer.json").write_text(example)
    code, _, err = harness("eval", "--model", "proxy", "--prompt", "mine", "--limit", "1", "--seeds", "0:1",
                           "--condition", "single-local", "--out", "run")  # fmt: skip
    assert code == 0, err
    run = folder.read(tmp_path / "run")
    assert {(a.status, json.dumps(a.extension)) for a in run.answers if a.role == "ego"} == {
        ("strict", '{"reason": "", "gaps": []}')
    }
    kept = json.loads((tmp_path / "run/sources/schemas/mine/ego.json").read_text())
    assert [*kept["properties"]] == ["reason", "gaps", "action_distribution"]
    assert (tmp_path / "run/sources/prompts/mine/answer.json").read_text() == example


# -- what is refused -------------------------------------------------------------------------------

TEXT = {"type": "string", "maxLength": 9}


def nested(depth: int) -> Any:
    return TEXT if not depth else {"type": "array", "maxItems": 1, "items": nested(depth - 1)}


@pytest.mark.parametrize(
    ("file", "said"),
    [
        ("[", "is no JSON: "),
        ("[" * 100_000, "is no JSON: "),
        ("[]", "is no object with members"),
        ('{"driver":{}}', "unknown role 'driver'; known: ego, helper"),
        ({}, "ego has no members or too many"),
        ({f"a{n}": TEXT for n in range(17)}, "ego has no members or too many"),
        ({"a b": TEXT}, "'a b' is no name"),
        ({"Risk": TEXT}, "ego.Risk is a field of every answer"),
        ({"a": {"$ref": "http://example.com/s"}}, 
            "ego.a: a schema may not have "
            "'$ref'; allowed: type, enum"),
        ({"a": {**TEXT, "$ref": "#/ego/a"}}, "may not have '$ref'; allowed: type, maxLength, enum"),
        ({"a": {**TEXT, "pattern": "(a+)+$"}}, "type string may not have 'pattern'"),
        ({"a": {"oneOf": [TEXT]}}, "a schema may not have 'oneOf'"),
        ({"a": {"type": ["string", "null"]}}, 
            "give one of string, number, "
            "integer, boolean, array, object"),
        ({"a": 3}, "ego.a is no schema"),
        ({"a": {"type": "string"}}, "ego.a.maxLength is None; give 1 to 400"),
        ({"a": {"type": "string", "maxLength": 10**9}}, 
            "ego.a.maxLength is "
            "1000000000; give 1 to 400"),
        ({"a": {"type": "string", "enum": ["x", "x"]}}, 
            "ego.a.enum: give 1 to "
            "100 different texts"),
        ({"a": {"type": "string", "enum": ['x"']}}, "ego.a.enum: give 1 to 100 different texts"),
        ({"a": {"type": "number", "minimum": 0}}, "nan is no bound"),
        ({"a": {"type": "number", "minimum": 0, "maximum": 10**400}}, "is no bound; give"),
        ({"a": {"type": "number", "minimum": 0, "maximum": 1e-9}}, 
            "from 0 to 1e-09; give a minimum below"),
        ({"a": {"type": "integer", "minimum": 0, "maximum": 5000}}, 
            "of an integer by at most 1000"),
        ({"a": {"type": "integer", "minimum": 0, "maximum": 1.5}}, "1.5 is no bound"),
        ({"a": {"type": "array", "items": TEXT, "maxItems": 21}}, 
            "ego.a.maxItems is "
            "21; give 1 to 20"),
        ({"a": {"type": "array", "maxItems": 2}}, "ego.a.items is no schema"),
        ({"a": nested(4)}, "nested 5 deep; give at most 4"),
        ({"a": {"type": "array", "maxItems": 20, "items": {"type": "string", "maxLength": 400}}},
         "ego may take 8067 characters; give bounds that leave at most 2000"),
    ],
)  # fmt: skip
def test_what_cannot_be_constrained_is_refused_in_one_line(file: Any, said: str) -> None:
    text = file if isinstance(file, str) else json.dumps({"ego": file})
    with pytest.raises(UserError) as refused:
        extension.read(text, "prompt mine answer.json")
    assert said in str(refused.value)
    assert str(refused.value).startswith("prompt mine answer.json")
    assert "\n" not in str(refused.value)


def test_a_member_named_as_an_action_is_refused_where_that_is_one(
    copied: Path, harness: Callable[..., tuple[int, str, str]], small_path: Path
) -> None:
    from harness.world import scenarios

    scenario = scenarios.get("occluded-intersection")
    assert versions.unfit(versions.load("mine", copied), scenario) is None
    (copied / "mine/answer.json").write_text(json.dumps({"helper": {"slower": TEXT}}))
    assert versions.unfit(versions.load("mine", copied), scenario) == (
        "has slower in answer.json, which is an action of occluded-intersection"
    )
    Path("swarmdrive.toml").touch()
    shutil.copytree(copied / "mine", Path("prompts/mine"))
    assert harness("prompt", "check", "mine", "--dataset", small_path) == (
        2, "",
        "harness: prompt mine has slower in answer.json, which is an action of "
        "occluded-intersection; give "
        "another --dataset, or fix the prompt\n",
    )  # fmt: skip
    Path("answer.txt").write_text("{}")
    code, out, error = harness("prompt", "parse", "answer.txt", "--prompt", "mine")
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert (
        "--prompt mine has slower in answer.json, which is an action of occluded-intersection"
        in error
    )


def test_the_largest_that_is_allowed_is_walked_in_time() -> None:
    """Four hundred decisions in a list of lists: nothing recurses by their number."""
    of = {"type": "array", "maxItems": 20, "items": {"type": "integer", "minimum": 0, "maximum": 9}}
    read = extension.read(json.dumps({"ego": {"a": {**of, "items": of}}}), "answer.json")
    assert (
        Skeleton(CHARACTERS, Shape("ego", ACTIONS, "distribution", read["ego"])).most_tokens > 800
    )
