"""Do models, prompts and rules rank on traffic as they rank on the harness's own scenes?

    python benchmarks/traffic_ranks.py [--sumo DATASET ...] [--recordings DATASET ...]
                                       [--only TEXT] [--layouts N] [--tune 100]
                                       [--out reports/traffic]
                                       [--page benchmarks/measured/traffic.md]

The sides are the suite v2v-safety-2, SUMO's traffic and recordings, each the mean of its datasets.
Drivers, `uniform`, constants and the blind plan are read from the trees; on traffic the plan is
that of open_loop.py in tune layouts, of which it builds some. `ASKED` and `RULES` are evaluated; a
finished run is read. Intervals are of `DRAWS` bootstrap resamples of layouts, or of recordings.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from families import Families, Row
from open_loop import best, weights
from pages import markdown, options, write_tables
from scipy.stats import kendalltau

from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import printable
from harness.core.figures import interval_of
from harness.core.seeds import FIRST
from harness.core.statistics import Estimate, known_mean, mean_of, too_few
from harness.dataset.build import build
from harness.dataset.load import Dataset, find, load
from harness.dataset.suites import datasets
from harness.extensions.roads import driver
from harness.extensions.roads.family import PREFIX, recording_of
from harness.runs.metric_names import BASELINE
from harness.runs.success import Success, by_condition, mean_difference
from harness.world.drivers import ALWAYS, OPEN_LOOP, PRIVILEGED, UNIFORM, open_loop
from harness.world.scenario import Scenario

SMALLEST = "--only right-hand --layouts 2 --tune 2 --ours blind-merge-v2 --sumo parking-exit-v2"
DRAWS = 1_000
OURS, SUITE = "ours", "suite:v2v-safety-2"
SUMO = ("sumo-crossing-v1", "sumo-merge-v1")
CONDITION = "6g"
RULES = (Row("right-hand", "v4", "json"), Row("first-come", "v4", "json"))
ASKED = (
    Row("proxy", "v4", "json"),
    Row("swarm-tiny-six-v2", "v4", "readout"),
    Row("swarm-tiny-six-v2", "v10", "readout"),
)
BLIND = (*ALWAYS, OPEN_LOOP, UNIFORM, "always")  # how names begin of who looks at nothing
UNRANKED = (PRIVILEGED, driver.NAME)  # one sees everything, one has been there


def main() -> None:
    """Make what is missing, and write the page's tables."""
    arguments = options(__doc__, "traffic")
    arguments.add_argument("--ours", nargs="*", default=datasets(SUITE), help="our own scenes")
    arguments.add_argument("--sumo", nargs="*", default=SUMO, help="datasets of SUMO's traffic")
    arguments.add_argument("--recordings", nargs="*", default=(), help="datasets of recordings")
    arguments.add_argument("--tune", type=int, default=100, help="layouts that plans are chosen on")
    given = arguments.parse_args()
    names = {OURS: given.ours, "SUMO": given.sumo, "recordings": given.recordings}
    sides = []
    for side, of_side in names.items():
        tune = 0 if side == OURS else given.tune  # the plans of ours are known
        scenes = [
            scored(name, given.out / Path(name).name, given.only, given.layouts, tune)
            for name in of_side
        ]
        if scenes:
            sides.append(Side(side, tuple(scenes)))
    text = "\n\n".join((successes(sides), *ranks(sides)))
    print(text)
    if given.page:
        write_tables(given.page, text)


class Scenes(NamedTuple):
    """Success of everybody in a dataset's layouts."""

    name: str
    rule: Success  # how it is averaged
    success: Mapping[str, Floats]  # by policy, of E layouts, (E,); the mean over channel seeds


