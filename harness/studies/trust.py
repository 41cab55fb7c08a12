"""`harness study trust`: every consensus rule under every attack, and its cost while nobody attacks.

A run's stored answers are played again under each rule, attack and share of attackers. All cells have the
same episodes, channel draws and attackers, so differences are paired by episode.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from harness.coordination.operating_point import OperatingPoint, setting_of
from harness.coordination.rules import EGO_PROMPT
from harness.core import noise
from harness.core.arrays import Floats
from harness.core.errors import UserError, printable, unknown
from harness.core.files import digest
from harness.core.multiplicity import LEVEL, holm
from harness.core.statistics import Estimate, negative_log_likelihood, resampled, resampled_estimate
from harness.core.versions import versions
from harness.dataset.load import Scene
from harness.evaluate.frozen_world import FrozenWorld
from harness.evaluate.walk import Decided, walk
from harness.radio.profiles import CHANNELS
from harness.runs.metrics import SUCCESS, difference, mean_by_place, over_episodes, p_value
from harness.studies.replayed_run import ReplayedRun
from harness.studies.study import Cells, refuse_other
from harness.studies.sweep import point_of

RESAMPLES = 2000
Key = tuple[str, str, float]  # rule, attack, share
TRUSTED = 0.5  # of trust; below it a helper is taken for an attacker
PEACE, EXCLUDED = "", "absent"
BASE = "linear"
CAPPED = "linear:weight_cap=0.3"


@dataclass(frozen=True)
class Cell:
    """A rule under an attack by a share of the helpers: seeds S, episodes E."""

    rule: str
    attack: str  # without its share; empty for peace
    share: float  # of the helpers that attack
    success: Floats  # (S, E)
    unsafe: Floats  # which episodes end unsafely, (S, E)
    # mean -ln of the probability that the policy gives to safe actions, over decisions with one; NaN without
    nats: Floats  # (S, E)
    # messages heard, by episode: attackers' that were suspected, and not; honest ones that were, and not
    flagged: Floats | None  # (4, E); None of a rule that judges nobody
    first: Sequence[int]  # messages until an attacker was suspected, by attacker, episode and seed; 0: never

    def detection(self) -> Mapping[str, Estimate] | None:
        """Return precision, recall, F1 and false alarms of messages; None if the rule judges nobody.

        False alarms are the share of honest messages that were suspected. Intervals resample episodes.
        """
        if self.flagged is None:
            return None
        n = self.flagged.shape[1]
        times = resampled(noise.generator("trust", "detection"), n, RESAMPLES)
        hits, misses, wrongs, rights = (times @ counts for counts in self.flagged)
        with np.errstate(invalid="ignore", divide="ignore"):
            shares = {
                "precision": hits / (hits + wrongs),
                "recall": hits / (hits + misses),
                "f1": 2 * hits / (2 * hits + wrongs + misses),
                "false_alarms": wrongs / (wrongs + rights),
            }
        return {name: resampled_estimate(values, n) for name, values in shares.items()}

    @property
    def time_to_detection(self) -> float:
        """Median of the messages until an attacker is suspected, of those that are; NaN if none is."""
        return float(np.median(caught)) if (caught := [n for n in self.first if n]) else float("nan")


def under(point: OperatingPoint, rule: str, attack: str, share: float) -> OperatingPoint:
    """Return the operating point with a rule, such as `linear:weight_cap=0.3`, and attackers.

    Every part of the attack has the same share.
    """
    text = "+".join(f"{part}:share={share:.10g}" for part in attack.split("+") if part)
    consensus, *settings = rule.split(":")
    pairs = dict(setting.partition("=")[::2] for setting in settings)
    if pairs.keys() - {"weight_cap"}:
        raise UserError(f"--rules {printable(rule)}: a rule may have a weight_cap, such as {CAPPED}")
    more: dict[str, Any] = {key: setting_of(key, value) for key, value in pairs.items()}
    name = f"{point.name} · {rule}" + (f" · {text}" if text else "")
    return point.changed(name=name, consensus=consensus, attack=text, **more)


def names_of(option: str, text: str, usual: Sequence[str], known: Sequence[str]) -> tuple[str, ...]:
    """Return the names of a list such as `liar,brake`, or the usual ones for `all`. Raises UserError."""
    if text == "all":
        return tuple(usual)
    names = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    for part in (part for name in names for part in name.split("+")):
        if part.partition(":")[0] not in known:
            raise unknown(option, part.partition(":")[0], ("all", *known))
        if "share=" in part:
            raise UserError(f"{option} {printable(part)}: give shares with --share")
    return names


def shares_of(text: str) -> tuple[float, ...]:
    """Return the shares above 0 of a list such as `0,1/3,2/3`; peace is always played. Raises UserError."""
    try:
        shares = [float(Fraction(part.strip())) for part in text.split(",")]
    except (ValueError, ZeroDivisionError):
        shares = [np.nan]
    if not all(0 <= share <= 1 for share in shares):
        raise UserError(f"--share {printable(text)}: give shares from 0 to 1, such as 0,1/3,2/3")
    if not any(shares):
        raise UserError(f"--share {printable(text)}: nobody attacks; give a share above 0 as well: 0,1/3")
    return tuple(dict.fromkeys(share for share in shares if share))


def play(run: ReplayedRun, point: OperatingPoint, seeds: Sequence[int], key: Key) -> Cell:
    """Play one cell: a rule, an attack and a share."""
    at = under(point, *key)
    world = FrozenWorld(run.dataset, [at], seeds)
    parts = [part for [part] in walk(world, [at], run.asked_in(world, [at]), run.spec.ties)]
    ends, shape = world.ends(at), (len(seeds), len(world.numbers))
    row, column = ({number: n for n, number in enumerate(of)} for of in (seeds, world.numbers.tolist()))
    places = [row[seed] * shape[1] + column[episode] for part in parts for episode, seed in part.due.episodes]
    nats = mean_by_place(
        np.concatenate([_nats(run, p) for p in parts]), np.array(places), shape[0] * shape[1]
    )
    nats = np.where(np.isnan(ends[SUCCESS]), np.nan, nats.reshape(shape))  # left out
    return Cell(*key, ends[SUCCESS], ends["unsafe_rate"], nats, *_flagged(parts, column))


def _nats(run: ReplayedRun, part: Decided[Scene]) -> Floats:
    """-ln of what each decision's policy gives to safe actions, (n,); NaN where none is safe."""
    forest = run.dataset.forest
    at = np.array([forest.place[scene.id] for scene in part.moments])[part.due.at]
    return negative_log_likelihood(part.result.fused, forest.safe[at])


