"""Make the scene graphs that egos are asked with once helpers have shared what they see."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from msgspec import structs

from harness.coordination.contents_of_packages import graphs as graphs_heard
from harness.coordination.part_settings import change_of, questions, stream_of
from harness.coordination.parts_of_packages import shown_graph
from harness.coordination.streams import Hearing
from harness.core.arrays import Floats
from harness.core.errors import UserError, printable
from harness.core.files import canonical_bytes
from harness.dataset.load import Scene, by_seat
from harness.evaluate.fusion import marks_of, source_of, stream_text
from harness.runs.records import ASKED, REWRITTEN, Answer
from harness.world.perception.shared import Heard
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph


def shared_graphs(
    scenario: Scenario, sets: Sequence[tuple[Scene, Sequence[str]]], scenes: Mapping[str, Scene]
) -> Sequence[SceneGraph | None]:
    """Return the ego's scene graph with the objects that it heard of, for each set of messages.

    A scene graph is what one vehicle knows of a scene. It is None where the messages add nothing.

    Args:
        scenario: the scenario as the ego plays it.
        sets: for each set the ego's scene and the keys of the messages heard (`fusion.key_of`), all
            of which hold the same kind of content: words, intents or objects.
        scenes: the scenes that the messages come from, by id.
    """
    graphs: list[SceneGraph | None] = [None] * len(sets)
    for seat, places in by_seat([scene for scene, _ in sets], scenario).items():
        graphs_here = _shared_graphs(seat, [sets[n] for n in places], scenes)
        for n, graph in zip(places, graphs_here, strict=True):
            graphs[n] = graph
    return graphs


def _shared_graphs(
    scenario: Scenario, sets: Sequence[tuple[Scene, Sequence[str]]], scenes: Mapping[str, Scene]
) -> Sequence[SceneGraph | None]:
    keys = [key for _, senders in sets for key in senders]
    if texts := [text for text in map(stream_text, keys) if text]:
        hearings = []
        for scene, senders in sets:
            name = source_of(scene.id, senders)
            source = scene if name == scene.id else scenes[name]
            hearings.append(_hearing(scenario, scene, source, senders))
        return stream_of(texts[0]).graphs(scenario, hearings)
    calls = (marks_of(key).call for key in keys)
    call = next((call for call in calls if call and call.in_graph), None)
    if call is None:
        return [None] * len(sets)
    cases = []
    for scene, senders in sets:
        source = scenes[source_of(scene.id, senders)]
        graphs = [_sent(scenario, source, key) for key in senders]
        if source.id != scene.id:
            graphs = [_without_ego(graph) for graph in graphs]
        cases.append(Heard(scene.state, scene.graphs[scene.viewers[0]], graphs, source.state))
    return graphs_heard(call, scenario, cases)


def _hearing(scenario: Scenario, scene: Scene, source: Scene, senders: Sequence[str]) -> Hearing:
    """Return what an ego has heard of a stream, by the keys of its senders' messages."""
    texts, changes = {}, {}
    for key in senders:
        sender, _, question = key.partition(REWRITTEN)[0].partition(ASKED)
        texts[sender] = stream_text(key)
        if question or source.id != scene.id or marks_of(key).changes:
            change = partial(_unasked, source.seat or scenario, key, source.id != scene.id)
            changes[sender] = change
    return Hearing(scene, source, texts, changes)


def _unasked(
    scenario: Scenario, key: str, elsewhere: bool, graph: SceneGraph, scene: Scene
) -> SceneGraph:
    """Return the graph that a message sent unasked is made of, given what its sender knows."""
    sent = _changed(scenario, scene, key, graph)
    return _without_ego(sent) if elsewhere else sent


def _without_ego(graph: SceneGraph) -> SceneGraph:
    """Return a graph without the ego, which the ego that hears it would take for somebody else."""
    return structs.replace(
        graph, nodes=tuple(node for node in graph.nodes if node.id != graph.ego.id)
    )


def _sent(scenario: Scenario, scene: Scene, key: str) -> SceneGraph:
    """Return the graph that a message of this key is made of."""
    sender = key.partition(REWRITTEN)[0].partition(ASKED)[0]
    return _changed(scenario, scene, key, scene.graphs[sender])


def _changed(scenario: Scenario, scene: Scene, key: str, graph: SceneGraph) -> SceneGraph:
    """Return what a message of this key is made of, given what its sender knows of the scene."""
    question = key.partition(REWRITTEN)[0].partition(ASKED)[2]
    graph = shown_graph(questions()[question], graph)
    changes = [change_of(change) for change in marks_of(key).changes]
    for change in sorted(changes, key=lambda change: change.adds):
        graph = change.graph(graph, scenario, scene)
    return graph


def as_asked(
    scenario: Scenario, scene: Scene, answer: Answer, source: Scene | None = None
) -> Scene:
    """Return a scene as it was shown to the vehicle that gave an answer.

    A helper may have been asked another question, with another scene graph; an ego that was asked
    again may have had the objects of others, of the scene `source` (`fusion.source_of`) if messages
    came from elsewhere. A scene graph is what one vehicle knows of a scene.

    Raises:
        UserError: the answer names a sender or an attack that there is not, as only a stranger's
            can.
    """
    if answer.question:
        question = questions()[answer.question]
        return scene.changed(
            graphs={viewer: shown_graph(question, graph) for viewer, graph in scene.graphs.items()}
        )
    try:
        [graph] = shared_graphs(
            scenario, [(scene, answer.heard)], {each.id: each for each in (source, scene) if each}
        )
    except (KeyError, UserError) as error:
        reason = f"{printable(error)} is not there" if isinstance(error, KeyError) else error
        raise UserError(
            f"answers.jsonl has an answer in scene {printable(scene.id)} that heard "
            f"{printable('+'.join(answer.heard), 100)}: {reason}; make the run again"
        ) from None
    return scene if graph is None else scene.changed(graphs={**scene.graphs, answer.viewer: graph})


def listed(scenes: Sequence[Scene]) -> tuple[Floats, Floats]:
    """Return how many objects helpers list in n scenes, and their size in bits, both `(n, H)`.

    H is the greatest number of helpers; both are 0 where there is no helper. The size is as JSON:
    each object has its id, class, place in metres to one decimal, heading in degrees, speed and
    indicator; each region the share that is in sight.
    """
    counts, bits = np.zeros((2, len(scenes), max(len(scene.viewers) for scene in scenes) - 1))
    for n, scene in enumerate(scenes):
        graphs = [scene.graphs[viewer] for viewer in scene.viewers[1:]]
        if (kept := scene.notes.get("object_bits")) is None:
            kept = scene.notes["object_bits"] = [
                8 * len(canonical_bytes(_message(graph))) for graph in graphs
            ]
        bits[n, : len(graphs)] = kept
        counts[n, : len(graphs)] = [len(graph.sensed) for graph in graphs]
    return counts, bits


def _message(graph: SceneGraph) -> dict[str, object]:
    objects = [
        [n.id, n.type, n.forward_m, n.left_m, n.heading_deg, n.speed_mps, n.indicator]
        for n in graph.sensed
    ]
    seen = [[sector.sector, sector.seen_share] for sector in graph.sectors]
    return {
        "from": graph.viewer,
        "objects": objects,
        "seen": seen,
        "speed_mps": graph.itself.speed_mps,
    }
