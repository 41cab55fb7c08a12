"""Leakage: how a model does on train, tune and report layouts,
and how near report layouts come to train's.

Success: the first layouts of each purpose in the scenes of a dataset, those of report seeds from
the dataset itself; the others are frozen at the first call and kept in the cache folder. A model
that remembers its layouts does better on train than on report. The first model, `proxy`, learnt
from none, so its rows say how hard the layouts are; the last column is by how much more another
gains on train than on report over it.

Distance: a layout is the numbers of all viewers' scene graphs at its start, standardised by those
of the train layouts, and whether each is known. Beside the distance of each report layout to the
nearest of the train layouts stands that of each train layout to the nearest other one. The ratio is
of the medians. Intervals of both are 95 %, by bootstrap over layouts.

    python benchmarks/leakage.py [DATASET ...] [--models proxy swarm-tiny-six] [--prompt v4]
                                 [--layouts 20] [--nearest 100] [--out reports/leakage]
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import harness
from harness.core import noise
from harness.core.arrays import Floats
from harness.core.seeds import FIRST
from harness.dataset.freeze import record_of
from harness.dataset.load import Dataset, find, load
from harness.extensions.learn.rewards.layouts import trees
from harness.runs.records import Score
from harness.world.scenario import Scenario
from harness.world.scene_numbers import numbers
from harness.world.world import World

SMALLEST = "blind-merge-v1 --models proxy --layouts 1 --nearest 3"
DATASETS = (
    "blind-merge-v1",
    "hard-brake-ahead-v1",
    "occluded-intersection-v2",
)  # scenes swarm-tiny-six learnt
CONDITIONS = ("single-local", "6g")
RESAMPLES = 1999


def starts(scenario: Scenario, seeds: Sequence[int]) -> list[dict[str, float]]:
    """Return the numbers of each layout's start by name; what is not known is left out."""
    layouts = []
    for seed in seeds:
        world = World.start(scenario, seed)
        state = world.state()
        graphs = record_of(world, state, 0, (state.ego, *state.helpers)).graphs
        layouts.append(
            {
                f"{place} {name}": number
                for place, graph in enumerate(graphs.values())
                for name, number in numbers(graph, scenario.road())
                if number is not None
            }
        )
    return layouts


def standardised(
    train: Sequence[dict[str, float]], report: Sequence[dict[str, float]]
) -> list[Floats]:
    """Return both as rows, in standard deviations of the train layouts,
    over the root of the columns.
    """
    parts = [pd.DataFrame(list(some)) for some in (train, report)]
    names = [name for name, sd in parts[0].std(ddof=0).items() if sd > 1e-9]
    parts = [part.reindex(columns=names) for part in parts]
    centred = [((part - parts[0].mean()) / parts[0].std(ddof=0)).fillna(0.0) for part in parts]
    both = [np.hstack([rows, part.notna()]) for rows, part in zip(centred, parts, strict=True)]
    return [rows / np.sqrt(2 * len(names)) for rows in both]


def nearest(of: Floats, to: Floats, others: bool = False) -> Floats:
    """Return the distance of each row to the nearest row of `to`,
    or to the nearest other one, (n,).
    """
    distances = np.linalg.norm(of[:, None] - to[None], axis=-1)
    if others:
        np.fill_diagonal(distances, np.inf)
    return np.asarray(distances.min(axis=1))


def distance(data: Dataset, layouts: int) -> dict[str, Any]:
    """Compare how near report layouts and train layouts come to train layouts."""
    scenario, first = data.scenario, FIRST["train"]
    seeds = range(first, first + layouts), data.seeds[:layouts]
    train, report = standardised(*(starts(scenario, some) for some in seeds))
    to_train, within = nearest(report, train), nearest(train, train, others=True)
    rng = noise.generator("leakage", data.name)

    def medians(of: Floats) -> Floats:
        return np.asarray(np.median(rng.choice(of, (RESAMPLES, len(of))), axis=1))

    ratios = medians(to_train) / medians(within)
    return {
        "dataset": data.name,
        "n_report": len(report),
        "n_train": len(train),
        "median_report": float(np.median(to_train)),
        "median_train": float(np.median(within)),
        "least_report": float(to_train.min()),
        "least_train": float(within.min()),
        "ratio": float(np.median(to_train) / np.median(within)),
        "ci": np.quantile(ratios, [0.025, 0.975]).tolist(),
    }


