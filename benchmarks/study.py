"""What playing decisions costs: the grid points of the paper's campaign, its figures,
and ten million.

The limit is drawing the random numbers that each grid point's decisions need, with NumPy.

    python benchmarks/study.py [--decisions 10000000]
"""

import argparse
import resource
from collections.abc import Sequence
from io import BytesIO
from time import process_time

import numpy as np
import pandas as pd
from rows import Row, finish

from harness.coordination.named_points import POINTS
from harness.extensions.paper.calibrated import STEPS, Calibrated
from harness.extensions.paper.panels import panels
from harness.report.drawing.pictures import FORMATS, lay_out, save
from harness.studies.axes import Setting
from harness.studies.figures.bars import operating_points
from harness.studies.figures.lines import along
from harness.studies.play import play

SMALLEST = "--decisions 1000"
TABLE = "--decisions 1000000"
SEEDS = range(5)


def main() -> None:
    """Print each figure beside its aim, and all as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--decisions", type=int, default=10_000_000)
    most = arguments.parse_args().decisions
    found = {**campaign(), **linear(most)}
    aims = {"play_over_draw": 5, "peak_mb": 1000}
    for name, value in found.items():
        aim = f"   aim {aims[name]}" if name in aims else ""
        print(f"{name:<28}{value:>10.2f}{aim}")
    a_million = f"a million decisions of one grid point, of {most}, CPU"
    rows = [
        Row(
            "the campaign's decisions played, CPU", found["play_cpu_s"], "s", 1, found["draw_cpu_s"]
        ),
        Row(a_million, found["large_s_per_million"], "s", 1, found["small_s_per_million"]),
    ]
    finish(rows, **found)


def campaign() -> dict[str, float]:
    """Its grid points against drawing what they need."""
    start, decisions = process_time(), 0
    sources = {panel.episodes: Calibrated(panel.episodes) for panel in panels()}
    played = [
        play(sources[p.episodes], p.name, p.settings, SEEDS, lambda done: None) for p in panels()
    ]
    play_s = process_time() - start
    start = process_time()
    for panel in panels():
        for setting in panel.settings:
            for seed in SEEDS:
                draw(np.random.default_rng(seed), panel.episodes, setting.vehicles - 1)
                decisions += panel.episodes * STEPS
    draw_s = process_time() - start
    return {
        "campaign_decisions": decisions,
        "play_cpu_s": play_s,
        "draw_cpu_s": draw_s,
        "play_over_draw": play_s / draw_s,
        **pictures([part.summary for part in played]),
    }


def pictures(summaries: "Sequence[pd.DataFrame]") -> dict[str, float]:
    """CPU of making the campaign's two figures, of laying them out, and of each format."""
    core, *sweeps, _ = summaries
    start = process_time()
    drawn = [operating_points(core), along(sweeps)]
    found = {"make_figures_cpu_s": process_time() - start}
    start = process_time()
    for figure in drawn:
        lay_out(figure)
    found["lay_out_cpu_s"] = process_time() - start
    for kind in FORMATS:
        start = process_time()
        for figure in drawn:
            save(figure, BytesIO(), kind, dpi=300)
        found[f"{kind}_cpu_s"] = process_time() - start
    return found


def draw(generator: np.random.Generator, episodes: int, helpers: int) -> None:
    """As many numbers as `Calibrated` draws: four an episode and a link, one and two a decision."""
    generator.random((episodes, 4 + 4 * helpers))
    generator.random((episodes * STEPS, 1 + 2 * helpers))


def linear(most: int) -> dict[str, float]:
    """Seconds per million decisions of one grid point with five seeds, small and large;
    peak memory.
    """
    found = {}
    for name, decisions in (("small", most // 10), ("large", most)):
        source = Calibrated(decisions // (STEPS * len(SEEDS)))
        start = process_time()
        play(source, "one", [Setting("6g", POINTS["6g"], 4)], SEEDS, lambda done: None)
        found[f"{name}_s_per_million"] = (process_time() - start) / decisions * 1e6
    found["large_decisions"] = most
    found["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return found


if __name__ == "__main__":
    main()
