"""The page of the paper's study: figures, every number, what was fitted."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.report.library import picture
from harness.report.page import environment

if TYPE_CHECKING:
    import pandas as pd

TEMPLATES = Path(__file__).parent / "templates"
OFF = ("misses", "unclear")
UNITS = {"count": "", "pct": ", %"}


def page(manifest: Mapping[str, Any], ledger: "pd.DataFrame", folder: Path) -> str:
    """The page, with the figures that lie in `folder` in it."""
    rows = [shown(row) for row in ledger.itertuples()]
    pictures = {
        key: picture((folder / f"{key.replace('_', '-')}.svg").read_bytes())
        for key in ("figure_a", "figure_b")
    }
    off = {v: [f"{r['id']}, {r['what']}: {r['off']}" for r in rows if r["verdict"] == v] for v in OFF}
    template = environment(TEMPLATES).get_template("paper.html.j2")
    return template.render(manifest=manifest, rows=rows, off=off, **pictures, **tally(ledger))


def tally(ledger: "pd.DataFrame") -> dict[str, int]:
    """Numbers of the paper that can be run; how many of them have which verdict, and are predicted."""
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


def shown(row: Any) -> dict[str, Any]:
    """One row of the ledger as text."""
    value = f" {row.value:g}" if isinstance(row.value, float) else ""
    theirs = f"{row.paper_low:g}" + (f" to {row.paper_high:g}" if row.paper_high != row.paper_low else "")
    cited = row.kind == "cited"
    unit = UNITS.get(row.unit, f", {row.unit}")
    return {
        "id": row.id,
        "what": " ".join(filter(None, (row.condition, f"{row.variable}{value}", f"{row.metric}{unit}"))),
        "paper": theirs,
        "ours": "" if cited else f"{row.ours:.1f} [{row.ci_low:.1f}, {row.ci_high:.1f}]",
        "off": "" if cited else f"{row.difference:+.1f}",
        "allowed": "" if cited else f"{row.allowed:.1f}",
        "kind": row.kind,
        "verdict": row.verdict,
        "assumed": row.assumed,
    }
