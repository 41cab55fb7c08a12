"""`harness campaign paper`: plays the panels, draws the figures, and writes everything to one folder."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from harness.core.files import write_whole
from harness.evaluate.spec import versions
from harness.studies import figures
from harness.studies.calibrated import Calibrated
from harness.studies.episode_tables import joined, write_table
from harness.studies.ledger import ledger
from harness.studies.page import page
from harness.studies.paper import SEEDS, Panel
from harness.studies.play import play
from harness.studies.setting import described

if TYPE_CHECKING:
    import pandas as pd

FORMAT = "swarmdrive-study/1"


def run_paper(panels: Sequence[Panel], out: Path, progress: Callable[[int], None]) -> "pd.DataFrame":
    """Play the paper's panels with the calibrated proxy.

    Writes `conditions`, `episodes` and `ledger` as CSV and JSON Lines, `study.json`, the Figures A and B as
    SVG, PDF and PNG, and `index.html`.

    Returns:
        The ledger.
    """
    import pandas as pd

    sources = {panel.episodes: Calibrated(panel.episodes) for panel in panels}
    played = [play(sources[p.episodes], p.name, p.settings, SEEDS, progress) for p in panels]
    summary = pd.concat([p.summary for p in played], ignore_index=True)
    found = ledger(summary)
    manifest = {
        "format": FORMAT,
        "study": "paper",
        "seeds": list(SEEDS),
        "episodes_per_seed": {p.name: p.episodes for p in panels},
        "source": next(iter(sources.values())).manifest(),
        "panels": described({p.name: p.settings for p in panels}),
        "versions": versions(),
    }
    core, *sweeps = (p.summary for p in played)
    drawn = {"figure-a": figures.composite_a(core), "figure-b": figures.along(sweeps, best_band=True)}
    out.mkdir(parents=True, exist_ok=True)
    for stem, figure in drawn.items():
        figures.save_all(figure, out / stem)
    write_table(summary, out / "conditions")
    write_table(joined([p.episodes for p in played]), out / "episodes")
    write_table(found, out / "ledger")
    write_whole(out / "study.json", json.dumps(manifest, indent=1, allow_nan=False) + "\n")
    write_whole(out / "index.html", page(manifest, found, out))
    return found
