"""Twins of decision points: the same question put another way,
and what must hold of the answers to both.

These are metamorphic relations (Chen et al. 2018): nobody needs to know the right answer to tell
that two answers do not go together. A twin that does not apply to a question leaves it as it is.
"""

import dataclasses
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, get_args

import numpy as np
from msgspec import UNSET, Struct
from msgspec.structs import replace

from harness.backends.base import AnswerMode, Request
from harness.core import noise
from harness.core.files import text_of
from harness.core.image import Image
from harness.dataset.load import Scene
from harness.evaluate.spec import Spec
from harness.prompts import readout
from harness.prompts.alternatives import resolved
from harness.world.perception.sensors import LIDAR_NOISE_M, RADAR_NOISE_M
from harness.world.scene_graph import Conflict, Node, SceneGraph

Leaf = Callable[[str, Any], Any]
FAR_M = 100.0  # from the viewer to the vehicle that is added, at least
CLEAR_M = 65.0  # from there to the conflict zone, at least
FEET, KMH = 1 / 0.3048, 3.6
# Words of units, and those that take their place.
UNITS = {r"\bm/s\b": "km/h", r"\bm\b": "ft", r"\bmet(?:er|re)s\b": "feet"}
PLACEHOLDER = re.compile(r"{{.*?}}|{%.*?%}", re.DOTALL)
MEMBER = re.compile(r'\s*,\s*(?="\w+"\s*:)')
SIDES = {"left": "right", "right": "left"}
LANES = {"LANE_LEFT": "LANE_RIGHT", "LANE_RIGHT": "LANE_LEFT"}


@dataclasses.dataclass(frozen=True)
class Twin:
    """Describe one change of a question, and how the answers to both versions must agree.

    A twin is the question put another way, to test whether the answer stays. It changes the scene
    graph (what the asked vehicle knows of the scene), the text, the picture or the senders of
    messages, by the functions that are not None; each takes the original last, and returns the
    changed one. `spec` is the evaluation and `scene` the situation, for those that need them. Both
    answers are distributions over actions: they must have the same likeliest action, or differ by
    no more than a total variation distance.
    """

    name: str  # how commands call it
    says: str  # what is changed, in words
    needs: str = "a graph or a text that it changes"  # what a question must have for it to apply
    # greatest total-variation distance that it allows; None where the action must be the same
    within: float | None = None
    # the twin's scene graph, `(spec, scene, graph)`
    graph: Callable[[Spec, Scene, SceneGraph], SceneGraph] | None = None
    # the twin's request, `(spec, request)`, of a language model
    text: Callable[[Spec, Request], Request] | None = None
    # the twin's scene graph for a driver that reads the graph and no text
    view: Callable[[SceneGraph], SceneGraph] | None = None
    # the twin's picture, where the graph is another; None where it is the same
    image: Callable[[Image], Image] | None = None
    # the senders of the messages in the twin's fusion call, given those of the question's
    senders: Callable[[Sequence[str]], Sequence[str]] | None = None
    # the question's name for an action of the twin, where it is another
    actions: Mapping[str, str] | None = None
    modes: tuple[str, ...] = get_args(AnswerMode)  # answer modes in which it applies
    # whether it holds of an ego that always gives the same answer, and so reads nothing; of a
    # read-out, where the letters are read once
    constant: bool = True

    @property
    def text_only(self) -> bool:
        """Return whether it changes only text, which a driver that reads the graph never sees.

        Such a driver is a rule in place of a model.
        """
        return bool(self.text or self.senders) and not self.view

    @property
    def holds(self) -> str:
        """Return how both answers must be related: `same`, `mirrored` or such as `TV <= 0.1`.

        The first two are of the likeliest action; TV is the total variation distance of both
        distributions.
        """
        if self.within is not None:
            return f"TV <= {self.within:g}"
        return "mirrored" if self.actions else "same"


