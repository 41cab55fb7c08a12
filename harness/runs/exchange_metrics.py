"""The metrics of exchanges: messages, time on air, latency and packet loss."""

import numpy as np

from harness.core.figures import PERCENT, Unit
from harness.runs.metric import COUNT, MS, Metric, decision_share, of_column
from harness.runs.metric_names import LATENCY

EXCHANGE_METRICS = (
    Metric(
        "messages_per_episode",
        "number of scheduled replies; requests do not count",
        COUNT,
        "lower",
        decisions=of_column("messages"),
        total=True,
    ),
    Metric(
        "requests_per_episode",
        "number of broadcast requests; one request asks several helpers",
        COUNT,
        "lower",
        decisions=of_column("requests"),
        total=True,
    ),
    Metric(
        "bits_per_episode",
        "bits of all requests, scheduled replies and messages sent unasked",
        Unit("bit", 0),
        "lower",
        decisions=lambda d: d["request_bits"] + d["reply_bits"] + np.nan_to_num(d["unasked_bits"]),
        total=True,
    ),
    Metric(
        "unasked_per_episode",
        "number of messages that helpers sent unasked, from the first decision to the last",
        COUNT,
        "lower",
        decisions=of_column("unasked"),
        total=True,
        optional=True,
    ),
    Metric(
        "airtime_ms",
        "total time on air of an episode's requests, scheduled replies and messages sent unasked",
        MS,
        "lower",
        label="airtime",
        decisions=of_column("airtime_ms"),
        total=True,
    ),
    Metric(
        "unasked_ms",
        "the part of the time on air that messages sent unasked take",
        MS,
        "lower",
        label="unasked airtime",
        decisions=of_column("unasked_ms"),
        total=True,
        optional=True,
    ),
    Metric(
        "busy_ratio",
        "share of the time that the radio's channel is busy with background traffic",
        PERCENT,
        "lower",
        most=1.0,
        decisions=of_column("busy_ratio"),
        optional=True,
    ),
    Metric(
        LATENCY,
        "time from the start of a decision to the end of the exchange and of fusion, with all "
        "inference",
        MS,
        "lower",
        primary=True,
        label="latency proxy",
        decisions=of_column("latency_ms"),
    ),
    decision_share(
        "deadline_miss_rate",
        "share of decisions that took longer than the decision window",
        "deadline_missed",
    ),
    decision_share(
        "trigger_rate", "share of decisions in which the ego asked helpers", "triggered", "neither"
    ),
    # A computed probability and no share of events, so that its interval is a mean's.
    Metric(
        "effective_loss",
        "packet loss: probability that one transmission was lost",
        PERCENT,
        "neither",
        most=1.0,
        decisions=of_column("effective_loss"),
    ),
    decision_share(
        "observed_reply_loss",
        "share of scheduled replies that did not arrive; the request or the reply was lost",
        "observed_loss",
    ),
)