def _flagged(parts: Sequence[Decided[Scene]], column: Mapping[int, int]) -> tuple[Floats | None, list[int]]:
    counts, judged = np.zeros((4, len(column))), False
    heard: dict[tuple[int, int, int], int] = {}
    first: dict[tuple[int, int, int], int] = {}
    for part in parts:
        trust, attackers = part.result.trust, part.said.attackers
        for n, h in zip(*np.nonzero(~np.isnan(trust)), strict=True):
            judged, helper = True, (*part.due.episodes[n], int(h))
            suspected, attacks = bool(trust[n, h] < TRUSTED), bool(attackers[n, h])
            counts[2 * (not attacks) + (not suspected), column[helper[0]]] += 1
            if attacks:
                heard[helper] = heard.get(helper, 0) + 1
                if suspected:
                    first.setdefault(helper, heard[helper])
    return (counts if judged else None), [first.get(helper, 0) for helper in heard]


@dataclass(frozen=True)
class Bench:
    """All cells of a study."""

    name: str  # of the run
    source: str  # its dataset
    condition: str  # the operating point that is attacked
    seeds: tuple[int, ...]  # of the channel
    cells: Mapping[Key, Cell]
    alone: Floats  # success of an ego that never asks, (S, E)
    caveats: tuple[str, ...] = ()  # what the run lacks

    @cached_property
    def rules(self) -> tuple[str, ...]:
        """Rules, the paper's first."""
        return tuple(dict.fromkeys(rule for rule, _, _ in self.cells))

    @cached_property
    def attacks(self) -> tuple[str, ...]:
        """Attacks, without peace and without the reference."""
        return tuple(dict.fromkeys(a for _, a, _ in self.cells if a not in (PEACE, EXCLUDED)))

    @cached_property
    def shares(self) -> tuple[float, ...]:
        """Shares above 0."""
        return tuple(dict.fromkeys(share for _, _, share in self.cells if share))

    def at(self, rule: str, attack: str = PEACE, share: float = 0.0) -> Cell:
        """Return a cell."""
        return self.cells[rule, attack, share]

    def success(self, *key: Any) -> Estimate:
        """Return success in a cell, over episodes."""
        return over_episodes(SUCCESS, self.at(*key).success)

    def price(self, rule: str) -> Estimate:
        """Return what a rule costs while nobody attacks: its success less the linear pool's, paired."""
        return difference(SUCCESS, self.at(rule).success.T, self.at(BASE).success.T)

    def loss(self, rule: str, attack: str, share: float) -> Estimate:
        """Return what an attack takes from a rule: success under it less success in peace, paired."""
        return difference(SUCCESS, self.at(rule, attack, share).success.T, self.at(rule).success.T)

    @cached_property
    def holm(self) -> Mapping[Key, float]:
        """P of no difference to the linear pool under the same attack, by Holm's method over the grid."""
        p_values = {
            key: p_value(SUCCESS, cell.success.T, self.at(BASE, *key[1:]).success.T)
            for key, cell in self.cells.items()
            if cell.rule != BASE and cell.attack not in (PEACE, EXCLUDED)
        }
        known = {key: p for key, p in p_values.items() if p is not None}
        return dict(zip(known, holm(list(known.values())), strict=True))

    def clear(self, *key: Any) -> bool:
        """Return whether a rule differs from the linear pool under an attack by more than chance explains."""
        return self.holm.get(key, 1.0) <= LEVEL

    def worst(self, rule: str, share: float) -> str:
        """Return the attack under which a rule succeeds least."""
        return min(self.attacks, key=lambda attack: self.success(rule, attack, share).value)

    def mean(self, rule: str, share: float) -> Estimate:
        """Return success as a mean over all attacks, over episodes."""
        values = [self.at(rule, attack, share).success for attack in self.attacks]
        return over_episodes(SUCCESS, np.mean(values, axis=0))


