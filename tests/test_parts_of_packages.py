"""What a package's part may do: it moves its own condition alone, and fails in one line."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from harness.coordination.coordinate import coordinate
from harness.coordination.intents import Intents
from harness.coordination.named_points import named_point
from harness.coordination.operating_point import OperatingPoint, kept_of
from harness.coordination.parts import PACKAGES_PARTS, PLAIN, Kept, Part, Question
from harness.coordination.parts_of_packages import (
    SpeakerOfPart,
    after_call,
    after_fusion,
    change_by,
    obstacle,
    prepared,
    shown_graph,
    sources,
)
from harness.coordination.sent import SentIntents
from harness.core.errors import UserError
from harness.dataset.load import Dataset, Scene
from harness.radio.channel import Draws

P = np.full((2, 2), 0.5)
PLACES = np.arange(2)
NOBODY = np.zeros((2, 2), dtype=bool)
DRAWS = Draws(P, np.full((2, 1), 0.5))


def intents() -> Intents:
    own = np.array([[0.2, 0.8], [np.nan, np.nan]])
    return Intents(own, np.full((2, 2, 2), 0.5), ~NOBODY, np.ones((2, 3)), 2 * P, 2 * P,
                   np.ones((2, 3)))  # fmt: skip


def written(given: Any) -> Any:
    given[:] = 0
    return given


def of_part(hook: str, act: Callable[..., Any]) -> Part:
    return made(**{hook: lambda self, *given: act(*given)})


def made(**members: Any) -> Part:
    kind: Any = type("Mine", (Part,), members, frozen=True)
    PACKAGES_PARTS[kind] = "part mine of package by-hand"
    part: Part = kind()
    return part


@dataclass
class Speaks:
    act: Callable[[Intents], Any]

    def said(self, truth: Intents, *given: Any) -> Any:
        return self.act(truth)


@pytest.mark.parametrize(
    ("act", "says"),
    [
        (lambda i: replace(i, own=written(i.own)), "read-only"),
        (lambda i: replace(i, inference_s=0 * i.inference_s), "it changes inference_s"),
        (lambda i: replace(i, range_m=0 * i.range_m), "it changes range_m"),
        (lambda i: replace(i, own=2 * i.own), "the ego's intents that are no distributions"),
        (lambda i: replace(i, helpers=np.nan * i.helpers), "helpers' intents that are no distr"),
        (lambda i: replace(i, helpers=i.helpers[:, :1]), "helpers' intents of shape (2, 1, 2)"),
        (lambda i: None, "no attribute 'arrays'"),
    ],
)
def test_a_part_prepares_intents_and_nothing_else(act: Callable[..., Any], says: str) -> None:
    before = intents()
    with pytest.raises(UserError) as error:
        prepared(of_part("before", act), before)
    assert str(error.value).startswith("part mine of package by-hand fails (")
    assert says in str(error.value)
    assert np.array_equal(before.own, intents().own, equal_nan=True)


def test_a_part_may_turn_intents_round_and_an_answer_that_failed_stays_so() -> None:
    turned = of_part("before", lambda i: replace(i, own=i.own[:, ::-1]))
    own = prepared(turned, intents()).own
    assert own.tolist()[0] == [0.8, 0.2]
    assert np.isnan(own[1]).all()


@pytest.mark.parametrize(
    ("act", "says"),
    [
        (lambda t: SentIntents(t, DRAWS, written(t.valid)), "read-only"),
        (lambda t: SentIntents(replace(t, own=0 * t.own), DRAWS, NOBODY), "it changes the ego's i"),
        (
            lambda t: SentIntents(replace(t, inference_s=0 * t.inference_s), DRAWS, NOBODY),
            "it changes the ego's time",
        ),
        (
            lambda t: SentIntents(replace(t, helpers=9 * t.helpers), DRAWS, NOBODY),
            "intents that are no distributions",
        ),
        (lambda t: SentIntents(t, DRAWS, NOBODY[0]), "attackers of shape (2,)"),
        (lambda t: (t, DRAWS, NOBODY), "no attribute 'intents'"),
    ],
)
def test_a_speaker_says_nothing_of_the_egos(act: Callable[..., Any], says: str) -> None:
    with pytest.raises(UserError) as error:
        SpeakerOfPart(made(), Speaks(act)).said(intents(), DRAWS, PLACES, PLACES)
    assert str(error.value).startswith("part mine of package by-hand fails (")
    assert says in str(error.value)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ([0, 1], "sources of type list"),
        (np.array([0]), "sources of shape (1,)"),
        (np.array([0.0, 1.0]), "sources that are no decisions"),
        (np.array([-1, 0]), "sources that are no decisions"),
        (np.array([0, 2]), "sources that are no decisions"),
    ],
)
def test_messages_come_from_decisions_that_there_are(given: Any, says: str) -> None:
    with pytest.raises(UserError) as error:
        sources(of_part("sources", lambda *_: given), PLACES, PLACES)
    assert says in str(error.value)


@pytest.mark.parametrize(
    ("act", "says"),
    [
        (lambda fused, p, heard: written(p)[:, 0], "read-only"),
        (lambda fused, p, heard: 5 * fused, "policies that are no distributions"),
        (lambda fused, p, heard: np.nan * fused, "policies that are no distributions"),
        (lambda fused, p, heard: None, "policies of type NoneType"),
    ],
)
def test_the_last_word_on_a_call_is_a_policy(act: Callable[..., Any], says: str) -> None:
    with pytest.raises(UserError) as error:
        after_call(of_part("after_call", act), P, np.full((2, 3, 2), 0.5), ~NOBODY)
    assert says in str(error.value)


@pytest.mark.parametrize(
    ("act", "says"),
    [
        (lambda fused: written(fused), "read-only"),
        (lambda fused: fused[:1], "policies of shape (1, 2)"),
        (lambda fused: 2 * fused, "policies that are no distributions"),
        (lambda fused: 1 / 0, "ZeroDivisionError"),
    ],
)
def test_the_policies_by_which_egos_act_are_policies(act: Callable[..., Any], says: str) -> None:
    with pytest.raises(UserError) as error:
        after_fusion(of_part("after_fusion", act), np.full((2, 2), 0.5))
    assert says in str(error.value)


def test_a_package_may_have_the_last_word_on_what_egos_do() -> None:
    """It acts by the second action; with one helper or none, in every decision."""
    point = named_point("6g:tau=0.5")
    plain = coordinate(point, intents(), DRAWS)
    second = np.array([0.0, 1.0])
    part = of_part("after_fusion", lambda fused: np.broadcast_to(second, fused.shape))
    object.__setattr__(point, "more", (part,))
    acted = coordinate(point, intents(), DRAWS)
    np.testing.assert_array_equal(acted.fused, np.broadcast_to(second, plain.fused.shape))
    np.testing.assert_array_equal(acted.action, np.ones_like(plain.action))
    np.testing.assert_array_equal(acted.latency_s, plain.latency_s)


@pytest.mark.parametrize(
    ("hook", "act", "says"),
    [
        ("check", lambda: next(iter(())), "part mine of package by-hand fails (StopIteration at"),
        ("kept", lambda: {"x": {"../y": Kept(1)}}, "../y to keep is no plain name"),
        ("kept", lambda: {"..": {"y": Kept(1)}}, ".. to keep is no plain name"),
        ("kept", lambda: {"x": {"y": Kept(object())}}, "Encoding objects of type object"),
    ],
)
def test_a_part_that_fails_as_a_run_begins_is_one_line(
    hook: str, act: Callable[[], Any], says: str
) -> None:
    with pytest.raises(UserError) as error:
        kept_of([cast(OperatingPoint, SimpleNamespace(more=[of_part(hook, act)]))])
    assert says in str(error.value)


@pytest.mark.parametrize(
    ("hook", "value", "ask"),
    [
        ("needs", property(lambda part: 1 / 0), lambda point: point.needs("claims")),
        ("needs", None, lambda point: point.needs("claims")),
        ("needs_all", property(lambda part: 1 / 0), lambda point: point.needs_all),
        ("question", Question("zork"), lambda point: point.question),
        ("question", None, lambda point: point.question),
        ("elsewhere", np.zeros(2), lambda point: point.elsewhere),
        ("changes", lambda part, words, objects: None, lambda point: point.rewrites),
        ("speaker", lambda part: 1 / 0, lambda point: point.speaker()),
    ],
)
def test_what_a_part_says_of_itself_is_asked_behind_the_door(
    hook: str, value: Any, ask: Callable[[OperatingPoint], Any]
) -> None:
    point = named_point("6g:tau=0.5")
    object.__setattr__(point, "more", (made(**{hook: value}),))
    with pytest.raises(UserError, match=r"^part mine of package by-hand fails \("):
        ask(point)


MESSAGE = {"intent": [0.25, 0.75], "evidence": "Clear.", "confidence": 0.5}


@pytest.mark.parametrize(
    ("act", "says"),
    [
        (lambda m: None, "'NoneType' object has no attribute 'keys'"),
        (lambda m: {"intent": m["intent"]}, "it adds members to a message, or leaves some out"),
        (lambda m: {**m, "zork": 1}, "it adds members to a message, or leaves some out"),
        (lambda m: {**m, "confidence": "high"}, "it gives confidence of type str"),
        (lambda m: {**m, "evidence": 5}, "it gives evidence of type int"),
        (lambda m: {**m, "evidence": "\ud800"}, "surrogates not allowed"),
        (lambda m: {**m, "intent": [0.5]}, "an intent of shape (1,), not (2,)"),
        (lambda m: {**m, "intent": [np.nan, 1.0]}, "an intent that are no distributions"),
        (lambda m: {**m, "intent": [2.0, -1.0]}, "an intent that are no distributions"),
        (lambda m: {**m, "intent": object()}, "Encoding objects of type object"),
    ],
)
def test_what_a_part_does_to_messages_is_held_to_what_a_message_is(
    act: Callable[..., Any], says: str
) -> None:
    class Alters:
        adds = False

        def message(self, message: Any, actions: Any) -> Any:
            return act(message)

    change = change_by(type(made(change=lambda text: Alters())), "zork")
    assert change is not None
    with pytest.raises(UserError) as error:
        change.message(MESSAGE, ("GO", "STAY"))
    assert str(error.value).startswith("part mine of package by-hand fails (")
    assert says in str(error.value)


def test_what_a_part_asks_helpers_is_a_graph_of_the_helpers(small: Dataset) -> None:
    class Asks(Question):
        def shown(self, graph: Any) -> Any:
            return "a graph"

    question = Asks("mine")
    made(questions=(question,))
    scene: Scene = small.scenes(small.courses())[0]
    graph = scene.graphs[scene.viewers[1]]
    with pytest.raises(UserError, match=r"^part mine of .* no graph of the helper's"):
        shown_graph(question, graph)
    assert shown_graph(PLAIN, graph) is graph


def test_an_obstacle_is_one_line_or_none() -> None:
    def told(said: Any) -> str | None:
        return obstacle(of_part("obstacle", lambda *_: said), cast(Any, None), cast(Any, None))

    assert told("a\nb\x1b[31m" + 1000 * "!") == "a b\\x1b[31m" + 288 * "!" + "…"
    assert told(None) is None
    for said in ("", " \n", 5, ["x"]):
        with pytest.raises(UserError, match=r"^part mine of package by-hand fails .* no text, and"):
            told(said)


class Echo(Part, frozen=True, kw_only=True):
    echo: int = 0
    loud: bool = False


@pytest.mark.parametrize(
    ("setting", "value", "allowed"),
    [("echo", "abc", "a whole number"), ("loud", 3, "true or false")],
)
def test_a_setting_whose_type_says_no_range_is_refused_by_its_type(
    setting: str, value: Any, allowed: str
) -> None:
    with pytest.raises(ValueError, match=f"{setting} is .*; it must be {allowed}"):
        Echo(**{setting: value})
