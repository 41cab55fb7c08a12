"""`harness dataset scenario audit`: whether a scenario's hidden danger can be told from what is in
sight.
"""

from typing import TYPE_CHECKING

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.scenario import ready_to_drive
from harness.cli.terminal import console, echo_json, table
from harness.core.errors import UserError, printable
from harness.core.figures import Unit, interval_of
from harness.core.seeds import FIRST, seeds_text

if TYPE_CHECKING:
    from harness.extensions.audit.tells import Audit


def command(
    name: options.Scenario,
    layouts: int = typer.Option(300, help="Number of layouts to look at."),
    seed: int = typer.Option(
        FIRST["report"], help="Layout seed of the first layout; the others follow."
    ),
    workers: options.Workers = "2",
    as_json: options.Json = False,
) -> None:
    """Test whether the ego's view gives the hidden danger away. Exit code 1 if it does.

    A classifier tries to predict the danger from the ego's view alone;
    above chance, the scenario leaks it.
    """
    scenario, who = ready_to_drive(name, layouts, seed, "--layouts"), options.workers_of(workers)
    if scenario.has_own_world:
        raise UserError(
            f"{printable(name)} has a world of its own and no known danger, so there is nothing to "
            "audit; give a scenario of the harness's own simulator"
        )
    from harness.extensions.audit.tells import audit
    from harness.world import scenarios

    with bar(f"auditing {name}", layouts, as_json) as progress:
        result = audit(scenario, layouts, seed, progress, who)
    if as_json:
        echo_json(
            {
                "scenario": name,
                "layouts": layouts,
                "seed": seed,
                "steps": result.steps,
                "tells": result.tells,
                "worst": result.worst,
                "auc": result.auc,
                "told_by": result.told_by,
            }
        )
    else:
        typer.echo(printable(scenarios.title(scenario)))
        _print(result)
    if result.tells:
        raise typer.Exit(1)


def _print(result: "Audit") -> None:
    from harness.extensions.audit.tells import MOST_AUC

    table(
        ("predicted from the ego's view", "AUC [95 % CI]"),
        [(question, interval_of(auc, Unit(decimals=2))) for question, auc in result.auc.items()],
    )
    text = console()
    text.print(f"n = {result.layouts} layouts, {seeds_text(result.seed, result.layouts)};")
    text.print(
        f"decision points {result.steps[0]} to {result.steps[-1]}, while the danger is out of sight"
    )
    if not result.tells:
        text.print(f"no tell: every AUC is {MOST_AUC:.2f} or less")
        return
    text.print(f"a tell: {result.worst} is above {MOST_AUC:.2f}; AUC lost without each number:")
    for name, lost in result.told_by.items():
        text.print(f"  {lost:.2f} {name}")
