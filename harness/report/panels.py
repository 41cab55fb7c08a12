"""Which charts a report has: what is counted for each, and how it is read.

The rows of a chart are plain. Shares are 0 to 1;
`low` and `high` are a 95 % interval over episodes.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.plugins import Shipped
from harness.core.statistics import rate_interval, units_of
from harness.parsing.status import Status
from harness.report import charts
from harness.report.references import driven, in_trees, label, sentences
from harness.report.runs import Runs
from harness.runs.folder import Run
from harness.runs.headline import IN_WORDS, headline_of
from harness.runs.metric_names import LATENCY
from harness.runs.records import Score, role_word
from harness.runs.reliability import BINS, LEAST
from harness.runs.summary import judged_of

Table = list[dict[str, Any]]
ENTROPY_NATS, TOKENS, ARRIVAL_MS = 0.1, 25, 10.0  # widths of bins
Part = Literal["overview", "probabilities", "answers", "communication"]
ENTROPY = "entropy of the ego's own intent, nats"
REPLIES = ("on time", "late", "lost")
BUDGET = (200, 400)  # tokens of a prompt: the paper's


@dataclass(frozen=True)
class Panel:
    """Hold one chart of the report page: a Vega-Lite specification with its title and caption.

    `id` is its name in the page. `part` is the section of the page in which it stands: `overview`,
    `probabilities`, `answers` or `communication`. `caption` says how to read it.
    """

    id: str  # its name in the page, and of the files it is saved as
    part: Part  # section of the page: `overview`, `probabilities`, `answers` or `communication`
    title: str  # what is drawn over what
    caption: str  # how to read it, and what it is conditional on
    spec: dict[str, Any]  # the chart, a Vega-Lite specification


@dataclass(frozen=True)
class AddedPanel:
    """Describe a chart that a shipped extension adds to the report page.

    The extension names it as a plug-in of kind `panels`. `part` is the section of the page, and
    `title` and `caption` stand beside the chart. `rows` returns a run's data for it, empty if there
    is nothing to draw, and `spec` the Vega-Lite specification of all runs' rows.
    """

    part: Part  # section of the page: `overview`, `probabilities`, `answers` or `communication`
    title: str  # what is drawn over what
    caption: str  # how to read it
    # takes a run and returns the chart's data, dicts for Vega-Lite; empty if there is nothing to
    # draw
    rows: Callable[[Run], Table]
    # takes the rows of all runs and returns the Vega-Lite specification
    spec: Callable[[Table], dict[str, Any]]


PANELS = Shipped[AddedPanel]("swarmdrive.panels", AddedPanel, {})


def panels(runs: Runs) -> Iterator[Panel]:
    """Yield the charts of the runs, one section of the page after the other.

    A chart without any data is left out.
    """

    def joined(table_of: Callable[[Run], Table]) -> Table:
        rows = []
        for name, run in zip(runs.names, runs.runs, strict=True):
            rows += [charts.named({"run": name, **row}) for row in table_of(run)]
        return rows

    points = [c for run in runs.runs for c in run.manifest.conditions if c.get("profile")]
    tau_nats = sorted({c["tau_nats"] for c in points})
    windows_ms = sorted({c["window_s"] * 1000 for c in points})

    metric = headline_of(*runs.runs)
    if rows := joined(lambda run: success(run, metric)):
        references, scenario = _references(runs, metric), runs.scenario
        rates = {}
        for name, score in references.items():
            if score.value is not None:
                rates[label(name, scenario)] = score.value
        yield Panel(
            "success-latency",
            "overview",
            f"{IN_WORDS[metric].capitalize()} and latency",
            "Each point is a condition; the lines through it are 95 % intervals over episodes. "
            "Rings: what the paper reports, with other scenes and another model. A reply that "
            "arrives after the decision window is not fused."
            + sentences(references, scenario, runs.dataset is not None),
            charts.success_latency(rows, rates, windows_ms, IN_WORDS[metric]),
        )
    if rows := joined(statuses):
        yield Panel(
            "statuses",
            "answers",
            "How answers were read",
            "Share of each role's answers by status. Strict: the text fits the schema as it is. "
            "Recovered: it was read after repairs. All others failed and gave no distribution.",
            charts.statuses(rows),
        )
    if rows := joined(reliability):
        yield Panel(
            "reliability",
            "probabilities",
            "Is the policy as often right as it is sure?",
            "Decisions in which exactly one action is optimal, so that success is possible after "
            "no other, are grouped by the probability of the likeliest action in the fused "
            f"policy, in {BINS} bins of equal mass; each point shows how often that action was "
            "the optimal one. The mean distance from the dashed line is the ECE; above the line "
            f"the policy is less sure than it could be. Conditions with fewer than {LEAST} such "
            "decisions are left out. All seeds; 95 % intervals over episodes.",
            charts.shares(
                rows,
                "certainty",
                "fused probability of the likeliest action",
                "share optimal",
                diagonal=True,
            ),
        )
    if rows := joined(entropies):
        yield Panel(
            "entropy",
            "answers",
            "Entropy of the ego's own answers",
            "Number of the ego's own answers by entropy, for those that could be read. Dashed: τ, "
            "above which the ego asks helpers.",
            charts.bars(rows, "entropy_nats", ENTROPY, "answers", ENTROPY_NATS, rules=tau_nats),
        )
    if rows := joined(errors):
        yield Panel(
            "entropy-error",
            "probabilities",
            "Entropy against error",
            "Share of decisions whose action was unsafe, by the entropy of the ego's own intent "
            "before fusion. If high entropy predicts errors, the line of the condition without "
            "V2V rises to the right. How far the other lines lie below it is what the helpers "
            "correct. All seeds; 95 % intervals over episodes.",
            charts.shares(rows, "entropy_nats", ENTROPY, "share unsafe", rules=tau_nats),
        )
    if rows := joined(tokens):
        yield Panel(
            "tokens",
            "answers",
            "Length of prompts",
            "Number of prompts by length, in tokens as the engine counted them. Shaded: the "
            "paper's budget of 200 to 400 tokens.",
            charts.bars(
                rows,
                "tokens",
                "tokens in the prompt",
                "prompts",
                TOKENS,
                series="role",
                within=BUDGET,
            ),
        )
    if rows := joined(replies):
        yield Panel(
            "replies",
            "communication",
            "Replies on time, late and lost",
            "Scheduled replies, all seeds. On time: the reply arrived within the decision window "
            "and was fused. Late: it arrived after the window. Lost: the request or the reply was "
            "lost.",
            charts.stacked(rows, "condition", "reply", charts.REPLIES, "replies"),
        )
    for name, added in PANELS.items():
        if rows := joined(added.rows):
            yield Panel(name, added.part, added.title, added.caption, added.spec(rows))
    if rows := joined(arrivals):
        yield Panel(
            "arrivals",
            "communication",
            "When replies arrive",
            "Number of replies by arrival time, for those that were not lost; all seeds. Dashed: "
            "the end of the decision window.",
            charts.bars(
                rows,
                "arrival_ms",
                "arrival, ms from the start of the decision",
                "replies",
                ARRIVAL_MS,
                series="condition",
                rules=windows_ms,
            ),
        )


def _references(runs: Runs, metric: str) -> dict[str, Score]:
    """Return the headline metric of the references: from the trees, in closed loop from their
    own runs.
    """
    if runs.dataset is None:
        return driven(runs.runs, metric)
    episodes = {number for run in runs.runs for number in run.grid.episodes}
    references = in_trees(runs.dataset.of_episodes(episodes))
    return {name: scores[metric] for name, scores in references.items()}


def success(run: Run, metric: str) -> Table:
    """Return the data of the chart of success over latency: a row for each condition of a run.

    A row has `condition`; the mean `latency_ms` with the ends of its interval, `latency_low` and
    `latency_high`; `success`, 0 to 1, by the metric of the name `metric`, with the ends `low` and
    `high`; `n`, the number of episodes; and `interval`, what that is over. A condition, a named set
    of settings that the run scores, is left out if one of the two is unknown.
    """
    rows = []
    for condition in run.conditions:
        latency, rate = run.score(condition, LATENCY), run.score(condition, metric)
        if latency and rate:
            rows.append(
                {
                    "condition": condition,
                    "latency_ms": latency.value,
                    "latency_low": latency.low,
                    "latency_high": latency.high,
                    "success": rate.value,
                    "low": rate.low,
                    "high": rate.high,
                    "n": rate.n,
                    "interval": rate.interval,
                }
            )
    return rows


def statuses(run: Run) -> Table:
    """Return a row for each role and parse status: count of answers and share of the role's.

    A role is who answered: `ego`, `helper` or `fusion` (the ego after it heard messages); a status
    is the outcome of parsing, such as `strict` or `bad_sum`. Keys are `role`, `status`, `verdict`,
    `count`, `share` and `n`, the number of the role's answers.
    """
    order = {str(status): n for n, status in enumerate(Status)}
    count = Counter[tuple[str, int, str, str]]()  # by role, the status's place, status and verdict
    total = Counter[str]()  # by role
    for answer in run.answers:
        role = role_word(answer.role)
        count[role, order.get(answer.status, -1), answer.status, answer.verdict] += 1
        total[role] += 1
    rows = []
    for (role, _, status, verdict), n in sorted(count.items()):
        share, of_role = n / total[role], total[role]
        row = {"role": role, "status": status, "verdict": verdict, "count": n}
        rows.append({**row, "share": share, "n": of_role})
    return rows


def reliability(run: Run) -> Table:
    """Return a reliability diagram's rows: for each condition and bin of the policy's confidence.

    The policy is the distribution over actions from which the ego acts, its confidence the greatest
    probability. A row says how often the likeliest action was the only optimal one: `condition`,
    `certainty` (the bin's mean confidence), `share`, its interval's ends `low` and `high`, and `n`.
    Conditions with fewer than `LEAST` decisions that have exactly one optimal action are left out.
    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages.
    """
    rows: Table = []
    judged_by_condition = judged_of(run.grid, run.decisions, run.grid.places(run.decisions))
    clusters = run.clusters
    for condition, judged in zip(run.conditions, judged_by_condition, strict=True):
        if len(judged.sure) < LEAST:
            continue
        bins = judged.bins()
        for place in np.unique(bins):
            here = bins == place
            units = judged.episode[here]
            if clusters is not None:
                units = clusters[units]
            share = rate_interval(judged.right[here], units)
            rows.append(
                {
                    "condition": condition,
                    "certainty": round(float(judged.sure[here].mean()), 4),
                    "share": share.value,
                    "low": share.low,
                    "high": share.high,
                    "n": share.n,
                }
            )
    return rows


def errors(run: Run) -> Table:
    """Return the share of unsafe decisions by condition and bin of the ego's entropy, in nats.

    The entropy says how unsure the ego's own answer is. After an unsafe decision success is no
    longer possible, though it was. Keys of a row are `condition`, `entropy_nats` (the bin's mean),
    `share`, its interval's ends `low` and `high`, and `n`. A condition is a named set of settings
    of the radio, of asking helpers and of fusing their messages.
    """
    nats = run.decisions["entropy_nats"]
    bins = np.where(np.isnan(nats), -1, nats / ENTROPY_NATS).astype(int)
    return list(_shares(run, bins, nats, run.decisions["regret"], "entropy_nats"))


def _shares(
    run: Run, bins: Ints, value: Floats, hits: Floats, name: str
) -> Iterator[dict[str, Any]]:
    """Yield the share of hits, each (n,), in each bin of decisions, with the bin's mean value
    as `name`; bins below 0 are left out.
    """
    conditions = run.decisions.codes("condition", run.conditions)
    units = units_of(run.decisions.whole("episode"), run.grid.episodes, run.clusters)
    for n, condition in enumerate(run.conditions):
        for place in np.unique(bins[(conditions == n) & (bins >= 0)]):
            here = (conditions == n) & (bins == place) & ~np.isnan(hits)
            if here.any():
                share = rate_interval(hits[here], units[here])
                yield {
                    "condition": condition,
                    name: round(float(value[here].mean()), 4),
                    "share": share.value,
                    "low": share.low,
                    "high": share.high,
                    "n": share.n,
                }


def entropies(run: Run) -> Table:
    """Return a histogram of the entropy of the ego's own answers, in nats; empty if none parsed.

    The entropy says how unsure an answer is: 0 is sure. A row is a bin, with its start
    `entropy_nats`, the `count` of answers and their `share` of all.
    """
    intents = [answer.intent for answer in run.answers if answer.role == "ego" and answer.intent]
    if not intents:
        return []
    probabilities = np.array(intents, dtype=float)
    nats = -np.sum(probabilities * np.log(np.where(probabilities > 0, probabilities, 1.0)), axis=1)
    return _histogram(nats, ENTROPY_NATS, "entropy_nats")


def tokens(run: Run) -> Table:
    """Return a histogram of prompt lengths in tokens for each role whose engine counts them.

    A role is who was asked: `ego`, `helper` or `fusion` (the ego again, with messages). A row is a
    bin, with `role`, the least length `tokens`, the `count` of prompts and their `share` of the
    role's.
    """
    by_role: dict[str, list[float]] = {}
    for answer in run.answers:
        if answer.prompt_tokens is not None:
            by_role.setdefault(role_word(answer.role), []).append(answer.prompt_tokens)
    rows = []
    for role, counts in by_role.items():
        rows += [{"role": role, **bar} for bar in _histogram(counts, TOKENS, "tokens")]
    return rows


def replies(run: Run) -> Table:
    """Return how many of the replies that were asked for came on time, late, or got lost.

    On time is within the decision window. A row has a `condition`, a `reply` (one of the three),
    its `count`, its `share` of the condition's `n` replies, and `n`. A condition is a named set of
    settings of the radio, of asking helpers and of fusing their messages.
    """
    counts = {condition: dict.fromkeys(REPLIES, 0) for condition in run.conditions}
    for d in run.decisions.pieces():
        delivered, on_time = d.of_messages("delivered"), d.of_messages("on_time")
        conditions = d.codes("condition", run.conditions)
        masks = on_time == 1.0, (delivered == 1.0) & (on_time == 0.0), delivered == 0.0
        for reply, which in zip(REPLIES, masks, strict=True):
            for place, condition in enumerate(run.conditions):
                counts[condition][reply] += int(which[conditions == place].sum())
    rows = []
    for condition, count in counts.items():
        total = sum(count.values())
        rows += [
            {"condition": condition, "reply": reply, "count": n, "share": n / total, "n": total}
            for reply, n in count.items()
            if n
        ]
    return rows


def arrivals(run: Run) -> Table:
    """Return for each condition a histogram of replies' arrival, in ms from the decision's start.

    A row is a bin, with `condition`, its start `arrival_ms`, the `count` of replies and their
    `share` of those that arrived. Lost ones are not in it. A condition is a named set of settings
    of the radio, of asking helpers and of fusing their messages.
    """
    bins_by_condition = {condition: Counter[int]() for condition in run.conditions}
    for d in run.decisions.pieces():
        arrival_ms, conditions = d.of_messages("arrival_ms"), d.codes("condition", run.conditions)
        for place, bins in enumerate(bins_by_condition.values()):
            of_condition = arrival_ms[conditions == place]
            bins.update(_binned(of_condition[~np.isnan(of_condition)], ARRIVAL_MS))
    rows = []
    for condition, bins in bins_by_condition.items():
        rows += [{"condition": condition, **bar} for bar in _bars(bins, ARRIVAL_MS, "arrival_ms")]
    return rows


def _histogram(values: Sequence[float] | Floats, width: float, name: str) -> Table:
    """Return bars of one width with their lower end,
    from the first that is not empty to the last.
    """
    return _bars(_binned(np.asarray(values, dtype=float), width), width, name)


def _binned(values: Floats, width: float) -> Counter[int]:
    """Return how many values are in each bin, by its number."""
    # A value on a bin's edge belongs to the bin above it, whatever rounding makes of the quotient.
    bins, counts = np.unique(np.floor(values / width + 1e-9).astype(int), return_counts=True)
    return Counter(dict(zip(bins.tolist(), counts.tolist(), strict=True)))


def _bars(bins: Counter[int], width: float, name: str) -> Table:
    total = bins.total()
    places = range(min(bins), max(bins) + 1) if bins else ()
    return [
        {name: round(place * width, 6), "count": bins[place], "share": bins[place] / total}
        for place in places
    ]