def scored(name: str, out: Path, only: str, layouts: int | None, tune: int) -> Scenes:
    """Return everybody's success in a dataset, of which runs and tune layouts are kept in a folder.

    `only` is in the names of what is evaluated, of so many layouts. The blind plan is chosen on as
    many layouts as `tune` says; with 0 it is the driver's.
    """
    for row in RULES:
        if only in row.name:
            row.asked(layouts, name).evaluate(
                out / row.name, "--condition", BASELINE, "--seeds", "0"
            )
    for row in ASKED:
        if only in row.name:
            row.asked(layouts, name).evaluate(
                out / row.name,
                *("--condition", BASELINE, "--condition", CONDITION, "--latency", "paper"),
            )
    data = load(find(name), layouts)
    success = of_trees(data)
    plan = blind_plan(data.scenario, out / "tune", tune) if tune else open_loop(data.scenario)
    if plan:
        success[OPEN_LOOP] = data.forest.sequence_success(plan).astype(float)
    for row in (*RULES, *ASKED):
        for condition, values in of_run(out / row.name).items():
            success[label(row, condition)] = values
    return Scenes(data.name, Success(data.dangerous, data.clusters), success)


def label(row: Row, condition: str) -> str:
    """Return what a row of a run is called under a condition."""
    if row in RULES:
        return row.model
    read = f" · {row.prompt}" if row.model != "proxy" else ""
    return f"{row.model}{read}, {condition}"


def of_run(path: Path) -> dict[str, Floats]:
    """Return success in a finished run's layouts by condition, (E,); nothing without a run."""
    families = Families.read(path)
    if not families:
        return {}
    [run] = families.runs.values()
    _, success = by_condition(run.grid, run.episodes)
    return {condition: known_mean(values, 0) for condition, values in success.items()}


def of_trees(data: Dataset) -> dict[str, Floats]:
    """Return the success, (E,), of those whose actions a dataset's trees say."""
    forest = data.forest
    success = {name: forest.driver_success(name).astype(float) for name in forest.drivers}
    for action in forest.actions:
        if action not in ALWAYS.values():
            success[f"always {action}"] = forest.constant_success(action).astype(float)
    success[UNIFORM] = forest.uniform_success()
    return success


def blind_plan(scenario: Scenario, folder: Path, layouts: int) -> tuple[str, ...]:
    """Return the fixed sequence that clears most tune layouts; empty if there are none.

    They are built in a folder, unless they are there.
    """
    if scenario.name.startswith(PREFIX):
        moments = recording_of(scenario.name).moments
        layouts = min(layouts, sum(moment.purpose == "tune" for moment in moments))
    if not layouts:
        return ()
    if not (folder / "manifest.json").exists():
        build(scenario, folder, layouts, FIRST["tune"], 1, lambda done: None)
    tune = load(folder)
    return best(tune.forest, weights(tune.dangerous.astype(float)))


@dataclass(frozen=True)
class Side:
    """One kind of scenes: datasets that weigh alike."""

    name: str
    scenes: tuple[Scenes, ...]

    @property
    def policies(self) -> list[str]:
        """Return who was tried in each of the datasets."""
        first, *others = self.scenes
        return [name for name in first.success if all(name in each.success for each in others)]

    def estimate(self, policy: str) -> Estimate:
        """Return a policy's success with its interval."""
        return mean_of([each.rule.estimate(each.success[policy][None]) for each in self.scenes])

    def difference(self, one: str, other: str) -> Estimate:
        """Return by how much one policy is above another, paired by layout."""
        pairs = [
            (each.rule, each.success[one][None], each.success[other][None]) for each in self.scenes
        ]
        return mean_difference(pairs)

    def drawn(self, policies: Sequence[str]) -> Floats:
        """Return everybody's success, and in resamples, (1 + DRAWS, policies)."""
        of_scenes = []
        for each in self.scenes:
            draws = np.random.default_rng((0, *each.name.encode()))
            counts = each.rule.resampled(draws, DRAWS)
            values = np.array([each.success[policy] for policy in policies]).T
            parts = [counts[:, part] @ values[part] for part in each.rule.parts]
            sizes = [counts[:, part].sum(axis=1, keepdims=True) for part in each.rule.parts]
            with np.errstate(invalid="ignore"):  # a resample may have none of a kind
                means = [part / size for part, size in zip(parts, sizes, strict=True)]
            of_scenes.append(np.mean(means, axis=0))
        return np.asarray(np.round(np.mean(of_scenes, axis=0), 9))  # so that equals are equal

    @property
    def is_bounded(self) -> bool:
        """Return whether there are enough layouts or recordings to resample."""
        return not any(too_few(each.rule.clusters) for each in self.scenes)

    @property
    def counted(self) -> str:
        """Layouts, and recordings where several are of one, in words."""
        layouts = sum(len(each.rule.dangerous) for each in self.scenes)
        numbers = [each.rule.clusters for each in self.scenes if each.rule.clusters is not None]
        scenes = sum(len(np.unique(each)) for each in numbers)
        return f"{layouts} layouts" + (f", {scenes} scenes" if numbers else "")


