"""Which charts a report has, in what part of it, and what is to be read from each."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

from harness.backends.registry import find
from harness.report import charts, layers, statistics
from harness.report.runs import Runs
from harness.runs.folder import Run

Part = Literal["overview", "answers", "communication"]
BUDGET = (200, 400)  # tokens of a prompt: the paper's


@dataclass(frozen=True)
class Panel:
    """One chart of the page.

    Attributes:
        id: its name in the page, and of the files it is saved as.
        part: of the page.
        title: what is drawn over what.
        caption: how to read it, and what it is conditional on.
        spec: Vega-Lite.
    """

    id: str
    part: Part
    title: str
    caption: str
    spec: dict[str, Any]


def panels(runs: Runs) -> Iterator[Panel]:
    """The charts of which there is anything to draw."""

    def joined(of: Callable[[Run], statistics.Table]) -> statistics.Table:
        return [
            layers.named({"run": name, **row})
            for name, run in zip(runs.names, runs.runs, strict=True)
            for row in of(run)
        ]

    points = [c for run in runs.runs for c in run.manifest.conditions if c.get("profile")]
    tau_nats = sorted({c["tau_nats"] for c in points})
    windows_ms = sorted({c["window_s"] * 1000 for c in points})

    if rows := joined(statistics.success):
        references = _references(runs)
        yield Panel(
            "success-latency", "overview", "Success and latency",
            "Lines through a point: 95 % intervals over episodes. Rings: what the paper reports, of other "
            "scenes and another model. A reply that comes after the decision window is not fused." + (
                " Dashed: reference drivers that need no model, in the same episodes." if references else ""
            ),
            charts.success_latency(rows, references, windows_ms),
        )  # fmt: skip
    if rows := joined(statistics.statuses):
        yield Panel(
            "statuses", "answers", "How answers were read",
            "Share of the answers of a role. Strict needed no mending, recovered was read after repairs, "
            "the others gave no distribution.",
            charts.statuses(rows),
        )  # fmt: skip
    if rows := joined(statistics.reliability):
        yield Panel(
            "reliability", "answers", "Is the policy as safe as it is sure?",
            "Each point is the decisions whose fused probability of the action taken lies in one tenth: "
            "how often that action was safe. On the dashed line the two agree; above it the policy is too"
            " modest. A probability spread over two safe actions is no mistake, so this is not the "
            "calibration of one label. All seeds; decisions without a safe action are left out; intervals"
            " are over episodes.",
            charts.reliability(rows),
        )  # fmt: skip
    if rows := joined(statistics.entropies):
        yield Panel(
            "entropy", "answers", "Entropy of the ego's own answers",
            "One count an answer that could be read. Dashed: τ, above which the ego asks for help.",
            charts.entropies(rows, tau_nats, statistics.ENTROPY_NATS),
        )  # fmt: skip
    if rows := joined(statistics.errors):
        yield Panel(
            "entropy-error", "answers", "Entropy against error",
            "Share of decisions whose action was unsafe, by the entropy of the ego's own intent before "
            "fusion. If entropy tells when the ego errs, the condition without V2V rises to the right; "
            "what the others have less is what helpers mend. All seeds; intervals are over episodes.",
            charts.errors(rows, tau_nats),
        )  # fmt: skip
    if rows := joined(statistics.tokens):
        yield Panel(
            "tokens", "answers", "Length of prompts",
            "Tokens as the engine counted them. Shaded: the paper's budget of 200 to 400.",
            charts.tokens(rows, BUDGET, statistics.TOKENS),
        )  # fmt: skip
    if rows := joined(statistics.replies):
        yield Panel(
            "replies", "communication", "What became of replies",
            "Replies that were scheduled, all seeds. On time: fused. Late: arrived after the decision "
            "window. Lost: request or reply did not cross.",
            charts.replies(rows),
        )  # fmt: skip
    if rows := joined(statistics.energies):
        yield Panel(
            "energy", "communication", "What a decision takes",
            "Joules of inference on the declared device and of sending, mean over decisions; the total's "
            "interval is over episodes. A helper's inference counts where it was asked. Where the radios' "
            "part cannot be seen, asking costs energy because helpers think, not because they transmit.",
            charts.energies(rows),
        )  # fmt: skip
    if rows := joined(statistics.arrivals):
        yield Panel(
            "arrivals", "communication", "When replies arrive",
            "Replies that were not lost, all seeds. Dashed: the end of the decision window.",
            charts.arrivals(rows, windows_ms, statistics.ARRIVAL_MS),
        )  # fmt: skip


def _references(runs: Runs) -> dict[str, float]:
    """Success of the reference drivers: from the trees, in closed loop from their own runs."""
    if runs.dataset is None:
        drivers = {
            run.manifest.model["name"]: run
            for run in runs.runs
            if (engine := find(str(run.manifest.model.get("engine")))) and engine.capabilities.reference
        }
        scores = {name: run.score(run.conditions[0], "success_rate") for name, run in drivers.items()}
        return {name: score.value for name, score in scores.items() if score and score.value is not None}
    some = runs.dataset.of_episodes({number for run in runs.runs for number in run.grid.episodes})
    return {driver: float(success.mean()) for driver, success in some.driver_success().items()}
