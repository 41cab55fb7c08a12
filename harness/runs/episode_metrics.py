"""The metrics of how episodes go: success, harm, time lost and near misses."""

from collections.abc import Callable, Iterator
from typing import Any

from harness.core.figures import PERCENT
from harness.runs.headline import BALANCED, SUCCESS
from harness.runs.metric import (
    MEAN_COUNT,
    METRES,
    SECONDS,
    Better,
    Metric,
    decision_share,
    of_column,
)
from harness.runs.records import Episode


def _rate(
    name: str,
    meaning: str,
    happened: Callable[[Episode], bool | None],
    better: Better = "lower",
    **more: Any,
) -> Metric:
    return Metric(name, meaning, PERCENT, better, "rate", 1.0, episodes=happened, **more)


def _halves(
    stem: str, meaning: str, value: Callable[[Episode], bool | None], better: Better = "lower"
) -> Iterator[Metric]:
    """Yield the metrics of a share of the episodes with a danger, and of those without."""
    for half, which in (("dangerous", "with a danger"), ("harmless", "without a danger")):

        def of_half(e: Episode, harmless: bool = half == "harmless") -> bool | None:
            return value(e) if (e.danger == "none") == harmless else None

        text = meaning.format(f"episodes {which}")
        yield _rate(f"{stem}_{half}_rate", text, of_half, better, optional=True, half=True)


def _fails(*failures: str) -> Callable[[Episode], bool]:
    return lambda e: e.failure in failures


def _field(name: str) -> Callable[[Episode], Any]:
    return lambda e: getattr(e, name)


def _witnessed(count: int) -> Callable[[Episode], bool | None]:
    return lambda e: e.success if e.witnesses == count else None


def _seen_by(count: int) -> Callable[[Episode], bool | None]:
    """Build the function of success where so many helpers see the danger,
    which sends nothing itself.
    """
    return lambda e: (
        e.success if e.danger != "none" and e.witnesses == count and not e.danger_radio else None
    )


