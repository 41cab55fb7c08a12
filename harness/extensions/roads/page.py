"""What a run's page says of the recorded driver: his success, his regret, and who does better."""

from collections.abc import Iterator, Sequence

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.errors import printable
from harness.core.figures import POINTS, interval_of
from harness.core.statistics import Estimate, parts_of, rate_interval
from harness.dataset.forest import Forest
from harness.extensions.roads.family import REPLAYED
from harness.report.document import Section, Table
from harness.runs.folder import Run
from harness.runs.headline import SUCCESS
from harness.runs.metrics import entry
from harness.runs.run_dataset import dataset_of
from harness.runs.success import Success

REGRET = "regret_rate"
SHOWN = 20  # layouts that the page lists
WORTH = "`harness study reaction` says what that is worth."
HEADS = ("who", "success %", "regret %", "minus the recorded driver", "better", "worse")


def section(run: Run) -> Section | None:
    """Return the section of a run's page on the recorded driver.

    He is a reference driver, who drives as it was recorded. None for a run on a dataset without
    him, or in closed loop.
    """
    first = run.episodes[: len(run.grid.episodes)]
    if run.world != "frozen" or all(episode.cluster is None for episode in first):
        return None
    from harness.extensions.roads.driver import NAME  # imports highway-env

    dataset = dataset_of(run).of_episodes(run.grid.episodes)
    forest, reacts = dataset.forest, dataset.manifest.parameters.get("react", True)
    if NAME not in forest.drivers:
        return None
    success_of = dict(zip(forest.episodes.tolist(), forest.driver_success(NAME), strict=True))
    his = np.array([float(success_of[number]) for number in run.grid.episodes])
    success = np.array([episode.success for episode in run.episodes], dtype=float)
    success = success.reshape(run.grid.shape)
    rule = Success.of(first, SUCCESS)
    reached, regret = interval_of(rule.estimate(his[None])), interval_of(_regret(forest, NAME, run))
    rows = [("recorded driver", reached, regret, "–", "–", "–")]
    rows += _rows(run, rule, success, his)
    layouts = list(_layouts(run, success, his))
    tables = [Table("Beside the recorded driver", HEADS, rows)]
    if layouts:
        tables.append(_listed(run, layouts))
    return Section(
        f"The recorded driver beside {printable(run.manifest.variant, 80)}",
        [
            f"The recorded driver succeeds in {reached} % of the layouts, and {regret} % of his "
            f"decisions give success away; n = {len(his)} layouts."
        ],
        [
            "He drives as the vehicle did whose place the ego has. Better and worse are numbers of "
            "layouts in which the run succeeds with more channel seeds than he does, or with "
            "fewer. Regret is the share of decisions that give success away, of those in which it "
            "was still possible. Differences are in points, paired by layout; 95 % intervals are "
            "over what layouts are cut from."
        ],
        tables,
        caveats=() if reacts else (f"{REPLAYED} {WORTH}",),
    )


def _regret(forest: Forest, name: str, run: Run) -> Estimate:
    """Return the share of a driver's decisions that give success away, as `regret_rate` counts."""
    chosen = forest.drivers[name]
    points = forest.visited(chosen)
    points = points[forest.value[points]]
    is_lost = ~forest.safe[points, chosen[points]]
    trees = len(forest.root)
    count = np.bincount(forest.tree[points], minlength=trees)
    lost = np.bincount(forest.tree[points], weights=is_lost, minlength=trees)
    shares = np.where(count, lost / np.maximum(count, 1), np.nan)
    share_of = dict(zip(forest.episodes.tolist(), shares.tolist(), strict=True))
    return rate_interval(np.array([share_of[each] for each in run.grid.episodes]), run.clusters)


def _rows(
    run: Run, rule: Success, success: Floats, his: Floats
) -> Iterator[tuple[str, str, str, str, str, str]]:
    """Yield a row for each condition: `success` is (C, S, E), and `his` (E,)."""
    for condition, of_condition in zip(run.conditions, success, strict=True):
        regret = run.score(condition, REGRET)
        change = rule.difference(of_condition, np.broadcast_to(his, of_condition.shape))
        gained: Ints = np.sign(of_condition.mean(axis=0) - his)
        yield (
            condition,
            interval_of(rule.estimate(of_condition)),
            interval_of(regret, entry(REGRET).unit) if regret else "–",
            interval_of(change, POINTS, "+"),
            str(int((gained > 0).sum())),
            str(int((gained < 0).sum())),
        )


def _listed(run: Run, layouts: Sequence[tuple[str, ...]]) -> Table:
    """Return the table of `_layouts`, the first of them if there are many."""
    more = f"; the first {SHOWN} of {len(layouts)}" if len(layouts) > SHOWN else ""
    return Table(
        "Layouts in which the run does better or worse than he",
        ("layout seed", "cut from", "recorded driver %", *run.conditions),
        layouts[:SHOWN],
        f"Success in % of channel seeds{more}.",
    )


def _layouts(run: Run, success: Floats, his: Floats) -> Iterator[tuple[str, ...]]:
    """Yield a row for each layout in which a condition does better or worse than he."""
    means = success.mean(axis=1)
    for place in np.flatnonzero((means != his).any(axis=0)).tolist():
        episode = run.episodes[place]
        shares = [f"{100 * share:.0f}" for share in (his[place], *means[:, place])]
        yield (str(episode.layout_seed), _cut_from(episode.cluster), *shares)


def _cut_from(cluster: str | None) -> str:
    """Return what a layout is cut from: the first of several parts, and how many there are."""
    first, *others = parts_of(cluster or "–")
    return f"{first} and {len(others)} more" if others else first
