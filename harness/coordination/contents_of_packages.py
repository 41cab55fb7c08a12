"""The door to a package's contents of messages:
none writes to what it gets, and what it returns is checked and copied.

So a content says who is able to send it, how large it is, and what the ego is asked with it, and
moves nothing else; it fails in one line, a UserError.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from msgspec import json

from harness.coordination.contents import CONTENTS, Call, Content, is_ours
from harness.coordination.intents import Intents
from harness.core.arrays import Bools, Floats, Ints, check_shape, numbers, read_only
from harness.core.config import LONGEST_S
from harness.core.errors import printable
from harness.core.plugins import line_or_none
from harness.core.strangers import worded
from harness.world.scene_graph import SceneGraph

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint
    from harness.coordination.parts import RunFacts
    from harness.world.perception.shared import Heard
    from harness.world.scenario import Scenario

MADE = {"valid", "inference_s", "unasked"}  # what `able` may change
MOST_BITS = 1e12  # of a reply, which no radio here sends in an hour
MOST_CHARACTERS = 10_000  # of a helper's words


def obstacle(point: "OperatingPoint", run: "RunFacts") -> str | None:
    """Return why what messages hold at an operating point cannot be used in a run, or None.

    Call it in place of `Content.obstacle`, which a package may have written. The text is one line.
    `point` is the settings of the radio, of asking helpers and of fusing their messages; `run` has
    the run's models and prompts, its scenario and its world. Raises UserError if a package's
    content fails or returns no text.
    """
    content, prompt = point.content, run.agents[0].prompt
    if point.has_fusion_call and content.call and content.call.in_words and not prompt.shows_words:
        return (
            f"prompt {prompt.version} cannot show words without an intent; use --prompt v11 or v12"
        )
    if CONTENTS.is_ours(point.ask.content):
        return content.obstacle(point, run)
    with worded(_of(point)):
        return line_or_none(content.obstacle(point, run), "an obstacle")


def able(point: "OperatingPoint", intents: Intents, senders: Ints | None) -> Intents:
    """Return what vehicles intend in n decisions, with only those helpers valid that can send.

    Call it in place of `Content.able`, which a package may have written: of its content only
    `valid`, helpers' inference times and `unasked` may change. Raises UserError if it fails or
    changes anything else.

    Args:
        point: the settings of the radio, of asking helpers and of fusing their messages, with the
            content of messages.
        intents: what the ego and H helpers intend in each of the n decisions.
        senders: where messages hold plans, the row, among the n, of the decision that each helper
            makes itself at this time, `(n, H)`; -1 for none.
    """
    content = point.content
    if CONTENTS.is_ours(point.ask.content):
        return content.able(point, intents, senders)
    with worded(_of(point)):
        made = content.able(point, read_only(intents), read_only(senders))
        after, before = made.arrays(), intents.arrays()
        for name in before.keys() - MADE:
            if not np.array_equal(before[name], after[name], equal_nan=True):
                raise ValueError(f"it changes {name}, which are not its to change")
        check_shape("valid", made.valid, intents.valid.shape)
        if made.valid.dtype != bool or np.any(made.valid & ~_could(content, intents)):
            raise ValueError("it lets somebody send who has nothing to send")
        ready_s = numbers("times", made.inference_s, intents.inference_s.shape)
        if not np.array_equal(ready_s[:, 0], intents.inference_s[:, 0], equal_nan=True):
            raise ValueError("it changes the ego's time")
        fit = (ready_s >= 0) & (ready_s <= LONGEST_S)
        kept = np.isclose(ready_s, intents.inference_s, rtol=0, atol=0, equal_nan=True)
        if not np.all(fit | kept):
            raise ValueError(f"times that are not from 0 to {LONGEST_S:g} s")
        # whose model is not asked for it is not waited for
        unasked = intents.unasked if content.asks_helpers else None
        return replace(intents, valid=made.valid.copy(), inference_s=ready_s, unasked=unasked)


def bits(point: "OperatingPoint", intents: Intents) -> Floats:
    """Return the size in bits of each helper's reply at an operating point, `(..., H)`.

    Call it in place of `Content.bits`, which a package may have written. The size depends on what
    messages hold at `point`, and on how they are encoded; `intents` has what H helpers say in
    decisions `(...)`. Raises UserError if a package's content fails or gives sizes outside 0 to
    `MOST_BITS`.
    """
    content, encoding, headers = point.content, point.radio.encoding, point.physical is not None
    if CONTENTS.is_ours(point.ask.content):
        return content.bits(encoding, intents, headers)
    with worded(_of(point)):
        given = content.bits(encoding, read_only(intents), headers)
        sizes = numbers("sizes", given, intents.payload_bits.shape)
        fit = (sizes >= 0) & (sizes <= MOST_BITS)
        if not np.all(fit | ~intents.valid):
            raise ValueError(f"sizes that are not from 0 to {MOST_BITS:g} bits")
        return sizes


def graphs(
    call: Call, scenario: "Scenario", cases: Sequence["Heard"]
) -> Sequence[SceneGraph | None]:
    """Return the scene graph that a second question shows the ego in each case.

    None keeps the ego's own graph. Call it in place of `Call.graphs`, which a package may have
    written. `call` is the question; each of `cases` is one ego's: its scene, its own graph (what it
    knows of the scene) and those of the helpers that it has heard. All egos are of `scenario`.
    Raises UserError if a package's call fails or returns another vehicle's graph.
    """
    if is_ours(call):
        return call.graphs(scenario, cases)
    with worded(_content(call.name)):
        given = list(call.graphs(scenario, cases))
        if len(given) != len(cases):
            raise ValueError(f"{len(given)} graphs of {len(cases)} cases")
        graphs = []
        for graph, case in zip(given, cases, strict=True):
            graphs.append(None if graph is None else graph_like(graph, case.own, "the ego's"))
        return graphs


def words(call: Call, evidence: str) -> str:
    """Return one helper's free text (`evidence`) as the line that the ego's prompt shows.

    Call it in place of `Call.words`, which a package may have written. `call` is the second
    question to the ego's model that shows it. Raises UserError if a package's call fails or its
    line is too long.
    """
    if is_ours(call):
        return call.words(evidence)
    with worded(_content(call.name)):
        text = call.words(evidence)
        if not isinstance(text, str):
            raise ValueError(f"words of type {type(text).__name__}")
        if len(line := _line(text)) > MOST_CHARACTERS:
            raise ValueError(f"words of {len(line)} characters, more than {MOST_CHARACTERS}")
        line.encode()  # which no lone surrogate lets itself be
        return line


def graph_like(given: object, own_graph: SceneGraph, whose: str) -> SceneGraph:
    """Return what a package gave as a scene graph: a fresh copy, checked as one from a file is.

    `given` is what it gave. A scene graph is what one vehicle knows of a scene; `own_graph` is the
    one that this vehicle has here. Raises ValueError or TypeError, with `whose` (such as
    `the ego's`) in the message, unless both are of the same viewer, role, step and ego.
    """
    if not isinstance(given, SceneGraph):
        raise TypeError(f"it returns what is no graph of {whose}")
    graph = json.decode(json.encode(given), type=SceneGraph)
    for name in ("viewer", "role", "step", "ego"):
        if getattr(graph, name) != getattr(own_graph, name):
            raise ValueError(f"it returns what is no graph of {whose}, whose {name} is another")
    return graph


def _line(text: str) -> str:
    """Return a text, which may be of a package's class, as a plain one of one line."""
    return " ".join("".join((text,)).split())


def _could(content: Content, intents: Intents) -> Bools:
    """Return who has what a content holds at most, `(..., H)`."""
    return intents.valid if content.asks_helpers else np.isfinite(intents.range_m)


def _of(point: "OperatingPoint") -> str:
    return _content(point.ask.content)


def _content(name: str) -> str:
    return f"content {printable(name)}"
