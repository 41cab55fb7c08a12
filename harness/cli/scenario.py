"""`harness dataset scenario`: the scenarios, and how hard each is for the reference drivers."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.terminal import attributes, console, echo_each, echo_fields, echo_json, table
from harness.core import resources
from harness.core.errors import UserError, in_range, printable
from harness.core.extensions import owner_of_plugin, part_of
from harness.core.figures import interval_of
from harness.core.plugins import Shipped
from harness.core.seeds import purpose, seeds_text

if TYPE_CHECKING:
    from harness.core.parallel import Workers
    from harness.world.scenario import Scenario


def list_scenarios(as_json: options.Json = False) -> None:
    """List the scenarios, each with a summary."""
    from harness.world import scenarios

    echo_each(
        resources.each(scenarios.names(), scenarios.get),
        as_json,
        lambda scenario: {"summary": scenario.summary},
        lambda name, scenario: typer.echo(f"{name}: {scenario.summary}"),
    )


def show(name: options.Scenario, as_json: options.Json = False) -> None:
    """Print a scenario's actions and its parameters, with meanings."""
    from harness.world import scenarios

    scenario = scenarios.get(options.typed_scenario(name))
    description, actions = scenario.description, scenario.actions
    if as_json:
        from harness.prompts.answer_schema import ROLES, answer_schema

        meanings = attributes(type(scenario.parameters))
        parameters = {}
        for key, value in asdict(scenario.parameters).items():
            parameters[key] = {"value": value, "meaning": meanings[key]}
        result = {
            "name": name,
            "description": description,
            "actions": actions,
            "parameters": parameters,
            "answer_schema": {role: answer_schema(role, actions, name) for role in ROLES},
        }
        echo_json(result)
        return
    typer.echo(f"{description}\nactions: {', '.join(actions)}\n")
    echo_fields(scenario.parameters)


def drive(
    name: options.Scenario,
    episodes: int = typer.Option(500, help="Number of episodes; every driver drives each."),
    seed: options.FirstSeed = 0,
    agents: options.Agents = None,
    workers: options.Workers = "2",
    as_json: options.Json = False,
) -> None:
    """Let the reference drivers drive, and show how episodes end.

    All drive the same episodes. With several agents a driver drives all of them.
    """
    from harness.cli.drive import deciding

    name = name if agents is None else deciding(name, agents)
    scenario, who = ready_to_drive(name, episodes, seed), options.workers_of(workers)
    from harness.world import scenarios

    drives = drives_of(scenario)
    with bar(f"driving {printable(name, 30)}", episodes) as progress:
        outcomes = drives.check(scenario, episodes, seed, who, progress)
    if as_json:
        echo_json({"scenario": name, "episodes": episodes, "seed": seed, **outcomes})
    else:
        typer.echo(printable(scenarios.title(scenario)))
        drives.show(episodes, seed, outcomes)


@dataclass(frozen=True)
class Drives:
    """Describe how reference drivers drive the layouts of a scenario, and what is said of it.

    A reference driver is a rule that decides without a model; a layout is one drawn start
    situation. `check` takes the scenario, the number of layouts, the seed of the first, the
    workers, and what is called with the number just done; it returns the results by name, as JSON
    has them. `show` takes both numbers and the results, and prints them.
    """

    # takes the scenario, how many layouts, the seed of the first, the workers, and what is told how
    # many are done; returns the results as the JSON output has them
    check: Callable[["Scenario", int, int, "Workers", Callable[[int], None]], dict[str, Any]]
    show: Callable[[int, int, dict[str, Any]], None]  # prints them; takes both numbers first


def _check(
    scenario: "Scenario", episodes: int, seed: int, workers: "Workers", done: Callable[[int], None]
) -> dict[str, Any]:
    from harness.world import reference

    return {"drivers": reference.check(scenario, episodes, seed, workers, done)}


def _show(episodes: int, seed: int, outcomes: dict[str, Any]) -> None:
    _table(episodes, seed, outcomes["drivers"])


EGO, AGENTS = "ego", "agents"  # who decides in a scenario
DRIVES = Shipped[Drives]("swarmdrive.drives", Drives, {EGO: Drives(_check, _show)})


def drives_of(scenario: "Scenario") -> Drives:
    """Return how reference drivers are driven through a scenario, and what is printed of it.

    A reference driver is a rule that decides without a model. Raises UserError if several agents
    (vehicles) decide in the scenario, and no extension says how to drive these.
    """
    from harness.world.seats import agent_share

    who = AGENTS if agent_share(scenario) > 0 else EGO
    if who not in DRIVES:
        owner = owner_of_plugin("drives", who) or who
        what = f"{printable(scenario.name)} with several agents"
        raise UserError(f"{what}: how reference drivers drive it is {part_of(owner)}")
    return DRIVES[who]


def ready_to_drive(name: str, episodes: int, seed: int, counted: str = "--episodes") -> "Scenario":
    """Return the scenario of this name, once it is sure that its episodes can be driven.

    Each episode has its own start situation, drawn by a layout seed: `seed`, `seed` + 1 and so on,
    `episodes` of them. Raises UserError if there is no such scenario, or the seeds are too many or
    serve different purposes, such as tuning and reporting. `counted` is the option for their
    number, for the message.
    """
    from harness.core.seeds import LAST_EPISODE, LAST_SEED
    from harness.world import scenarios

    scenario = scenarios.get(options.typed_scenario(name))
    in_range(counted, episodes, 1, LAST_EPISODE + 1)
    in_range("--seed", seed, 0, LAST_SEED)
    purpose(seed, episodes)
    return scenario


def _table(episodes: int, seed: int, outcomes: dict[str, Any]) -> None:
    halves = ("balanced", "dangerous", "harmless")
    if all("balanced" in rates for rates in outcomes.values()):
        rows = []
        for driver, rates in outcomes.items():
            rows.append((driver, *(interval_of(rates[half]) for half in halves)))
        table(("driver", "balanced success % [95 % CI]", "with a danger", "without"), rows)
        first = next(iter(outcomes.values()))
        episodes_of_each = f"{first['dangerous'].n} and {first['harmless'].n} episodes"
        console().print(f"balanced: mean of both, of {episodes_of_each}\n")
    heads = (
        "driver",
        "success % [95 % CI]",
        "collision %",
        "late %",
        "time-out %",
        "other crashes",
    )
    rows = []
    for driver, rates in outcomes.items():
        percent = (f"{100 * rates[k].value:.1f}" for k in ("collision", "late", "time_out"))
        rows.append((driver, interval_of(rates["success"]), *percent, str(rates["other_crashes"])))
    table(heads, rows)
    off_road = sum(round(rates["off_road"].value * episodes) for rates in outcomes.values())
    console().print(
        f"n = {episodes} episodes, {seeds_text(seed, episodes)};\nWilson intervals; off the road: "
        f"{off_road}"
    )
