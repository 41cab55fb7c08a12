"""Numbers and findings in the words of the report."""

from collections.abc import Mapping
from typing import Any

from harness.runs.folder import Run, Score

SUCCESS, LATENCY = "success_rate", "latency_proxy_ms"
GAIN = "success_gain_over_"  # and the name of the condition it is over

MEANINGS = {
    SUCCESS: "episodes with every decision safe, and their delays within the allowance",
    "unsafe_rate": "episodes with a decision that leads to a collision or a forced failure",
    "late_rate": "episodes with all decisions safe, but delays beyond the allowance",
    "collision_rate": "episodes that end in a collision",
    LATENCY: "start of the decision to the end of the whole exchange and of fusion, inference included",
    "latency_p50_ms": "half of all decisions are as fast",
    "latency_p95_ms": "95 % of all decisions are as fast",
    "latency_p99_ms": "99 % of all decisions are as fast",
    "fusion_ms": "part of it that fusion takes: 0 for a rule, which is arithmetic; ego-prompt infers again",
    "merge_failed_rate": "second answers that could not be read; the ego kept its own intent",
    "trigger_rate": "decisions in which the ego asked",
    "messages_per_episode": "replies scheduled; the request is none",
    "message_count": "replies scheduled in the whole run; the request is none",
    "effective_loss": "probability that one crossing was lost",
    "observed_reply_loss": "scheduled replies that did not arrive; request and reply must both cross",
    "deadline_miss_rate": "decisions that took longer than the decision window",
    "entropy_nats": "of the ego's own intent",
    "normalised_entropy": "of the ego's own intent; 1 is undecided",
    "brier": "of the fused policy against the safe actions; 0 best, 2 worst",
    "negative_log_likelihood": "of the safe actions in the fused policy; 0 best",
    "fallback_rate": "decisions in which the ego's own answer could not be read",
}

LIVE_MEANINGS = MEANINGS | {
    SUCCESS: "episodes in which the ego clears the intersection, and no later than the allowance",
    "unsafe_rate": "episodes that end in a collision, by time-out or off the road",
    "late_rate": "episodes cleared, but too long after the full-view driver, whose decisions act at once",
    "at_fault_rate": "episodes that end in a collision in which the ego should have given way",
    "time_out_rate": "episodes in which the ego does not clear the intersection in time",
    "off_road_rate": "episodes in which the ego leaves the road",
    "time_to_clear_s": "until the ego has cleared the intersection, where it does, late or not",
    "least_gap_m": "smallest distance to another vehicle's outline in an episode; 0 in a collision",
    "hard_brakings_per_episode": "times the ego begins to brake harder than 4 m/s²",
    "other_crashes_per_episode": "vehicles that crash without the ego",
    "decisions_per_episode": "decisions begun",
    "skipped_per_episode": "decisions not begun, since the one before was still open",
    "never_acted_per_episode": "decisions that were not ready before the episode ended",
}


def number(value: float | None, digits: int = 2) -> str:
    """A number with so many decimals; a dash for None."""
    return "–" if value is None else f"{value:.{digits}f}"


def unit(metric: str) -> tuple[float, str, int]:
    """How a metric is shown: factor, unit, decimals."""
    if "_gain_" in metric:
        return 100.0, " points", 1
    if "_rate" in metric or metric.endswith("_loss"):
        return 100.0, " %", 1
    if metric.endswith("_ms"):
        return 1.0, " ms", 1
    if metric.endswith("_nats"):
        return 1.0, " nats", 3
    if metric.endswith("_s"):
        return 1.0, " s", 2
    if metric.endswith("_m"):
        return 1.0, " m", 1
    if metric.endswith("_per_episode"):
        return 1.0, "", 2
    return 1.0, "", 1 if "message" in metric or "tokens" in metric else 3


def shown(score: Score) -> dict[str, str]:
    """Value, interval and n of a score, for a cell of the table."""
    factor, suffix, digits = unit(score.metric)
    value = "–" if score.value is None else number(score.value * factor, digits) + suffix
    n = f"n = {score.n} {score.interval}"
    if score.n_excluded:
        n += f", {score.n_excluded} excluded"
    return {"value": value, "interval": interval(score), "n": n}


def interval(score: Score) -> str:
    """`low to high` in the metric's unit; empty where there is none."""
    if score.low is None or score.high is None:
        return ""
    factor, suffix, digits = unit(score.metric)
    return f"{number(score.low * factor, digits)} to {number(score.high * factor, digits)}{suffix}"


def metric_name(metric: str) -> str:
    """A metric's name in words; its unit is shown with the value."""
    for suffix in ("_ms", "_nats", "_s", "_m"):
        metric = metric.removesuffix(suffix)
    return metric.replace("_", " ")


def headline(run: Run) -> str:
    """What came out, in one sentence: the best condition, and the one without V2V beside it."""
    found = {c: s for c in run.conditions if (s := run.score(c, SUCCESS)) is not None}
    model = run.config["model"].get("name")
    if not found:
        return f"{model} on {run.source}: the run has no success rate."
    best = max(found, key=lambda c: found[c].value or 0.0)
    text = f"With {model}, {best} {_clears(found[best])} of {run.source}"
    latency = run.score(best, LATENCY)
    if latency is not None:
        text += f" at {shown(latency)['value']} a decision"
    alone = [c["name"] for c in run.config["conditions"] if c.get("profile") is None and c["name"] in found]
    base = alone[0] if alone else min(found, key=lambda c: found[c].value or 0.0)
    if base == best:
        return text + (", and no other condition does better." if len(found) > 1 else ".")
    text += f"; {base} {_clears(found[base])}"
    gain = run.score(best, GAIN + base)
    if gain is not None and gain.low is not None and gain.high is not None:
        clear = "a clear difference" if gain.low > 0 or gain.high < 0 else "which may be chance"
        text += f", a gap of {shown(gain)['value']} ({interval(gain)}), {clear}"
    return text + "."


def _clears(score: Score) -> str:
    return f"clears {success_of(score)} of the episodes"


def success_of(score: Score) -> str:
    """A success rate and its interval, where it has one."""
    bounds = f" (95 % interval {interval(score)})" if interval(score) else ""
    return shown(score)["value"] + bounds


def latency_source(latency: Mapping[str, Any]) -> str:
    """Where the inference time comes from, and how long it is."""
    source = {
        "measured": "measured where it ran, one answer at a time",
        "card": "stated by the model card, not measured here",
        "paper": "the paper's, not measured here",
    }.get(latency["source"], latency["source"])
    seconds = latency["inference_s"]
    by_role = dict(seconds) if isinstance(seconds, Mapping) else {"each vehicle": seconds}
    by_role["ego with messages"] = latency.get("merge_s")
    known = [f"{role} {s * 1000:.0f} ms" for role, s in by_role.items() if s is not None]
    return f"{', '.join(known) or 'each answer has its own time'}; {source} ({latency['basis']})"


def facts(value: Any, name: str = "") -> list[tuple[str, Any]]:
    """A nested mapping as lines of a table: dotted name and value."""
    if isinstance(value, Mapping):
        return [
            line
            for key, inner in value.items()
            for line in facts(inner, f"{name}.{key}" if name else str(key))
        ]
    if isinstance(value, list):
        return [(name, ", ".join(map(str, value)))]
    return [(name, value)]
