"""Contents of messages that make the ego's graph larger: lists of objects, alone or beside an
intent, and the truth, which no message can hold.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from msgspec import structs

from harness.coordination import contents as kinds
from harness.coordination.contents import INTENTS, TRUTH, WORDS, Call, Content
from harness.coordination.encodings import intent_bits, object_bits
from harness.coordination.intents import Intents
from harness.core.arrays import Floats, Ints

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint
    from harness.world.perception.shared import Heard
    from harness.world.scenario import Scenario
    from harness.world.scene_graph import SceneGraph


class ListsObjects(Call):
    """Ask the ego's model again, with a scene graph that also has the helpers' lists of objects.

    A scene graph is what a vehicle knows of the scene; objects are the vehicles that a helper's
    sensors see. It is a `Call`, a second question that shows the ego's model what it has heard.
    """

    name = "objects"
    in_graph = True

    def graphs(
        self, scenario: "Scenario", cases: Sequence["Heard"]
    ) -> Sequence["SceneGraph | None"]:
        from harness.world.perception.shared import merged

        return merged(scenario, cases)


class ShowsTruth(Call):
    """Ask the ego's model again with the true scene graph, in which every region is in sight.

    A scene graph is what a vehicle knows of the scene. No message can hold the whole truth, so what
    the ego then does bounds what messages can bring. It is a `Call`, a second question to the ego's
    model.
    """

    name = "truth"
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


class OfLists(Content):
    """Describe a message that lists the objects which a helper's sensors see.

    A helper is a vehicle that the ego (the car that decides) asks. Its model is not asked, so the
    message leaves at once. The ego's model is asked again (`call`) with a scene graph (what the ego
    knows) that has these objects as well, and the ego acts on that answer. `kind` says which of the
    kinds of `coordination.contents.KINDS` the message holds.
    """

    needs = (kinds.OBJECTS,)

    def __init__(self, kind: str, call: Call) -> None:
        self.holds = frozenset((kind,))
        self.call = call

    def able(self, point: "OperatingPoint", intents: Intents, senders: Ints | None) -> Intents:
        return intents.without_models() if point.asks else intents

    def bits(self, encoding: str, intents: Intents, headers: bool) -> Floats:
        return object_bits(encoding, intents, headers)


class OfBoth(Content):
    """Describe two messages of a helper: its intent, and the list of objects that it sees.

    An intent is probabilities of the ego's actions. The ego's model is asked again with a scene
    graph (what the ego knows) that has these objects as well, and that answer is fused with the
    intents to the policy that the ego acts on.
    """

    holds = frozenset((INTENTS, WORDS, kinds.OBJECTS))
    needs = (kinds.OBJECTS,)
    call = ListsObjects()

    def bits(self, encoding: str, intents: Intents, headers: bool) -> Floats:
        of_intents = intent_bits(encoding, intents, headers)
        return of_intents + object_bits(encoding, intents, headers)


OBJECTS = OfLists(kinds.OBJECTS, ListsObjects())  # as a CPM or an SDSM
BOTH = OfBoth()
# Perfect sharing: an ego that hears anybody sees everything, without noise. It is no bound, since
# a model may misread the truth, and plans on its own view again where it does not ask.
ORACLE = OfLists(TRUTH, ShowsTruth())
