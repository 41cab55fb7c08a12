"""`harness study paper`: operating points, swarm size, packet loss and entropy threshold,
by the proxy.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from harness.coordination.named_points import POINTS
from harness.core.versions import versions
from harness.extensions.paper.calibrated import Calibrated
from harness.extensions.paper.ledger import headline, ledger, marks, tables
from harness.report.document import Table
from harness.studies.axes import AXES, CORE, Axis, Setting, Value, axis_of, described, grid
from harness.studies.figures.described import Draws
from harness.studies.play import joined, play
from harness.studies.study import Study, percent

if TYPE_CHECKING:
    import pandas as pd

WEIGHTS = "min_distance_m"  # the setting that flattens the weights of Equation 2
EQUAL_M = 1000.0  # beyond every distance, so that all weights are equal
VEHICLES = 4  # the ego and the cooperative neighbourhood of three


@dataclass(frozen=True)
class Panel:
    """Hold one panel of the SwarmDrive paper's study: what is varied, and over how many episodes.

    A panel is a set of operating points (settings of radio, asking and fusion) that one figure
    shows.
    """

    name: str  # the panel's name in `paper_numbers.csv`
    # its grid points: settings of radio, asking and fusion, each with a number of vehicles
    settings: tuple[Setting, ...]
    episodes: int  # number of episodes per seed


def panels(core: int = 1500, sweep: int = 300) -> list[Panel]:
    """Return the four panels of the SwarmDrive paper, and one of our own with equal weights.

    A panel is a set of operating points (settings of radio, asking and fusion) that one figure
    shows. The paper's Equation 2 weighs messages by their sender's distance; ours weighs all alike.
    `core` and `sweep` are episodes per seed: of the paper's operating points, and at each value
    that the other panels vary. The paper's numbers are read as 5 seeds x 1 500, and 5 x 300.
    """
    # Helpers whose entropy is above tau open rounds of their own everywhere; at 0.7 nats none is.
    points = {name: point.changed(helper_rounds=True) for name, point in POINTS.items()}
    six = points["6g"]
    crowded = six.changed(helper_rounds=False, density_coupled=True)
    conditions = [Setting(name, point, VEHICLES) for name, point in points.items()]
    sizes = [Setting("6g", crowded, int(n), "size", n) for n in grid(AXES["size"], "1:8")]

    def along(axis: Axis, values: Sequence[Value]) -> tuple[Setting, ...]:
        """Return `6g` with other values of one setting."""
        return tuple(Setting("6g", axis.at(six, v), VEHICLES, axis.name, v) for v in values)

    loss, tau, weights = AXES["loss"], AXES["tau"], axis_of(WEIGHTS)
    return [
        Panel(CORE, tuple(conditions), core),
        Panel("size", tuple(sizes), sweep),
        Panel("loss", along(loss, grid(loss)), sweep),
        Panel("tau", along(tau, grid(tau)), sweep),
        Panel(WEIGHTS, along(weights, (1.0, EQUAL_M)), core),
    ]


def run_paper(
    panels: Sequence[Panel], seeds: Sequence[int], progress: Callable[[int], None]
) -> Study:
    """Play the SwarmDrive paper's study with a rule in place of a model, and compare the numbers.

    The rule, the calibrated proxy, draws intents (probabilities of actions). `panels` are sets of
    operating points (settings of radio, asking and fusion), `seeds` those of episodes and channel;
    `progress` is called with 1 after each operating point of a panel. Returns a study: sentences,
    tables and figures with the paper's numbers and ours, and the verdict on each.
    """
    sources = {panel.episodes: Calibrated(panel.episodes) for panel in panels}
    results = [play(sources[p.episodes], p.name, p.settings, seeds, progress) for p in panels]
    whole = joined(results)
    core, *sweeps, weights = [result.summary for result in results]
    numbers = ledger(whole.summary)
    paper_marks = marks(numbers)
    proxy = next(iter(sources.values())).manifest()
    episodes = {p.name: p.episodes for p in panels}
    return Study(
        "study",
        "The paper's study, from one causal simulator",
        headline(numbers),
        [
            f"Intents of a calibrated proxy (version {proxy['proxy_model_version']}) go through "
            "the same trigger, channel, consensus and scoring as a language model's. It was "
            f"{proxy['calibration_label']}. No condition has a success probability of its own to "
            "draw from, and no parameter depends on a panel or a grid point. So the study shows "
            "that one mechanism explains the numbers. It is no evidence that a language model "
            "would give them.",
            f"95 % intervals are over {len(seeds)} seed means of {episodes[CORE]} episodes each, "
            f"{episodes['size']} at a grid point of figure B, whose points share their random "
            "draws. Draws are stratified, so an interval shows how far other seeds of this proxy "
            "would move a mean; plain draws, like the paper's, scatter more.",
            equation_2(weights),
            "Crosses and bars in the figures are the paper's values and ranges, and shaded is the "
            "band that it calls best. The cloud's latency is the paper's figure: nothing here "
            "simulates a cloud.",
        ],
        [
            *tables(numbers),
            _fitted(proxy),
        ],
        {"conditions": whole.summary, "episodes": whole.episodes, "ledger": numbers},
        {
            "study": "paper",
            "seeds": list(seeds),
            "episodes_per_seed": episodes,
            "source": proxy,
            "panels": described({p.name: p.settings for p in panels}),
            "versions": versions(),
        },
        numbers,
        lambda draws: _figures(draws, core, sweeps, paper_marks),
    )


def _fitted(proxy: Mapping[str, Any]) -> Table:
    """Return the table of the proxy's parameters that were chosen on rows of the paper."""
    rows = []
    for name, paper_rows in proxy["fitted_on"].items():
        rows.append((name, str(proxy["parameters"].get(name, "")), ", ".join(paper_rows)))
    return Table(
        "What was fitted",
        ("parameter", "value", "rows of the paper"),
        rows,
        "Every parameter that was chosen on rows of the paper.",
    )


def _figures(
    draws: Draws[Any],
    core: "pd.DataFrame",
    sweeps: "Sequence[pd.DataFrame]",
    paper_marks: "pd.DataFrame",
) -> dict[str, Any]:
    """Return both figures, with the paper's values as marks."""
    return {
        "figure-a": draws.operating_points(core, paper_marks),
        "figure-b": draws.along(sweeps, paper_marks),
    }


def equation_2(weights: "pd.DataFrame") -> str:
    """Return a sentence on what it changes to weigh messages by their sender's distance.

    Equation 2 of the paper has these weights. `weights` has the results of a rule in place of a
    model: a row for each metric, with such weights and with equal ones.
    """
    success = weights[weights.metric == "success_rate"].set_index("value")
    with_it = percent(success.loc[1.0], "mean", "ci_low", "ci_high")
    without = percent(success.loc[EQUAL_M], "mean", "ci_low", "ci_high")
    return (
        f"Equation 2 in the calibrated proxy: 6g succeeds in {with_it} % with weights by distance, "
        f"and in {without} % with equal ones. The distances are declared so that the witness "
        "decides: this is no evidence for the equation. For a run: harness study sweep RUN --over "
        f"{WEIGHTS} --grid 1,{EQUAL_M:g}"
    )
