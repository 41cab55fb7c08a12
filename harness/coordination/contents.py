"""Define what a helper's message holds: its intent, the objects that it lists, both, or the whole truth.

What a message lists makes the ego's scene graph larger, and the ego's model is asked once more with that
graph. A list of objects needs no model: it can leave as soon as the request is there, while an intent waits
for the helper's inference.
"""

from typing import Final, Literal, NamedTuple

INTENT: Final = "intent"
OBJECTS: Final = "objects"
TRUTH: Final = "truth"


class Content(NamedTuple):
    """What a message holds."""

    intent: bool  # whether it holds the helper's intent, for which the helper's model is asked
    # what extends the ego's graph before its model is asked again: the `objects` of those who were heard, or
    # the `truth`, which no message can hold; empty where it is not asked again
    graph: Literal["", "objects", "truth"]


CONTENTS = {
    INTENT: Content(True, ""),  # the paper's
    OBJECTS: Content(False, OBJECTS),  # as a CPM or an SDSM; the ego acts on its answer to the larger graph
    "both": Content(True, OBJECTS),  # the ego's answer to the larger graph is fused with the helpers' intents
    "oracle": Content(False, TRUTH),  # the ceiling: an ego that hears anybody sees everything, without noise
}
