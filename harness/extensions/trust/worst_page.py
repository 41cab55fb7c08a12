"""Say in a study of trust what the strongest lies leave of each rule."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from harness.core.figures import as_mapping, interval_of, some_of
from harness.core.statistics import Estimate
from harness.extensions.trust.bench import Bench
from harness.extensions.trust.lies import CLAIMS, PLACES, VOICES, WORDS
from harness.extensions.trust.strongest_lies import StrongestLies, space_of
from harness.extensions.trust.worst import TRUST
from harness.report.document import Table
from harness.runs.estimates import over_episodes
from harness.studies.study import ends

NAMES = {WORDS: "words", PLACES: "and a false place", VOICES: "and three voices"}


def strongest(bench: Bench, rule: str) -> StrongestLies:
    """Return what the strongest lies do to a rule; attacks that ship and were played are lies."""
    case = bench.strongest_lies[rule]
    for attack in bench.attacks:
        if cell := bench.cells.get((rule, attack, bench.shares[0])):
            case = case.with_lie(space_of(attack), cell.success, cell.unsafe, bench.liars)
    return case


def worst_headline(bench: Bench) -> Iterator[str]:
    """Yield a sentence on what the strongest lies leave, if they were looked for."""
    if not bench.strongest_lies:
        return
    success_rule, share = bench.success_rule, bench.shares[0]
    successes = {rule: strongest(bench, rule).success[WORDS] for rule in bench.strongest_lies}
    first, *others = successes
    best, *close = success_rule.most(successes)
    shares = {rule: interval_of(success_rule.estimate(each)) for rule, each in successes.items()}
    if others:
        alike = f", not told from {some_of(close)}" if close else ""
        rules = f"{shares[first]} % under {first}, and {shares[best]} % at most, by {best}{alike}"
    else:
        rules = f"{shares[first]} %"
    yield (
        f"If {100 * share:.0f} % of the helpers say, from true places, what harms most, "
        f"{success_rule.words} is {rules}; with an ego that never asks it is "
        f"{interval_of(success_rule.estimate(bench.alone))} %."
    )


def worst_tables(bench: Bench) -> Iterator[Table]:
    """Yield what the strongest lies leave of each rule, and how many liars it withstands."""
    if not bench.strongest_lies:
        return
    words, share = bench.success_rule.words, bench.shares[0]
    alone = interval_of(bench.success_rule.estimate(bench.alone))
    rows = []
    for rule in bench.strongest_lies:
        estimates = _estimates(bench, rule)
        names = (*CLAIMS, "at_least", "worst_unsafe")
        values = [interval_of(estimates[name]) if name in estimates else "–" for name in names]
        by_words = strongest(bench, rule).success[WORDS]
        more = bench.success_rule.difference(by_words, bench.alone)
        values.insert(1, interval_of(more, sign="+"))
        rows.append((rule, interval_of(_withstands(bench, rule)[0]), *values))
    rows.append(("never asks", alone, alone, "", *[alone] * 3, ""))
    words_head, *claims_heads = NAMES.values()
    more_head = "over never asks, points"
    heads = ("rule", "nobody lies", words_head, more_head, *claims_heads, "at least", "unsafe")
    yield Table(
        f"{100 * share:.0f} % of the helpers lie as well as they can: {words}, %",
        heads,
        rows,
        "Liars know all: each answer, the rule, its memory, and where each action leads. They say "
        "what loses most episodes: words alone, from their true places; or claim to be on the "
        "ego's way, 0 m before the zone; or to be three. All say the same. For linear, log-pool, "
        "median, trimmed-mean, trimmed-heads and bayes no other message does more. For trust these "
        "are messages near others'; for other rules, and where the ego is careful, all in steps of "
        "a tenth (a fifth with five actions). Where the ego's model reads messages, it is asked "
        "about those of the attacks that ship. 'At least' is what is kept whatever is said from "
        "true places, where that is known. Over never asks: words, less the success of an ego "
        "that never asks, paired. Unsafe: episodes that end so by words that aim at this.",
        terminal=range(4),
    )
    rows = []
    for rule in bench.strongest_lies:
        nobody, *liars = [interval_of(estimate) for estimate in _withstands(bench, rule)]
        at_most = "" if _is_exact(bench, rule) else "≤ "
        rows.append((rule, nobody, *[at_most + share for share in liars]))
    counts = ("no liar", "any one liar", "any two liars")[: len(rows[0]) - 1]
    yield Table(
        f"Certificates: {words} whatever liars say from true places, whoever they are, %",
        ("rule", *counts),
        rows,
        "Every helper, and every pair, is tried as the liars, who say what harms most. ≤: not "
        "every message is tried, as said above, so that it may be less.",
        terminal=range(len(counts) + 1),
    )


def worst_rows(bench: Bench) -> Iterator[dict[str, Any]]:
    """Yield the rows of `figures.csv` on the strongest lies."""
    for rule in bench.strongest_lies:
        place = {"rule": rule, "attack": WORDS, "share": bench.shares[0]}
        for name, estimate in _estimates(bench, rule).items():
            is_space = name in CLAIMS
            metric = bench.success_rule.metric if is_space else name
            attack = name if is_space else WORDS
            yield {**place, "attack": attack, "metric": metric, **ends(estimate)}
        for count, estimate in enumerate(_withstands(bench, rule)):
            yield {**place, "metric": f"withstands_{count}_liars", **ends(estimate)}


def worst_mapping(bench: Bench) -> dict[str, Any]:
    """Return the figures on the strongest lies for `--json`, by rule."""
    rules = dict[str, Any]()
    for rule in bench.strongest_lies:
        figures = {name: as_mapping(each) for name, each in _estimates(bench, rule).items()}
        withstands = [as_mapping(each) for each in _withstands(bench, rule)]
        rules[rule] = {**figures, "withstands": withstands}
    return rules


def _estimates(bench: Bench, rule: str) -> dict[str, Estimate]:
    """Return the means with intervals of a rule's worst case, by name."""
    case, success_rule = strongest(bench, rule), bench.success_rule
    estimates = {space: success_rule.estimate(success) for space, success in case.success.items()}
    if case.at_least is not None:
        estimates["at_least"] = success_rule.estimate(case.at_least)
    unsafe = over_episodes("unsafe_rate", case.unsafe, success_rule.clusters)
    return {**estimates, "worst_unsafe": unsafe}


def _is_exact(bench: Bench, rule: str) -> bool:
    """Return whether no other message could do more to a rule."""
    is_known = bench.strongest_lies[rule].at_least is not None
    return is_known and rule.partition(":")[0] != TRUST


def _withstands(bench: Bench, rule: str) -> list[Estimate]:
    """Return how much success there is with 0, 1, … liars, whoever they are, under a rule."""
    most = max(1, *(int(np.max(case.liars)) for case in bench.strongest_lies.values()))
    case, estimates = strongest(bench, rule), []
    for count in range(most):
        withstands = (case.liars > count).astype(float)
        estimates.append(bench.success_rule.estimate(withstands))
    return estimates
