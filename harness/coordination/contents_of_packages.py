"""The door to a package's contents of messages:
none writes to what it gets, and what it returns is checked and copied.

So a content says who is able to send it, how large it is, and what the ego is asked with it, and
moves nothing else; it fails in one line, a UserError.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from harness.coordination.contents import Call, Content
from harness.coordination.intents import Intents
from harness.core.arrays import Bools, Floats, Ints, check_shape, numbers, read_only
from harness.core.strangers import is_ours, worded
from harness.world.scene_graph import SceneGraph

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint
    from harness.coordination.parts import RunFacts
    from harness.world.perception.shared import Heard
    from harness.world.scenario import Scenario

MADE = {"valid", "inference_s", "unasked"}  # what `able` may change


def obstacle(point: "OperatingPoint", run: "RunFacts") -> str | None:
    """Return why a condition's content cannot be played in a run; None if it can."""
    content = point.content
    with worded(_named(content), built_in=is_ours(content)):
        return content.obstacle(point, run)


def able(point: "OperatingPoint", intents: Intents, senders: Ints | None) -> Intents:
    """Return what helpers intend, of whom only those are valid that can send the content."""
    content = point.content
    if is_ours(content):
        return content.able(point, intents, senders)
    with worded(_named(content)):
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
        if np.any(ready_s < 0):
            raise ValueError("a time below 0")
        # whose model is not asked for it is not waited for
        unasked = intents.unasked if content.asks_helpers else None
        return replace(intents, valid=made.valid.copy(), inference_s=ready_s, unasked=unasked)


def bits(point: "OperatingPoint", intents: Intents) -> Floats:
    """Return the size of each helper's reply by its condition's content, `(..., H)`."""
    content, encoding, headers = point.content, point.radio.encoding, point.physical is not None
    if is_ours(content):
        return content.bits(encoding, intents, headers)
    with worded(_named(content)):
        given = content.bits(encoding, read_only(intents), headers)
        sizes = numbers("sizes", given, intents.payload_bits.shape)
        fit = np.isfinite(sizes) & (sizes >= 0)
        if not np.all(fit | ~intents.valid):
            raise ValueError("sizes that are no finite numbers of bits, 0 or more")
        return sizes


def graphs(
    call: Call, scenario: "Scenario", cases: Sequence["Heard"]
) -> Sequence[SceneGraph | None]:
    """Return the ego's graph of each case, by what it has heard."""
    if is_ours(call):
        return call.graphs(scenario, cases)
    with worded(_named(call)):
        given = list(call.graphs(scenario, cases))
        if len(given) != len(cases):
            raise ValueError(f"{len(given)} graphs of {len(cases)} cases")
        for graph, case in zip(given, cases, strict=True):
            if graph is not None and (
                not isinstance(graph, SceneGraph) or graph.viewer != case.own.viewer
            ):
                raise ValueError("it returns what is no graph of the ego's")
        return given


def words(call: Call, evidence: str) -> str:
    """Return the line that the prompt shows of a helper's words."""
    if is_ours(call):
        return call.words(evidence)
    with worded(_named(call)):
        said = call.words(evidence)
        if not isinstance(said, str):
            raise ValueError(f"words of type {type(said).__name__}")
        return " ".join("".join((said,)).split())


def _could(content: Content, intents: Intents) -> Bools:
    """Return who has what a content holds at most, `(..., H)`."""
    return intents.valid if content.asks_helpers else np.isfinite(intents.range_m)


def _named(thing: object) -> str:
    return f"content {type(thing).__name__}"
