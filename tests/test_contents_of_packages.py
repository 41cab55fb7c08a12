"""What a package's content of messages may do: it plays its own condition alone,
and fails in one line.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from evaluating import says, spec_of, walked
from msgspec.structs import replace as changed
from packaged import register

from harness.backends.base import Completion, Request
from harness.coordination import contents_of_packages as door
from harness.coordination.contents import (
    CONTENTS,
    INTENTS,
    OBJECTS,
    PLANS,
    WORDS,
    Call,
    Content,
    OfIntent,
)
from harness.coordination.intents import Intents
from harness.coordination.named_points import named_point
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.part_settings import calls
from harness.core.errors import UserError
from harness.dataset.load import Dataset, Scene
from harness.prompts import versions

# A list of what is within some metres, which costs a bit for each of them.
GLANCE = """
from harness.extend import Call, Content

class Shows(Call):
    name = "glance"
    in_graph = True

    def graphs(self, scenario, cases):
        return [case.own.blinded() for case in cases]

class Taken(Call):
    name = "schema"
    in_graph = True

class Glance(Content):
    holds = frozenset(("objects",))
    needs = ("objects",)
    call = Shows()

    def able(self, point, intents, senders):
        return intents.without_models()

    def bits(self, encoding, intents, headers):
        return 7.0 + 0 * intents.payload_bits

class Schema(Glance):
    call = Taken()

