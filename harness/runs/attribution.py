"""What moved a run's answers, where `harness attribute` looked: a file beside its tables."""

from pathlib import Path
from typing import Literal

import msgspec
from msgspec import Struct

FILE = "attribution.json"


class LeftOut(Struct, frozen=True, kw_only=True):
    """One thing that was left out of a prompt, or of what was fused, and what it changed.

    Attributes:
        scene: id of the decision point.
        episode: its number.
        seed: of the channel's draws of a decision whose message was left out; None otherwise.
        viewer: whose answer it is; the ego of a policy.
        role: whose prompt it was left out of, the `ego`'s or a `helper`'s, or `fusion`.
        item: id of the object, or of the helper that sent the message.
        kind: one of `harness.studies.attribution.KINDS`.
        action: the likeliest with all there.
        instead: the likeliest without it; None where that answer failed.
        change: of the probability of `action`; None where that answer failed.
        shift: total variation between both distributions; None where that answer failed.
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
    """All that was left out, one thing at a time.

    Attributes:
        condition: the operating point whose decision points were drawn.
        decision_points: how many were.
        of: how many the condition came to.
        sample_seed: of the draw.
        left_out: what was left out of them.
    """

    condition: str
    decision_points: int
    of: int
    sample_seed: int
    left_out: tuple[LeftOut, ...]


def load(file: Path) -> Attribution:
    """A run's attribution. Raises OSError or ValueError where it is broken."""
    return msgspec.json.decode(file.read_bytes(), type=Attribution)