def changed(value: Any, leaf: Leaf, key: str = "") -> Any:
    """Return a copy of a record in which each leaf value is replaced by what a function returns.

    `value` is a msgspec struct; its leaves are the values in it, and in structs and tuples in it,
    that are neither. `leaf` takes the key and the value of a leaf. The key is the name of the
    field; values in a tuple have the key of the tuple. `key` is that of `value` itself.
    """
    if isinstance(value, Struct):
        values = {name: getattr(value, name) for name in value.__struct_fields__}
        return replace(value, **{name: changed(part, leaf, name) for name, part in values.items()})
    if isinstance(value, tuple):
        return tuple(changed(part, leaf, key) for part in value)
    return value if value is UNSET else leaf(key, value)


def mirrored(spec: Spec, scene: Scene, graph: SceneGraph) -> SceneGraph:
    """Return a scene graph with left and right swapped, for a twin of a question.

    A twin is the question put another way, to test whether the answer stays, mirrored. A scene
    graph is what the asked vehicle knows of the scene. It is unchanged if the scenario of the
    evaluation `spec` may not be mirrored, or the road of `scene` lacks a mirrored path.
    """
    if spec.scenario.one_sided is not None:
        return graph
    twin = swapped(graph)
    paths = spec.scenario_of(scene).road().paths
    return twin if all((c.sector, c.route) in paths for c in twin.conflicts) else graph


def swapped(graph: SceneGraph) -> SceneGraph:
    """Return a scene graph with left and right swapped in positions, headings and words.

    It is what the mirrored question of a twin shows: a question put another way. A scene graph is
    what the asked vehicle knows of the scene. Sectors, the sides from which a vehicle that the ego
    would meet may come, stay in the order that they had.
    """

    def leaf(key: str, value: Any) -> Any:
        if key in ("left_m", "heading_deg") and value is not None:
            return 0 - value
        if key in ("sector", "lane", "route", "indicator") and value is not None:
            return re.sub(r"\b(left|right)\b", lambda side: SIDES[side[0]], value)
        return value

    twin: SceneGraph = changed(graph, leaf)
    order = [sector.sector for sector in graph.sectors]
    if {sector.sector for sector in twin.sectors} != set(order):
        return twin
    return replace(
        twin, sectors=tuple(sorted(twin.sectors, key=lambda sector: order.index(sector.sector)))
    )


def flipped(image: Image) -> Image:
    """Return a camera picture mirrored left to right, as the mirrored scene would look.

    It is the picture of a twin, the same question put another way.
    """
    return Image(np.ascontiguousarray(image.pixels[:, ::-1]))


def permuted_ids(spec: Spec, scene: Scene, graph: SceneGraph) -> SceneGraph:
    """Return a scene graph in which every vehicle has the id of another, for a twin of a question.

    A twin is the question put another way, to test whether the answer stays. `graph` is what one
    vehicle of `scene` knows; all graphs of the scene are renamed alike. `spec` is the evaluation,
    not read.
    """
    ids = [vehicle.id for vehicle in scene.state.vehicles]
    order = noise.generator("twins", "ids", scene.id).permutation(len(ids)).tolist()
    # one cycle
    named = {ids[n]: ids[m] for n, m in zip(order, [*order[1:], *order[:1]], strict=True)}
    twin: SceneGraph = changed(
        graph, lambda key, value: named.get(value, value) if key in NAMES else value
    )
    return twin


NAMES = ("id", "vehicle", "viewer", "by")


def rounded(spec: Spec, scene: Scene, graph: SceneGraph) -> SceneGraph:
    """Return a scene graph with whole metres and m/s, for a twin of a question.

    A twin is the question put another way, to test whether the answer stays. `graph` is what one
    vehicle knows. The visible share of a sector (a side from which a danger may come) has one
    decimal. Times stay: half a second decides conflicts. `spec` and `scene` are not read.
    """

    def leaf(key: str, value: Any) -> Any:
        if isinstance(value, float) and key.endswith(("_m", "_mps")):
            return round(value) + 0.0
        return round(value, 1) if key == "seen_share" else value

    twin: SceneGraph = changed(graph, leaf)
    return twin


