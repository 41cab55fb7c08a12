"""The page of the paper's study: figures, every number, what was fitted."""

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from harness.drawing.pictures import uri

if TYPE_CHECKING:
    import pandas as pd


def page(manifest: Mapping[str, Any], ledger: "pd.DataFrame", folder: Path) -> str:
    """The page, with the figures that lie in `folder` in it."""
    environment = Environment(
        loader=PackageLoader("harness.study"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    style = (files("harness.report") / "templates" / "style.css").read_text(encoding="utf-8")
    rows = [shown(row) for row in ledger.itertuples()]
    totals = tally(ledger)
    pictures = {
        key: uri((folder / f"{key.replace('_', '-')}.svg").read_bytes()) for key in ("figure_a", "figure_b")
    }
    misses = [f"{r['id']}, {r['what']}: {r['off']}" for r in rows if r["misses"]]
    return environment.get_template("paper.html.j2").render(
        manifest=manifest, rows=rows, misses=misses, style=style, **pictures, **totals
    )


def tally(ledger: "pd.DataFrame") -> dict[str, int]:
    """Numbers of the paper that can be run; of these, those within the aim, and those predicted."""
    ran = ledger[ledger.kind != "cited"]
    total = set(ran.id)
    return {
        "total": len(total),
        "within": len(total - set(ran[ran.verdict == "misses"].id)),
        "predicted": len(set(ran[ran.kind == "predicted"].id)),
    }


def shown(row: Any) -> dict[str, Any]:
    """One row of the ledger as text."""
    value = f" {row.value:g}" if isinstance(row.value, float) else ""
    theirs = f"{row.paper_low:g}" + (f" to {row.paper_high:g}" if row.paper_high != row.paper_low else "")
    cited = row.kind == "cited"
    return {
        "id": row.id,
        "what": f"{row.condition} {row.variable}{value} {row.metric}, {row.unit}".replace("  ", " "),
        "paper": theirs,
        "ours": "" if cited else f"{row.ours:.1f} [{row.ci_low:.1f}, {row.ci_high:.1f}]",
        "off": "" if cited else f"{row.difference:+.1f}",
        "allowed": "" if cited else f"{row.allowed:.1f}",
        "kind": row.kind,
        "misses": row.verdict == "misses",
        "assumed": row.assumed,
    }
