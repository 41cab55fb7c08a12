"""Define what a helper's message holds:
its intent, its words, the objects that it lists, or the whole truth.

A content is asked, by what plays a decision and in this order, whether it can be played, which
helpers are able to send it, how large it is, and what the ego's model is asked once more with it:
with the helpers' words in its prompt, or with a scene graph that their objects make larger. A list
of objects needs no model: it can leave as soon as the request is there, while an intent and words
wait for the helper's inference. Where several vehicles decide, a message can hold its sender's own
plan, which costs no further inference.
"""

import re
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, ClassVar, Final

from harness.coordination.encodings import intent_bits
from harness.coordination.intents import Intents
from harness.core.arrays import Floats, Ints
from harness.core.errors import printable
from harness.core.plugins import Plugins

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint
    from harness.coordination.parts import RunFacts
    from harness.world.perception.shared import Heard
    from harness.world.scenario import Scenario
    from harness.world.scene_graph import SceneGraph

INTENT: Final = "intent"
# The kinds of what a message may hold.
INTENTS: Final = "intents"  # what helpers intend in the ego's place, by their models
WORDS: Final = "words"  # what helpers' models say beside an intent, or alone
OBJECTS: Final = "objects"  # what helpers' sensors list
TRUTH: Final = "truth"  # all that there is, which no message can hold
PLANS: Final = "plans"  # what agents are themselves going to do
KINDS = (INTENTS, WORDS, OBJECTS, TRUTH, PLANS)
NEEDS = (OBJECTS, PLANS)  # what a content may need of the world
# in the key of a message, after the name of a call: the prompt shows the whole message, too
WHOLE: Final = "words"
NAME = re.compile(r"\w[\w-]*")
BY_MODELS = frozenset((INTENTS, WORDS))  # what a helper's model is asked for


class Call:
    """Describe a second question to the ego's model, which shows it what it has heard from helpers.

    Some contents of messages have one (`Content.call`): the question adds the helpers' objects to
    the ego's scene graph, what it knows of the scene, (`in_graph`) or their words to its prompt
    (`in_words`). `name` stands in the keys under which answers to it are stored.
    """

    name: ClassVar[str]  # stands in the keys under which answers to it are stored
    in_graph: ClassVar[bool] = False  # whether what was heard is added to the ego's scene graph
    in_words: ClassVar[bool] = False  # whether what was heard is added to the prompt as text

    def graphs(
        self, scenario: "Scenario", cases: Sequence["Heard"]
    ) -> Sequence["SceneGraph | None"]:
        """Return the scene graph to show the ego in each case, or None where its own graph stays.

        A scene graph is what one vehicle knows of a scene. Each of `cases` is one ego's: its scene,
        its own graph and the graphs of the helpers that it has heard. All egos are of `scenario`:
        they come from the same approach, with the same route.
        """
        return [None] * len(cases)

    def words(self, evidence: str) -> str:
        """Return one helper's free text (`evidence`) as the line that the ego's prompt shows.

        Here it is the text in one line; a package's kind of question may write it in another way.
        """
        return " ".join(evidence.split())


class Content:
    """Describe what helpers' messages hold: the setting `content` of an operating point.

    An operating point is the settings of the radio, of asking helpers and of fusing their messages.
    Messages hold helpers' intents with their words, words alone, lists of detected objects, or
    senders' own plans. An intent is probabilities of the ego's actions. Methods of this base class
    are right for an intent with its words.
    """

    holds: frozenset[str]  # the kinds of what such a message holds, some of `KINDS`
    needs: tuple[str, ...] = ()  # what the world must know to make such messages, some of `NEEDS`
    # second question to the ego's model, which shows it what it has heard; None without one
    call: Call | None = None

    @property
    def of_agents(self) -> bool:
        """Return whether the senders decide for themselves, and send their own plans."""
        return PLANS in self.holds

    @property
    def asks_helpers(self) -> bool:
        """Return whether a helper's model must be asked before it can send such a message."""
        return not self.holds.isdisjoint(BY_MODELS)

    def obstacle(self, point: "OperatingPoint", run: "RunFacts") -> str | None:
        """Return why this content cannot be used under an operating point in a run, or None.

        It is one line, which also says what to do instead. `point` is the settings of the radio, of
        asking helpers and of fusing their messages; `run` has the run's models and prompts, its
        scenario and its world.
        """
        return None

    def able(self, point: "OperatingPoint", intents: Intents, senders: Ints | None) -> Intents:
        """Return what vehicles intend in n decisions, with only those helpers valid that can send.

        A helper that has nothing of this content is not valid in the result: it then sends nothing.
        May also change helpers' inference times. Raises UserError if it needs `senders` and they
        are None.

        Args:
            point: the operating point: the settings of the radio, of asking helpers and of fusing
                their messages.
            intents: what the ego and H helpers intend in each of the n decisions.
            senders: where messages hold plans, the row, among the n, of the decision that each
                helper makes itself at this time, `(n, H)`; -1 for none.
        """
        return intents

    def bits(self, encoding: str, intents: Intents, headers: bool) -> Floats:
        """Return the size of each helper's reply in bits, `(..., H)`.

        `encoding` is how messages are written, `json` or one of `encodings.ENCODINGS`; `intents`
        has what H helpers say in decisions `(...)`. `headers` says whether those of network and
        transport count.
        """
        return intent_bits(encoding, intents, headers)


