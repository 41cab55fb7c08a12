"""The study of schedules: fronts of success against messages and joules, and tables."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from harness.core.figures import shown
from harness.core.statistics import Estimate
from harness.core.versions import versions
from harness.report.document import Table
from harness.report.drawing.colours import COLOURS, INK, MARKERS
from harness.studies.figures.points import Steps, fronts
from harness.studies.replayed_run import ReplayedRun
from harness.studies.schedules import NEVER, Chosen, Compared, Play
from harness.studies.study import Study, p_cell

if TYPE_CHECKING:
    import pandas as pd

SLACK = 1.1  # by which messages may exceed on these layouts what they were on tune layouts
BUDGETS = {"messages": "messages per episode", "energy_j": "joules per episode"}
HEADS = (
    "schedule", "success %", "msgs", "J", "over paper's", "gap closed %", "p", "over random, points",
    "messages, % of the paper's", "on air, ms", "latency, ms", "area, %", "area over joules, %",
)  # fmt: skip
JOULES = ("J", "area over joules, %")


def schedule_study(compared: Sequence[Compared], runs: Sequence[ReplayedRun], seeds: Sequence[int]) -> Study:
    """Declare the study of schedules on one or several runs; `runs` are these and those on tune layouts."""
    first, data = compared[0], tables(compared)
    tuned = bool(first.tune)
    panels = [
        (f"{run.name}, {run.point.name}", BUDGETS[cost], list(_steps(run, cost)))
        for run in compared for cost in BUDGETS if cost == "messages" or run.energy
    ]  # fmt: skip
    chosen = (
        "Both were chosen for the most success on tune layouts, within "
        f"{100 * first.budget:.0f} % of the paper's messages there."
        if tuned
        else "Both are the defaults of the condition and of the schedule; give a run on tune layouts to have "
        "them chosen."
    )
    best = "that is best on tune layouts" if tuned else "that is best on these layouts, which flatters it"
    return Study(
        "schedule", "Whom the ego asks, and when",
        [sentence for run in compared for sentence in headline(run)],
        [
            "Decisions are made again from stored answers with the same random draws, channel seeds "
            f"{', '.join(map(str, seeds))}; n is {first.regret.n} episodes, differences are paired by "
            "episode, and 95 % intervals are over episodes; those of shares and areas come from a "
            "bootstrap. The oracle knows how every course ends: it is a bound and no schedule.",
            "After a schedule's name stand the most helpers that it asks, and the threshold above which "
            "it asks. "
            + chosen + f" A line of the figure shows, of the settings within a budget, the one {best}.",
        ],
        [_table(run) for run in compared], data,
        {
            "sources": [run.manifest() for run in runs], "condition": first.point.name,
            "schedules": first.names, "budget": first.budget, "seeds": list(seeds), "versions": versions(),
        },
        data["schedules"], {"fronts": fronts(panels)},
        [caveat for run in runs for caveat in run.caveats],
    )  # fmt: skip


def name_of(row: Chosen) -> str:
    """Return a schedule with the setting chosen for it: at most so many helpers, above a threshold."""
    return f"{row.play.setting.schedule} {row.play.setting}"


def headline(compared: Compared) -> list[str]:
    """Say the paper's regret, and what the best schedule within half of its messages closes."""
    regret, bound = compared.regret, compared.oracle.means["messages"]
    sentences = [
        f"{compared.name}, {compared.point.name}: the oracle succeeds {shown(regret)} points more often than "
        f"entropy above {compared.point.ask.tau_nats:g} (n = {regret.n} episodes), with {bound:.1f} instead "
        f"of {compared.paper.means['messages']:.1f} messages per episode."
    ]
    within = [row for row in compared.rows[1:-1] if row.messages.value <= SLACK * compared.budget]
    if compared.tune and within:
        best = max(within, key=lambda row: row.success.value)
        sentences.append(
            f"Chosen on tune layouts within {100 * compared.budget:g} % of the paper's messages, "
            f"{name_of(best)} succeeds most often, in {shown(best.success)} %, a difference of "
            f"{shown(best.over_paper)} points from the paper's schedule: it closes {shown(best.closed)} % "
            f"of that gap with {shown(best.messages)} % of the messages."
        )
    return sentences


