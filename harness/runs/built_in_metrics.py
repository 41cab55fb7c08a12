"""The table of the metrics that the core has, in the order of a summary's rows."""

from harness.core.figures import PERCENT, POINTS
from harness.runs.answer_metrics import answer_metrics
from harness.runs.episode_metrics import EPISODE_METRICS
from harness.runs.exchange_metrics import EXCHANGE_METRICS
from harness.runs.headline import BALANCED, IN_WORDS
from harness.runs.metric import COUNT, MS, Metric, decision_share, of_column
from harness.runs.metric_names import ADJUSTED, GAIN, GAINS
from harness.runs.percentiles import PERCENTILES
from harness.runs.policy_metrics import POLICY_METRICS
from harness.runs.records import PLAIN_ROLES

BUILT_IN = (
    *EPISODE_METRICS,
    *EXCHANGE_METRICS,
    *POLICY_METRICS,
    decision_share(
        "fallback_rate",
        "share of decisions in which the ego's own answer could not be read",
        "own_failed",
    ),
    Metric(
        "fusion_ms",
        "part of the latency that fusion takes: 0 for a rule, which is arithmetic; "
        "ego-prompt calls the model again",
        MS,
        "lower",
        label="fusion",
        decisions=of_column("fusion_ms"),
    ),
    decision_share(
        "merge_failed_rate",
        "share of answers to fusion calls that could not be read; the ego then kept its own intent",
        "fusion_failed",
        label="fusion failed rate",
    ),
    Metric(
        "message_count",
        "number of scheduled replies in the whole run; requests do not count",
        COUNT,
        "lower",
    ),
    *(
        Metric(
            f"latency_p{p}_ms",
            f"{p} % of all decisions are at most this slow",
            MS,
            "lower",
            label=f"latency p{p}",
            percentile=p,
        )
        for p in PERCENTILES
    ),
    Metric(
        GAIN,
        "success rate less that of the condition without V2V, in the same episodes",
        POINTS,
        "higher",
        "rate",
        1.0,
    ),
    Metric(
        GAINS[BALANCED],
        "balanced success rate less that of the condition without V2V, in the same episodes",
        POINTS,
        "higher",
        "rate",
        1.0,
    ),
    *(
        Metric(
            ADJUSTED[name],
            f"{IN_WORDS[name]}, corrected by what references that ask no model do in these "
            "layouts and in others of the dataset",
            PERCENT,
            "higher",
            "rate",
            1.0,
            corrects=name,
            world="frozen",
            optional=True,
        )
        for name in GAINS
    ),
    *(
        Metric(
            ADJUSTED[gain],
            f"{IN_WORDS[name]} less that of the condition without V2V, corrected likewise",
            POINTS,
            "higher",
            "rate",
            1.0,
        )
        for name, gain in GAINS.items()
    ),
    *answer_metrics(PLAIN_ROLES),
    Metric(
        "agreement_rate",
        "share of episodes that end alike, frozen and in closed loop",
        PERCENT,
        "higher",
        "rate",
        1.0,
    ),
)
