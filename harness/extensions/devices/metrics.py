"""The energy of a decision, of the columns that a device profile adds."""

from functools import partial

from harness.core.figures import Unit
from harness.runs.metric import Metric

JOULES, BEHIND = Unit("J", 2), "busy_ratio"
_metric = partial(Metric, better="lower", optional=True, behind=BEHIND)

ENERGY = _metric(
    "energy_j",
    "energy of a decision: inference of the ego, of the helpers that infer and of a "
    "fusion call, and their radios; known only with a device profile",
    JOULES,
    label="energy",
    decisions=lambda d: d["inference_j"] + d["radio_mj"] / 1000,
)
HELPERS = _metric(
    "helpers_j",
    "energy of a decision: the part of the helpers' inference",
    JOULES,
    label="helpers",
    decisions=lambda d: d["helpers_j"],
)
RADIO = _metric(
    "radio_mj",
    "energy of a decision: the part of the radios",
    Unit("mJ", 3),
    label="radio",
    decisions=lambda d: d["radio_mj"],
)
WAITING = _metric(
    "waiting_j",
    "energy that the ego's computer draws while it waits for messages; not part of energy_j",
    JOULES,
    label="waiting",
    decisions=lambda d: d["waiting_j"],
)
