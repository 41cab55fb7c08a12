"""Make the scene graphs that egos are asked with once helpers have shared what they see."""

from collections.abc import Sequence

import numpy as np

from harness.coordination.attacks import ATTACKS, attacks_of
from harness.coordination.contents import TRUTH
from harness.coordination.operating_point import Rewrites
from harness.core.arrays import Floats
from harness.core.files import canonical_bytes
from harness.dataset.load import Scene
from harness.runs.records import BLIND, REWRITTEN
from harness.world.perception.graph import truth_graphs
from harness.world.perception.shared import Heard, invented, merged
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph


def shared_graphs(
    scenario: Scenario, sets: Sequence[tuple[Scene, Sequence[str]]], rewrites: Rewrites
) -> Sequence[SceneGraph | None]:
    """Return the ego's graph for each scene and the keys of those who were heard in it.

    None where messages hold no objects.
    """
    if not rewrites.graph:
        return [None] * len(sets)
    if rewrites.graph == TRUTH:
        return truth_graphs(scenario, [scene.state for scene, _ in sets])
    cases = []
    for scene, senders in sets:
        heard = []
        for key in senders:
            sender, _, changes = key.partition(REWRITTEN)
            graph = scene.graphs[sender.removesuffix(BLIND)]
            graph = graph.blinded() if sender.endswith(BLIND) else graph
            for name in changes.split("&") if rewrites.attack else ():
                if name.partition(":")[0] in ATTACKS:
                    [attack] = attacks_of(name)
                    graph = attack.listed(graph, invented(scenario, scene.state, graph.viewer))
            heard.append(graph)
        cases.append(Heard(scene.state, scene.graphs[scene.viewers[0]], heard))
    return merged(scenario, cases)


def listed(scenes: Sequence[Scene]) -> tuple[Floats, Floats]:
    """Return how many objects each helper lists, and in how many bits as compact JSON, both (n, H).

    Each object has its id, class, place in metres to one decimal, heading in degrees, speed and indicator;
    each region the share that is in sight. Both are 0 where there is no helper.
    """
    counts, bits = np.zeros((2, len(scenes), max(len(scene.viewers) for scene in scenes) - 1))
    for n, scene in enumerate(scenes):
        graphs = [scene.graphs[viewer] for viewer in scene.viewers[1:]]
        if (kept := scene.notes.get("object_bits")) is None:
            kept = scene.notes["object_bits"] = [
                8 * len(canonical_bytes(_message(graph))) for graph in graphs
            ]
        bits[n, : len(graphs)] = kept
        counts[n, : len(graphs)] = [len(graph.nodes) for graph in graphs]
    return counts, bits


def _message(graph: SceneGraph) -> dict[str, object]:
    objects = [
        [n.id, n.type, n.forward_m, n.left_m, n.heading_deg, n.speed_mps, n.indicator] for n in graph.nodes
    ]
    seen = [[sector.sector, sector.seen_share] for sector in graph.sectors]
    return {"from": graph.viewer, "objects": objects, "seen": seen, "speed_mps": graph.itself.speed_mps}
