"""Define streams: messages that vehicles send unasked, which the ego has before it asks anybody.

What an ego has heard depends on the course to its decision point and on the radio, and not on what
models answer. It stands in the key under which the ego's answer is kept, so that equal questions
are asked once.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from harness.core.arrays import Floats, Ints

if TYPE_CHECKING:
    from harness.world.scene_graph import SceneGraph


class Hearing(NamedTuple):
    """Hold what an ego has heard of a stream, and what became of it on the way.

    Scenes are decision points (`harness.dataset.load.Scene`).
    """

    scene: Any  # the ego's own
    source: Any  # the one whose ego received the messages: `scene`, unless a control shuffles them
    texts: Mapping[str, str]  # what it holds of each sender, by sender (`Stream.heard`)
    # By sender, where it does not send what it sees, as under an attack: a function of what it
    # knows and of the scene, both when it sends a message, which returns the graph that is sent.
    changes: "Mapping[str, Callable[[SceneGraph, Any], SceneGraph]]"


class Stream(Protocol):
    """Describe the messages that helpers send unasked under a condition, and what the ego hears.

    It can be hashed: conditions with equal streams hear alike. Scenes are decision points
    (`harness.dataset.load.Scene`) of a scenario (`harness.world.scenario.Scenario`).
    """

    def heard(self, scenario: Any, scenes: Sequence[Any]) -> list[Mapping[str, str]]:
        """Return, for each scene, what its ego holds of each sender's messages, by sender.

        It is a text that `Part.unasked_of` reads, without `+`, `&`, `!` and `/`. Senders of whom
        the ego holds nothing are left out.
        """

    def graphs(self, scenario: Any, heard: Sequence[Hearing]) -> "list[SceneGraph]":
        """Return each ego's scene graph with what it has heard.

        A scene graph is what one vehicle knows of a scene. The egos' scenes are all of one road.
        """

    def sent(self, scenario: Any, scenes: Sequence[Any]) -> "Sent":
        """Return what helpers have sent since the decision point before each of n scenes.

        All that they send counts, whoever hears it. At the first scene of a course it is nothing.
        """

    def allowed_s(self, scenario: Any, scenes: Sequence[Any]) -> list[Mapping[str, float]]:
        """Return, for each scene, when a sender may send its next message, s after it, by sender.

        It is 0 or more. Senders that may at once can be left out.
        """


class Sent(NamedTuple):
    """Hold how much helpers have sent unasked before n decisions, each since the one before."""

    messages: Floats  # number of messages, `(n,)`
    bits: Floats  # their size, `(n,)`
    # seconds that they were on air, `(n,)`; NaN where the channel's model does not know it
    airtime_s: Floats

    def take(self, at: Any) -> "Sent":
        """Return those before some of the decisions: at `at`, indices or a mask."""
        return Sent(*(array[at] for array in self))


class Streamed(NamedTuple):
    """Hold what n egos answer that have heard a stream, and what H helpers sent before."""

    own: Floats  # each ego's probabilities of its A actions, `(n, A)`; NaN where an answer failed
    inference_s: Floats  # seconds of each answer, `(n,)`; NaN where unknown
    sent: Sent  # what helpers have sent since the decision before
    # seconds from each decision's start until each helper may send its reply, `(n, H)`; 0 for at
    # once
    allowed_s: Floats

    def take(self, at: Ints) -> "Streamed":
        """Return the answers at these indices, `(m,)`."""
        return Streamed(self.own[at], self.inference_s[at], self.sent.take(at), self.allowed_s[at])
