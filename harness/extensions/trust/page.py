"""Say in sentences, tables and a heat map how consensus rules fare under attack."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from harness.core.figures import as_mapping, crossed, interval_of, some_of
from harness.core.versions import versions
from harness.extensions.trust.bench import BASE, EXCLUDED, PEACE, Bench, Cell
from harness.extensions.trust.worst_page import (
    worst_headline,
    worst_mapping,
    worst_rows,
    worst_tables,
)
from harness.report.document import Table, strong
from harness.runs.estimates import over_episodes
from harness.runs.headline import SUCCESS
from harness.studies.figures.described import Draws
from harness.studies.study import Study, ends

LOSES, COSTS = 2.0, 1.0  # points: what a robust rule may lose under an attack, and cost in peace


def trust_study(bench: Bench) -> Study:
    """Return the study of how consensus rules fare under attacks, for page, terminal and `--json`.

    A rule is how the ego fuses messages, and `bench` has the result of each under each attack. The
    study has a heat map, and tables of rules, of success and of detection: how well rules tell
    attackers' messages from honest ones.
    """
    import pandas as pd

    rows = [row for cell in bench.cells.values() for row in _rows(bench, cell)]
    rows += worst_rows(bench)
    cells = [_cell(bench, cell) for cell in bench.cells.values()]
    means = [
        {"rule": rule, "share": share, **as_mapping(bench.mean(rule, share))}
        for share in bench.shares
        for rule in bench.rules
    ]
    n = bench.price(BASE).n
    return Study(
        "trust",
        f"Consensus rules under attack: {bench.name} on {bench.source}",
        headline(bench),
        [
            f"n = {crossed(n, len(bench.seeds))} under {bench.condition}. All cells have the same "
            "episodes, channel draws and attackers, so differences are paired by episode; 95 % "
            "intervals are over episodes. Price in peace: the difference in "
            f"{bench.success_rule.words} from linear while nobody attacks, in points. All figures "
            "are in figures.csv."
        ],
        [*worst_tables(bench)]
        + [table for share in bench.shares for table in _tables(bench, share)]
        + [*_detections(bench)],
        {"figures": pd.DataFrame(rows)},
        {
            "sources": [{"name": bench.name}],
            "dataset": bench.source,
            "condition": bench.condition,
            "seeds": list(bench.seeds),
            "rules": list(dict.fromkeys([*bench.rules, *bench.strongest_lies])),
            "attacks": list(bench.attacks),
            "shares": list(bench.shares),
            "versions": versions(),
        },
        {
            "run": bench.name,
            "dataset": bench.source,
            "condition": bench.condition,
            "cells": cells,
            "alone": as_mapping(bench.success_rule.estimate(bench.alone)),
            "means": means,
            "worst": worst_mapping(bench),
        },
        lambda draws: {"heat-map": _heat_map(draws, bench)},
        bench.caveats,
    )


def _cell(bench: Bench, cell: Cell) -> dict[str, Any]:
    """Return a cell as the study's manifest has it: what was played, and what it came to."""
    clusters = bench.success_rule.clusters
    detection = {name: as_mapping(each) for name, each in cell.detection(clusters).items()}
    return {
        "rule": cell.rule,
        "attack": cell.attack or None,
        "share": cell.share,
        "success": as_mapping(over_episodes(SUCCESS, cell.success, clusters)),
        bench.success_rule.metric: as_mapping(bench.success_rule.estimate(cell.success)),
        "detection": detection or None,
    }


def _heat_map(draws: Draws[Any], bench: Bench) -> Any:
    """Draw success of each rule under each attack, a panel a share of attackers."""
    panels = {}
    for share in bench.shares:
        rows = []
        for attack in (PEACE, *bench.attacks):
            of_attack = share if attack else 0.0
            successes = [bench.success(rule, attack, of_attack) for rule in bench.rules]
            rows.append([100 * success.value for success in successes])
        panels[_title(share)] = np.array(rows)
    return draws.heat_map(panels, ["nobody attacks", *bench.attacks], bench.rules)


def headline(bench: Bench) -> list[str]:
    """Return sentences on what asking gains, which attack harms most, and which rule withstands it.

    `bench` has how each consensus rule, by which the ego fuses messages, fares under each attack.
    """
    share, peace = bench.shares[0], bench.success(BASE)
    alone, worst = bench.success_rule.estimate(bench.alone), bench.worst(BASE, share)
    words = bench.success_rule.words
    if bench.unfused:
        return [
            *worst_headline(bench),
            f"While nobody attacks, {words} is {interval_of(peace)} %, and {interval_of(alone)} % "
            "with an ego that never asks.",
            f"If {100 * share:.0f} % of the helpers attack, {worst} harms most: {words} is "
            f"{interval_of(bench.success(BASE, worst, share))} %. No rule fuses anything, since "
            f"{bench.unfused}; what is called linear is the ego's own answer.",
        ]
    if len(bench.attacks) > 1:
        attacked = f"On average over all {len(bench.attacks)} attacks"
    else:
        attacked = f"Under {bench.attacks[0]}"
    sentences = [
        *worst_headline(bench),
        f"While nobody attacks, {words} is {interval_of(peace)} % under the linear pool, and "
        f"{interval_of(alone)} % with an ego that never asks.",
        f"If {100 * share:.0f} % of the helpers attack, {_worst(bench, share)}",
        f"{attacked}, {_best(bench, share)}",
    ]
    if "liar+spoof" in bench.attacks:
        robust = [
            rule
            for rule in bench.rules
            if 100 * bench.price(rule).value >= -COSTS
            and 100 * bench.loss(rule, "liar+spoof", share).value >= -LOSES
        ]
        sentences.append(
            f"Rules that lose {LOSES:g} points or less to a liar at a spoofed place, and cost "
            f"{COSTS:g} point or less in peace: {', '.join(robust) or 'none'}."
        )
    return sentences