EPISODE_METRICS = (
    _rate(
        SUCCESS,
        "share of episodes in which the ego clears the intersection within the allowed time",
        _field("success"),
        "higher",
        primary=True,
    ),
    Metric(
        BALANCED,
        "mean of the success rates with and without a danger",
        PERCENT,
        "higher",
        "rate",
        1.0,
        halves=("success_dangerous_rate", "success_harmless_rate"),
        primary=True,
    ),
    *_halves("success", "share of {} that succeed", _field("success"), "higher"),
    _rate(
        "unsafe_rate",
        "share of episodes that end in a collision or off the road; where `limits` is 1, by "
        "time-out, too",
        lambda e: e.outcome == "unsafe" if e.outcome else not e.success and e.failure != "late",
        primary=True,
    ),
    _rate("collision_rate", "share of episodes that end in a collision", _fails("collision")),
    _rate(
        "at_fault_rate",
        "share of episodes that end in a collision in which the ego had to give way",
        lambda e: e.fault == "ego",
    ),
    _rate(
        "late_rate",
        "share of episodes that the ego clears, but too long after the full-view driver",
        _fails("late"),
    ),
    _rate(
        "time_out_rate",
        "share of episodes in which time runs out before the ego clears the intersection",
        _fails("time_out"),
    ),
    _rate(
        "stuck_rate",
        "share of episodes in which the ego never clears, without harm",
        lambda e: e.outcome == "stuck" if e.outcome else None,
        optional=True,
    ),
    *_halves(
        "miss",
        "share of {} in which a decision made harm inevitable, which was not before",
        _field("miss"),
    ),
    *_halves(
        "false_alarm",
        "share of {} in which a decision gave success away, and harm could still be avoided",
        _field("false_alarm"),
    ),
    Metric(
        "time_lost_s",
        "time from the earliest possible clearing until the ego's; only episodes in which "
        "it clears, late or not",
        SECONDS,
        "lower",
        label="time lost",
        episodes=_field("time_lost_s"),
        world="frozen",
        optional=True,
    ),
    _rate(
        "off_road_rate", "share of episodes in which the ego leaves the road", _fails("off_road")
    ),
    decision_share(
        "regret_rate",
        "share of decisions that gave success away, of those in which it was still possible",
        "regret",
        world="frozen",
    ),
    Metric(
        "delay_s",
        "time that a safe decision adds to the earliest possible success",
        SECONDS,
        "lower",
        label="delay",
        decisions=of_column("delay_s"),
        world="frozen",
    ),
    decision_share(
        "off_lag_rate",
        "share of decisions so fast or slow that they would act in another frame than the "
        "dataset assumes",
        "off_lag",
        "neither",
        world="frozen",
    ),
    Metric(
        "time_to_clear_s",
        "time until the ego has cleared the intersection; only episodes in which it "
        "does, late or not",
        SECONDS,
        "lower",
        label="time to clear",
        episodes=lambda e: e.time_s if e.failure in ("", "late") else None,
    ),
    *(
        _rate(
            f"success_rate_{k}_witness{'' if k == 1 else 'es'}",
            "success rate in the layouts in which so "
            "many helpers have, or would have, the danger in sight at the first decision",
            _witnessed(k),
            "higher",
            optional=True,
        )
        for k in range(4)
    ),
    *(
        _rate(
            f"success_dangerous_rate_{k}_witness{'' if k == 1 else 'es'}",
            "success rate where so many "
            "helpers have the danger in sight at the first decision, and it has no radio",
            _seen_by(k),
            "higher",
            optional=True,
            half=True,
        )
        for k in range(4)
    ),
    _rate(
        "success_dangerous_rate_with_radio",
        "success rate where the danger has a radio and tells of itself",
        lambda e: e.success if e.danger_radio else None,
        "higher",
        optional=True,
        half=True,
    ),
    Metric(
        "arrived_rate",
        "share of an episode's agents that reach their goal; where several decide",
        PERCENT,
        "higher",
        most=1.0,
        optional=True,
        episodes=lambda e: (e.arrived or 0) / e.agents if e.agents else None,
    ),
    _rate(
        "met_rate",
        "share of episodes in which agents collide with each other; where several decide",
        lambda e: bool(e.met) if e.agents else None,
        optional=True,
    ),
    Metric(
        "agents_lost_s",
        "how much later all agents reach their goals than each would alone, in sum; only "
        "those that do",
        SECONDS,
        "lower",
        label="time lost by all",
        episodes=_field("agents_lost_s"),
        optional=True,
    ),
    Metric(
        "most_lost_s",
        "the same of the agent that loses most",
        SECONDS,
        "lower",
        label="time lost by one",
        episodes=_field("most_lost_s"),
        optional=True,
    ),
    decision_share(
        "broken_word_rate",
        "share of decisions in which an agent's action is not the likeliest of the "
        "plan that another got from it",
        "broke_word",
        optional=True,
    ),
    Metric(
        "least_gap_m",
        "smallest distance to another vehicle's outline; 0 in a collision",
        METRES,
        "higher",
        label="least gap",
        episodes=_field("least_gap_m"),
    ),
    Metric(
        "hard_brakings_per_episode",
        "number of times that the ego begins to brake harder than 4 m/s²",
        MEAN_COUNT,
        "lower",
        episodes=_field("hard_brakings"),
    ),
    Metric(
        "least_ttc_s",
        "least time to collision with another vehicle at constant velocities, up to 5 s; "
        "only episodes in which it is known",
        SECONDS,
        "higher",
        label="least TTC",
        episodes=_field("least_ttc_s"),
        optional=True,
    ),
    _rate(
        "short_ttc_rate",
        "share of episodes with a time to collision below 1.5 s",
        _field("short_ttc"),
        label="short TTC rate",
        optional=True,
    ),
    decision_share(
        "short_ttc_decision_rate",
        "share of decisions with a time to collision below 1.5 s before the next one",
        "short_ttc",
        label="short TTC decision rate",
        optional=True,
    ),
    Metric(
        "least_pet_s",
        "least post-encroachment time: from one vehicle's leaving a place to the other's "
        "arrival, the ego one of them, up to 5 s; only episodes in which it is known",
        SECONDS,
        "higher",
        label="least PET",
        episodes=_field("least_pet_s"),
        optional=True,
    ),
    _rate(
        "short_pet_rate",
        "share of episodes with a post-encroachment time below 1.5 s",
        _field("short_pet"),
        label="short PET rate",
        optional=True,
    ),
    Metric(
        "other_crashes_per_episode",
        "number of vehicles that crash without the ego",
        MEAN_COUNT,
        "lower",
        episodes=_field("other_crashes"),
    ),
    Metric(
        "decisions_per_episode",
        "number of decisions begun",
        MEAN_COUNT,
        "neither",
        episodes=_field("decisions"),
    ),
    Metric(
        "skipped_per_episode",
        "number of decisions not begun because the one before was still open",
        MEAN_COUNT,
        "lower",
        episodes=_field("skipped"),
        world="closed-loop",
    ),
    Metric(
        "never_acted_per_episode",
        "number of decisions that were not ready when the episode ended",
        MEAN_COUNT,
        "lower",
        episodes=_field("never_acted"),
        world="closed-loop",
    ),
)
