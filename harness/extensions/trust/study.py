"""`harness study trust`: every consensus rule under every attack,
and its cost while nobody attacks.

A run's stored answers are played again under each rule, attack and share of attackers. All cells
have the same episodes, channel draws and attackers, so differences are paired by episode.
"""

from collections.abc import Callable, Hashable, Iterator, Sequence
from fractions import Fraction
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from harness.coordination.contents import INTENTS
from harness.coordination.named_points import setting_of
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.rules import EGO_PROMPT, RULES, reads
from harness.core.arrays import Floats
from harness.core.errors import UserError, printable, unknown
from harness.core.files import digest, sha256_file
from harness.core.progress import Progress
from harness.core.statistics import negative_log_likelihood
from harness.core.versions import versions
from harness.dataset.load import Scene
from harness.evaluate.spec import files_of
from harness.evaluate.walk import Decided
from harness.extensions.trust.attacks import attacks_of, count_of_attackers
from harness.extensions.trust.bench import BASE, EXCLUDED, PEACE, Bench, Cell, Key
from harness.extensions.trust.strongest_lies import (
    StrongestLies,
    strongest_lies,
    why_not_searched,
)
from harness.runs.alike import setup
from harness.runs.headline import SUCCESS
from harness.runs.places import mean_by_place
from harness.runs.success import Success
from harness.studies.axes import NONE, Setting, axis_of, refusal, usual_at
from harness.studies.play import WalkResult
from harness.studies.replayed_run import ReplayedRun
from harness.studies.study import Cells, refuse_other
from harness.studies.sweep import point_of

TRUSTED = 0.5  # of trust; below it a helper is taken for an attacker
# what loses least to the strongest lies, chosen on tune layouts (benchmarks/strongest_lies.py)
CAPPED = "trimmed-mean:weight_cap=0.25"


def under(point: OperatingPoint, rule: str, attack: str, share: float) -> OperatingPoint:
    """Return an operating point with another rule, and with attacks by a share of the helpers.

    An operating point is the settings of radio, asking and fusion; an attack is how some helpers
    lie. `rule` is a consensus rule, by which the ego fuses messages, such as
    `linear:weight_cap=0.3`. Each attack of `attack`, joined by `+`, gets the share, 0 to 1. Raises
    UserError for another setting of a rule.
    """
    text = "+".join(f"{part}:share={share!r}" for part in attack.split("+") if part)
    consensus, *settings = rule.split(":")
    pairs = dict(setting.partition("=")[::2] for setting in settings)
    if pairs.keys() - {"weight_cap"}:
        raise UserError(
            f"--rules {printable(rule)}: a rule may have a weight_cap, such as {CAPPED}"
        )
    more: dict[str, Any] = {key: setting_of(key, value) for key, value in pairs.items()}
    name = f"{point.name} · {rule}" + (f" · {text}" if text else "")
    return point.changed(name=name, consensus=consensus, attack=text, **more)


def names_of(option: str, text: str, allowed: Sequence[str]) -> tuple[str, ...]:
    """Return the names in the value of a command-line option, such as `liar,brake`; none for `all`.

    `option` is the option's name, for messages. Raises UserError for a name that is not among the
    `allowed`.
    """
    if text == "all":
        return ()
    names = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    for part in (part for name in names for part in name.split("+")):
        if part.partition(":")[0] not in allowed:
            raise unknown(option, part.partition(":")[0], ("all", *allowed))
        if "share=" in part:
            raise UserError(f"{option} {printable(part)}: give shares with --share")
    return names


def shares_of(text: str) -> tuple[float, ...]:
    """Return the shares of attackers in a list such as `0,1/3,2/3`, without 0, always played.

    A share is that of the helpers that attack. Raises UserError if the text has no share above 0,
    or one that is not from 0 to 1.
    """
    try:
        shares = [float(Fraction(part.strip())) for part in text.split(",")]
    except (ValueError, ZeroDivisionError):
        shares = [np.nan]
    if not all(0 <= share <= 1 for share in shares):
        raise UserError(f"--share {printable(text)}: give shares from 0 to 1, such as 0,1/3,2/3")
    if not any(shares):
        raise UserError(
            f"--share {printable(text)}: nobody attacks; give a share above 0 as well: 0,1/3"
        )
    by_text = {f"{share:.10g}": share for share in reversed(shares) if share}
    return tuple(reversed(by_text.values()))


def cell_of(key: Key, result: WalkResult) -> Cell:
    """Return the cell of the study with the decisions that were played under `key`.

    A cell is the result of one consensus rule, by which the ego fuses messages, under one attack.
    `key` is the rule, the attack and the share of attackers; `result` has the decisions and how
    their episodes ended.
    """
    success = result.ends[SUCCESS]
    nats = mean_by_place(result.columns["nats"], result.places, success.size).reshape(success.shape)
    nats[np.isnan(success)] = np.nan  # left out
    return Cell(*key, success, result.ends["unsafe_rate"], nats, *_flagged(result))


