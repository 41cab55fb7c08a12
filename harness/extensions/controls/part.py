"""The setting `messages` of a condition: what the ego hears in the place of its helpers."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from harness.coordination.contents import INTENTS, OBJECTS, TRUTH, WORDS
from harness.coordination.parts import PLAIN, ActsOn, Part, Question, RunFacts, Text
from harness.core.arrays import Ints
from harness.core.errors import unknown
from harness.core.extensions import control_settings

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint
    from harness.world.scene_graph import SceneGraph

OWN, SHUFFLED, BLIND = "own", "shuffled", "blind"
MESSAGES = (OWN, SHUFFLED, BLIND)
NO_MESSAGES = {"no-messages": "loss=1"}


@dataclass(frozen=True)
class Blinded(Question):
    """Ask a helper's model the usual question, with a scene graph and a picture that show nothing.

    A scene graph is what a vehicle knows of the scene. `name` ends the key of answers to this
    question, `words` says in messages how helpers are asked, and `pictured` whether a camera's
    picture is shown.
    """

    name: str = BLIND
    words: str = "are shown nothing, which messages=blind needs"
    pictured: bool = False

    def shown(self, graph: "SceneGraph") -> "SceneGraph":
        return graph.blinded()


# An agent that plans is itself asked, and the truth of another scene is another scene.
ACTS_ON = {BLIND: (INTENTS, WORDS, OBJECTS, TRUTH), SHUFFLED: (INTENTS, WORDS, OBJECTS)}


def _others(holds: frozenset[str]) -> list[str]:
    return [control for control in ACTS_ON if not holds.isdisjoint(ACTS_ON[control])]


class Controlled(Part, frozen=True, kw_only=True):
    """Hold the setting `messages` of an operating point: whose messages the ego hears.

    An operating point is the settings of radio, asking and fusion. `own` takes messages of the
    ego's own helpers. Two values are controls: `shuffled` takes messages of helpers in another
    start situation, and `blind` those of helpers that are shown nothing. A gain in success that
    remains under them does not come from what helpers see. Of what helpers send unasked, `shuffled`
    is all that the ego of the other decision then holds, whoever sends there; `blind` is where the
    sender is, as often as it would send. Methods are the hooks of `Part`, a group of such settings.
    `behind` is the setting after which it stands in records, `questions` has what helpers may be
    asked by it, and `controls` says by the value what the ego hears.
    """

    behind: ClassVar[str] = "on_demand"
    questions: ClassVar = (Blinded(),)
    controls: ClassVar = {
        f"messages={SHUFFLED}": "what helpers say in another layout, while a decision's page shows "
        "what its own helpers say",
        f"messages={BLIND}": "helpers that are shown nothing",
    }

    # whom the ego hears: its `own` helpers, helpers of another layout (`shuffled`), or helpers that
    # are shown nothing (`blind`)
    messages: Text = OWN

    def check(self) -> None:
        if self.messages not in MESSAGES:
            raise unknown("messages", self.messages, MESSAGES)

    @property
    def acts_on(self) -> Collection[ActsOn]:
        if self.messages == OWN:
            return ()
        return (ActsOn("messages", self.messages, ACTS_ON[self.messages], OWN, _others),)

    def obstacle(self, point: "OperatingPoint", run: RunFacts) -> str | None:
        if not self.elsewhere:
            return None
        if not run.frozen:
            return f"messages={SHUFFLED} is for frozen scenes; use harness eval"
        return None

    @property
    def question(self) -> Question:
        return self.questions[0] if self.messages == BLIND else PLAIN

    @property
    def elsewhere(self) -> bool:
        return self.messages == SHUFFLED

    def sources(self, episodes: Ints, seeds: Ints) -> Ints:
        """Return, for n decisions, the index of the one whose helpers each hears if shuffled, (n,).

        `episodes`, (n,), and `seeds`, (n,), have the number of each decision's episode and the seed
        of its channel's draws. It is the decision of the next episode under the same seed; the last
        one's is that of the first.
        """
        order = np.lexsort((episodes, seeds))
        following = np.roll(order, -1)
        starts = np.flatnonzero(np.diff(seeds[order], prepend=seeds[order[0]] - 1))
        following[np.roll(starts, -1) - 1] = order[starts]  # the last of a seed hears its first
        sources = np.empty_like(order)
        sources[order] = following
        return sources


def setting_of(control: str) -> str:
    """Return the setting of radio, asking and fusion that is a control, by the control's name.

    A control replaces what helpers say, to show whether a gain comes from what they see. For
    example, `shuffled-messages` is `messages=shuffled`. Raises UserError if there is no such
    control.
    """
    settings = {**NO_MESSAGES, **control_settings()}
    if control not in settings:
        raise unknown("--control", control, settings)
    return settings[control]
