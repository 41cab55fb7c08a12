"""`harness dataset scenario`: the scenarios, and how hard each is for the reference drivers."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.terminal import attributes, console, echo_each, echo_fields, echo_json, table
from harness.core import resources
from harness.core.errors import in_range, printable
from harness.core.figures import Unit, interval_of
from harness.core.seeds import purpose, seeds_text

if TYPE_CHECKING:
    from harness.world.scenario import Scenario

Row = Sequence[str]  # of a table


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

    All drive the same episodes. With several agents each is driven so, and by
    a joint plan for all of them: the best found, and the best where it was
    searched to the end.
    """
    from harness.cli.drive import deciding

    name = name if agents is None else deciding(name, agents)
    scenario, who = ready_to_drive(name, episodes, seed), options.workers_of(workers)
    from harness.world import policies, scenarios
    from harness.world import reference as live
    from harness.world.seats import agent_share

    together = agent_share(scenario) > 0
    with bar(f"driving {printable(name, 30)}", episodes) as progress:
        outcomes = (policies if together else live).check(scenario, episodes, seed, who, progress)
    if together:
        if as_json:
            echo_json({"scenario": name, "episodes": episodes, "seed": seed, **outcomes})
        else:
            typer.echo(printable(scenarios.title(scenario)))
            _swarm_tables(episodes, seed, outcomes)
    elif as_json:
        echo_json({"scenario": name, "episodes": episodes, "seed": seed, "drivers": outcomes})
    else:
        typer.echo(printable(scenarios.title(scenario)))
        _table(episodes, seed, outcomes)


def ready_to_drive(name: str, episodes: int, seed: int, counted: str = "--episodes") -> "Scenario":
    """Return the scenario of this name, if so many layouts from this seed can be driven together.

    Raises UserError if there is none, or the layouts are too many or serve different purposes.
    `counted` is the option for their number.
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


def _swarm_tables(episodes: int, seed: int, outcomes: dict[str, Any]) -> None:
    seconds, ratio, driver = Unit("s", 2), Unit(decimals=3), "driver of all agents"
    outcome_rows, time_rows, decision_rows = list[Row](), list[Row](), list[Row]()
    for policy, of in outcomes["policies"].items():
        shares = [f"{100 * of[name].value:.1f}" for name in ("arrived", "met", "stuck")]
        less = interval_of(of["less_than_joint"], sign="+")
        outcome_rows.append((policy, interval_of(of["success"]), less, *shares))
        lost_s = [interval_of(of[name], seconds) for name in ("lost_s", "most_lost_s")]
        anarchy = of["anarchy"]
        time_rows.append((policy, *lost_s, interval_of(anarchy, ratio), str(anarchy.n)))
        decisions = [interval_of(of[name]) for name in ("best_decisions", "gave_away")]
        decision_rows.append((policy, *decisions, interval_of(of["regret_s"], seconds)))
    success = "success % [95 % CI]"
    table((driver, success, "less than joint", "arrived %", "met %", "stuck %"), outcome_rows)
    table((driver, "lost s, in sum", "lost s, the most", "price of anarchy", "n"), time_rows)
    table((driver, "best decisions %", "arrival given away %", "regret s"), decision_rows)
    text = console()
    text.print(
        f"n = {episodes} episodes, {seeds_text(seed, episodes)}; times where all arrive;\n"
        "price of anarchy: summed time of trips against joint's, on the n that both clear;\n"
        "regret: of an agent's first decisions, had the others done what they did"
    )
    text.print(f"without a joint plan: {_seeds(outcomes['unsolved'])}")
    if inexact := outcomes["inexact"]:
        text.print(
            f"joint is the best found, and the best plan in {episodes - len(inexact)} of "
            f"{episodes} episodes; not searched to the end, or a driver did better: "
            f"{_seeds(inexact)}"
        )
    else:
        text.print(f"joint is the best plan, searched to the end in all {episodes} episodes")


def _seeds(seeds: list[int]) -> str:
    """Return how many seeds there are, and the first of them."""
    named = ", ".join(map(str, seeds[:10])) + (", …" if len(seeds) > 10 else "")
    return f"{len(seeds)}" + (f" (seeds {named})" if named else "")
