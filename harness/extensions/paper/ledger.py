"""Every number of the paper beside ours:
how far off, whether fitted, and what had to be assumed.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from harness.core.figures import PLAIN
from harness.extensions.paper.calibrated import FITTED_ON
from harness.report.document import Table, strong
from harness.studies.paper_numbers import paper_numbers

if TYPE_CHECKING:
    import pandas as pd

# metric of the paper's numbers: our metric, what ours is multiplied by, and how far it may be off
METRICS = {
    "success": ("success_rate", 100.0, 1.0),
    "trigger_rate": ("trigger_rate", 100.0, 3.0),
    "effective_loss": ("effective_loss", 100.0, 0.3),
    "latency": ("latency_proxy_ms", 1.0, 0.01),  # of the paper's value
    "messages_per_episode": ("messages_per_episode", 1.0, 0.5),
}
CONDITIONS = {"single_local": "single-local", "swarm_v2x": "v2x", "swarm_6g": "6g"}
BELOW, FROM = "below_", "from_"

UNITS = {"count": "", "pct": ", %"}

ASSUMED = {
    "core": "5 seeds x 1 500 episodes; the paper may mean 1 500 in all",
    "size": "N counts the ego; N = 5 to 7 are not in the paper; loss follows 0.6 + 3 (N - 2) %",
    "loss": "one crossing's; request and reply both cross",
    "tau": "entropies in nats over three actions; grid 0.3 to 1.05 in steps of 0.05, the paper "
    "states none",
    "A4": "the paper's window is 200 ms and its mean 218.9 ms: counted to the end of the exchange",
    "A6": "no roadside edge: the paper calls it optional",
}

PLACE = ("panel", "condition", "metric", "interval")


def ledger(summary: "pd.DataFrame") -> "pd.DataFrame":
    """Compare each number of the SwarmDrive paper with ours: a table with a row for each.

    `summary` has our results: a row for each panel, grid point and metric, with a mean and the ends
    of its interval. A panel is a set of operating points (settings of radio, asking and fusion)
    that the paper shows together; a grid point is one of them, a `value` of the `variable` that is
    varied in a `condition`. The table has `id`, `panel`, `condition`, `variable`, `value`, `metric`
    and `unit`; the paper's range `paper_low` to `paper_high`; `ours` with `ci_low` and `ci_high`;
    `difference` (to the nearest end of the range), `allowed`, `verdict`, `kind` (`fitted`,
    `predicted` or `cited`) and `assumed`. Where the paper gives a range over grid points, ours is
    one row a grid point. A verdict is `within` where the difference is allowed, `unclear` where it
    is not but the interval reaches what is, `misses` where it does not, or `cited` where nothing is
    played.
    """
    import pandas as pd

    fitted = {row for rows in FITTED_ON.values() for row in rows}
    ours = summary.to_dict("records")
    rows: list[dict[str, Any]] = []
    for row in paper_numbers():
        low = float(row["paper_value"] or row["paper_low"])
        high = float(row["paper_value"] or row["paper_high"])
        named = ("id", "panel", "condition", "variable", "value", "metric", "unit")
        place: dict[str, Any] = {k: row[k] for k in named}
        place |= {"paper_low": low, "paper_high": high}
        assumed = ASSUMED.get(row["id"], ASSUMED.get(row["panel"], ""))
        if row["condition"] not in CONDITIONS:
            rows.append({**place, "verdict": "cited", "kind": "cited", "assumed": row["note"]})
            continue
        metric, scale, allowed = METRICS[row["metric"]]
        allowed *= low if row["metric"] == "latency" else 1.0
        for our_row in _our_rows(ours, row, metric):
            mean = float(our_row["mean"]) * scale
            ci_low, ci_high = float(our_row["ci_low"]) * scale, float(our_row["ci_high"]) * scale
            compared = {
                **place,
                "value": "" if our_row["value"] is None else our_row["value"],
                "ours": mean,
                "ci_low": ci_low,
                "ci_high": ci_high,
                "difference": mean - min(max(mean, low), high),
                "allowed": allowed,
                "verdict": verdict(mean, ci_low, ci_high, low - allowed, high + allowed),
                "kind": "fitted" if row["id"] in fitted else "predicted",
                "assumed": assumed,
            }
            rows.append(compared)
    return pd.DataFrame(rows)


def verdict(mean: float, ci_low: float, ci_high: float, least: float, most: float) -> str:
    """Return how one of our numbers compares with the paper's: `within`, `misses` or `unclear`.

    `mean` is ours, with the ends `ci_low` and `ci_high` of its interval, NaN if unknown; from
    `least` to `most` is allowed. It is `unclear` if the mean is not allowed, but its interval
    reaches what is, or is unknown.
    """
    if least <= mean <= most:
        return "within"
    # also where no interval is known
    return "misses" if ci_low > most or ci_high < least else "unclear"


def _our_rows(
    summary: Sequence[Mapping[Any, Any]], row: Mapping[str, str], metric: str
) -> list[Mapping[Any, Any]]:
    """Return our rows for one of the paper's: one,
    or those of the grid points that it speaks of.
    """
    place = (row["panel"], CONDITIONS[row["condition"]], metric, "seed means")
    rows = []
    for each in summary:
        is_there = tuple(each[name] for name in PLACE) == place
        if is_there and _at(row["value"], each["value"]):
            rows.append(each)
    return rows


def _at(paper_value: str, value: Any) -> bool:
    """Return whether a grid point is one that a row of the paper speaks of."""
    if paper_value.startswith(BELOW):
        return float(value) < float(paper_value.removeprefix(BELOW)) - 1e-9
    if paper_value.startswith(FROM):
        return float(value) >= float(paper_value.removeprefix(FROM)) - 1e-9
    return not paper_value or abs(float(value) - float(paper_value)) < 1e-9


def marks(ledger: "pd.DataFrame") -> "pd.DataFrame":
    """Return the paper's values to draw in figures beside ours, a row a grid point.

    `ledger` has a row for each number of the paper, with ours. A grid point is a value of what a
    panel (a figure's set of operating points) varies. Columns: `panel`, `condition` (settings of
    radio, asking and fusion), `value` (of what is varied), `metric`, `low` and `high`, which are in
    the unit of the ledger and equal where the paper gives one value.
    """
    ran = ledger[ledger.kind != "cited"]
    our_metrics = {paper_name: our_name for paper_name, (our_name, *_) in METRICS.items()}
    ran = ran.assign(condition=ran.condition.map(CONDITIONS), metric=ran.metric.map(our_metrics))
    ran = ran.rename(columns={"paper_low": "low", "paper_high": "high"})
    return ran[["panel", "condition", "value", "metric", "low", "high"]]


def tally(ledger: "pd.DataFrame") -> dict[str, int]:
    """Count the numbers of the paper that can be played, by how they compare with ours.

    `ledger` has a row for each number, with the verdict on ours. The keys are `total`, the verdicts
    `within`, `unclear` and `misses`, and `predicted`: those on which no parameter was fitted.
    """
    ran = ledger[ledger.kind != "cited"]
    total, misses = set(ran.id), set(ran[ran.verdict == "misses"].id)
    unclear = set(ran[ran.verdict == "unclear"].id) - misses
    return {
        "total": len(total),
        "within": len(total - misses - unclear),
        "unclear": len(unclear),
        "misses": len(misses),
        "predicted": len(set(ran[ran.kind == "predicted"].id)),
    }


def headline(ledger: "pd.DataFrame") -> list[str]:
    """Return sentences on how many of the paper's numbers lie within the aim, and which do not.

    `ledger` has a row for each number of the paper: its difference to ours, the aim (the difference
    that is allowed), and the verdict.
    """
    counts = tally(ledger)
    sentences = [
        f"{counts['within']} of {counts['total']} numbers within the aim, {counts['misses']} miss "
        f"it, {counts['unclear']} unclear (the interval reaches the aim); {counts['predicted']} of "
        f"the {counts['total']} are predictions: no parameter of the proxy was chosen on them, as "
        "on the others (*)."
    ]
    for verdict, title in (("misses", "Missed"), ("unclear", "Unclear")):
        rows = ledger[ledger.verdict == verdict].to_dict("records")
        if named := "; ".join(
            f"{row['id']}, {_what(row)}: {row['difference']:+z.1f}" for row in rows
        ):
            sentences.append(f"{title}: {named}.")
    return sentences


def tables(ledger: "pd.DataFrame") -> list[Table]:
    """Return two tables to show: numbers of the paper that are played here, and those only cited.

    `ledger` has a row for each number of the paper, with ours, which a rule in place of a model
    played.
    """
    played, cited = list[Sequence[str]](), list[Sequence[str]]()
    for row in ledger.to_dict("records"):
        low, high = row["paper_low"], row["paper_high"]
        paper = f"{low:g}" + (f" to {high:g}" if high != low else "")
        if row["kind"] == "cited":
            cited.append((f"{row['id']} {_what(row)}", paper, row["assumed"]))
            continue
        off = f"{row['difference']:+z.1f}"
        missed = row["verdict"] in ("misses", "unclear")
        played.append(
            (
                f"{row['id']}{'*' * (row['kind'] == 'fitted')} {_what(row)}",
                paper,
                PLAIN.interval(row["ours"], row["ci_low"], row["ci_high"]),
                strong(f"{off} {row['verdict']}") if missed else off,
                f"{row['allowed']:.1f}",
                row["kind"],
                row["assumed"],
            )
        )
    heads = ("row", "paper", "ours [95 % CI]", "off by", "aim", "kind", "assumed")
    return [
        Table("Ledger", heads, played, terminal=range(4)),
        Table("Cited, and not played", ("row", "paper", "note"), cited),
    ]


def _what(row: Mapping[Any, Any]) -> str:
    value = f" {row['value']:g}" if isinstance(row["value"], float) else ""
    unit = UNITS.get(row["unit"], f", {row['unit']}")
    return " ".join(
        filter(None, (row["condition"], f"{row['variable']}{value}", f"{row['metric']}{unit}"))
    )
