"""The registry of metrics: all that is known of each, and their values from decisions,
episodes or answers.

A package adds a metric by an entry point in the group `swarmdrive.metrics`.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product, takewhile
from typing import Any, ClassVar, Literal, Protocol, get_args

import numpy as np
from msgspec import UNSET

from harness.core import multiplicity
from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import UserError, one_line, printable
from harness.core.figures import PERCENT, POINTS, Unit, interval_of
from harness.core.plugins import Plugins, of_type, one_of, say_once
from harness.core.statistics import (
    LEVEL,
    Estimate,
    brier,
    episode_interval,
    known_mean,
    mean_of,
    negative_log_likelihood,
    paired_difference,
    rate_interval,
    safe_target,
    seed_interval,
    seed_rate_interval,
)
from harness.core.strangers import aside
from harness.parsing.status import Repair
from harness.runs import headline, reliability
from harness.runs.decisions import Decisions
from harness.runs.records import (
    PLAIN_ROLES,
    Answer,
    AnswerFacts,
    Episode,
    Role,
    Score,
    role_word,
    roles,
)

World = Literal["frozen", "closed-loop"]
Better = Literal["higher", "lower", "neither"]
Answers = Sequence[Answer | AnswerFacts]
BASELINE = "single-local"  # the condition without V2V
SUCCESS, BALANCED, IN_WORDS = headline.SUCCESS, headline.BALANCED, headline.IN_WORDS
LATENCY, GAIN = "latency_proxy_ms", f"success_gain_over_{BASELINE}"
GAINS = {SUCCESS: GAIN, BALANCED: f"balanced_success_gain_over_{BASELINE}"}  # by what is gained
# What is corrected by the layouts' difficulty, by what it corrects
ADJUSTED = {name: f"adjusted_{name}" for name in (*GAINS, *GAINS.values())}
# how many decisions the figures of exactly one optimal action are of
ONE_OPTIMAL = "decisions_one_optimal"
PERCENTILES = (50, 95, 99)
ALL = "all"  # the condition of a figure that is the same in all of them
MS, SECONDS, METRES = Unit("ms"), Unit("s", 2), Unit("m")
NATS = Unit("nats", 3)
COUNT, MEAN_COUNT, SCORE = Unit(decimals=1), Unit(decimals=2), Unit(decimals=3)


class Columns(Protocol):
    """Describe a table of n decisions: `table[name]` is a column (n,), NaN where unknown."""

    def __getitem__(self, name: str, /) -> Floats: ...


@dataclass(frozen=True)
class Metric:
    """Define one metric, with values of 0 or more, by its name, meaning, unit and function.

    The function is one of `decisions`, `episodes`, `answers` and `pooled`, by what it takes; a
    metric without any is computed where `summary.csv` is made.
    """

    name: str  # its name in tables, with the unit at the end
    meaning: str  # its meaning, in words for people
    unit: Unit  # how it is written
    better: Better  # which change of it is better
    # `rate` for a share of events, whose interval is Wilson's; `mean` for Student's t
    interval: Literal["rate", "mean"] = "mean"
    most: float = math.inf  # the greatest value that it can have
    # whether the p of its differences is corrected (decision 0084); all others are exploratory
    primary: bool = False
    label: str = ""  # its name for people; by default the name with spaces
    # returns its values for decisions (n,), whose mean is the episode's
    decisions: Callable[[Any], Floats] | None = None
    # returns an episode's value; None where unknown
    episodes: Callable[[Episode], Any] | None = None
    # returns its values for the answers (n,) of one role; NaN where unknown
    answers: Callable[[Answers], Floats] | None = None
    role: Role | None = None  # whose answers
    percentile: int | None = None  # the percent of all decisions whose latency is at most so long
    # returns its value for all decisions, which has no mean
    pooled: reliability.Figure | None = None
    total: bool = False  # whether an episode has the sum over its decisions instead of the mean
    world: World | None = None  # the world in which it is known; None for every world
    optional: bool = False  # whether a run in which it is nowhere known has no row of it
    half: bool = False  # whether it is of the episodes with a danger alone, or of those without
    # names of two metrics whose mean it is: of the episodes with a danger, and of those without
    halves: tuple[str, ...] = ()
    # the metric that it corrects by the layouts' difficulty, where two runs are compared
    corrects: str = ""
    # whether another has taken its place: tables and, where it is still computed, comparisons keep
    # it, and pages leave it out
    superseded: bool = False
    # of an extension that ships: the metric behind whose rows its own stand
    behind: str = ""

    def __post_init__(self) -> None:
        if not self.label:
            object.__setattr__(self, "label", self.name.replace("_", " "))

    @property
    def compared(self) -> bool:
        """Return whether two runs are compared in the metric.

        It is so if it has a value for each episode or over all decisions.
        """
        ways = (
            self.decisions,
            self.episodes,
            self.percentile,
            self.pooled,
            self.halves,
            self.corrects,
        )
        return any(ways)


class Metrics(Plugins[Metric]):
    """Hold all metrics by name: built-in ones, those of extensions, and other packages'."""

    stated: ClassVar = {
        "meaning": of_type(str),
        "label": of_type(str),
        "unit": of_type(Unit),
        "better": one_of(*get_args(Better)),
        "interval": one_of("rate", "mean"),
        "most": of_type(float),
        "world": one_of(None, *get_args(World)),
    }

    @cached_property
    def of_harness(self) -> Mapping[str, Metric]:
        """Return the metrics that the harness defines, by name, in the order of a summary's rows.

        Those that other packages add are left out.
        """
        of_answers = {metric.name: metric for metric in _of_answers(roles())}
        before = takewhile(lambda name: name not in of_answers, self.built_in)
        core = {**{name: self.built_in[name] for name in before}, **of_answers, **self.built_in}
        of_extensions = [super(Metrics, self).__getitem__(name) for name in self._shipped()]
        ordered: dict[str, Metric] = {}
        for name, metric in core.items():
            ordered[name] = metric
            ordered |= {each.name: each for each in of_extensions if each.behind == name}
        return ordered

    def _shipped(self) -> list[str]:
        entries = self._entries()
        return [name for name in entries if self.is_ours(name) and name not in self.built_in]

    def __getitem__(self, name: str) -> Metric:
        return self.of_harness[name] if name in self.of_harness else super().__getitem__(name)

    def __iter__(self) -> Iterator[str]:
        return iter({**self.of_harness, **self._entries()})

    def check(self, name: str, plugin: Metric) -> None:
        functions = [each for each in (plugin.decisions, plugin.episodes) if each]
        if plugin.name != name or not name.isidentifier() or len(functions) != 1 or plugin.primary:
            raise UserError(
                f"plug-in {printable(name)!r} ({self.group}) is the metric "
                f"{printable(plugin.name)!r} with {len(functions)} "
                f"functions{', a primary one' * plugin.primary}; give it the name of its entry "
                "point, of letters, digits and _, and one function, of decisions or of episodes; "
                "a package's metric is not primary"
            )