class Ranks(NamedTuple):
    """How the same policies are ordered on two sides."""

    policies: int
    told: int  # pairs that are told apart on both sides
    same: int  # of these, in one order
    first_only: int  # told apart on the first side alone
    second_only: int
    neither: int
    tied: int  # of all pairs, exactly equal on a side
    share: tuple[float, float, float]  # of pairs that are not, in one order; its interval
    tau: tuple[float, float, float]
    turned: Sequence[tuple[str, str]]  # pairs told apart on both sides: above on the first alone


def compared(first: Side, second: Side, wanted: Callable[[str], bool]) -> Ranks:
    """Return how policies are ordered that were tried on both sides."""
    shared = [name for name in first.policies if name in second.policies]
    policies = [name for name in shared if name not in UNRANKED and wanted(name)]
    pairs = list(combinations(policies, 2))
    of_first, of_second = (
        np.array([sign(side.difference(*pair)) for pair in pairs], dtype=np.int64)
        for side in (first, second)
    )
    told = (of_first != 0) & (of_second != 0)
    scores = first.drawn(policies), second.drawn(policies)
    shares, untied = order(*scores)
    taus = [kendalltau(a, b).statistic for a, b in zip(*scores, strict=True)]
    is_bounded = first.is_bounded and second.is_bounded
    opposed = [
        pair if way > 0 else pair[::-1]
        for pair, way, other in zip(pairs, of_first.tolist(), of_second.tolist(), strict=True)
        if way * other < 0
    ]
    return Ranks(
        len(policies),
        int(told.sum()),
        int((told & (of_first == of_second)).sum()),
        int(((of_first != 0) & (of_second == 0)).sum()),
        int(((of_first == 0) & (of_second != 0)).sum()),
        int(((of_first == 0) & (of_second == 0)).sum()),
        int((~untied).sum()),
        bounded(shares, is_bounded),
        bounded(np.array(taus), is_bounded),
        opposed,
    )


def sign(difference: Estimate) -> int:
    """Return 1 if the interval is above 0, -1 if below, and 0 if it holds 0 or is not known."""
    return int(difference.low > 0) - int(difference.high < 0)


def order(first: Floats, second: Floats) -> tuple[Floats, Bools]:
    """Return in which share of pairs both sides agree, (1 + DRAWS,), of those equal on neither.

    Also return which pairs these are in the sample itself, a mask (pairs,).
    """
    one, other = np.triu_indices(first.shape[1], 1)
    ways = [np.sign(scores[:, one] - scores[:, other]) for scores in (first, second)]
    product = ways[0] * ways[1]
    untied: Bools = product != 0
    count: Ints = untied.sum(axis=1)
    shares = np.full(len(first), np.nan)
    np.divide((product > 0).sum(axis=1), count, out=shares, where=count > 0)
    return shares, untied[0]


