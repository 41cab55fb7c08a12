"""The study of trust: a heat map of success, and tables of rules, of attacks and of detection."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from harness.core.figures import as_mapping, shown
from harness.core.versions import versions
from harness.report.document import Table, strong
from harness.runs.metrics import SUCCESS, over_episodes
from harness.studies.figures.heat_map import heat_map
from harness.studies.study import Study, ends
from harness.studies.trust import BASE, EXCLUDED, PEACE, Bench, Cell

LOSES, COSTS = 2.0, 1.0  # points: what a robust rule may lose under an attack, and cost in peace


def trust_study(bench: Bench) -> Study:
    """Declare the study of a bench: a heat map, tables of rules and of success a share, and of detection."""
    import pandas as pd

    panels = {
        f"{100 * share:.0f} % of the helpers attack": 100
        * np.array(
            [
                [bench.success(rule, attack, share * bool(attack)).value for rule in bench.rules]
                for attack in (PEACE, *bench.attacks)
            ]
        )
        for share in bench.shares
    }
    rows = [row for cell in bench.cells.values() for row in _rows(bench, cell)]
    cells = [
        {"rule": c.rule, "attack": c.attack or None, "share": c.share,
         "success": as_mapping(over_episodes(SUCCESS, c.success)),
         "detection": {k: as_mapping(e) for k, e in rates.items()} if (rates := c.detection()) else None}
        for c in bench.cells.values()
    ]  # fmt: skip
    n = bench.price(BASE).n
    return Study(
        "trust", f"Consensus rules under attack: {bench.name} on {bench.source}", headline(bench),
        [
            f"n = {n} episodes × {len(bench.seeds)} channel seeds under {bench.condition}. All cells have "
            "the same episodes, channel draws and attackers, so differences are paired by episode; 95 % "
            "intervals are over episodes. Price in peace: the difference in success from linear while "
            "nobody attacks, in points. All figures are in figures.csv."
        ],
        [table for share in bench.shares for table in _tables(bench, share)] + [*_detections(bench)],
        {"figures": pd.DataFrame(rows)},
        {
            "sources": [{"name": bench.name}], "dataset": bench.source, "condition": bench.condition,
            "rules": list(bench.rules), "attacks": list(bench.attacks), "shares": list(bench.shares),
            "versions": versions(),
        },
        {"run": bench.name, "dataset": bench.source, "condition": bench.condition, "cells": cells},
        {"heat-map": heat_map(panels, ["nobody attacks", *bench.attacks], bench.rules)}, bench.caveats,
    )  # fmt: skip


def headline(bench: Bench) -> list[str]:
    """Say what asking is worth in peace, what the worst attack takes from linear, and who withstands it."""
    share, peace = bench.shares[0], bench.success(BASE)
    alone, worst = over_episodes(SUCCESS, bench.alone), bench.worst(BASE, share)
    best = max(bench.rules, key=lambda rule: bench.mean(rule, share).value)
    sentences = [
        f"While nobody attacks, {shown(peace)} % of episodes succeed under the linear pool, and "
        f"{shown(alone)} % with an ego that never asks.",
        f"If {100 * share:.0f} % of the helpers attack, {worst} harms the linear pool most: "
        f"{shown(bench.success(BASE, worst, share))} % succeed.",
        f"On average over all {len(bench.attacks)} attacks, {best} succeeds most often, in "
        f"{shown(bench.mean(best, share))} % (linear: {shown(bench.mean(BASE, share))}); its price in "
        f"peace, in points: {price(bench, best)}.",
    ]
    if "liar+spoof" in bench.attacks:
        robust = [
            rule
            for rule in bench.rules
            if 100 * bench.price(rule).value >= -COSTS
            and 100 * bench.loss(rule, "liar+spoof", share).value >= -LOSES
        ]
        sentences.append(
            f"Rules that lose {LOSES:g} points or less to a liar at a spoofed place, and cost {COSTS:g} "
            f"point or less in peace: {', '.join(robust) or 'none'}."
        )
    return sentences


def price(bench: Bench, rule: str) -> str:
    """Return what a rule costs in peace, in points; a dash for the one that others are held against."""
    return "–" if rule == BASE else shown(bench.price(rule))


def _tables(bench: Bench, share: float) -> Iterator[Table]:
    title = f"{100 * share:.0f} % of the helpers attack"
    worst = {rule: bench.worst(rule, share) for rule in bench.rules}
    rows: list[Sequence[str]] = [
        (
            rule,
            price(bench, rule),
            shown(bench.mean(rule, share)),
            attack,
            shown(bench.success(rule, attack, share)),
        )
        for rule, attack in worst.items()
    ]
    heads = ("rule", "price in peace", "mean of attacks %", "worst attack", "there %")
    yield Table(title, heads, rows, terminal=range(len(heads)))
    rows = [("nobody attacks", *(shown(bench.success(rule)) for rule in bench.rules))]
    rows += [
        (attack, *(
            strong(shown(bench.success(rule, attack, share)), bench.clear(rule, attack, share))
            for rule in bench.rules
        ))
        for attack in bench.attacks
    ]  # fmt: skip
    yield Table(
        f"{title}: success, %", ("attack", *bench.rules), rows,
        "Bold: the rule differs from the linear pool under the same attack, with p at most 0.05 after Holm's "
        "correction over the grid. For comparison, a linear pool that knows the attackers and does not hear "
        f"them succeeds in {shown(bench.success(BASE, EXCLUDED, share))} %.",
    )  # fmt: skip


def _detections(bench: Bench) -> Iterator[Table]:
    """Yield how rules that judge helpers find attackers, and whom they take for one in peace."""
    names = ("precision", "recall", "f1", "false_alarms")
    for rule in bench.rules:
        rows = [
            (
                c.attack or "nobody attacks", f"{c.share:.2f}", *(shown(rates[name]) for name in names),
                "–" if np.isnan(c.time_to_detection) else f"{c.time_to_detection:.0f}",
                f"{sum(map(bool, c.first))} of {len(c.first)}",
            )
            for c in bench.cells.values() if c.rule == rule and (rates := c.detection())
        ]  # fmt: skip
        if rows:
            yield Table(
                f"How well {rule} finds attackers",
                ("attack", "share", "precision %", "recall %", "F1 %", "false alarms %",
                 "messages until an attacker is found, median", "attackers found"), rows,
                "Counted over messages that were heard. An attack that leaves a message unchanged cannot be "
                "found in it. The rule's parameters were chosen on tune layouts.",
            )  # fmt: skip


def _rows(bench: Bench, cell: Cell) -> list[dict[str, Any]]:
    place = {"rule": cell.rule, "attack": cell.attack or "none", "share": cell.share}
    estimates = {
        "success_rate": over_episodes(SUCCESS, cell.success),
        "unsafe_rate": over_episodes("unsafe_rate", cell.unsafe),
        "nats": over_episodes("nats", cell.nats),
        **{f"detection_{name}": e for name, e in (cell.detection() or {}).items()},
    }
    if cell.attack == PEACE:
        estimates["price_in_peace"] = bench.price(cell.rule)
    elif cell.attack != EXCLUDED:
        estimates["loss_to_attack"] = bench.loss(cell.rule, cell.attack, cell.share)
    p = bench.holm.get((cell.rule, cell.attack, cell.share))
    rows = [
        {
            **place,
            "metric": name,
            **ends(e),
            "n": e.n,
            "p_holm_against_linear": p if name == SUCCESS else None,
        }
        for name, e in estimates.items()
    ]
    if cell.flagged is not None:
        n = sum(map(bool, cell.first))
        rows.append({**place, "metric": "messages_to_detection", "value": cell.time_to_detection, "n": n})
    return rows