def _rate(
    name: str,
    meaning: str,
    happened: Callable[[Episode], bool | None],
    better: Better = "lower",
    **more: Any,
) -> Metric:
    return Metric(name, meaning, PERCENT, better, "rate", 1.0, episodes=happened, **more)


def _share(name: str, meaning: str, column: str, better: Better = "lower", **more: Any) -> Metric:
    """Build the metric of a share of decisions, one column of their table."""
    return Metric(name, meaning, PERCENT, better, "rate", 1.0, decisions=_column(column), **more)


def _judged(
    name: str,
    meaning: str,
    unit: Unit,
    better: Better,
    score: Callable[[Floats, Any], Floats],
    **more: Any,
) -> Metric:
    """Build the metric of a score of fused policies by their optimal actions."""
    return Metric(
        name,
        meaning,
        unit,
        better,
        world="frozen",
        decisions=lambda d: score(d.of_actions("fused"), d.of_actions("safe") == 1.0),
        **more,
    )


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


def _column(name: str) -> Callable[[Columns], Floats]:
    return lambda d: d[name]


def _of_field(name: str) -> Callable[[Answers], Floats]:
    """Build the function of one field of answers, NaN where it is not stated."""

    def values(answers: Answers) -> Floats:
        numbers = [getattr(answer, name) for answer in answers]
        return np.array([np.nan if v is None or v is UNSET else v for v in numbers], dtype=float)

    return values


