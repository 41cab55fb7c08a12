"""Make the requests of scenes: what each viewer is asked, and the ego of the messages it heard."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cache, partial
from itertools import repeat
from typing import Any

import numpy as np

from harness.backends.base import Request
from harness.backends.base import Role as AskedRole
from harness.coordination.operating_point import AS_SENT, Rewrites
from harness.coordination.parts import PLAIN, Question
from harness.coordination.parts_of_packages import shown_graph
from harness.coordination.streams import Stream
from harness.core.arrays import Bools, Ints
from harness.dataset.load import Scene
from harness.evaluate.fusion import heard_in, key_of, messages_of
from harness.evaluate.pictures import picture
from harness.evaluate.sharing import shared_graphs
from harness.evaluate.spec import Spec
from harness.runs.records import Answer, asked_key
from harness.world.perception.graph import truth_graph
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph

EGO = (0,)
Places = Sequence[Collection[int]]  # of the viewers of each scene, the ego at 0


def requests(
    spec: Spec,
    scenes: Sequence[Scene],
    question: Question = PLAIN,
    places: Places | None = None,
) -> Iterator[Request]:
    """Yield the requests to the models of vehicles in scenes, the ego's first in each scene.

    `spec` is the evaluation: which model answers for whom, by which prompt. With another `question`
    than the plain one, what the ego should do as they see it, only helpers are asked. `places` has
    for each scene the indices in `Scene.viewers` of the vehicles to ask, the ego at 0; None asks
    all.
    """
    agents, actions = spec.agents, spec.actions
    privileged, sees = (
        any(agent.card.privileged for agent in agents),
        any(agent.sees for agent in agents),
    )
    blank = cache(partial(_blank, spec))
    for scene, asked_places in zip(scenes, places or repeat(None), strict=False):
        scenario = spec.scenario_of(scene)
        words = scenario.prompt_words
        truth = truth_graph(scenario, scene.state) if privileged else None
        for place, viewer in enumerate(spec.viewers(scene)):
            of_ego = not place
            if (of_ego and question != PLAIN) or (
                asked_places is not None and place not in asked_places
            ):
                continue
            graph, index = (
                shown_graph(question, scene.graphs[viewer]),
                spec.agent(scene.place(place)),
            )
            agent = agents[index]
            image = picture(spec, index, scene, viewer, question.pictured) if sees else None
            yield blank(index, graph.role).alike(
                id=request_id(scene, viewer, question),
                **agent.chats(graph, actions, words),
                image=image,
                view=graph,
                truth=truth if agent.card.privileged else None,
                scenario=scenario,
            )


def wanted_in(scenes: Sequence[Scene], wanted: Bools) -> tuple[list[Scene], Places]:
    """Return the scenes where some helper is wanted, and the indices of these helpers in each.

    `wanted` is a mask `(n, H)` of n scenes with H helpers. An index is that in `Scene.viewers`: the
    ego has 0 and the first helper 1.
    """
    rows = np.flatnonzero(wanted.any(axis=1)).tolist()
    return [scenes[n] for n in rows], [(1 + np.flatnonzero(wanted[n])).tolist() for n in rows]


def request_id(scene: Scene, viewer: str, question: Question) -> str:
    """Return the id of the request that asks a vehicle a question in a scene.

    `viewer` is the vehicle's id. It is the scene's id, the vehicle's and, if it is not the plain
    one, the question's name.
    """
    return f"{scene.id}/{asked_key(viewer, question.name)}"


def _blank(spec: Spec, index: int, role: AskedRole) -> Request:
    """Return a request to an agent in a role, without what differs between such requests."""
    agent = spec.agents[index]
    sampled: dict[str, Any] = {}
    if agent.samples:
        sampled = {"temperature": spec.settings.temperature, "sample": spec.settings.sampling_seed}
    return agent.blank(role, spec.actions).alike(agent=index, **sampled)


def fusion_request(
    spec: Spec,
    scene: Scene,
    answers: Mapping[str, Answer],
    senders: Sequence[str],
    graph: SceneGraph | None = None,
) -> Request:
    """Return the request of a fusion call: it asks the ego once more, with what it has heard.

    A scene graph is what one vehicle knows of a scene.

    Args:
        spec: the evaluation.
        scene: the ego's scene.
        answers: helpers' answers by key: the vehicle's id and the question (`asked_key`).
        senders: keys of the messages that the ego has heard (`fusion.key_of`), which also say how
            each is changed and shown.
        graph: scene graph to show instead of the ego's own; None for its own.
    """
    heard = messages_of(answers, senders, spec.actions)
    scenario, index = spec.scenario_of(scene), spec.agent(scene.agent)
    agent, words = spec.agents[index], scenario.prompt_words
    image = picture(spec, index, scene, scene.viewers[0])
    truth = truth_graph(scenario, scene.state) if agent.card.privileged else None
    view = scene.graphs[scene.viewers[0]] if graph is None else graph
    return _blank(spec, index, "ego").alike(
        id=fusion_id(scene, senders),
        **agent.chats(view, spec.actions, words, heard),
        image=image,
        view=view,
        truth=truth,
        scenario=scenario,
    )


def fusion_id(scene: Scene, senders: Sequence[str]) -> str:
    """Return the id of a fusion call: the request that asks the ego of a scene once more.

    It names what the ego has heard: `senders` are the keys of the messages (`fusion.key_of`).
    """
    return f"{scene.id}/{'+'.join((scene.viewers[0], *senders))}"


def stream_sets(
    scenario: Scenario,
    scenes: Sequence[Scene],
    stream: Stream,
    codes: Ints,
    rewrites: Rewrites = AS_SENT,
) -> list[tuple[Scene, list[str]]]:
    """Return for each of K egos its scene with the keys of what it has heard of a stream.

    `stream` are the messages that helpers send unasked, in `scenario`; `rewrites` says how they are
    changed, and a key is as in `heard_sets`. `codes`, `(K,)`, has for each ego an integer that says
    in which of `scenes` it is and, if attacks change messages, which helpers attack
    (`fusion.codes_of`). An ego that would hear another layout, and has none, has heard nothing.
    """
    width = 0
    if rewrites.changes.of_attackers:
        width = max(len(scene.viewers) for scene in scenes) - 1
    places = []
    for code in codes.tolist():
        at, attacking, _ = heard_in(code, width)
        at, source = divmod(at, len(scenes)) if rewrites.elsewhere else (at, at)
        places.append((at, source, attacking))
    texts = stream.heard(scenario, [scenes[source] for _, source, _ in places])
    sets = []
    for (at, source, attacking), of_senders in zip(places, texts, strict=True):
        name = scenes[source].id if rewrites.elsewhere else ""
        alone = rewrites.elsewhere and source == at
        helpers = enumerate(scenes[source].viewers[1:])
        attackers = {helper for place, helper in helpers if place in attacking}
        senders = []
        for sender, unasked in of_senders.items():
            if not alone:
                senders.append(key_of(sender, rewrites, sender in attackers, name, unasked))
        sets.append((scenes[at], senders))
    return sets


def stream_requests(
    spec: Spec, scenes: Sequence[Scene], sets: Sequence[tuple[Scene, Sequence[str]]]
) -> Iterator[Request]:
    """Yield the requests that ask egos with what they have heard of a stream, by `stream_sets`.

    `spec` is the evaluation, and `scenes` are those that the sets were made of. An ego that has
    heard nothing is left out: its question is the plain one.
    """
    heard = [each for each in sets if each[1]]
    graphs = shared_graphs(spec.scenario, heard, {scene.id: scene for scene in scenes})
    for (scene, senders), graph in zip(heard, graphs, strict=True):
        yield fusion_request(spec, scene, {}, senders, graph)


def heard_sets(
    scenes: Sequence[Scene], codes: Ints, rewrites: Rewrites
) -> Iterator[tuple[Scene, list[str]]]:
    """Yield for each set of messages that an ego heard its scene and the messages' keys.

    They are what a fusion call (the ego's model asked again) is to show. `codes`, `(K,)`, has for
    each of K sets an integer that says in which scene, by index in `scenes`, which helpers were
    heard (`fusion.codes_of`). `rewrites` says how the messages are changed and shown. A key is a
    text that names a message: its sender, and how it is shown.
    """
    helpers = max(len(scene.viewers) for scene in scenes) - 1
    for code in codes.tolist():
        at, heard, attacking = heard_in(code, helpers, bool(rewrites.changes.of_attackers))
        at, source = divmod(at, len(scenes)) if rewrites.elsewhere else (at, at)
        name, viewers = scenes[source].id if rewrites.elsewhere else "", scenes[source].viewers
        yield scenes[at], [key_of(viewers[1 + h], rewrites, h in attacking, name) for h in heard]
