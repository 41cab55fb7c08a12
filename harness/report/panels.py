"""Which charts a report has, in what part of it, and what is to be read from each."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

from harness.report import charts, statistics
from harness.report.references import driven, in_trees, label, sentences
from harness.report.runs import Runs
from harness.runs.folder import Run
from harness.runs.records import Score

Part = Literal["overview", "answers", "communication"]
ENTROPY = "entropy of the ego's own intent, nats"
BUDGET = (200, 400)  # tokens of a prompt: the paper's


@dataclass(frozen=True)
class Panel:
    """One chart of the page."""

    id: str  # its name in the page, and of the files it is saved as
    part: Part  # of the page
    title: str  # what is drawn over what
    caption: str  # how to read it, and what it is conditional on
    spec: dict[str, Any]  # Vega-Lite


def panels(runs: Runs) -> Iterator[Panel]:
    """Yield the charts of which there is anything to draw."""

    def joined(of: Callable[[Run], statistics.Table]) -> statistics.Table:
        return [
            charts.named({"run": name, **row})
            for name, run in zip(runs.names, runs.runs, strict=True)
            for row in of(run)
        ]

    points = [c for run in runs.runs for c in run.manifest.conditions if c.get("profile")]
    tau_nats = sorted({c["tau_nats"] for c in points})
    windows_ms = sorted({c["window_s"] * 1000 for c in points})

    if rows := joined(statistics.success):
        references, scenario = _references(runs), runs.scenario.name
        success = {label(name, scenario): s.value for name, s in references.items() if s.value is not None}
        yield Panel(
            "success-latency", "overview", "Success and latency",
            "Each point is a condition; the lines through it are 95 % intervals over episodes. Rings: what "
            "the paper reports, with other scenes and another model. A reply that arrives after the "
            "decision window is not fused." + sentences(references, scenario),
            charts.success_latency(rows, success, windows_ms),
        )  # fmt: skip
    if rows := joined(statistics.statuses):
        yield Panel(
            "statuses", "answers", "How answers were read",
            "Share of each role's answers by status. Strict: the text fits the schema as it is. Recovered: "
            "it was read after repairs. All others failed and gave no distribution.",
            charts.statuses(rows),
        )  # fmt: skip
    if rows := joined(statistics.reliability):
        yield Panel(
            "reliability", "answers", "Is the policy as safe as it is sure?",
            "Decisions are grouped by the probability of the chosen action in the fused policy, in steps of "
            "a tenth; each point shows how often that action was safe. On the dashed line the two agree; "
            "above it the policy is less sure than it could be. A probability spread over two safe actions "
            "is no mistake, so this is not the calibration of a single label. All seeds; decisions without "
            "a safe action are left out; 95 % intervals over episodes.",
            charts.shares(
                rows, "certainty", "fused probability of the action taken", "share safe", diagonal=True
            ),
        )  # fmt: skip
    if rows := joined(statistics.entropies):
        yield Panel(
            "entropy",
            "answers",
            "Entropy of the ego's own answers",
            "Number of the ego's own answers by entropy, for those that could be read. Dashed: τ, above "
            "which the ego asks helpers.",
            charts.bars(rows, "entropy_nats", ENTROPY, "answers", statistics.ENTROPY_NATS, rules=tau_nats),
        )
    if rows := joined(statistics.errors):
        yield Panel(
            "entropy-error", "answers", "Entropy against error",
            "Share of decisions whose action was unsafe, by the entropy of the ego's own intent before "
            "fusion. If high entropy predicts errors, the line of the condition without V2V rises to the "
            "right. How far the other lines lie below it is what the helpers correct. All seeds; 95 % "
            "intervals over episodes.",
            charts.shares(rows, "entropy_nats", ENTROPY, "share unsafe", rules=tau_nats),
        )  # fmt: skip
    if rows := joined(statistics.tokens):
        yield Panel(
            "tokens", "answers", "Length of prompts",
            "Number of prompts by length, in tokens as the engine counted them. Shaded: the paper's budget "
            "of 200 to 400 tokens.",
            charts.bars(
                rows, "tokens", "tokens in the prompt", "prompts", statistics.TOKENS, series="role",
                within=BUDGET,
            ),
        )  # fmt: skip
    if rows := joined(statistics.replies):
        yield Panel(
            "replies", "communication", "Replies on time, late and lost",
            "Scheduled replies, all seeds. On time: the reply arrived within the decision window and was "
            "fused. Late: it arrived after the window. Lost: the request or the reply was lost.",
            charts.stacked(rows, "condition", "reply", charts.REPLIES, "replies"),
        )  # fmt: skip
    if rows := joined(statistics.energies):
        yield Panel(
            "energy",
            "communication",
            "Energy of a decision",
            "Joules of inference on the declared device and of the radios, as means over decisions; the "
            "interval is that of the total, over episodes. All helpers in the radius infer from the start, "
            "asked or not; with on_demand=true those alone that are asked. If the radios' part is too small "
            "to see, cooperation costs energy because helpers infer, not because they transmit.",
            charts.stacked(rows, "condition", "part", charts.ENERGIES, "J per decision", amount="joules"),
        )
    if rows := joined(statistics.arrivals):
        yield Panel(
            "arrivals", "communication", "When replies arrive",
            "Number of replies by arrival time, for those that were not lost; all seeds. Dashed: the end of "
            "the decision window.",
            charts.bars(
                rows, "arrival_ms", "arrival, ms from the start of the decision", "replies",
                statistics.ARRIVAL_MS, series="condition", rules=windows_ms,
            ),
        )  # fmt: skip


def _references(runs: Runs) -> dict[str, Score]:
    """Return success of the references: from the trees, in closed loop from their own runs."""
    if runs.dataset is None:
        return driven(runs.runs)
    return in_trees(runs.dataset.of_episodes({number for run in runs.runs for number in run.grid.episodes}))