def _verdict(verdict: str) -> Callable[[Answers], Floats]:
    return lambda answers: np.array([answer.verdict == verdict for answer in answers], dtype=float)


def _divided(answers: Answers) -> Floats:
    divided = np.array([Repair.DIVIDED in answer.repairs for answer in answers], dtype=float)
    return divided if divided.any() else np.full(len(answers), np.nan)


def _valid(turns: int) -> Callable[[Answers], Floats]:
    """Build the function of the answers that are valid after so many turns,
    where any needed two.
    """

    def values(answers: Answers) -> Floats:
        if all(answer.turns == 1 for answer in answers):
            return np.full(len(answers), np.nan)
        return np.array([a.verdict != "failed" and a.turns <= turns for a in answers], dtype=float)

    return values


def _label(name: str, role: Role) -> str:
    """Return a label for people."""
    return f"{name} {role_word(role)}".replace("_", " ")


def _of_answers(roles: Sequence[Role]) -> Iterator[Metric]:
    """Yield the metrics of each role's answers, in the order of a summary's rows."""
    rates: tuple[tuple[tuple[str, str, Better, Callable[[Answers], Floats]], ...], ...] = (
        (
            (
                "strict_rate",
                "share of answers that fit the schema as they are",
                "higher",
                _verdict("strict"),
            ),
            (
                "recovered_rate",
                "share of answers that were read after repairs",
                "neither",
                _verdict("recovered"),
            ),
            ("failed_rate", "share of answers that could not be read", "lower", _verdict("failed")),
            (
                "divided_rate",
                "share of answers whose numbers were divided by their sum",
                "lower",
                _divided,
            ),
            (
                "flip_rate",
                "share of read-outs whose likeliest action changes with the order of the list",
                "lower",
                _of_field("flipped"),
            ),
        ),
        (
            (
                "valid_at_first_rate",
                "share of answers that could be read without a repair turn",
                "higher",
                _valid(1),
            ),
            (
                "valid_after_repair_rate",
                "share of answers that could be read after the repair turn",
                "higher",
                _valid(2),
            ),
        ),
    )
    for group in rates:
        for role in roles:
            for name, meaning, better, values in group:
                yield Metric(
                    f"{name}_{role}",
                    meaning,
                    PERCENT,
                    better,
                    "rate",
                    1.0,
                    label=_label(name, role),
                    answers=values,
                    role=role,
                )
    in_letters = "probability of the letters together, in a read-out"
    by_letter = "part of a read-out that follows the letter and not the action"
    one_letter = "share of read-outs in which one letter is the likeliest in every order"
    lengths: tuple[tuple[str, str, Unit, Better, float], ...] = (
        ("prompt_tokens", "tokens of a prompt", COUNT, "lower", math.inf),
        ("completion_tokens", "tokens of an answer", COUNT, "lower", math.inf),
        ("label_mass", in_letters, SCORE, "higher", 1.0),
        ("letter_share", by_letter, SCORE, "lower", 1.0),
        ("follows_letter", one_letter, SCORE, "lower", 1.0),
    )
    for role in roles:
        for name, meaning, unit, better, most in lengths:
            values = _of_field(name)
            label = _label(name, role)
            yield Metric(
                f"{name}_{role}",
                meaning,
                unit,
                better,
                most=most,
                label=label,
                answers=values,
                role=role,
            )


