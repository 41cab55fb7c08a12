"""One cooperative decision, from seeing to acting, for any number of scenes at once.

First the exchange of messages (its timeline is in `exchange.py`), then fusion: a consensus rule is
arithmetic and takes no time; `ego-prompt` asks the ego's model once more, after the exchange, and the
decision takes that much longer. An ego that has heard nobody acts on its own intent at once.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from harness.coordination.consensus import RULES, inverse_distance_weights
from harness.coordination.exchange import Exchange, Luck, exchange
from harness.coordination.operating_point import OperatingPoint
from harness.core.arrays import Bools, Floats, Ints

# Who was heard, `(..., H)`, to the ego's second answer: its intent `(..., A)`, where it failed or nobody was
# heard NaN, and the seconds `(...)` it took.
Merge = Callable[[Bools], tuple[Floats, Floats]]


@dataclass(frozen=True)
class Coordination(Exchange):
    """What happened in each decision. Times are seconds from the start of the decision.

    Attributes:
        weights: each vehicle's weight in the policy, `(..., 1+H)`; NaN where a model merged the messages.
        fused: the policy, `(..., A)`.
        action: index of its most probable action, `(...)`. A tie goes to the earlier action, so list
            actions the most conservative first.
        merge_failed: the ego's second answer was unusable and `fused` is its own intent, `(...)`.
        latency_s: when the ego acts, `(...)`: end of exchange and fusion. The paper's `latency_proxy`.
        deadline_missed: that was after the window, `(...)`.
    """

    weights: Floats
    fused: Floats
    action: Ints
    merge_failed: Bools
    latency_s: Floats
    deadline_missed: Bools

    @property
    def fusion_s(self) -> Floats:
        """Part of the latency that fusion takes, `(...)`."""
        return self.latency_s - self.exchange_s


def coordinate(
    point: OperatingPoint,
    own: Floats,
    helpers: Floats,
    valid: Bools,
    distance_m: Floats,
    range_m: Floats,
    payload_bits: Floats,
    infer_s: Floats,
    luck: Luck,
    merge: Merge | None = None,
) -> Coordination:
    """Trigger, channel and fusion for decisions `(...)` with up to H helpers and A actions each.

    Args:
        point: the operating point.
        own: the ego's intent, `(..., A)`; a row with a NaN is a failed answer.
        helpers: helpers' intents, `(..., H, A)`.
        valid: the helper exists and its answer parsed, `(..., H)` (see `exchange`).
        distance_m: distance to the centroid of the conflict zone, `(..., 1+H)`, the ego first.
        range_m: distance to the ego, `(..., H)`.
        payload_bits: size of the reply, `(..., H)`.
        infer_s: seconds of inference, `(..., 1+H)`, the ego first.
        luck: the channel's draws.
        merge: the ego's second answers; needed where the point's consensus is `ego-prompt`.
    """
    heard = exchange(point, own, helpers, valid, range_m, payload_bits, infer_s, luck)
    return fuse(point, heard, helpers, distance_m, merge)


def fuse(
    point: OperatingPoint, heard: Exchange, helpers: Floats, distance_m: Floats, merge: Merge | None = None
) -> Coordination:
    """The policy of each decision, once it is known who was heard; arguments as in `coordinate`."""
    weights = inverse_distance_weights(distance_m, heard.on_time, point.min_distance_m)
    anybody = np.any(heard.on_time, axis=-1)
    latency_s, merge_failed = heard.exchange_s, np.zeros_like(heard.own_failed)
    if point.consensus in RULES:
        fused = RULES[point.consensus](np.concatenate([heard.own[..., None, :], helpers], axis=-2), weights)
    else:
        if merge is None:
            raise ValueError(f"consensus {point.consensus} needs the ego's second answers")
        fused, seconds = merge(heard.on_time)
        merge_failed = anybody & np.any(np.isnan(fused), axis=-1)
        weights = np.where(anybody[..., None], np.nan, weights)
        latency_s = latency_s + np.where(anybody, seconds, 0.0)
    fused = np.where((anybody & ~merge_failed)[..., None], fused, heard.own)
    return Coordination(
        **{field.name: getattr(heard, field.name) for field in fields(Exchange)},
        weights=weights,
        fused=fused,
        action=np.argmax(fused, axis=-1),
        merge_failed=merge_failed,
        latency_s=latency_s,
        deadline_missed=latency_s > point.window_s,
    )
