"""`harness study trust`: every consensus rule under every attack,
and its cost while nobody attacks.

A run's stored answers are played again under each rule, attack and share of attackers. All cells
have the same episodes, channel draws and attackers, so differences are paired by episode.
"""

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property, lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from harness.coordination.contents import INTENTS
from harness.coordination.named_points import setting_of
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.rules import EGO_PROMPT, RULES, reads
from harness.core import noise
from harness.core.arrays import Floats, Ints
from harness.core.errors import UserError, printable, unknown
from harness.core.figures import as_mapping, crossed, interval_of, some_of
from harness.core.files import digest, sha256_file
from harness.core.multiplicity import LEVEL
from harness.core.progress import Progress
from harness.core.statistics import Estimate, negative_log_likelihood, resampled, resampled_estimate
from harness.core.versions import versions
from harness.dataset.load import Scene
from harness.evaluate.spec import files_of
from harness.evaluate.walk import Decided
from harness.extensions.trust.attacks import attacks_of, count_of_attackers
from harness.extensions.trust.strongest_lies import (
    StrongestLies,
    strongest_lies,
    why_not_searched,
)
from harness.extensions.trust.worst_page import (
    worst_headline,
    worst_mapping,
    worst_rows,
    worst_tables,
)
from harness.report.document import Table, strong
from harness.runs.alike import setup
from harness.runs.estimates import over_episodes
from harness.runs.headline import SUCCESS
from harness.runs.places import mean_by_place
from harness.runs.success import Success
from harness.studies.axes import NONE, Setting, axis_of, refusal, usual_at
from harness.studies.figures.described import Draws
from harness.studies.play import WalkResult
from harness.studies.replayed_run import ReplayedRun
from harness.studies.study import Cells, Study, corrected, ends, refuse_other
from harness.studies.sweep import point_of

RESAMPLES = 2000
Key = tuple[str, str, float]  # rule, attack, share
TRUSTED = 0.5  # of trust; below it a helper is taken for an attacker
PEACE, EXCLUDED = "", "absent"
BASE = "linear"
# what loses least to the strongest lies, chosen on tune layouts (benchmarks/strongest_lies.py)
CAPPED = "trimmed-mean:weight_cap=0.25"
LOSES, COSTS = 2.0, 1.0  # points: what a robust rule may lose under an attack, and cost in peace


@dataclass(frozen=True)
class Cell:
    """Hold how one consensus rule fares under one attack, for S channel seeds and E episodes.

    A consensus rule makes the ego's policy, its probabilities of actions, of its own intent and of
    the messages that it heard. In an attack, a share of the helpers sends what is false. Some rules
    also judge helpers: whom they trust little they suspect.
    """

    rule: str  # the consensus rule, such as `linear:weight_cap=0.3`
    attack: str  # without its share; empty where nobody attacks
    share: float  # share of the helpers that attack, 0 to 1
    success: Floats  # which episodes succeed, 1 or 0, (S, E)
    unsafe: Floats  # which episodes end unsafely, 1 or 0, (S, E)
    # mean -ln of the probability that the policy gives to safe actions, over decisions with one,
    # (S, E); NaN without
    nats: Floats
    # number of messages heard in each episode, (4, E): attackers' that the rule suspected, and
    # others of attackers; honest helpers' that it suspected, and others of theirs. None of a rule
    # that judges nobody
    flagged: Floats | None
    # messages until an attacker was suspected, by attacker, episode and seed; 0: never
    first: Sequence[int]

    def detection(self, clusters: Ints | None = None) -> dict[str, Estimate]:
        """Return how well a rule tells attackers' messages from honest ones, as shares by name.

        A rule is a consensus rule, by which the ego fuses messages; it suspects whom it trusts
        little. `precision` is the share of suspected messages that are attackers', `recall` the
        share of attackers' messages that are suspected, `f1` the harmonic mean of both, and
        `false_alarms` the share of honest messages that are suspected. Intervals resample episodes.
        The dict is empty if the rule judges no helper. `clusters`, (E,), are resampled in place of
        episodes, if these have some.
        """
        if self.flagged is None:
            return {}
        n = self.flagged.shape[1]
        if clusters is None:
            times = _resamples(n)
        else:
            times = _resamples(int(clusters.max()) + 1)[:, clusters]
        hits, misses, wrongs, rights = (times @ counts for counts in self.flagged)
        with np.errstate(invalid="ignore", divide="ignore"):
            shares = {
                "precision": hits / (hits + wrongs),
                "recall": hits / (hits + misses),
                "f1": 2 * hits / (2 * hits + wrongs + misses),
                "false_alarms": wrongs / (wrongs + rights),
            }
        return {name: resampled_estimate(values, n, clusters) for name, values in shares.items()}

    @property
    def caught(self) -> list[int]:
        """Return, for each attacker that the rule suspected, its messages heard until then.

        The rule is the consensus rule, by which the ego fuses messages. The list has a number for
        each attacker, episode and channel seed.
        """
        return [n for n in self.first if n]

    @property
    def time_to_detection(self) -> float:
        """Return the median number of messages until an attacker is suspected; NaN if none is.

        Messages are counted for each attacker, episode and channel seed.
        """
        return float(np.median(self.caught)) if self.caught else np.nan