def bounded(values: Floats, is_bounded: bool) -> tuple[float, float, float]:
    """Return the first value, and the ends of the interval of the others; NaN without one."""
    if not is_bounded or np.isnan(values[0]):
        return float(values[0]), np.nan, np.nan
    drawn = values[~np.isnan(values)][1:]
    low, high = np.quantile(drawn, (0.025, 0.975)) if len(drawn) else (np.nan, np.nan)
    return float(values[0]), float(low), float(high)


def successes(sides: Sequence[Side]) -> str:
    """A table of everybody's success on each side, and in each dataset of traffic."""
    columns = {f"{side.name} ({side.counted})": side for side in sides}
    for side in sides[1:]:
        if len(side.scenes) > 1:
            columns |= {each.name: Side(each.name, (each,)) for each in side.scenes}
    ours = sides[0]
    everybody = dict.fromkeys(name for side in columns.values() for name in side.policies)
    ranked = sorted(everybody, key=lambda name: height(ours, name), reverse=True)
    rows = []
    for name in ranked:
        cells = [
            interval_of(side.estimate(name)) if name in side.policies else ""
            for side in columns.values()
        ]
        rows.append((known_as(name), *cells))
    return markdown(("success, %", *columns), rows)


def height(side: Side, policy: str) -> float:
    """Return a policy's success; below all where it was not tried."""
    return side.estimate(policy).value if policy in side.policies else -1.0


def known_as(policy: str) -> str:
    """Return what a policy is called in the table."""
    if policy in ALWAYS:
        return f"{policy} (always {ALWAYS[policy]})"
    return f"{policy} (no rank)" if policy in UNRANKED else policy


def ranks(sides: Sequence[Side]) -> Iterator[str]:
    """Yield the table of how sides order policies, and the pairs that are turned round."""
    ours, *traffic = sides
    found = {}
    for side in traffic:
        found[f"ours, {side.name}"] = compared(ours, side, lambda name: True)
        found[f"ours, {side.name}: who look"] = compared(ours, side, looks)
        if len(side.scenes) > 1:
            for scenes in side.scenes:
                alone = Side(scenes.name, (scenes,))
                found[f"ours, {printable(scenes.name)}"] = compared(ours, alone, lambda name: True)
    for number, scenes in enumerate(ours.scenes if len(ours.scenes) > 1 else ()):
        others = Side("others", ours.scenes[:number] + ours.scenes[number + 1 :])
        alone = Side(scenes.name, (scenes,))
        found[f"our others, {scenes.name}"] = compared(others, alone, lambda name: True)
    heads = (
        "sides",
        "policies",
        "pairs told apart on both",
        "of these in one order",
        "told apart on the first alone",
        "on the second alone",
        "on neither",
        "equal on a side",
        "share of all others in one order",
        "Kendall's tau-b",
    )
    rows = []
    for name, of in found.items():
        counts = (of.policies, of.told, of.same, of.first_only, of.second_only, of.neither, of.tied)
        shown = (bounds_of(of.share, ".2f"), bounds_of(of.tau, "+.2f"))
        rows.append((name, *(str(count) for count in counts), *shown))
    yield markdown(heads, rows)
    for side in traffic:
        turned = found[f"ours, {side.name}"].turned
        if turned:
            words = "; ".join(f"{upper} over {lower}" for upper, lower in turned)
            yield f"Told apart on both, and the other way round on {side.name}: {words}."


def looks(policy: str) -> bool:
    """Return whether a policy looks at the scene."""
    return not policy.startswith(BLIND)


def bounds_of(bounds: tuple[float, float, float], form: str) -> str:
    """Write a number in a form, with its interval; empty where it is not known."""
    value, low, high = (format(each, form) for each in bounds)
    if np.isnan(bounds[0]):
        return ""
    return value if np.isnan(bounds[1]) else f"{value} [{low}, {high}]"


if __name__ == "__main__":
    main()