def _steps(run: Compared, cost: str) -> Iterator[Steps]:
    """Yield the settings that are taken as the budget grows."""

    def steps(label: str, plays: Sequence[Play], **look: Any) -> Steps:
        success = [100 * float(play.success.mean()) for play in plays]
        return Steps(label, [play.means[cost] for play in plays], success, look)

    for n, name in enumerate(name for name in run.names if name != NEVER):
        yield steps(
            name, run.front(name, cost), linestyle="-" if n < len(COLOURS) else ":", markersize=3,
            color=COLOURS[n % len(COLOURS)], marker=MARKERS[n % len(MARKERS)],
        )  # fmt: skip
    yield steps("oracle, a bound", run.of_oracle(), linestyle="--", color=INK)
    tau = f"entropy above {run.point.ask.tau_nats:g}"
    yield steps(tau, [run.paper], linestyle="", marker="*", color=INK, markersize=9)


def _table(run: Compared) -> Table:
    heads = [head for head in HEADS if run.energy or head not in JOULES]
    rows = []
    for n, row in enumerate(run.rows):
        means = row.play.means
        cells = (
            name_of(row) + " (the paper's)" * (n == 0), shown(row.success), f"{means['messages']:.1f}",
            f"{means['energy_j']:.1f}", shown(row.over_paper), shown(row.closed), p_cell(row.p),
            shown(row.over_random), shown(row.messages), f"{means['airtime_ms']:.3f}",
            f"{means['latency_ms']:.1f}", shown(row.area), shown(row.area_j),
        )  # fmt: skip
        rows.append([cell for head, cell in zip(HEADS, cells, strict=True) if head in heads])
    return Table(
        f"{run.name}, {run.point.name}", heads, rows,
        "Messages, milliseconds on air and joules are per episode, latency is per decision. Over paper's: "
        "success less that of the paper's schedule, in points; over random: less that of the schedule "
        "random with as many messages. Gap: from the paper's schedule to the oracle. Area: success "
        "averaged over budgets from no message to always asking all; over joules, from the joules of "
        "asking nobody. p comes from the interval and is corrected by Holm's method for all schedules of "
        "the table; bold: 0.05 or less. All settings are in "
        "settings.csv.", terminal=range(heads.index("p")),
    )  # fmt: skip


def tables(compared: Sequence[Compared]) -> "dict[str, pd.DataFrame]":
    """Return `schedules`, each at the setting chosen for it, and `settings`, all that were played."""
    import pandas as pd

    def ends(name: str, e: Estimate) -> dict[str, Any]:
        return {name: e.value, f"{name}_low": e.low, f"{name}_high": e.high}

    def place(run: Compared, play: Play) -> dict[str, Any]:
        of = play.setting
        where = {"run": run.name, "condition": run.point.name}
        return {**where, "schedule": of.schedule, "threshold": of.threshold, "max_helpers": of.most}

    schedules = [
        {
            **place(run, row.play), **ends("success", row.success), "n": row.success.n, **row.play.means,
            **ends("over_paper", row.over_paper), "p_holm": row.p, **ends("over_random", row.over_random),
            **ends("gap_closed", row.closed), **ends("messages_share", row.messages),
            **ends("area", row.area), **ends("area_j", row.area_j),
        }
        for run in compared for row in run.rows
    ]  # fmt: skip
    settings = [
        {
            **place(run, play), "success": float(play.success.mean()), **play.means,
            "success_on_tune": _on_tune(run, play),
            "on_front": any(play is taken for taken in run.front(play.setting.schedule)),
        }
        for run in compared for plays in run.plays.values() for play in plays
    ]  # fmt: skip
    return {"schedules": pd.DataFrame(schedules), "settings": pd.DataFrame(settings)}


def _on_tune(run: Compared, play: Play) -> float | None:
    tuned = {candidate.setting: candidate for candidate in run.tune.get(play.setting.schedule, ())}
    return float(tuned[play.setting].success.mean()) if tuned else None