def run_bench(
    run: ReplayedRun, condition: str, rules: Sequence[str], attacks: Sequence[str], shares: Sequence[float],
    seeds: Sequence[int], out: Path, progress: Callable[[int], None], more: Callable[[int], None],
) -> Bench:  # fmt: skip
    """Play every cell that the folder has not.

    Args:
        run: the run.
        condition: an operating point with a channel.
        rules: of consensus; the linear pool is added.
        attacks: without shares.
        shares: above 0.
        seeds: of the channel.
        out: the study's folder, in which finished cells are kept.
        progress: called with 1 whenever a cell is done.
        more: called with the number of cells that are to be played.

    Raises:
        UserError: the point has no channel, or asks nobody, or its rule is a fusion call; or the folder has
            the study of another run or condition.
    """
    point = point_of([run], condition)
    if why := point.idle("attack"):
        raise UserError(f"--condition {printable(condition)}: no attack changes anything: {why}")
    if point.guard.attack or EGO_PROMPT in rules:
        raise UserError(
            "harness study trust: give a condition without attack, and rules that are arithmetic; a fusion "
            f"call is attacked by `harness eval --condition {condition}:consensus={EGO_PROMPT} --attack "
            "injection`"
        )
    refuse_other(
        out, "trust", {"sources": [{"name": run.name}], "dataset": run.run.source, "condition": condition}
    )
    every = [
        *((rule, PEACE, 0.0) for rule in dict.fromkeys([BASE, *rules])),
        *((BASE, EXCLUDED, share) for share in shares),
        *product(dict.fromkeys([BASE, *rules]), attacks, shares),
    ]
    depends_on = [
        run.manifest(), str(run.run.manifest.identity), point.record(), list(seeds),
        point.radio.profile and CHANNELS.record(point.radio.profile), versions(),
    ]  # fmt: skip
    kept, cells = Cells(out / "cells.jsonl", digest(depends_on)), dict[Key, Cell]()

    def compute(key: Key) -> Mapping[str, Any]:
        values = vars(play(run, point, seeds, key))
        run.settle()
        return {name: value for name, value in values.items() if name not in ("rule", "attack", "share")}

    more(len(every))
    for key in every:
        cells[key] = Cell(*key, **kept.part(key, partial(compute, key)))
        progress(1)
    never = FrozenWorld(run.dataset, [alone := OperatingPoint.of("never asks")], seeds)
    for _ in walk(never, [alone], run.asked_in(never, [alone]), run.spec.ties):
        pass
    run.settle()
    success = never.ends(alone)[SUCCESS]
    return Bench(run.name, run.run.source, condition, tuple(seeds), cells, success, run.caveats)