def far_vehicle(spec: Spec, scene: Scene, graph: SceneGraph) -> SceneGraph:
    """Return a scene graph with one more vehicle, parked off the road, for a twin of a question.

    A twin is the question put another way, to test whether the answer stays. `graph` is what one
    vehicle (the viewer) of `scene` knows, in a scenario of the evaluation `spec`. The new one is at
    least 100 m from the viewer, and 65 m from the conflict zone, where paths meet.
    """
    away = max(FAR_M, CLEAR_M + graph.itself.zone_m)
    ahead = graph.ego.forward_m < 0  # the other way than the ego; behind the ego itself
    last = max(int(vehicle.id[1:]) for vehicle in scene.state.vehicles)
    own_mps = graph.itself.speed_mps
    node = Node(
        f"v{last + 1}",
        "vehicle",
        away if ahead else -away,
        0.0,
        None,
        0.0,
        0 - own_mps if ahead else own_mps,
        "off-lane",
        None,
        ("radar",),
        None if spec.scenario.brake_lamps else UNSET,
    )
    return replace(graph, nodes=(*graph.nodes, node))


def jittered(spec: Spec, scene: Scene, graph: SceneGraph) -> SceneGraph:
    """Return a scene graph whose distances have the sensors' noise added again, for a twin.

    A twin is the question put another way, to test whether the answer stays. `graph` is what one
    vehicle (the viewer) of `scene` knows, in a scenario of the evaluation `spec`. The noise is
    Gaussian, in metres, keyed by scene and viewer.
    """
    draws = noise.generator("twins", "jitter", scene.id, graph.viewer)
    nodes, moved_m = [], {}
    for node in graph.nodes:
        scale = LIDAR_NOISE_M if "lidar" in node.sensors else RADAR_NOISE_M
        forward, left = (scale * draws.standard_normal(2)).tolist()
        moved_m[node.id] = forward
        at = round(node.forward_m + forward, 1), round(node.left_m + left, 1)
        nodes.append(replace(node, forward_m=at[0], left_m=at[1]))
    conflicts = tuple(_farther(c, moved_m.get(c.vehicle)) for c in graph.conflicts)
    return replace(graph, nodes=tuple(nodes), conflicts=conflicts)


def _farther(conflict: Conflict, by_m: float | None) -> Conflict:
    """Return a conflict whose way to go is longer;
    one with the viewer, who knows where it is, as it is.
    """
    if by_m is None:
        return conflict
    who = "other" if conflict.other.arc_m else "ego"
    to_go = getattr(conflict, who)
    return replace(conflict, **{who: replace(to_go, arc_m=round(to_go.arc_m + by_m, 1))})


def reversed_lines(spec: Spec, request: Request) -> Request:
    """Return a request whose lines about vehicles are in reverse order, for a twin of a question.

    A twin is the question put another way, to test whether the answer stays. A request is what a
    model is sent; each run of such lines in its texts is reversed. `spec` is the evaluation, not
    read.
    """

    def turned(run: re.Match[str]) -> str:
        return "".join(reversed(run[0].splitlines(keepends=True)))

    return _reworded(request, lambda text: re.sub(r"(?m)(?:^v\d+\b.*\n){2,}", turned, text))


def reversed_lists(graph: SceneGraph) -> SceneGraph:
    """Return a scene graph with its objects and its conflicts in reverse order, for a twin.

    A twin is the question put another way, to test whether the answer stays. `graph` is what one
    vehicle knows of a scene, as a driver that reads no text gets it.
    """
    return replace(graph, nodes=graph.nodes[::-1], conflicts=graph.conflicts[::-1])


