"""`harness dataset scenario`: the scenarios, and how hard each is for the reference drivers."""

from typing import TYPE_CHECKING, Any

import typer

from harness.cli import options
from harness.cli.estimates import console, echo_json, echo_wrong, table
from harness.cli.progress import bar
from harness.core import resources
from harness.core.errors import UserError, in_range, printable
from harness.core.figures import Unit, as_mapping, shown
from harness.core.seeds import FIRST, purpose, stated

if TYPE_CHECKING:
    from harness.world.audit import Audit
    from harness.world.scenario import Scenario


def list_scenarios(as_json: options.Json = False) -> None:
    """List the scenarios, each with a summary."""
    from harness.world import scenarios

    entries = resources.each(scenarios.names(), scenarios.get)
    if as_json:
        echo_json([
            {"name": name, "error": str(each)} if isinstance(each, UserError)
            else {"name": name, "summary": each.summary}
            for name, each in entries.items()
        ])  # fmt: skip
        return
    for name, each in entries.items():
        if isinstance(each, UserError):
            echo_wrong(name, each)
        else:
            typer.echo(f"{name}: {each.summary}")


def show(name: options.Scenario, as_json: options.Json = False) -> None:
    """Print a scenario's actions and its parameters, with meanings."""
    from harness.cli.docstrings import echo_fields
    from harness.world import scenarios

    scenario = scenarios.get(options.typed_scenario(name))
    description, actions = scenario.description, scenario.actions
    if as_json:
        from harness.prompts.answer_schema import ROLES, answer_schema

        described = {"name": name, "description": description, "actions": actions}
        schemas = {role: answer_schema(role, actions, name) for role in ROLES}
        echo_json({**described, "parameters": _parameters(scenario), "answer_schema": schemas})
        return
    typer.echo(f"{description}\nactions: {', '.join(actions)}\n")
    echo_fields(scenario.parameters)


def drive(
    name: options.Scenario,
    episodes: int = typer.Option(500, help="Number of episodes; every driver drives each."),
    seed: options.FirstSeed = 0,
    workers: options.Workers = "2",
    as_json: options.Json = False,
) -> None:
    """Let the reference drivers drive, and show how episodes end.

    All drive the same episodes.
    """
    scenario, who = ready_to_drive(name, episodes, seed), options.workers_of(workers)
    from harness.world import reference as live

    with bar(f"driving {printable(name, 30)}", episodes) as progress:
        outcomes = live.check(scenario, episodes, seed, who, progress)
    if as_json:
        echo_json(_as_mapping(name, episodes, seed, outcomes))
    else:
        _table(episodes, seed, outcomes)


def audit(
    name: options.Scenario,
    layouts: int = typer.Option(300, help="Number of layouts to look at."),
    seed: int = typer.Option(FIRST["report"], help="Layout seed of the first layout; the others follow."),
    workers: options.Workers = "2",
    as_json: options.Json = False,
) -> None:
    """Test whether the ego's view gives the hidden danger away. Exit code 1 if it does.

    A classifier tries to predict the danger from the ego's view alone; above chance, the scenario leaks it.
    """
    scenario, who = ready_to_drive(name, layouts, seed, "--layouts"), options.workers_of(workers)
    if scenario.is_environment:
        raise UserError(
            f"{printable(name)} is an environment without a known danger, so there is nothing to audit; "
            "give a scenario"
        )
    from harness.world.audit import audit as run

    with bar(f"auditing {name}", layouts, as_json) as progress:
        result = run(scenario, layouts, seed, progress, who)
    if as_json:
        echo_json({
            "scenario": name, "layouts": layouts, "seed": seed, "steps": result.steps, "tells": result.tells,
            "worst": result.worst, "auc": {question: as_mapping(auc) for question, auc in result.auc.items()},
            "told_by": result.told_by,
        })  # fmt: skip
    else:
        _print(result)
    if result.tells:
        raise typer.Exit(1)


def ready_to_drive(name: str, episodes: int, seed: int, counted: str = "--episodes") -> "Scenario":
    """The scenario. Raises UserError if there is none, or where those layouts cannot be driven together."""
    from harness.core.seeds import LAST_EPISODE, LAST_SEED
    from harness.world import scenarios

    scenario = scenarios.get(options.typed_scenario(name))
    in_range(counted, episodes, 1, LAST_EPISODE + 1)
    in_range("--seed", seed, 0, LAST_SEED)
    purpose(seed, episodes)
    return scenario


def _parameters(scenario: "Scenario") -> dict[str, dict[str, Any]]:
    """Return the value of each parameter, and its meaning."""
    from dataclasses import asdict

    from harness.cli.docstrings import attributes

    meanings = attributes(type(scenario.parameters))
    return {
        name: {"value": value, "meaning": meanings[name]}
        for name, value in asdict(scenario.parameters).items()
    }


def _as_mapping(name: str, episodes: int, seed: int, outcomes: dict[str, Any]) -> dict[str, Any]:
    from harness.core.statistics import Estimate

    drivers = {
        driver: {k: as_mapping(v) if isinstance(v, Estimate) else v for k, v in results.items()}
        for driver, results in outcomes.items()
    }
    return {"scenario": name, "episodes": episodes, "seed": seed, "drivers": drivers}


def _table(episodes: int, seed: int, outcomes: dict[str, Any]) -> None:
    heads = ("driver", "success % [95 % CI]", "collision %", "late %", "time-out %", "other crashes")
    rows = []
    for driver, of in outcomes.items():
        rates = (f"{100 * of[k].value:.1f}" for k in ("collision", "late", "time_out"))
        rows.append((driver, shown(of["success"]), *rates, str(of["other_crashes"])))
    table(heads, rows)
    off_road = sum(round(of["off_road"].value * episodes) for of in outcomes.values())
    console().print(
        f"n = {episodes} episodes, {stated(seed, episodes)};\nWilson intervals; off the road: {off_road}"
    )


def _print(result: "Audit") -> None:
    from harness.world.audit import MOST_AUC

    table(
        ("predicted from the ego's view", "AUC [95 % CI]"),
        [(question, shown(auc, Unit(decimals=2))) for question, auc in result.auc.items()],
    )
    text = console()
    text.print(f"n = {result.layouts} layouts, {stated(result.seed, result.layouts)};")
    text.print(f"decision points {result.steps[0]} to {result.steps[-1]}, while the danger is out of sight")
    if not result.tells:
        text.print(f"no tell: every AUC is {MOST_AUC:.2f} or less")
        return
    text.print(f"a tell: {result.worst} is above {MOST_AUC:.2f}; AUC lost without each number:")
    for name, lost in result.told_by.items():
        text.print(f"  {lost:.2f} {name}")
