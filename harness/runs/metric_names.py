"""The names of metrics and conditions that code asks for, besides those of `headline`."""

from harness.runs.headline import BALANCED, SUCCESS

ALL = "all"  # the condition of a figure that is the same in all of them
BASELINE = "single-local"  # the condition without V2V
LATENCY, GAIN = "latency_proxy_ms", f"success_gain_over_{BASELINE}"
GAINS = {SUCCESS: GAIN, BALANCED: f"balanced_success_gain_over_{BASELINE}"}  # by what is gained
# What is corrected by the layouts' difficulty, by what it corrects
ADJUSTED = {name: f"adjusted_{name}" for name in (*GAINS, *GAINS.values())}
# how many decisions the figures of exactly one optimal action are of
ONE_OPTIMAL = "decisions_one_optimal"
