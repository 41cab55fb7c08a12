"""Define what a helper's message holds:
its intent, its words, the objects that it lists, or the whole truth.

A content is asked, by what plays a decision and in this order, whether it can be played, which
helpers are able to send it, how large it is, and what the ego's model is asked once more with it:
with the helpers' words in its prompt, or with a scene graph that their objects make larger. A list
of objects needs no model: it can leave as soon as the request is there, while an intent and words
wait for the helper's inference. Where several vehicles decide, a message can hold its sender's own
plan, which costs no further inference.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Final

from msgspec import structs

from harness.coordination.encodings import intent_bits, object_bits, words_bits
from harness.coordination.intents import Intents
from harness.core.arrays import Floats, Ints
from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint
    from harness.coordination.parts import RunFacts
    from harness.world.perception.shared import Heard
    from harness.world.scenario import Scenario
    from harness.world.scene_graph import SceneGraph

INTENT: Final = "intent"
TEXT: Final = "text"
PLAN: Final = "plan"
# The kinds of what a message may hold.
INTENTS: Final = "intents"  # what helpers intend in the ego's place, by their models
WORDS: Final = "words"  # what helpers' models say beside an intent, or alone
OBJECTS: Final = "objects"  # what helpers' sensors list
TRUTH: Final = "truth"  # all that there is, which no message can hold
PLANS: Final = "plans"  # what agents are themselves going to do
KINDS = (INTENTS, WORDS, OBJECTS, TRUTH, PLANS)
BY_MODELS = frozenset((INTENTS, WORDS))  # what a helper's model is asked for


class Call:
    """A further question to the ego's model, with what it has heard."""

    name: ClassVar[str]  # marks it in the keys of what was heard
    in_graph: ClassVar[bool] = False  # whether the ego's graph has what was heard
    in_words: ClassVar[bool] = False  # whether the prompt has it

    def graphs(
        self, scenario: "Scenario", cases: Sequence["Heard"]
    ) -> Sequence["SceneGraph | None"]:
        """Return the ego's graph of each case; None where its own stays. All are of one seat."""
        return [None] * len(cases)

    def message(self, message: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return what the prompt shows of a message, whose evidence is text."""
        return message


class Content:
    """What a message holds; plainly, a helper's intent, with its words beside it."""

    holds: ClassVar[frozenset[str]]  # some of the kinds above
    needs: ClassVar[tuple[str, ...]] = ()  # what it needs of the world: `objects` or `plans`
    # whether its senders are agents, whose messages are made of what they decide now, and of no
    # answer
    of_agents: ClassVar[bool] = False
    call: ClassVar[Call | None] = None  # what the ego is asked once more; None if it is not

    @property
    def asks_helpers(self) -> bool:
        """Whether the helper's model is asked for it."""
        return not self.holds.isdisjoint(BY_MODELS)

    def obstacle(self, point: "OperatingPoint", run: "RunFacts") -> str | None:
        """Return why it cannot be played in a run, and what to do; None if it can."""
        return None

    def able(self, point: "OperatingPoint", intents: Intents, senders: Ints | None) -> Intents:
        """Return what helpers intend, (n, ...), of whom only those are valid that can send it.

        `senders` has the decision that each helper makes itself now, (n, H), if it needs `plans`.
        """
        return intents

    def bits(self, encoding: str, intents: Intents, headers: bool) -> Floats:
        """Return the size of each helper's reply, `(..., H)`."""
        return intent_bits(encoding, intents, headers)


class OfIntent(Content):
    """The paper's."""

    holds = frozenset((INTENTS, WORDS))


class SaysWords(Call):
    """Shows each helper's words in one line, and nothing else."""

    name = TEXT
    in_words = True

    def message(self, message: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"evidence": " ".join(message["evidence"].split())}


class OfText(Content):
    """The helper's words alone: the ego acts on its answer to them."""

    holds = frozenset((WORDS,))
    call = SaysWords()

    def obstacle(self, point: "OperatingPoint", run: "RunFacts") -> str | None:
        prompt = run.agents[0].prompt
        if point.has_fusion_call and not prompt.shows_words:
            return (
                f"prompt {prompt.version} cannot show words without an intent; use --prompt v11 "
                "or v12"
            )
        return None

    def able(self, point: "OperatingPoint", intents: Intents, senders: Ints | None) -> Intents:
        return intents.with_words()

    def bits(self, encoding: str, intents: Intents, headers: bool) -> Floats:
        return words_bits(encoding, intents, headers)


class ListsObjects(Call):
    """Adds to the ego's graph what helpers list, and themselves."""

    name = OBJECTS
    in_graph = True

    def graphs(
        self, scenario: "Scenario", cases: Sequence["Heard"]
    ) -> Sequence["SceneGraph | None"]:
        from harness.world.perception.shared import merged

        return merged(scenario, cases)


class OfObjects(Content):
    """A list of objects, as a CPM or an SDSM: the ego acts on its answer to the larger graph."""

    holds = frozenset((OBJECTS,))
    needs = (OBJECTS,)
    call = ListsObjects()

    def able(self, point: "OperatingPoint", intents: Intents, senders: Ints | None) -> Intents:
        return intents.without_models() if point.asks else intents

    def bits(self, encoding: str, intents: Intents, headers: bool) -> Floats:
        return object_bits(encoding, intents, headers)


class OfBoth(Content):
    """Two messages, of which one holds an intent and one objects:
    the ego's answer to the larger graph is fused with the intents.
    """

    holds = frozenset((INTENTS, WORDS, OBJECTS))
    needs = (OBJECTS,)
    call = ListsObjects()

    def bits(self, encoding: str, intents: Intents, headers: bool) -> Floats:
        of_intents = intent_bits(encoding, intents, headers)
        return of_intents + object_bits(encoding, intents, headers)


class ShowsTruth(Call):
    """Takes the true graph, of which every region is in sight, for the ego's."""

    name = TRUTH
    in_graph = True

    def graphs(
        self, scenario: "Scenario", cases: Sequence["Heard"]
    ) -> Sequence["SceneGraph | None"]:
        from harness.world.perception.graph import truth_graphs

        truths = truth_graphs(scenario, [case.state for case in cases])
        graphs = []
        for truth, case in zip(truths, cases, strict=True):
            graphs.append(structs.replace(truth, sectors=case.own.all_in_sight))
        return graphs


class OfTruth(Content):
    """Perfect sharing: an ego that hears anybody sees everything, without noise.

    It is no bound, since a model may misread the truth, and plans on its own view again where it
    does not ask.
    """

    holds = frozenset((TRUTH,))
    needs = (OBJECTS,)
    call = ShowsTruth()

    def able(self, point: "OperatingPoint", intents: Intents, senders: Ints | None) -> Intents:
        return intents.without_models() if point.asks else intents

    def bits(self, encoding: str, intents: Intents, headers: bool) -> Floats:
        return object_bits(encoding, intents, headers)


class OfPlan(Content):
    """What its sender is itself going to do: the answer that it gave as an agent."""

    holds = frozenset((PLANS,))
    needs = (PLANS,)
    of_agents = True

    def obstacle(self, point: "OperatingPoint", run: "RunFacts") -> str | None:
        return None if run.several_decide else NO_AGENTS

    def able(self, point: "OperatingPoint", intents: Intents, senders: Ints | None) -> Intents:
        if intents.plans is None or senders is None:
            raise UserError(f"condition {printable(point.name)}: {NO_AGENTS}")
        return intents.planned(senders)


NO_AGENTS = (
    "content plan needs several agents, and here one ego decides; give --agents all with `harness "
    "drive`, or content=intent"
)
CONTENTS: Mapping[str, Content] = {
    INTENT: OfIntent(),
    TEXT: OfText(),
    PLAN: OfPlan(),
    OBJECTS: OfObjects(),
    "both": OfBoth(),
    "oracle": OfTruth(),
}
# What messages of one ego's helpers hold; a plan is sent by agents alone.
OF_HELPERS = tuple(name for name, content in CONTENTS.items() if not content.of_agents)


@cache
def calls() -> Mapping[str, Call]:
    """Return the further questions to the ego that contents ask, by name."""
    return {content.call.name: content.call for content in CONTENTS.values() if content.call}
