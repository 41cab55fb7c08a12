"""How reference drivers drive all agents of a layout, beside a plan for all of them."""

from collections.abc import Sequence
from typing import Any

from harness.cli.scenario import Drives
from harness.cli.terminal import console, table
from harness.core.figures import Unit, interval_of
from harness.core.seeds import seeds_text
from harness.extensions.joint_plans import policies

Row = Sequence[str]  # of a table


def show(episodes: int, seed: int, outcomes: dict[str, Any]) -> None:
    """Print tables of how agents fare under each policy, and what it costs against a plan for all.

    Agents are vehicles that decide for themselves; a policy is a rule driver, or the plan that a
    search found for all of them together. `outcomes` is what `policies.check` returns (estimates by
    policy, and the seeds without a plan) for `episodes` start situations with layout seeds from
    `seed` on.
    """
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


DRIVES = Drives(policies.check, show)