BUILT_IN = (
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
    _share(
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
        decisions=_column("delay_s"),
        world="frozen",
    ),
    _share(
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
    _share(
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
    _share(
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
    Metric(
        "messages_per_episode",
        "number of scheduled replies; requests do not count",
        COUNT,
        "lower",
        decisions=_column("messages"),
        total=True,
    ),
    Metric(
        "requests_per_episode",
        "number of broadcast requests; one request asks several helpers",
        COUNT,
        "lower",
        decisions=_column("requests"),
        total=True,
    ),
    Metric(
        "bits_per_episode",
        "bits of all requests and scheduled replies",
        Unit("bit", 0),
        "lower",
        decisions=lambda d: d["request_bits"] + d["reply_bits"],
        total=True,
    ),
    Metric(
        "airtime_ms",
        "total time on air of an episode's requests and scheduled replies",
        MS,
        "lower",
        label="airtime",
        decisions=_column("airtime_ms"),
        total=True,
    ),
    Metric(
        "busy_ratio",
        "share of the time that the radio's channel is busy with background traffic",
        PERCENT,
        "lower",
        most=1.0,
        decisions=_column("busy_ratio"),
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
        decisions=_column("latency_ms"),
    ),
    _share(
        "deadline_miss_rate",
        "share of decisions that took longer than the decision window",
        "deadline_missed",
    ),
    _share(
        "trigger_rate", "share of decisions in which the ego asked helpers", "triggered", "neither"
    ),
    # A computed probability and no share of events, so that its interval is a mean's.
    Metric(
        "effective_loss",
        "packet loss: probability that one transmission was lost",
        PERCENT,
        "neither",
        most=1.0,
        decisions=_column("effective_loss"),
    ),
    _share(
        "observed_reply_loss",
        "share of scheduled replies that did not arrive; the request or the reply was lost",
        "observed_loss",
    ),
    Metric(
        "entropy_nats",
        "entropy of the ego's own intent",
        NATS,
        "neither",
        label="entropy",
        decisions=_column("entropy_nats"),
    ),
    Metric(
        "normalised_entropy",
        "entropy of the ego's own intent from 0 (sure) to 1 (undecided)",
        SCORE,
        "neither",
        decisions=_column("normalised_entropy"),
    ),
    _judged(
        "optimal_action_rate",
        "share of decisions whose likeliest action is optimal; only those in "
        "which success was still possible",
        PERCENT,
        "higher",
        reliability.right,
        interval="rate",
        most=1.0,
    ),
    _judged(
        "optimal_brier",
        "Brier score of the optimal actions, taken as one event; 0 best, 2 worst",
        SCORE,
        "lower",
        reliability.brier,
        most=2.0,
        label="Brier",
    ),
    _judged(
        "optimal_nll_nats",
        "negative log-likelihood of the optimal actions together, whose probability "
        f"counts as {reliability.LEAST_P} at least",
        NATS,
        "lower",
        reliability.likelihood_nats,
        label="NLL",
    ),
    Metric(
        ONE_OPTIMAL,
        "number of decisions, of all seeds, in which exactly one action is optimal",
        Unit(decimals=0),
        "neither",
        world="frozen",
        pooled=reliability.decisions,
    ),
    Metric(
        "calibration_error_one_optimal",
        "expected calibration error of the likeliest action, in "
        f"{reliability.BINS} bins of equal mass, over all decisions in which exactly one action is "
        f"optimal; not known below {reliability.LEAST} of them",
        PERCENT,
        "lower",
        most=1.0,
        label="ECE",
        world="frozen",
        pooled=reliability.calibration_error,
    ),
    Metric(
        "coverage_at_5_risk_one_optimal",
        "greatest share, the surest first, of the decisions in which "
        "exactly one action is optimal, of which 5 % at most are not right; not known below "
        f"{reliability.LEAST} of them",
        PERCENT,
        "higher",
        most=1.0,
        label="coverage at 5 % risk",
        world="frozen",
        pooled=reliability.coverage,
    ),
    Metric(
        "calibration_error",
        "expected calibration error over all decisions, also those in which several "
        "actions are optimal; in older runs",
        PERCENT,
        "lower",
        most=1.0,
        world="frozen",
        superseded=True,
    ),
    Metric(
        "coverage_at_5_risk",
        "coverage at 5 % risk over all decisions, also those in which several "
        "actions are optimal; in older runs",
        PERCENT,
        "higher",
        most=1.0,
        world="frozen",
        superseded=True,
    ),
    Metric(
        "brier",
        "distance of the fused policy from the uniform one over the safe actions; 0 best, 2 worst",
        SCORE,
        "lower",
        world="frozen",
        superseded=True,
        decisions=lambda d: brier(d.of_actions("fused"), safe_target(d.of_actions("safe") == 1.0)),
    ),
    Metric(
        "negative_log_likelihood",
        "optimal_nll_nats with a least probability of 0.0001",
        SCORE,
        "lower",
        world="frozen",
        superseded=True,
        decisions=lambda d: negative_log_likelihood(
            d.of_actions("fused"), d.of_actions("safe") == 1.0
        ),
    ),
    _share(
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
        decisions=_column("fusion_ms"),
    ),
    _share(
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
    *_of_answers(PLAIN_ROLES),
    Metric(
        "agreement_rate",
        "share of episodes that end alike, frozen and in closed loop",
        PERCENT,
        "higher",
        "rate",
        1.0,
    ),
)
METRICS = Metrics("swarmdrive.metrics", Metric, {metric.name: metric for metric in BUILT_IN})


def metrics_of(world: World) -> tuple[Metric, ...]:
    """Return the metrics of decisions and of episodes that are known in a kind of world.

    `world` is `frozen` (recorded scenes) or `closed-loop`. Raises UserError if a package's metric
    does not load.
    """
    by_row = (metric for metric in METRICS.values() if metric.decisions or metric.episodes)
    return tuple(metric for metric in by_row if metric.world in (None, world))


@lru_cache(1024)
def entry(name: str) -> Metric:
    """Return the metric of a name; a plain one without a meaning if it is not registered.

    Such a name may stand in a run that another version of the harness made.
    """
    try:
        return METRICS[name]
    except (KeyError, UserError):
        return Metric(name, "", SCORE, "neither")


@dataclass(frozen=True)
class Grid:
    """Hold the conditions, seeds and episodes of a run: the axes (C, S, E) of its figures.

    Each combination is a cell: one episode under one condition with one seed.
    """

    conditions: tuple[str, ...]  # names of the C conditions, operating points of the run
    seeds: tuple[int, ...]  # the S seeds of the channel's draws
    episodes: tuple[int, ...]  # numbers of the E episodes, one for each layout

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.conditions), len(self.seeds), len(self.episodes)

    def places(self, decisions: Decisions) -> Ints:
        """Return the index of each of n decisions' cells in a flattened array (C, S, E), (n,).

        Raises ValueError for a decision outside the grid.
        """
        condition = decisions.codes("condition", self.conditions)
        seed, episode = (
            _position(decisions.whole(name), names)
            for name, names in (("seed", self.seeds), ("episode", self.episodes))
        )
        return np.ravel_multi_index((condition, seed, episode), self.shape)

    def ordered(self, episodes: Sequence[Episode]) -> list[Episode]:
        """Return the episodes in the order of the cells: by condition, seed and episode.

        Raises ValueError unless each cell has exactly one.
        """
        by_cell = {(e.condition, e.seed, e.episode): e for e in episodes}
        cells = [*product(self.conditions, self.seeds, self.episodes)]
        if len(by_cell) != len(episodes) or set(by_cell) != set(cells):
            raise ValueError("not every episode is there once in every condition and seed")
        return [by_cell[cell] for cell in cells]


def by_episode(
    metrics: Sequence[Metric], grid: Grid, decisions: Decisions, episodes: Sequence[Episode]
) -> dict[str, Floats]:
    """Return each metric's values by its name, (C, S, E); NaN where unknown.

    The axes are those of the grid: C conditions, S channel seeds and E episodes, and `episodes`, of
    one record for each, are in that order.
    """
    places = grid.places(decisions)

    def values(metric: Metric) -> Floats:
        if metric.episodes:
            return of_ends(metric, grid, episodes)
        return of_decisions(metric, decisions, places, len(episodes)).reshape(grid.shape)

    return {metric.name: values(metric) for metric in metrics}


def of_ends(metric: Metric, grid: Grid, episodes: Sequence[Episode]) -> Floats:
    """Return a metric's values from how episodes ended, (C, S, E); NaN where unknown.

    The axes are those of the grid: C conditions, S channel seeds and E episodes, and `episodes`, of
    one record for each, are in that order.
    """
    function = metric.episodes
    assert function

    def values() -> Floats:
        numbers = [function(episode) for episode in episodes]
        return np.array([np.nan if v is None else float(v) for v in numbers])

    return _values(metric, values, len(episodes)).reshape(grid.shape)


def of_decisions(metric: Metric, decisions: Columns, places: Ints, n: int) -> Floats:
    """Return a metric's value for each of n episodes, (n,), from m decisions; NaN where unknown.

    `places`, (m,), is the index from 0 to n - 1 of each decision's episode.
    """
    function = metric.decisions
    assert function
    values = _values(metric, lambda: np.asarray(function(decisions), dtype=float), len(places))
    if not metric.total:
        return mean_by_place(values, places, n)
    unknown = sum_by_place(np.isnan(values), places, n)
    return np.where(unknown > 0, np.nan, sum_by_place(values, places, n))


def _values(metric: Metric, values: Callable[[], Floats], n: int) -> Floats:
    """Return a metric's values, (n,). Those of a package that fails are unknown,
    and a line says so.
    """
    if metric is METRICS.of_harness.get(metric.name):
        return values()
    what = f"metric {printable(metric.name)} of a package"
    try:
        with aside(what):
            numbers = values()
        if numbers.shape != (n,):
            raise ValueError(f"it has values of shape {numbers.shape}, not ({n},)")
        if not ((numbers >= 0) & (numbers <= metric.most) | np.isnan(numbers)).all():
            raise ValueError(f"it has values beyond 0 to {metric.most:g}")
    except Exception as error:  # a stranger's code
        reason = one_line(error).removeprefix(f"{what} ") or type(error).__name__
        # though figures are computed part by part
        say_once(f"{what}: {reason}; its figure is unknown")
        return np.full(n, np.nan)
    return numbers


def sum_by_place(values: Floats, places: Ints, n: int) -> Floats:
    """Return the sum of the known values of each of n groups, such as episodes, (n,).

    `places`, (m,), is the group of each of m `values`, (m,): an index from 0 to n - 1.
    """
    return np.bincount(places, weights=np.nan_to_num(values), minlength=n).astype(float)


def mean_by_place(values: Floats, places: Ints, n: int) -> Floats:
    """Return the mean of the known values of each of n groups, such as episodes, (n,).

    `places`, (m,), is the group of each of m `values`, (m,): an index from 0 to n - 1. NaN for a
    group without a known value.
    """
    is_known = ~np.isnan(values)
    count = np.bincount(places[is_known], minlength=n)
    total = sum_by_place(values[is_known], places[is_known], n)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def least_by_place(values: Floats, places: Ints, n: int) -> Floats:
    """Return the least of the known values of each of n groups, such as episodes, (n,).

    `places`, (m,), is the group of each of m `values`, (m,): an index from 0 to n - 1. NaN for a
    group without a known value.
    """
    least = np.full(n, np.nan)
    np.fmin.at(least, places, values)
    return least


def over_seeds(name: str, values: Floats) -> Estimate:
    """Return the mean of a metric's values with a 95 % interval over channel seeds.

    `values` are (S, E), by S channel seeds and E episodes, NaN where unknown; `name` is the
    metric's.
    """
    if entry(name).interval == "rate":
        return in_range(name, seed_rate_interval(values))
    return in_range(name, seed_interval(known_mean(values, axis=1)))


def over_episodes(name: str, values: Floats) -> Estimate:
    """Return the mean of a metric's values with a 95 % interval over episodes.

    `values` are (S, E), by S channel seeds and E episodes, NaN where unknown; `name` is the
    metric's.
    """
    means = known_mean(values, axis=0)
    rate = entry(name).interval == "rate"
    return rate_interval(means) if rate else in_range(name, episode_interval(means))


def difference(name: str, pairs: Sequence[tuple[Floats, Floats]], level: float = LEVEL) -> Estimate:
    """Return the difference a - b of a metric with its interval over episodes.

    `pairs` has the metric's values a and b of the same episodes, (E, S) each, by E episodes and S
    channel seeds: one pair, or of balanced success one for each half, with a danger and without, in
    which the episodes of the other half are NaN. `level` is the confidence of the interval.
    """
    if entry(name).interval != "rate":
        ((a, b),) = pairs
        return episode_interval(a - b, level=level)
    result = paired_difference([known_mean(a - b, axis=1) for a, b in pairs], level)
    if len(pairs) == 1:
        return result
    return replace(result, n_excluded=max((result.n_excluded - result.n) // 2, 0))


def halved(name: str, estimate: Callable[[str], Estimate], shared: bool = False) -> Estimate:
    """Return a metric's estimate: for balanced success the mean of those of its two halves.

    A half is the episodes with a danger, or those without. `estimate` returns the estimate of the
    metric with a name. Halves have no episode in common, so that their intervals are independent.
    `shared` says that they share units, such as seeds: n is then that of each half, else the sum.
    """
    halves = entry(name).halves
    if not halves:
        return estimate(name)
    first, second = map(estimate, halves)
    mean = mean_of([first, second])
    n, n_excluded = (
        (first.n, first.n_excluded) if shared else (mean.n, (mean.n_excluded - mean.n) // 2)
    )
    return replace(mean, n=n, n_excluded=max(n_excluded, 0))


def by_danger(success: Floats, dangerous: Bools) -> dict[str, Floats]:
    """Return success with a danger, and success without, by the metrics' names, (..., E) each.

    `success` is (..., E), 1 or 0, of E episodes; `dangerous` is a mask (E,) of those with a danger.
    NaN in the episodes of the other kind.
    """
    parts = (np.where(part, success, np.nan) for part in (dangerous, ~dangerous))
    return dict(zip(entry(BALANCED).halves, parts, strict=True))


def known_in(values: Mapping[str, Floats]) -> list[str]:
    """Return the names of the metrics that a run with these values by episode states, in order.

    Metrics of one half (with or without a danger) are stated only if there are episodes of both.
    """
    names = {name for name, v in values.items() if not (entry(name).optional and np.isnan(v).all())}
    both = names.issuperset(entry(BALANCED).halves)
    return [
        m.name
        for m in METRICS.values()
        if (m.name in names or m.halves) and (both or not (m.half or m.halves))
    ]


def p_value(name: str, pairs: Sequence[tuple[Floats, Floats]]) -> float | None:
    """Return the p-value of no difference in a metric; None if the difference has no interval.

    `pairs` has the values of both sides, (E, S) each, as `difference` takes them: E episodes by S
    channel seeds.
    """
    return multiplicity.p_value(lambda level: difference(name, pairs, level))


def in_range(name: str, e: Estimate) -> Estimate:
    """Return an estimate with its interval cut to the metric's range, from 0 to `most`."""
    low, high = float(np.maximum(e.low, 0.0)), float(np.minimum(e.high, entry(name).most))
    return Estimate(e.value, low, high, e.n, e.n_excluded)


def percentiles(latency_ms: Floats) -> Floats:
    """Return the `PERCENTILES` of latencies (n,), ms; NaN if none is known.

    Unknown latencies, which are NaN, are left out.
    """
    measured = latency_ms[~np.isnan(latency_ms)]
    return (
        np.percentile(measured, PERCENTILES) if len(measured) else np.full(len(PERCENTILES), np.nan)
    )


def written(score: Score) -> str:
    """Return a score and its interval as text, with the metric's unit but without its name."""
    return interval_of(score, entry(score.metric).unit)


def _position(values: Ints, names: Sequence[int]) -> Ints:
    order = np.argsort(names)
    place = order[np.minimum(np.searchsorted(names, values, sorter=order), len(names) - 1)]
    if (np.asarray(names)[place] != values).any():
        raise ValueError("a decision of another seed or episode")
    return np.asarray(place)
