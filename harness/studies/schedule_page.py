"""What a comparison of schedules has on paper: fronts, tables and a page."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from harness.core.figures import shown
from harness.core.files import bytes_of, write_whole
from harness.core.statistics import Estimate
from harness.core.versions import versions
from harness.report.drawing.colours import COLOURS, INK, MARKERS, PALE
from harness.report.drawing.pictures import styled
from harness.report.library import picture
from harness.report.page import environment
from harness.studies.schedules import NEVER, Chosen, Compared, Play
from harness.studies.study import write, write_manifest

if TYPE_CHECKING:
    import pandas as pd

SLACK = 1.1  # by which messages may exceed on these layouts what they were on tune layouts
BUDGETS = {"messages": "messages per episode", "energy_j": "joules per episode"}
TEMPLATES = Path(__file__).parent / "templates"


def said(row: Chosen) -> str:
    """A schedule with the setting chosen for it: at most so many helpers, above a threshold."""
    setting = row.play.setting
    return f"{setting.schedule} {setting}"


def in_sentences(compared: Compared) -> list[str]:
    """What came out: the paper's regret, and what the best schedule within half of its messages closes."""
    regret, bound = compared.regret, compared.oracle.means["messages"]
    paper = compared.paper.means["messages"]
    found = [
        f"{compared.name}, {compared.point.name}: the oracle succeeds {shown(regret)} points more often than "
        f"entropy above {compared.point.tau_nats:g} (n = {regret.n} episodes), with {bound:.1f} instead of "
        f"{paper:.1f} messages per episode."
    ]
    within = [row for row in compared.rows[1:-1] if row.messages.value <= SLACK * compared.budget]
    if compared.tune and within:
        best = max(within, key=lambda row: row.success.value)
        found.append(
            f"Chosen on tune layouts within {100 * compared.budget:g} % of the paper's messages, "
            f"{said(best)} succeeds most often, in {shown(best.success)} %, a difference of "
            f"{shown(best.over_paper)} points from the paper's schedule: it closes {shown(best.closed)} % "
            f"of that gap with {shown(best.messages)} % of the messages."
        )
    return found


@styled
def fronts(compared: Sequence[Compared]) -> Figure:
    """Success against messages, and joules where they are known: settings taken as the budget grows."""
    each = [(run, cost) for run in compared for cost in BUDGETS if cost == "messages" or run.energy]
    figure = Figure(figsize=(max(3.6 * len(each), 4.4), 3.6), layout=ConstrainedLayoutEngine(w_pad=0.1))
    panels = figure.subplots(1, len(each), squeeze=False, sharey=True)[0]
    for axes, (run, cost) in zip(panels, each, strict=True):
        for n, name in enumerate(name for name in run.names if name != NEVER):
            axes.plot(
                *_line(run.front(name, cost), cost), "-" if n < len(COLOURS) else ":", drawstyle="steps-post",
                color=COLOURS[n % len(COLOURS)], marker=MARKERS[n % len(MARKERS)], markersize=3, linewidth=1,
                label=name,
            )  # fmt: skip
        bound: dict[str, Any] = {"drawstyle": "steps-post", "linewidth": 1, "label": "oracle, a bound"}
        axes.plot(*_line(run.of_oracle(), cost), "--", color=INK, **bound)
        tau = f"entropy above {run.point.tau_nats:g}"
        axes.plot(*_line([run.paper], cost), "*", color=INK, markersize=9, label=tau)
        axes.set(xlabel=BUDGETS[cost], xlim=(0, None))
        axes.set_title(f"{run.name}, {run.point.name}", fontsize=8)
        axes.grid(color=PALE, linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("success, %")
    key = panels[0].get_legend_handles_labels()
    figure.legend(*key, loc="outside lower center", ncols=4, frameon=False, fontsize=7)
    return figure


def _line(played: Sequence[Play], cost: str) -> tuple[list[float], list[float]]:
    return [play.means[cost] for play in played], [100 * float(play.success.mean()) for play in played]


def tables(compared: Sequence[Compared]) -> "dict[str, pd.DataFrame]":
    """`schedules`, each at the setting chosen for it, and `settings`, all that were played."""
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
        for run in compared for played in run.plays.values() for play in played
    ]  # fmt: skip
    return {"schedules": pd.DataFrame(schedules), "settings": pd.DataFrame(settings)}


def _on_tune(run: Compared, play: Play) -> float | None:
    tuned = {other.setting: other for other in run.tune.get(play.setting.schedule, ())}
    return float(tuned[play.setting].success.mean()) if tuned else None


def write_schedules(
    compared: Sequence[Compared], sources: Sequence[dict[str, Any]], seeds: Sequence[int], out: Path
) -> Path:
    """Write the picture, the tables and the page, `schedule.json` last; returns the page's path."""
    write(out, {"fronts": fronts(compared)}, tables(compared))
    page = out / "index.html"
    rendered = environment(TEMPLATES).get_template("schedule.html.j2").render(
        compared=compared, said=said, shown=shown, seeds=seeds, budget=compared[0].budget,
        sentences=[sentence for run in compared for sentence in in_sentences(run)],
        picture=picture(bytes_of(out / "fronts.svg", "picture")),
    )  # fmt: skip
    write_whole(page, rendered)
    manifest = {
        "sources": list(sources), "condition": compared[0].point.name, "schedules": compared[0].names,
        "budget": compared[0].budget, "seeds": list(seeds), "versions": versions(),
    }  # fmt: skip
    write_manifest(out, "schedule", manifest)
    return page