# by condition and purpose, with each layout's, (n,)
Scores = dict[tuple[str, str], tuple[Score, Floats]]


def success(data: Dataset, model: str, prompt: str, layouts: int, out: Path) -> Scores:
    """Return a model's success on the first layouts of each purpose."""
    scores: Scores = {}
    for purpose, first in FIRST.items():
        run = out / f"{model}-{data.name}-{purpose}-{layouts}"
        if not (run / "summary.csv").is_file():
            frozen = range(first, first + layouts)
            kept = (
                data if purpose == "report" else trees(data.scenario, frozen, 2, lambda done: None)
            )
            asked: dict[str, Any] = (
                {} if model == "proxy" else {"prompt": prompt, "answer": "readout"}
            )
            harness.run(
                model=model,
                dataset=str(kept.path),
                limit=layouts,
                condition=list(CONDITIONS),
                seeds="0:5",
                out=run,
                quiet=True,
                **asked,
            )
        loaded = harness.load(run)
        for condition in CONDITIONS:
            episodes = loaded.episodes[loaded.episodes.condition == condition]
            each = episodes.groupby("layout_seed").success.mean().to_numpy(float)
            score = loaded.source.score(condition, "success_rate")
            assert score
            scores[condition, purpose] = score, each
    return scores


def surplus(model: Scores, first: Scores, condition: str, rng: np.random.Generator) -> str:
    """Return the gain over the first model on train less that on report layouts, in points,
    with interval.
    """
    gains = [model[condition, p][1] - first[condition, p][1] for p in ("train", "report")]
    drawn = [rng.choice(gain, (RESAMPLES, len(gain))).mean(axis=1) for gain in gains]
    low, high = np.quantile(drawn[0] - drawn[1], [0.025, 0.975])
    return f"{100 * (gains[0].mean() - gains[1].mean()):.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def shown(score: Score) -> str:
    if score.value is None or score.low is None or score.high is None:
        return "–"
    return f"{100 * score.value:.1f} [{100 * score.low:.1f}, {100 * score.high:.1f}]"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("datasets", nargs="*", default=DATASETS)
    parser.add_argument("--models", nargs="+", default=["proxy", "swarm-tiny-six"])
    parser.add_argument("--prompt", default="v4", help="what a model reads; `proxy` reads none")
    parser.add_argument("--layouts", type=int, default=20)
    parser.add_argument("--nearest", type=int, default=100)
    parser.add_argument("--out", type=Path, default=Path("reports/leakage"))
    args = parser.parse_args()
    everything = [load(find(name)) for name in args.datasets]
    head = " | ".join(f"{purpose} %" for purpose in FIRST)
    print(f"Success, n = {args.layouts} layouts a cell, 95 % intervals over layouts\n")
    print(
        f"| dataset | model | condition | {head} | surplus on train "
        "|\n|---|---|---|---|---|---|---|"
    )
    for data in everything:
        by_model: dict[str, Scores] = {}
        for model in args.models:
            by_model[model] = scores = success(data, model, args.prompt, args.layouts, args.out)
            for condition in CONDITIONS:
                rng = noise.generator("surplus", data.name, model, condition)
                first = by_model[args.models[0]]
                more = surplus(scores, first, condition, rng) if scores is not first else "–"
                cells = " | ".join(shown(scores[condition, purpose][0]) for purpose in FIRST)
                print(
                    f"| `{data.name}` | `{model}` | `{condition}` | {cells} | {more} |", flush=True
                )
    distances = [distance(data, args.nearest) for data in everything]
    print(
        "\n| dataset | report to train, median (least) | n | train to train, median (least) | n | "
        "ratio [95 % CI] |\n|---|---|---|---|---|---|"
    )
    for d in distances:
        low, high = d["ci"]
        print(
            f"| `{d['dataset']}` | {d['median_report']:.3f} ({d['least_report']:.3f}) | "
            f"{d['n_report']} | {d['median_train']:.3f} ({d['least_train']:.3f}) | {d['n_train']} "
            f"| {d['ratio']:.2f} [{low:.2f}, {high:.2f}] |"
        )
    print(json.dumps(distances))


if __name__ == "__main__":
    main()