def in_feet(spec: Spec, scene: Scene, graph: SceneGraph) -> SceneGraph:
    """Return a scene graph with distances in feet and speeds in km/h, for a twin of a question.

    A twin is the question put another way, to test whether the answer stays. `graph` is what one
    vehicle knows of a scene. It is unchanged if the words for the units in the prompt of the
    evaluation `spec` cannot be replaced. `scene` is not read.
    """
    return changed(graph, _in_feet) if _says_units(spec, graph.role) else graph


def _in_feet(key: str, value: Any) -> Any:
    if value is None or not key.endswith(("_m", "_mps")):
        return value
    return round(value * (KMH if key.endswith("_mps") else FEET), 1)


def _says_units(spec: Spec, role: str) -> bool:
    """Return whether a template has both units, and no number of its own with one,
    but for the target speeds.

    The numbers of examples are metres and stay so.
    """
    if spec.ego.prompt.examples:
        return False
    fixed = PLACEHOLDER.sub("", resolved(spec.ego.prompt.texts[role])).replace(
        f"{_speeds(spec, 1.0)} m/s", "m/s"
    )
    return all(re.search(unit, fixed) for unit in ("m/s", r"\bm\b(?!/)")) and not re.search(
        r"\d\s*m\b", fixed
    )


def _speeds(spec: Spec, factor: float) -> str:
    """Return the target speeds as prompts have them, `14, 7, 0`."""
    speeds = spec.scenario.prompt_words["speeds"].split(", ")
    return ", ".join(f"{round(float(speed) * factor, 1):g}" for speed in speeds)


def other_units(spec: Spec, request: Request) -> Request:
    """Return a request whose texts say feet and km/h, for a twin of a question.

    A twin is the question put another way, to test whether the answer stays. A request is what a
    model is sent; target speeds in it are converted. It is unchanged if the words for the units in
    the prompt of the evaluation `spec` cannot be replaced.
    """
    if not _says_units(spec, request.role):
        return request

    def reworded(text: str) -> str:
        text = text.replace(f"{_speeds(spec, 1.0)} m/s", f"{_speeds(spec, KMH)} m/s")
        for unit, new_unit in UNITS.items():
            text = re.sub(unit, new_unit, text)
        return text

    return _reworded(request, reworded)


def paraphrased(spec: Spec, request: Request) -> Request:
    """Return a request in which sentences are replaced by others of the same meaning, for a twin.

    A twin is the question put another way, to test whether the answer stays. A request is what a
    model is sent; the file `paraphrases.toml` has the sentences. `spec` is the evaluation, not
    read.
    """

    def reworded(text: str) -> str:
        for sentence, paraphrase in paraphrases().items():
            text = text.replace(sentence, paraphrase)
        return text

    return _reworded(request, reworded)


@cache
def paraphrases() -> dict[str, str]:
    """Return the paraphrases in `paraphrases.toml`: a sentence of equal meaning, by sentence."""
    text = text_of(Path(__file__).parent / "paraphrases.toml", "settings")
    return {str(sentence): str(paraphrase) for sentence, paraphrase in tomllib.loads(text).items()}


def reordered_keys(spec: Spec, request: Request) -> Request:
    """Return a request whose JSON objects have their keys in reverse order, for a twin.

    A twin is the question put another way, to test whether the answer stays. A request is what a
    model is sent, and the objects are those that its prompt shows. `spec` is the evaluation that
    asks.
    """
    return _reworded(request, _reversed_members)


def _reversed_members(text: str) -> str:
    """The same text with the members of its outermost objects, and of those in them,
    the last first.
    """
    done, at = "", 0
    while (start := text.find('{"', at)) >= 0 and (end := _closing(text, start)):
        inner, members, comma, depth, last = text[start + 1 : end], [""], "", 0, 0
        for mark in re.finditer(r"[{}]|" + MEMBER.pattern, inner):
            depth += {"{": 1, "}": -1}.get(mark[0], 0)
            if depth == 0 and mark[0] not in "{}":
                members[-1] += inner[last : mark.start()]
                members.append("")
                comma, last = mark[0], mark.end()
        members[-1] += inner[last:]
        body = comma.join(map(_reversed_members, reversed(members)))
        done, at = f"{done}{text[at : start + 1]}{body}}}", end + 1
    return done + text[at:]