def _judged(run: ReplayedRun, part: Decided[Scene]) -> dict[str, Floats]:
    """Return the columns of a cell's decisions: `nats`, (n,), and of their messages, (n, H).

    `suspected` is NaN where nobody was heard or the rule judges nobody.
    """
    forest, trust = run.dataset.forest, part.result.trust
    scenes, of_scene = np.unique(part.due.at, return_inverse=True)
    at = np.array([forest.place[part.decision_points[n].id] for n in scenes])[of_scene]
    return {
        "nats": negative_log_likelihood(part.result.fused, forest.safe[at]),
        "suspected": np.where(np.isnan(trust), np.nan, trust < TRUSTED),
        "attacks": part.said.attackers.astype(float),
    }


def _flagged(result: WalkResult) -> tuple[Floats | None, list[int]]:
    import pandas as pd

    suspected, attacks = result.columns["suspected"], result.columns["attacks"]
    if np.isnan(suspected).all():
        return None, []
    episode, n = result.places % len(result.episodes), len(result.episodes)
    kinds = [(suspected == s) & (attacks == a) for a, s in product((1.0, 0.0), repeat=2)]
    counts = np.array([np.bincount(episode, kind.sum(axis=1), n) for kind in kinds])
    decision, helper = np.nonzero(~np.isnan(suspected) & (attacks == 1))
    sender = pd.Series(result.places[decision] * attacks.shape[1] + helper)
    number = sender.groupby(sender).cumcount() + 1
    first = number.where(suspected[decision, helper] == 1).groupby(sender).min().fillna(0)
    return counts, first.astype(int).tolist()


