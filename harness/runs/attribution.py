"""The file of a run's attribution, which `harness study attribute` writes: what moved its answers."""

from pathlib import Path
from typing import Literal

import msgspec
from msgspec import Struct

from harness.core.files import text_of

FILE = "attribution.json"


class LeftOut(Struct, frozen=True, kw_only=True):
    """One object or message that was left out of a prompt or of the fusion, and what that changed.

    Attributes:
        scene: id of the decision point.
        episode: the episode's number.
        seed: seed of the channel's draws, if a message was left out of a decision; None otherwise.
        viewer: id of the vehicle whose answer changes; that of the ego for a policy.
        role: what the item was left out of: the prompt of the `ego` or a `helper`, or the `fusion`.
        item: id of the object, or of the helper that sent the message.
        kind: one of `harness.studies.attribution.KINDS`.
        action: the likeliest action with the item.
        instead: the likeliest action without it; None if that answer failed.
        change: change of the probability of `action`; None if that answer failed.
        shift: total variation between both distributions; None if that answer failed.
    """

    scene: str
    episode: int
    seed: int | None
    viewer: str
    role: Literal["ego", "helper", "fusion"]
    item: str
    kind: str
    action: str
    instead: str | None
    change: float | None
    shift: float | None


class Attribution(Struct, frozen=True, kw_only=True):
    """A run's attribution: every item that was left out, one at a time.

    Attributes:
        condition: name of the condition whose decision points were drawn.
        decision_points: how many were drawn.
        of: how many decision points the condition has.
        sample_seed: seed of the draw.
        left_out: the items that were left out.
    """

    condition: str
    decision_points: int
    of: int
    sample_seed: int
    left_out: tuple[LeftOut, ...]


def load(file: Path) -> Attribution:
    """Read a run's attribution. Raises OSError or ValueError if the file is broken."""
    return msgspec.json.decode(text_of(file, "record"), type=Attribution)
