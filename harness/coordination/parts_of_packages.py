"""The door to a package's parts:
none writes to what it gets, and what it returns is checked and copied.

So a part moves no condition but its own, in it nothing but what its hook is for, and fails in one
line, a UserError.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import json

from harness.coordination.contents_of_packages import graph_like
from harness.coordination.intents import Intents
from harness.coordination.parts import (
    PACKAGES_PARTS,
    Change,
    Part,
    Question,
    RunFacts,
    is_ours,
    worded_part,
)
from harness.coordination.sent import SentIntents, Speaker
from harness.core.arrays import (
    Bools,
    Floats,
    Ints,
    check_distributions,
    check_shape,
    numbers,
    read_only,
)
from harness.core.plugins import line_or_none
from harness.core.strangers import worded
from harness.radio.channel import Draws
from harness.world.scene_graph import SceneGraph

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint


def obstacle(part: Part, point: "OperatingPoint", run: RunFacts) -> str | None:
    """Return why a part of an operating point cannot be used in a run, or None if it can.

    The text is one line. `point` is the operating point, the settings of the radio, of asking
    helpers and of fusing their messages; `run` has the run's agents (models with their prompts),
    its scenario and its world. Raises UserError if a package's part fails or returns no text.
    """
    if is_ours(part):
        return part.obstacle(point, run)
    with worded_part(part):
        return line_or_none(part.obstacle(point, run), "an obstacle")


def obstacle_of_models(part: Part, identities: Sequence[Mapping[str, Any]]) -> str | None:
    """Return why a part of an operating point cannot be used with models, or None if it can.

    The text is one line. `identities` tell the opened models apart, the ego's first. Raises
    UserError if a package's part fails or returns no text.
    """
    if is_ours(part):
        return part.obstacle_of_models(identities)
    with worded_part(part):
        return line_or_none(part.obstacle_of_models(identities), "an obstacle of its models")


def prepared(part: Part, intents: Intents) -> Intents:
    """Return what vehicles intend in n decisions, corrected by one group of settings.

    The group, `part`, is such as a calibration's, and `intents` has probabilities of actions. What
    a package's code returns is checked. Raises UserError if it fails, changes more than `own` and
    `helpers`, or returns no distribution for an answer.
    """
    if is_ours(part):
        return part.before(intents)
    with worded_part(part):
        after, before = part.before(read_only(intents)).arrays(), intents.arrays()
        for name in before.keys() - {"own", "helpers"}:
            if not np.array_equal(before[name], after[name], equal_nan=True):
                raise ValueError(f"it changes {name}, which nobody intends")
        ego_intents = _distributions("the ego's intents", after["own"], intents.own)
        helpers = _distributions("helpers' intents", after["helpers"], intents.helpers)
        return replace(intents, own=ego_intents, helpers=helpers)


@dataclass(frozen=True)
class SpeakerOfPart:
    """Wrap a package's speaker, which decides what helpers send, and check what it returns.

    Raises UserError if it changes the ego's own intent, place or time, or sends no distributions.
    """

    part: Part  # the package's group of settings that the speaker is of
    speaker: Speaker  # the speaker that is checked

    def said(self, truth: Intents, draws: Draws, episode: Ints, seed: Ints) -> SentIntents:
        given = (read_only(truth), read_only(draws), read_only(episode), read_only(seed))
        with worded_part(self.part):
            sent = self.speaker.said(*given)
            now = sent.intents
            for name, before, after in (
                ("intent", truth.own, now.own),
                ("place", truth.distance_m[:, 0], now.distance_m[:, 0]),
                ("time", truth.inference_s[:, 0], now.inference_s[:, 0]),
            ):
                if not np.array_equal(before, after, equal_nan=True):
                    raise ValueError(f"it changes the ego's {name}")
            check_shape("attackers", sent.attackers, now.valid.shape)
            answered = now.valid if now.unasked is None else now.valid & ~now.unasked
            check_distributions("intents", now.helpers, answered)
        return sent


def speaker_of(part: Part) -> Speaker | None:
    """Return what decides what helpers send under a part, its speaker; None if they send the truth.

    A part is a group of settings, such as an attack's.
    Each walk through a run's episodes needs its own. Raises UserError if a package's part fails.
    """
    with worded_part(part):
        speaker = part.speaker()
    if speaker is None or is_ours(part):
        return speaker
    return SpeakerOfPart(part, speaker)


def sources(part: Part, episode: Ints, seed: Ints) -> Ints:
    """Return for each of n decisions the index of the decision whose helpers it hears, `(n,)`.

    By `part`, the settings of a control, these may be the helpers of another decision among the n.
    `episode` and `seed`, `(n,)`, have each decision's episode number and seed of draws. Raises
    UserError if a package's part fails or returns no valid indices.
    """
    if is_ours(part):
        return part.sources(episode, seed)
    with worded_part(part):
        places = part.sources(read_only(episode), read_only(seed))
        check_shape("sources", places, episode.shape)
        if places.dtype.kind not in "iu" or np.any((places < 0) | (places >= len(episode))):
            raise ValueError("sources that are no decisions")
        return places.astype(np.int64)


def after_call(part: Part, fused: Floats, intents: Floats, heard: Bools) -> Floats:
    """Return the policies, `(..., A)`, to use in place of what a fusion call answered.

    A fusion call is a second question to the ego's model, which shows it what it has heard; a
    policy is the probabilities of the ego's A actions. `fused` are the call's answers, `(..., A)`,
    NaN where one failed; `intents` those of the ego, at index 0, and H helpers, `(..., 1+H, A)`;
    `heard` says who was heard in time, `(..., H)`. Raises UserError if a package's part fails or
    returns no distributions.
    """
    if is_ours(part):
        return part.after_call(fused, intents, heard)
    with worded_part(part):
        after = part.after_call(read_only(fused), read_only(intents), read_only(heard))
        return _distributions("policies", after, fused)


def after_fusion(part: Part, policies: Floats) -> Floats:
    """Return the policies by which egos act, `(..., A)`, given those after all fusion.

    A policy is the probabilities of the ego's A actions; `part` is a group of settings of the
    condition. Raises UserError if a package's part fails or returns no distributions.
    """
    if is_ours(part):
        return part.after_fusion(policies)
    with worded_part(part):
        return _distributions("policies", part.after_fusion(read_only(policies)), policies)


@dataclass(frozen=True)
class ChangeOfPart:
    """Guard a package's change of helpers' messages, such as an attack's: check what it returns.

    Messages are changed before a fusion call, a second question to the ego's model, shows them.
    `what` names the package's group of settings in errors, and `change` is the package's own
    object. Raises UserError if it fails, or returns what is no such message or scene graph.
    """

    what: str  # what messages on errors call the part
    change: Change  # what is checked

    @property
    def adds(self) -> bool:
        with worded(self.what):
            return bool(self.change.adds)

    def message(self, message: Mapping[str, Any], actions: Sequence[str]) -> dict[str, Any]:
        with worded(self.what):
            plain_message: dict[str, Any] = json.decode(json.encode(message))
            changed: dict[str, Any] = json.decode(
                json.encode(self.change.message(copy.deepcopy(plain_message), actions))
            )
            if changed.keys() != plain_message.keys():
                raise ValueError("it adds members to a message, or leaves some out")
            for name, value in changed.items():
                kinds = (str, type(None)) if name == "evidence" else (type(plain_message[name]),)
                if type(value) not in kinds:
                    raise TypeError(f"it gives {name} of type {type(value).__name__}")
            if changed["intent"] != plain_message["intent"]:
                intent = numbers("an intent", np.array(changed["intent"], float), (len(actions),))
                check_distributions("an intent", intent, np.array(True))
            return changed

    def graph(self, graph: SceneGraph, scenario: Any, scene: Any) -> SceneGraph:
        with worded(self.what):
            changed = self.change.graph(graph, scenario, scene)
            return graph_like(changed, graph, "the sender's")


def change_by(kind: type[Part], text: str) -> Change | None:
    """Return the change of helpers' messages that a text, such as `liar:share=1/3`, names.

    `kind` is the class of the group of settings (such as an attack's) that is asked for it. None if
    it has no change by that name.
    """
    what = PACKAGES_PARTS.get(kind)
    if what is None:
        return kind.change(text)
    with worded(what):
        change = kind.change(text)
    return None if change is None else ChangeOfPart(what, change)


def shown_graph(question: Question, graph: SceneGraph) -> SceneGraph:
    """Return the scene graph that a question puts into a helper's prompt, given the helper's own.

    A scene graph is what one vehicle knows of a scene. Raises UserError if a package's question
    fails or returns another vehicle's graph.
    """
    for kind, what in PACKAGES_PARTS.items():
        if question in kind.questions:
            with worded(what):
                return graph_like(question.shown(graph), graph, "the helper's")
    return question.shown(graph)


def _distributions(name: str, after: object, before: Floats) -> Floats:
    """Return a part's rows (..., A), copied; those that held an answer hold a distribution."""
    values = numbers(name, after, before.shape)
    answered: Bools = ~np.any(np.isnan(before), axis=-1)
    check_distributions(name, values, answered)
    return values