@lru_cache(maxsize=1)
def _resamples(n: int) -> Ints:
    """Return how often each of n units is in each resample, (1 + `RESAMPLES`, n): of all cells.

    Shared: do not write to it.
    """
    return resampled(noise.generator("trust", "detection"), n, RESAMPLES)


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


@dataclass(frozen=True)
class Bench:
    """Hold a study of trust: how every consensus rule fares under every attack.

    A consensus rule is how the ego fuses messages, and an attack how some of the helpers lie. A
    cell is the result of one rule, one attack and one share of attackers. The linear pool, the
    weighted mean of intents (probabilities of actions), is the paper's rule, with which others are
    compared. Arrays are (S, E), for S channel seeds and E episodes.
    """

    name: str  # name of the run that is played again
    source: str  # name of the run's dataset
    # name of the operating point (settings of radio, asking and fusion) that is attacked
    condition: str
    # the channel seeds, keys of the radio's random draws
    seeds: tuple[int, ...]
    # the results, by consensus rule, attack (empty for none) and share of the helpers that attack
    cells: Mapping[Key, Cell]
    alone: Floats  # success of an ego that never asks, 1 or 0, (S, E)
    success_rule: Success  # how success of every cell is averaged, such as balanced by danger
    # sentences on what the run lacks, to be read before the numbers
    caveats: tuple[str, ...] = ()
    # why no rule changes anything here, in words; None where rules do. The linear pool is then the
    # only rule, in name
    unfused: str | None = None
    # what the strongest lies by the first share of helpers do, by rule; empty where they were not
    # looked for
    strongest_lies: Mapping[str, StrongestLies] = field(default_factory=dict)
    liars: int = 0  # how many these are at most

    @cached_property
    def rules(self) -> tuple[str, ...]:
        """Return the names of the consensus rules that are compared, the paper's first.

        A consensus rule is how the ego fuses messages. Names are as typed, such as
        `linear:weight_cap=0.3`.
        """
        return tuple(dict.fromkeys(rule for rule, _, _ in self.cells))

    @cached_property
    def attacks(self) -> tuple[str, ...]:
        """Return the names of the attacks that the study plays on rules, such as `liar+spoof`.

        An attack is how some helpers lie; a rule is how the ego fuses messages. Two entries of the
        study are no attacks and are left out: that in which nobody attacks, and `absent`, in which
        attackers send nothing, which bounds what a rule could reach that knows who attacks.
        """
        return tuple(dict.fromkeys(a for _, a, _ in self.cells if a not in (PEACE, EXCLUDED)))

    @cached_property
    def shares(self) -> tuple[float, ...]:
        """Return the shares of the helpers that attack, above 0 to 1, that the study plays."""
        return tuple(dict.fromkeys(share for _, _, share in self.cells if share))

    def at(self, rule: str, attack: str = PEACE, share: float = 0.0) -> Cell:
        """Return the result of a consensus rule under an attack by a share of the helpers.

        A consensus rule is how the ego fuses messages, and an attack how some helpers lie; both are
        named as typed. By default nobody attacks.
        """
        return self.cells[rule, attack, share]

    def success(self, *key: Any) -> Estimate:
        """Return the success of one rule under one attack, 0 to 1, averaged over episodes.

        `key` is the consensus rule (how the ego fuses messages), the attack and the share of the
        helpers that attack; without the last two, nobody attacks. Episodes are averaged by
        `success_rule`, such as balanced over those with a danger and without.
        """
        return self.success_rule.estimate(self.at(*key).success)

    def price(self, rule: str) -> Estimate:
        """Return what a rule costs while nobody attacks: its success less the linear pool's.

        A rule is how the ego fuses messages. The linear pool is the weighted mean of intents
        (probabilities of actions), the paper's rule. The difference is paired by episode, with an
        interval.
        """
        return self.success_rule.difference(self.at(rule).success, self.at(BASE).success)

    def loss(self, rule: str, attack: str, share: float) -> Estimate:
        """Return what an attack takes from a rule: success under it less success without attack.

        A rule is a consensus rule, by which the ego fuses messages. `share` is the share of the
        helpers that attack. The difference is paired by episode, with an interval.
        """
        return self.success_rule.difference(
            self.at(rule, attack, share).success, self.at(rule).success
        )

    @cached_property
    def holm(self) -> Mapping[Key, float | None]:
        """Return p-values of no difference to the linear pool under the same attack, by cell.

        A cell is the result of one rule under one attack. The linear pool is the paper's consensus
        rule, by which the ego fuses messages; the key of a cell is rule, attack and share. They are
        corrected by Holm's method over all cells with an attack; None without an interval.
        """
        keys = [key for key in self.cells if key[0] != BASE and key[1] not in (PEACE, EXCLUDED)]
        pairs = ((self.cells[key].success, self.at(BASE, *key[1:]).success) for key in keys)
        return dict(
            zip(keys, corrected([self.success_rule.p_value(*pair) for pair in pairs]), strict=True)
        )

    def clear(self, *key: Any) -> bool:
        """Return whether a rule differs from the linear pool under an attack (corrected p <= 0.05).

        A rule is how the ego fuses messages. The linear pool, the weighted mean of intents
        (probabilities of actions), is the paper's. `key` is the rule, the attack and the share of
        the helpers that attack.
        """
        return (self.holm.get(key) or 1.0) <= LEVEL

    def worst(self, rule: str, share: float) -> str:
        """Return the attack, by name, under which a rule succeeds least at a share of attackers.

        A rule is a consensus rule, by which the ego fuses messages. The share of the helpers is
        from 0 to 1.
        """
        return min(self.attacks, key=lambda attack: self.success(rule, attack, share).value)

    def mean(self, rule: str, share: float) -> Estimate:
        """Return a rule's success as a mean over all attacks, at a share of attackers, 0 to 1.

        A rule is a consensus rule, by which the ego fuses messages; success is from 0 to 1.
        """
        return self.success_rule.estimate(self.over_attacks(rule, share))

    def over_attacks(self, rule: str, share: float) -> Floats:
        """Return a rule's success of every seed and episode, (S, E), as a mean over all attacks.

        A rule is a consensus rule, by which the ego fuses messages. The axes are S channel seeds
        and E episodes; `share` is the share of the helpers that attack.
        """
        values = [self.at(rule, attack, share).success for attack in self.attacks]
        return np.asarray(np.mean(values, axis=0))


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
    sentences = [
        *worst_headline(bench),
        f"While nobody attacks, {words} is {interval_of(peace)} % under the linear pool, and "
        f"{interval_of(alone)} % with an ego that never asks.",
        f"If {100 * share:.0f} % of the helpers attack, {_worst(bench, share)}",
        f"On average over all {len(bench.attacks)} attacks, {_best(bench, share)}",
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