class OfIntent(Content):
    """Describe the paper's content of messages: a helper's intent, with its words.

    The intent is what the helper would do in the ego's place, probabilities of the ego's actions.
    """

    holds = frozenset((INTENTS, WORDS))


class Contents(Plugins[Content]):
    """Hold what helpers' messages can carry, each a `Content`, by name, those of packages included.

    Such is `intent`: the probabilities that the helper gives to the ego's actions, with its words.
    """

    def check(self, name: str, plugin: Content) -> None:
        """Raise ValueError if what a package's messages carry, `plugin`, contradicts itself.

        Such is one that carries a sender's own plan and something beside it. `name` is the one
        under which the package offers it.
        """
        if not NAME.fullmatch(name) or name == WHOLE:
            raise ValueError("its name is no plain word")
        if name in _own_calls():
            raise ValueError("a call that ships has its name")
        holds, needs, call = plugin.holds, plugin.needs, plugin.call
        if not isinstance(holds, frozenset) or not holds or not holds <= set(KINDS):
            raise ValueError(f"holds is no frozenset of {', '.join(KINDS)}")
        for fact in ("asks_helpers", "of_agents"):
            if getattr(type(plugin), fact) is not getattr(Content, fact):
                raise ValueError(f"{fact} follows from what it holds")
        if not isinstance(needs, tuple) or not set(needs) <= set(NEEDS):
            raise ValueError(f"needs is no tuple of {', '.join(NEEDS)}")
        if PLANS in holds and (call or len(holds) > 1):
            raise ValueError("a message that holds a plan holds nothing else, and has no call")
        if call is None:
            if holds.isdisjoint((INTENTS, PLANS)):
                raise ValueError("it holds nothing that a rule fuses, and has no call")
            return
        if not isinstance(call, Call):
            raise ValueError("its call is no Call")
        if call.name != name:
            raise ValueError(f"its call is named {printable(repr(call.name))}")
        if bool(call.in_graph) == bool(call.in_words):
            raise ValueError("its call shows what was heard in the graph or in words, one of both")
        if call.in_words and WORDS not in holds:
            raise ValueError("its call shows words, and it holds none")


CONTENTS = Contents(
    "swarmdrive.contents",
    Content,
    {
        INTENT: OfIntent(),
    },
)


@cache
def _own_calls() -> frozenset[str]:
    """Return the names of the calls of contents that ship; no package's has one of them."""
    contents = [CONTENTS[name] for name in CONTENTS if CONTENTS.is_ours(name)]
    return frozenset(content.call.name for content in contents if content.call)


def is_ours(call: Call) -> bool:
    """Return whether a second question to the ego's model is the harness's own, not a package's.

    `call` is that question, of a content: what messages carry. Only one that ships is trusted
    unchecked.
    """
    return call.name in _own_calls()


def of_any_model() -> list[str]:
    """Return what messages can carry whatever answers for vehicles, by name, such as `objects`.

    Such a name is a value of the setting `content`. What answers may be no language model but a
    rule, which reads no words: what the ego's model must read is left out, and so are senders' own
    plans.
    """
    names = []
    for name, content in CONTENTS.usable().items():
        in_words = content.call is not None and content.call.in_words
        if not (content.of_agents or in_words):
            names.append(name)
    return names