def run_bench(
    run: ReplayedRun,
    condition: str,
    rules: Sequence[str],
    attacks: Sequence[str],
    shares: Sequence[float],
    seeds: Sequence[int],
    out: Path,
    progress: Progress,
) -> Bench:
    """Play every consensus rule under every attack on a run's stored answers.

    A consensus rule is how the ego fuses messages, and an attack how some helpers lie. Returns how
    the episodes end under each rule, attack and share of attackers.

    Args:
        run: the run whose answers are used; its model is asked for those that it lacks.
        condition: the operating point (settings of radio, asking and fusion) that is attacked, as
            it is typed.
        rules: consensus rules, such as `linear:weight_cap=0.3`. The linear pool is always among
            them; without any, the usual ones are played, as far as the condition allows them.
        attacks: attacks without shares, such as `liar+spoof`; without any, the usual ones.
        shares: shares of the helpers that attack, above 0 to 1; nobody is always played as well.
        seeds: the channel's seeds.
        out: the study's folder; results that it has already are read.
        progress: told how much there is to do, and called with what is done.

    Raises:
        UserError: the condition has no channel, or asks nobody, or its rule is a fusion call, or
            none of the rules changes anything; or the folder has another such study.
    """
    point = point_of([run], condition)
    if why := point.idle("attack"):
        raise UserError(f"--condition {printable(condition)}: no attack changes anything: {why}")
    if point.setting("attack"):
        raise UserError(
            f"--condition {printable(condition)}: it has an attack; leave it out, and name attacks "
            "with --attacks"
        )
    attacks = attacks or [str(name) for name in usual_at(axis_of("attack"), point) if name != NONE]
    if not attacks:
        raise UserError(
            f"--condition {printable(condition)}: it allows none of the usual attacks; give "
            f"another ({refusal(axis_of('attack'), point)})"
        )
    helpers = run.vehicles - 1
    for share in shares:
        if helpers and count_of_attackers(share, helpers) < 1:
            raise UserError(
                f"--share {share:g}: this is nobody of {helpers} helpers, the most there are; give "
                f"1/{2 * helpers} or more"
            )
    attacks = _different(attacks, attacks_of)
    for attack in attacks:
        parts = attack.split("+")
        if point.stream is None and EXCLUDED in parts and len(parts) > 1:
            raise UserError(
                f"--attacks {printable(attack)}: {EXCLUDED} leaves the attackers out, whatever "
                "else they would do; leave it out"
            )
    if set(attacks) == {EXCLUDED}:
        raise UserError(f"--attacks {EXCLUDED}: it is played beside any attack; name one that lies")
    unfused = point.idle("consensus")
    if unfused and set(rules) - {BASE}:
        raise UserError(
            f"--rules {','.join(rules)}: no rule changes anything: {unfused}; leave it out"
        )
    usual = [rule for rule in RULES if INTENTS in reads(rule)]
    different = _different([BASE, *rules], partial(_as_rule, point))
    of_model = [rule for rule in different if rule == EGO_PROMPT]  # which lies are looked for alone
    arithmetic = [rule for rule in different if rule != EGO_PROMPT]
    default = () if unfused or rules else (*usual, CAPPED)
    every_rule = dict.fromkeys([*arithmetic, *default])
    if of_model and not run.asks:
        raise UserError(f"--no-model: {EGO_PROMPT} asks the model about messages; leave it out")
    run.check([under(point, rule, PEACE, 0.0) for rule in of_model])
    every: list[Key] = list(
        dict.fromkeys(
            [
                *((rule, PEACE, 0.0) for rule in every_rule),
                *((BASE, EXCLUDED, share) for share in shares),
                *product(every_rule, attacks, shares),
            ]
        )
    )
    # which checks that they go together
    points = {key: under(point, *key) for key in every}
    refuse_other(
        out,
        "trust",
        {
            "sources": [{"name": run.name}],
            "dataset": run.run.source,
            "condition": condition,
            "seeds": list(seeds),
            "rules": [*every_rule, *of_model],
            "attacks": list(attacks),
            "shares": list(shares),
        },
    )
    depends_on = [
        run.manifest(),
        str(setup(run.run)),
        sha256_file(run.run.path / "answers.jsonl", "rows"),
        point.record(),
        list(seeds),
        run.asks,  # without the model, episodes may be left out
        files_of([*points.values()]),
        versions(),
    ]
    kept = Cells(out / "cells.jsonl", digest(depends_on), source=run)
    cells = dict[Key, Cell]()
    missing = [key for key in every if key not in kept]
    settings = [Setting(point.name, points[key], run.vehicles) for key in missing]
    walks = run.walked(settings, seeds, partial(_judged, run))

    def compute(key: Key) -> dict[str, Any]:
        [result] = next(walks)  # the cells that are missing are walked together
        run.settle()
        return vars(cell_of(key, result))

    progress.more(len(every))
    for key in every:
        cells[key] = Cell(**kept.part(key, partial(compute, key)))
        progress(1)
    lies = dict[str, StrongestLies]()
    not_searched = why_not_searched(point) if run.asks else "the model is not asked"
    if not not_searched:
        progress.more(len(every_rule) + len(of_model))
        for rule in (*every_rule, *of_model):
            honest = under(point, rule, PEACE, 0.0)
            find = partial(_found_lies, run, honest, shares[0], seeds)
            values = kept.part((rule, "worst", shares[0]), find)
            if values:
                lies[rule] = StrongestLies.of(values)
            run.settle()
            progress(1)
    unsearched = [rule for rule in (*every_rule, *of_model) if rule not in lies]
    [[alone]] = run.walked(
        [Setting(condition, OperatingPoint.of("never asks"), run.vehicles)], seeds
    )
    run.settle()
    return Bench(
        run.name,
        run.run.source,
        condition,
        tuple(seeds),
        cells,
        alone.ends[SUCCESS],
        Success(run.dataset.dangerous, run.dataset.clusters),
        (*run.caveats, *_unsearched(unsearched, not_searched)),
        unfused,
        lies,
        int(count_of_attackers(shares[0], helpers)),
    )


def _different(texts: Sequence[str], meaning: Callable[[str], Hashable]) -> list[str]:
    """Return the texts without those that mean what an earlier one does, spelt otherwise."""
    by_meaning = dict[Hashable, str]()
    for text in texts:
        by_meaning.setdefault(meaning(text), text)
    return list(by_meaning.values())


def _as_rule(point: OperatingPoint, rule: str) -> OperatingPoint:
    """Return an operating point with a rule, whatever its text.

    Raises UserError if the text has a setting that changes nothing.
    """
    of_rule = under(point, rule, PEACE, 0.0)
    name, *settings = rule.split(":")
    for setting in settings:
        key = setting.partition("=")[0]
        if why := of_rule.idle(key):
            raise UserError(f"--rules {printable(rule)}: {key} changes nothing: {why}; give {name}")
    return of_rule.changed(name=point.name)


def _unsearched(rules: Sequence[str], reason: str) -> Iterator[str]:
    """Yield a sentence on the rules whose strongest lies were not looked for, and why."""
    if reason:
        yield f"No strongest lie is looked for: {reason}."
    elif rules:
        yield (
            f"The strongest lies against {', '.join(rules)} were not looked for: of a package's "
            "rule with memory, not all courses can be followed."
        )


def _found_lies(*options: Any) -> dict[str, Floats]:
    lies = strongest_lies(*options)
    return lies.values() if lies else {}
