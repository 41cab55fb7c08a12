"""What comes of asking helpers: who was asked, what arrived, and until when the ego waits."""

from typing import NamedTuple

from harness.core.arrays import Bools, Floats, Ints


class Consulted(NamedTuple):
    """Hold the result of asking H helpers, by the ego itself or by another for it.

    Another, such as an antenna beside the road, may ask for the ego, fuse the replies and send the
    ego a policy, the probabilities of its actions. Times are seconds from the start of the ego's
    request. Arrays are of decisions of any shape `(...)`; index h of an axis of length H is helper
    h.
    """

    # which helpers were asked, `(..., H)`; by another none if the ego's request to it was lost
    asked: Bools
    # whether request and reply were received, and the policy if another sent one, `(..., H)`
    up: Bools
    # end of each reply at the place of fusion, s, `(..., H)`; inf for helpers that were not asked
    end_s: Floats
    fused: Bools  # which replies may be part of the policy, `(..., H)`
    # when the ego has heard all that it waits for, or gives up waiting for a policy, s, `(...)`
    acts_s: Floats
    # probability that one transmission is lost, `(..., H)`, or `(..., 1)` if all links have the
    # same
    loss: Floats
    requests: Ints  # number of requests, the ego's and another's for it, `(...)`
    # size of all requests, bits, with the ego's intent in its request to another, `(...)`
    request_bits: Floats
    policy_bits: Floats  # size of the policy that another sends, bits, `(...)`
    airtime_s: Floats  # time on air of all messages, s, `(...)`
