"""What a run's page says of a declared computer: a chart of energy, and whose speed it is."""

from collections.abc import Iterator
from typing import Any

from harness.core.errors import printable
from harness.core.figures import PLAIN
from harness.extensions.devices.timer import PROFILE
from harness.report import charts
from harness.report.drawing.colours import BAD, ROLES
from harness.report.notes import Shown
from harness.report.panels import AddedPanel, Table
from harness.runs.folder import Run
from harness.runs.records import Manifest

# Who takes joules, and the colour of each.
PARTS = {
    "ego's inference": ROLES["ego"],
    "helpers' inference": ROLES["helper"],
    "radios": BAD,
}


def caveats(manifest: Manifest) -> Iterator[str]:
    """Yield a sentence for each of a run's models whose times and joules are another model's.

    A run may time answers by a device profile, a file with a computer's speed and power for some
    models; there is none for a run without. `manifest` is what the run's `run.json` has.
    """
    if (device := manifest.beside.get(PROFILE)) is None:
        return
    agents = (manifest.agent(0), *manifest.helpers)
    for agent, speed in zip(agents, manifest.latency.speeds, strict=True):
        name = str(agent["model"]["name"])
        if name.partition(":")[0] != speed.model:
            yield (
                "Times and energy are conditional: the token counts are those of "
                f"{printable(name, 30)}, the speed is that of {printable(speed.model)} on "
                f"{printable(device['name'])}."
            )


def notes(run: Shown) -> Iterator[str]:
    """Yield a sentence for each condition on the joules of a decision, and on who takes them.

    A condition is a named set of settings of radio, asking and fusion. Yields nothing for a run
    whose energy is not known, as without a device profile (a file with a computer's speed and
    power).
    """
    for name in run.conditions:
        total, helpers = run.score(name, "energy_j"), run.score(name, "helpers_j")
        radio = run.score(name, "radio_mj")
        if total and helpers and radio and None not in (total.value, helpers.value, radio.value):
            joules = PLAIN.interval(total.value, total.low, total.high)
            yield (
                f"{printable(name)}: {joules} J per decision, of which the helpers' inference "
                f"takes {helpers.value:.1f} J and the radios {radio.value:.3g} mJ"
            )


def energies(run: Run) -> Table:
    """Return the mean joules of a decision as rows, one for each condition and who takes them.

    A condition is an operating point: settings of radio, asking and fusion. Who takes the joules
    (`part`) is the ego's inference, the helpers' inference or the radios. A row has the
    `condition`, the `part`, its `joules`, and of the whole decision `total_j` with `low` and
    `high`, the ends of the 95 % interval, `n` and `interval`, which says what n counts. A condition
    whose energy is not known is left out.
    """
    rows = []
    for condition in run.conditions:
        total, helpers = run.score(condition, "energy_j"), run.score(condition, "helpers_j")
        radio = run.score(condition, "radio_mj")
        if not (total and helpers and radio):
            continue
        of_radio, of_helpers = (radio.value or 0.0) / 1000, helpers.value or 0.0
        of_ego = (total.value or 0.0) - of_helpers - of_radio
        of_total = {
            "total_j": total.value,
            "low": total.low,
            "high": total.high,
            "n": total.n,
            "interval": total.interval,
        }
        parts = zip(PARTS, (of_ego, of_helpers, of_radio), strict=True)
        for part, joules in parts:
            rows.append({"condition": condition, "part": part, "joules": joules, **of_total})
    return rows


def chart(rows: Table) -> dict[str, Any]:
    """Return the Vega-Lite specification of a chart of the joules of a decision, stacked.

    The parts are the ego's inference, the helpers' and the radios. `rows` are those that `energies`
    returns, one for each condition and part, of one or several runs.
    """
    return charts.stacked(rows, "condition", "part", PARTS, "J per decision", amount="joules")


PANEL = AddedPanel(
    part="communication",
    title="Energy of a decision",
    caption="Joules of inference on the declared device and of the radios, as means over "
    "decisions; the interval is that of the total, over episodes. All helpers in the "
    "radius infer from the start, asked or not; with on_demand=true those alone that are "
    "asked. If the radios' part is too small to see, cooperation costs energy because "
    "helpers infer, not because they transmit.",
    rows=energies,
    spec=chart,
)
