"""Define what a helper's message holds:
its intent, its words, the objects that it lists, or the whole truth.

What a message holds besides an intent is for the ego's model, which is asked once more: with the
helpers' words in its prompt, or with a scene graph that their objects make larger. A list of
objects needs no model: it can leave as soon as the request is there, while an intent and words wait
for the helper's inference. Where several vehicles decide, a message can hold its sender's own plan,
which costs no further inference.
"""

from typing import Final, Literal, NamedTuple

INTENT: Final = "intent"
TEXT: Final = "text"
OBJECTS: Final = "objects"
PLAN: Final = "plan"
TRUTH: Final = "truth"


class Content(NamedTuple):
    """What a message holds."""

    intent: bool  # whether it holds the helper's intent, with the words beside it
    # what extends the ego's graph before its model is asked again: the `objects` of those who were
    # heard, or the `truth`, which no message can hold; empty where it is not asked again
    graph: Literal["", "objects", "truth"] = ""
    words: bool = False  # whether it holds the helper's words and nothing else
    # whether it holds what its sender is itself going to do: the answer that it gave as an agent
    plan: bool = False

    @property
    def asks_helpers(self) -> bool:
        """Whether the helper's model is asked for it."""
        return self.intent or self.words

    @property
    def asks_again(self) -> bool:
        """Whether the ego's model is asked once more with it."""
        return bool(self.graph) or self.words


CONTENTS = {
    INTENT: Content(intent=True),  # the paper's
    TEXT: Content(intent=False, words=True),  # the ego acts on its answer to the helpers' words
    PLAN: Content(intent=False, plan=True),  # from agents alone
    # as a CPM or an SDSM; the ego acts on its answer to the larger graph
    OBJECTS: Content(intent=False, graph=OBJECTS),
    # the ego's answer to the larger graph is fused with the helpers' intents
    "both": Content(intent=True, graph=OBJECTS),
    # perfect sharing: an ego that hears anybody sees everything, without noise. It is no bound,
    # since a model may misread the truth, and plans on its own view again where it does not ask
    "oracle": Content(intent=False, graph=TRUTH),
}
# What messages of one ego's helpers hold; a plan is sent by agents alone.
OF_HELPERS = tuple(name for name, content in CONTENTS.items() if not content.plan)