def _closing(text: str, start: int) -> int:
    """Return where the brace that opens at `start` is closed; 0 if it is not."""
    depth = 0
    for n, character in enumerate(text[start:], start):
        depth += {"{": 1, "}": -1}.get(character, 0)
        if depth == 0:
            return n
    return 0


def permuted_letters(spec: Spec, request: Request) -> Request:
    """Return a read-out request in which each letter stands for the next action, for a twin.

    A twin is the question put another way, to test whether the answer stays. In a read-out, a model
    answers with one letter for an action; the last letter gets the first action. `spec` is the
    evaluation that asks.
    """
    moved = (*request.actions[-1:], *request.actions[:-1])
    letters = readout.letters(moved)
    letter = dict(zip(letters, letters[1:] + letters[:1], strict=True))
    questions = {
        readout.question(old): readout.question(new)
        for old, new in zip(readout.cyclic(request.actions), readout.cyclic(moved), strict=True)
    }

    def reworded(text: str) -> str:
        if text in letter:  # an example's answer is a letter alone
            return letter[text]
        old = next((question for question in questions if question in text), None)
        return text.replace(old, questions[old]) if old else text

    return dataclasses.replace(_reworded(request, reworded), actions=moved)


def _reworded(request: Request, reworded: Callable[[str], str]) -> Request:
    def chat(messages: Sequence[Mapping[str, str]]) -> tuple[Mapping[str, str], ...]:
        return tuple({**message, "content": reworded(message["content"])} for message in messages)

    return dataclasses.replace(
        request,
        messages=chat(request.messages),
        orders=tuple(map(chat, request.orders)),
        question=request.question and request.question.reworded(reworded),
    )


_DECLARED = (
    Twin(
        "mirrored",
        "left and right swapped",
        "a scenario whose scenes may be mirrored",
        graph=mirrored,
        image=flipped,
        actions=LANES,
    ),
    Twin("ids", "vehicles have each other's names", graph=permuted_ids),
    Twin(
        "order",
        "objects and conflicts in another order",
        "two objects or conflicts",
        text=reversed_lines,
        view=reversed_lists,
    ),
    Twin("far-vehicle", "one more vehicle, far from every conflict", graph=far_vehicle),
    Twin(
        "units",
        "feet and km/h for metres and m/s",
        "a prompt that says m and m/s",
        within=0.1,
        graph=in_feet,
        text=other_units,
    ),
    Twin(
        "rounding", "one decimal fewer in distances, speeds and shares", within=0.1, graph=rounded
    ),
    Twin("jitter", "distances with the sensors' noise once more", within=0.1, graph=jittered),
    Twin(
        "paraphrase",
        "some sentences in other words",
        "sentences of the prompts that ship",
        within=0.1,
        text=paraphrased,
    ),
    Twin(
        "key-order",
        "keys of the JSON that the prompt shows in another order",
        "a prompt that shows JSON",
        text=reordered_keys,
    ),
    Twin(
        "letters",
        "letters of the read-out stand for other actions",
        "--answer readout",
        text=permuted_letters,
        modes=("readout",),
        constant=False,
    ),
    Twin(
        "message-order",
        "the helpers' messages in another order",
        "fusion calls in json or constrained",
        senders=lambda senders: senders[::-1],
        modes=("json", "constrained"),
    ),
    Twin(
        "message-twice",
        "one helper's message twice",
        "fusion calls in json or constrained",
        senders=lambda senders: [*senders, *senders[:1]],
        modes=("json", "constrained"),
    ),
)
TWINS = {twin.name: twin for twin in _DECLARED}
