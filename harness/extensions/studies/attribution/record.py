"""The file of a run's attribution, which `harness study attribute` writes:
what moved its answers.
"""

from pathlib import Path
from typing import Literal

import msgspec
from msgspec import Struct

from harness.core.files import text_of
from harness.runs.folder import Run

FILE = "attribution.json"


class LeftOut(Struct, frozen=True, kw_only=True):
    """Hold what changed when one object or message was left out of a prompt or of the fusion.

    It shows what an answer depends on. An object is a vehicle or the like that a prompt lists; the
    fusion makes the ego's policy of its own answer and of helpers' messages. Answers and policies
    are probabilities of actions.
    """

    scene: str  # id of the decision point
    episode: int  # the episode's number
    # seed of the channel's draws, if a message was left out of a decision; None otherwise
    seed: int | None
    viewer: str  # id of the vehicle whose answer changes; that of the ego for a policy
    # what the item was left out of: the prompt of the `ego` or a `helper`, or the `fusion`
    role: Literal["ego", "helper", "fusion"]
    item: str  # id of the object, or of the helper that sent the message
    kind: str  # what it is, such as `hidden conflict vehicle` or `helper with sight`
    action: str  # the likeliest action with the item
    instead: str | None  # the likeliest action without it; None if that answer failed
    # the probability of `action` without the item less that with it; None if that answer failed
    change: float | None
    # total variation distance of both distributions, 0 to 1; None if that answer failed
    shift: float | None


class Attribution(Struct, frozen=True, kw_only=True):
    """Hold the result of leaving out objects and messages of a run, one at a time.

    It shows what answers depend on. A sample of decision points, situations in which the ego
    decided, was drawn from those that the run has under one condition, a named set of settings of
    radio, asking and fusion.
    """

    condition: str  # name of the condition whose decision points were drawn
    decision_points: int  # how many were drawn
    of: int  # how many decision points the condition has
    sample_seed: int  # seed of the draw
    left_out: tuple[LeftOut, ...]  # the items that were left out


def of_run(run: Run) -> Attribution | None:
    """Read the attribution that lies in a run's folder; None if there is none.

    An attribution says what answers become without one object or message. Raises UserError if the
    file is broken.
    """
    return run.read_file(FILE, _load) if (run.path / FILE).is_file() else None


def _load(file: Path) -> Attribution:
    return msgspec.json.decode(text_of(file, "record"), type=Attribution)
