"""Fixed questions that try a model out: twelve scenes of tune layouts,
and pairs that differ in one fact.

`questions.json` has the scenes: of each of twelve layouts the first decision point of the reference
drivers at which the ego sees one conflict and a helper is near, as `harness dataset build
occluded-intersection --seed 1000` freezes it. No layout is one of a report.
"""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec
from msgspec.structs import replace

from harness.backends.base import Request, Role
from harness.core.files import text_of
from harness.evaluate.agent import Agent
from harness.prompts import readout
from harness.world import scenarios
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph

SCENARIO = "occluded-intersection:witnesses=any,radio_share=0,limits=1,perception=1"
# How much later than the ego the other vehicle arrives, in the two halves of a pair.
SOON_S, LATE_S = 0.2, 5.0
Fact = Literal["conflict", "gap", "danger", "number"]
YES_NO = ("YES", "NO")
_DANGER = (
    ("A car is about to hit you.", "The road is empty."),
    ("A child runs onto the road in front of you.", "No one is near the road."),
    ("The car ahead has stopped and is 3 m away.", "The car ahead is 300 m away and drives off."),
    ("A truck crosses your lane right now.", "Nothing crosses your lane."),
)
_NUMBERS = ((5, 3), (9, 2), (8, 1), (7, 4))


class Question(msgspec.Struct, frozen=True):
    """Hold one fixed question to try a model: what the ego and a helper see in one scene.

    `layout_seed` is the seed of the scene's start situation, and `step` the number of the decision
    in its episode, from 0. `graphs` has by role, `ego` and `helper`, the scene graph that is shown:
    what that vehicle knows of the scene.
    """

    layout_seed: int  # seed of the layout
    step: int  # number of the decision point in its episode
    graphs: Mapping[Role, SceneGraph]  # what the ego and a helper see, by role


class Pair(NamedTuple):
    """Hold two requests that differ in one fact, to test whether the answer follows it.

    `present` has the fact and `absent` has not; `expected` is the option that the fact should make
    likelier. The `fact` is of the kind `conflict` (a conflict of paths) or `gap` (little time
    between the vehicles) in a scene, or `danger` or `number` in a simple question.
    """

    fact: Fact  # the kind of fact
    expected: str  # the action that should be likelier with the fact
    present: Request  # the request with the fact
    absent: Request  # the request without


@cache
def questions() -> tuple[Question, ...]:
    """Return the twelve fixed questions that try a model out, which ship with the program."""
    text = text_of(Path(__file__).with_name("questions.json"), "settings")
    return msgspec.json.decode(text, type=tuple[Question, ...])


def scenario() -> Scenario:
    """Return the scenario, the kind of traffic situation, of the fixed questions."""
    return scenarios.get(SCENARIO)


def requests(agent: Agent, role: Role = "ego") -> list[Request]:
    """Return the twelve fixed questions as requests to an agent in a role, at temperature 0.

    An agent is a model with its prompt and answer mode; the role is `ego` or `helper`.
    """
    return [
        _request(agent, question.graphs[role], f"question-{n}/{role}")
        for n, question in enumerate(questions())
    ]


def scene_pairs(agent: Agent) -> list[Pair]:
    """Return pairs of scenes that differ in one fact, as requests to an agent, four of each kind.

    An agent is a model with its prompt and answer mode, here as the ego. Of the kind `conflict`, a
    conflict of paths is listed or not; of `gap`, the other vehicle arrives `SOON_S` or `LATE_S`
    seconds after the ego. SLOWER should be likelier with the conflict, and with the small gap.
    """

    def pair(fact: Fact, number: int, present: SceneGraph, absent: SceneGraph) -> Pair:
        halves = (("a", present), ("b", absent))
        return Pair(
            fact,
            "SLOWER",
            *(_request(agent, half, f"{fact}-{number}{end}/ego") for end, half in halves),
        )

    every = []
    for n, question in enumerate(questions()[::3]):
        graph = question.graphs["ego"]
        every.append(pair("conflict", n, graph, replace(graph, conflicts=())))
        every.append(pair("gap", n, _arriving(graph, SOON_S), _arriving(graph, LATE_S)))
    return every


def plain_pairs(agent: Agent) -> list[Pair]:
    """Return pairs of simple questions without a scene that differ in one fact, four of each kind.

    They are answered by YES or NO. Of the kind `danger`, the question is whether to brake, in
    danger or without; of `number`, whether the first of two numbers is greater. `agent` is the
    model with a prompt, and with an answer mode that reads letters.
    """
    every = []
    for n, (present_text, absent_text) in enumerate(_DANGER):
        every.append(_plain(agent, "danger", n, f"{present_text} Brake?", f"{absent_text} Brake?"))
    for n, (large, small) in enumerate(_NUMBERS):
        texts = (f"Is {a} greater than {b}?" for a, b in ((large, small), (small, large)))
        every.append(_plain(agent, "number", n, *texts))
    return every


def _request(agent: Agent, graph: SceneGraph, name: str) -> Request:
    actions, words, here = scenario().actions, scenario().prompt_words, scenario()
    return agent.blank(graph.role, actions).alike(
        id=name, view=graph, scenario=here, **agent.chats(graph, actions, words)
    )


def _arriving(graph: SceneGraph, later_s: float) -> SceneGraph:
    """Return a graph whose conflict has the other vehicle arrive so much later than the ego."""
    [conflict] = graph.conflicts
    later = replace(conflict.other, time_s=round((conflict.ego.time_s or 0.0) + later_s, 1))
    return replace(graph, conflicts=(replace(conflict, other=later),))


def _plain(agent: Agent, fact: Fact, number: int, present: str, absent: str) -> Pair:
    """Return a pair of plain questions, which are answered by YES or NO."""

    def half(end: str, text: str) -> Request:
        chat = [{"role": "user", "content": text}]
        chats = agent.in_orders(YES_NO, lambda order: readout.letter_chat(chat, order))
        return agent.blank("ego", YES_NO).alike(id=f"{fact}-{number}{end}/ego", **chats)

    return Pair(fact, "YES", half("a", present), half("b", absent))