def _worst(bench: Bench, share: float) -> str:
    """Say which attack harms the linear pool most, or that none clearly does."""
    harm = {attack: 1.0 - bench.at(BASE, attack, share).success for attack in bench.attacks}
    worst, *close = bench.success_rule.most(harm)
    left = f"{bench.success_rule.words} is {interval_of(bench.success(BASE, worst, share))} %"
    if not close:
        return f"{worst} harms the linear pool most: {left}."
    return (
        f"no attack clearly harms the linear pool most: {left} at the least, and these attacks "
        f"cannot be told apart there: {some_of([worst, *close])}."
    )


def _best(bench: Bench, share: float) -> str:
    """Say which rule has the most over all attacks, or that none clearly does."""
    best, *close = bench.success_rule.most(
        {rule: bench.over_attacks(rule, share) for rule in bench.rules}
    )
    most, linear = (interval_of(bench.mean(rule, share)) for rule in (best, BASE))
    if not close:
        price = _price(bench, best)
        return (
            f"{best} has the most, {most} % (linear: {linear}); its price in peace, in points: "
            f"{price}."
        )
    return (
        f"no rule clearly has the most: it is {most} % (linear: {linear}), and these rules cannot "
        f"be told apart there: {some_of([best, *close])}."
    )


def _price(bench: Bench, rule: str) -> str:
    return "–" if rule == BASE else interval_of(bench.price(rule))


def _title(share: float) -> str:
    return f"{100 * share:.0f} % of the helpers attack"


def _tables(bench: Bench, share: float) -> Iterator[Table]:
    """Yield a table of the rules at a share of attackers, and one of each attack under each."""
    rows: list[Sequence[str]] = []
    for rule in bench.rules:
        mean, worst = interval_of(bench.mean(rule, share)), bench.worst(rule, share)
        there = interval_of(bench.success(rule, worst, share))
        rows.append((rule, _price(bench, rule), mean, worst, there))
    heads = ("rule", "price in peace", "mean of attacks %", "worst attack", "there %")
    yield Table(_title(share), heads, rows, terminal=range(len(heads)))
    rows = [("nobody attacks", *(interval_of(bench.success(rule)) for rule in bench.rules))]
    for attack in bench.attacks:
        cells = []
        for rule in bench.rules:
            success = interval_of(bench.success(rule, attack, share))
            cells.append(strong(success, bench.clear(rule, attack, share)))
        rows.append((attack, *cells))
    yield Table(
        f"{_title(share)}: {bench.success_rule.words}, %",
        ("attack", *bench.rules),
        rows,
        "Bold: the rule differs from the linear pool under the same attack, with p at most 0.05 "
        "after Holm's correction over the grid. For comparison, a linear pool that knows the "
        "attackers and does not hear them succeeds in "
        f"{interval_of(bench.success(BASE, EXCLUDED, share))} %.",
    )


def _detections(bench: Bench) -> Iterator[Table]:
    """Yield how rules that judge helpers find attackers, and whom they take for one in peace."""
    for rule in bench.rules:
        rows = []
        for cell in bench.cells.values():
            if cell.rule == rule and cell.flagged is not None:
                detection = cell.detection(bench.success_rule.clusters)
                shares = [interval_of(estimate) for estimate in detection.values()]
                time = f"{cell.time_to_detection:.0f}" if cell.caught else "–"
                caught = f"{len(cell.caught)} of {len(cell.first)}"
                attack = cell.attack or "nobody attacks"
                rows.append((attack, f"{cell.share:.2f}", *shares, time, caught))
        if rows:
            yield Table(
                f"How well {rule} finds attackers",
                (
                    "attack",
                    "share",
                    "precision %",
                    "recall %",
                    "F1 %",
                    "false alarms %",
                    "messages until an attacker is found, median",
                    "attackers found",
                ),
                rows,
                "Counted over messages that were heard. An attack that leaves a message unchanged "
                "cannot be found in it. The rule's parameters were chosen on tune layouts.",
            )


def _rows(bench: Bench, cell: Cell) -> Iterator[dict[str, Any]]:
    key = cell.rule, cell.attack, cell.share
    place = {"rule": cell.rule, "attack": cell.attack or "none", "share": cell.share}
    clusters = bench.success_rule.clusters
    estimates = {
        SUCCESS: over_episodes(SUCCESS, cell.success, clusters),
        bench.success_rule.metric: bench.success_rule.estimate(cell.success),
        "unsafe_rate": over_episodes("unsafe_rate", cell.unsafe, clusters),
        "nats": over_episodes("nats", cell.nats, clusters),
        **{f"detection_{name}": e for name, e in cell.detection(clusters).items()},
    }
    if cell.attack == PEACE:
        estimates["price_in_peace"] = bench.price(cell.rule)
    elif cell.attack != EXCLUDED:
        estimates["loss_to_attack"] = bench.loss(*key)
    for name, e in estimates.items():
        p = bench.holm.get(key) if name == bench.success_rule.metric else None
        yield {**place, "metric": name, **ends(e), "p_holm_against_linear": p}
    if cell.flagged is not None:
        detection = {"value": cell.time_to_detection, "n": len(cell.caught)}
        yield {**place, "metric": "messages_to_detection", **detection}