GLANCE = Glance()
TAKEN = Glance()
SCHEMA = Schema()
"""
ENTRIES = "[swarmdrive.contents]\nglance = glances:GLANCE\nglimpse = glances:TAKEN\nschema = glances:SCHEMA\n"


class Asked:
    """Remembers what it was asked."""

    def __init__(self) -> None:
        self.asked = list[Request]()

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        self.asked += requests
        return [
            Completion(r.id, says((0.2, 0.5, 0.3), r.role), None, None, "stop", None, 1)
            for r in requests
        ]

    def identity(self) -> dict[str, Any]:
        return {"engine": "scripted"}


@pytest.fixture
def glances(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    register(tmp_path, ENTRIES, glances=GLANCE)
    monkeypatch.syspath_prepend(tmp_path)
    calls.cache_clear()
    yield
    calls.cache_clear()
    for name in ("glance", "schema"):
        CONTENTS._loaded.pop(name, None)


@pytest.mark.slow
@pytest.mark.usefixtures("glances")
def test_a_packages_content_is_played(small: Dataset) -> None:
    one = small.of_episodes({0})
    backend = Asked()
    point = named_point("6g:tau=0,loss=0,content=glance")
    rows = walked(spec_of(one, points=(point,), seeds=(0,), ask="used"), backend)
    heard = [request for request in backend.asked if "+" in request.id]
    assert heard
    assert all(request.view and not request.view.nodes for request in heard)
    assert all("!glance" in request.id for request in heard)
    messages, bits = (rows.decisions[name] for name in ("messages", "reply_bits"))
    assert np.array_equal(bits, 7.0 * messages)
    assert messages.sum() > 0
    with pytest.raises(UserError, match="its call is named 'glance'"):
        named_point("6g:content=glimpse")


@pytest.mark.usefixtures("glances")
def test_a_call_by_whose_name_messages_are_changed_is_refused_and_moves_no_other() -> None:
    pytest.importorskip("harness.extensions.trust")
    assert {*calls()} >= {"glance"}
    assert "schema" not in calls()
    with pytest.raises(UserError, match="content is 'schema'; it must be another: messages are"):
        named_point("6g:content=schema")


def made(**parts: Any) -> Content:
    content: Content = type("Mine", (Content,), {"holds": frozenset((INTENTS,)), **parts})()
    return content


def shown(**parts: Any) -> Call:
    call: Call = type("Mine", (Call,), {"name": "mine", **parts})()
    return call


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (made(holds=["intents"]), "holds is no frozenset of intents, words"),
        (made(holds=frozenset()), "holds is no frozenset"),
        (made(holds=frozenset(("smells",))), "holds is no frozenset"),
        (made(needs=("claims",)), "needs is no tuple of objects, plans"),
        (made(needs="plans"), "needs is no tuple of objects, plans"),
        (made(asks_helpers=False), "asks_helpers follows from what it holds"),
        (made(holds=frozenset((PLANS, WORDS))), "a plan holds nothing else"),
        (made(holds=frozenset((OBJECTS,))), "nothing that a rule fuses, and has no call"),
        (made(call="twice"), "its call is no Call"),
        (made(call=shown()), "in the graph or in words, one of both"),
        (made(call=shown(in_words=True)), "shows words, and it holds none"),
        (made(call=shown(name="text", in_graph=True)), "its call is named 'text'"),
    ],
)
def test_what_a_content_says_of_itself_is_checked(
    content: Content, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = type("Package", (), {"name": "by-hand"})
    entry = SimpleNamespace(value="packages:MINE", load=lambda: content, dist=package)
    monkeypatch.setattr(CONTENTS, "_entries", lambda: {"mine": entry})
    with pytest.raises(UserError) as error:
        CONTENTS["mine"]
    named = "plug-in 'mine' (swarmdrive.contents) of package by-hand fails ("
    assert str(error.value).startswith(named)
    assert told in str(error.value)
    assert "\n" not in str(error.value)


def of(content: Content, name: str = "mine") -> OperatingPoint:
    radio = SimpleNamespace(encoding="json")
    return cast(
        OperatingPoint,
        SimpleNamespace(
            content=content,
            radio=radio,
            physical=None,
            has_fusion_call=True,
            ask=SimpleNamespace(content=name),
        ),
    )


EVERY = np.ones((1, 3))
SAID = Intents(
    np.array([[0.3, 0.4, 0.3]]), np.array([[[1.0, 0.0, 0.0]] * 3]), EVERY > 0,
    np.full((1, 4), 10.0), 20 * EVERY, 400 * EVERY, np.full((1, 4), 0.1), text_bytes=40 * EVERY,
)  # fmt: skip


def written(given: Any) -> Any:
    given[:] = 0
    return given


@pytest.mark.parametrize(
    ("act", "told"),
    [
        (lambda i: replace(i, valid=written(i.valid)), "read-only"),
        (lambda i: replace(i, own=1 - i.own), "it changes own"),
        (lambda i: replace(i, helpers=0 * i.helpers), "it changes helpers"),
        (lambda i: replace(i, range_m=0 * i.range_m), "it changes range_m"),
        (lambda i: replace(i, valid=~i.valid), "who has nothing to send"),
        (lambda i: replace(i, valid=1.0 * i.valid), "who has nothing to send"),
        (lambda i: replace(i, valid=i.valid[:, :1]), "valid of shape (1, 1)"),
        (lambda i: replace(i, inference_s=0 * i.inference_s), "it changes the ego's time"),
        (
            lambda i: replace(i, inference_s=i.inference_s * [1, -1, -1, -1]),
            "times that are not from 0",
        ),
        (lambda i: replace(i, inference_s=i.inference_s * [1, 1, np.inf, 1]), "times that are not"),
        (lambda i: replace(i, inference_s=i.inference_s * [1, 1, np.nan, 1]), "times that are not"),
        (lambda i: replace(i, inference_s=i.inference_s * [1, 1, 1, 36001]), "from 0 to 3600 s"),
        (lambda i: None, "no attribute 'arrays'"),
    ],
)
def test_a_content_says_who_is_able_and_nothing_else(act: Callable[..., Any], told: str) -> None:
    content = made(able=lambda self, point, intents, senders: act(intents))
    some = replace(SAID, valid=np.array([[True, False, True]]))
    with pytest.raises(UserError) as error:
        door.able(of(content), some, None)
    assert str(error.value).startswith("content mine fails (")
    assert told in str(error.value)


@pytest.mark.parametrize(
    ("sizes", "told"),
    [
        (np.full((1, 2), 8.0), "sizes of shape (1, 2)"),
        (np.full((1, 3), -8.0), "sizes that are not from 0 to 1e+12 bits"),
        (np.full((1, 3), np.nan), "sizes that are not from 0"),
        (np.full((1, 3), 1e300), "sizes with 1e+300; allowed: up to 1e+12"),
        (8.0, "sizes of type float"),
    ],
)
def test_sizes_are_numbers_of_bits(sizes: Any, told: str) -> None:
    with pytest.raises(UserError) as error:
        door.bits(of(made(bits=lambda self, *given: sizes)), SAID)
    assert told in str(error.value)


def test_what_a_call_shows_is_a_graph_of_the_egos_or_a_line(small: Dataset) -> None:
    scene: Scene = small.scenes(small.courses())[0]
    ego, helper = scene.viewers[:2]
    own = scene.graphs[ego]
    case = SimpleNamespace(own=own)
    for given, told in (
        ([], "0 graphs of 1 cases"),
        (["a graph"], "no graph of the ego's"),
        ([scene.graphs[helper]], "no graph of the ego's"),
        ([changed(own, nodes=None)], "Expected `array`, got `null`"),
        ([changed(own, sectors=None)], "Expected `array`, got `null`"),
        ([changed(own, itself=changed(own.itself, zone_m=np.nan))], "Expected `float`, got `null`"),
        ([changed(own, ego=None)], "Expected `object`, got `null`"),
        ([changed(own, role="zork")], "Invalid enum value 'zork'"),
        ([changed(own, role="helper")], "whose role is another"),
        ([changed(own, step=-5)], "Expected `int` >= 0"),
        ([changed(own, step=own.step + 1)], "whose step is another"),
        ([changed(own, ego=changed(own.ego, speed_mps=99.0))], "whose ego is another"),
    ):
        call = shown(graphs=lambda self, scenario, cases, given=given: given)
        with pytest.raises(UserError, match=told):
            door.graphs(call, small.scenario, [cast(Any, case)])
    for taken in (own, own.blinded(), None):
        call = shown(graphs=lambda self, scenario, cases, taken=taken: [taken])
        assert door.graphs(call, small.scenario, [cast(Any, case)]) == [taken]
    assert door.words(shown(words=lambda self, text: f"{text}\n!"), "Go") == "Go !"
    with pytest.raises(UserError, match=r"^content mine fails .* surrogates not allowed"):
        door.words(shown(words=lambda self, text: "\udcff"), "Go")
    with pytest.raises(UserError, match="words of type int"):
        door.words(shown(words=lambda self, text: 1), "Go")
    with pytest.raises(UserError, match=r"^content mine fails .* words of 10001 characters"):
        door.words(shown(words=lambda self, text: 10001 * text), "G")


def test_an_obstacle_is_one_line_or_none() -> None:
    run = cast(Any, SimpleNamespace(agents=[SimpleNamespace(prompt=versions.load("v2"))]))

    def told(said: Any, **parts: Any) -> str | None:
        return door.obstacle(of(made(obstacle=lambda *_: said, **parts)), run)

    assert told("a\nb\x1b[31m") == "a b\\x1b[31m"
    assert told(None) is None
    for said in ("", " \n", 5, ["x"]):
        with pytest.raises(UserError, match="an obstacle that is no text, and not None"):
            told(said)
    words = told(None, call=shown(in_words=True))
    assert words == "prompt v2 cannot show words without an intent; use --prompt v11 or v12"


def test_the_papers_own_goes_through_no_door() -> None:
    point = of(OfIntent(), "intent")
    assert door.able(point, SAID, None) is SAID
    assert door.bits(point, SAID) is SAID.payload_bits
