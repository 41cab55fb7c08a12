"""`harness study trust`: every consensus rule under every attack, and its cost while nobody attacks.

A run's stored answers are played again under each rule, attack and share of attackers. All cells have the
same episodes, channel draws and attackers, so differences are paired by episode.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
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
from harness.core.kept import code_sha256
from harness.core.multiplicity import LEVEL, holm
from harness.core.statistics import Estimate, negative_log_likelihood, resampled, resampled_estimate
from harness.core.versions import versions
from harness.dataset.load import Scene
from harness.evaluate.frozen_world import FrozenWorld
from harness.evaluate.walk import Decided, walk
from harness.runs.metrics import SUCCESS, difference, mean_by_place, over_episodes, p_value
from harness.studies.replayed_run import ReplayedRun
from harness.studies.study import Cells, refuse_other
from harness.studies.sweep import point_of

RESAMPLES = 2000
TRUSTED = 0.5  # of trust; below it a helper is taken for an attacker
PEACE, EXCLUDED = "", "absent"
BASE = "linear"
CAPPED = "linear:weight_cap=0.3"


@dataclass(frozen=True)
class Cell:
    """A rule under an attack by a share of the helpers."""

    rule: str  # of consensus
    attack: str  # without its share; empty for peace
    share: float  # of the helpers that attack
    success: Floats  # which episodes succeed, (S, E)
    unsafe: Floats  # which end unsafely, (S, E)
    # mean of -ln of the probability that the policy gives to safe actions, of an episode's decisions where
    # some action was safe, (S, E); NaN where there is none
    nats: Floats
    # messages heard, by episode: of attackers that were taken for such, of attackers that were not, of honest
    # helpers that were, and that were not, (4, E); None of a rule that judges nobody
    flagged: Floats | None
    # how many decisions with an attacker's message it took until it was taken for one, for each attacker of
    # an episode and seed; 0 where it never was
    first: tuple[int, ...]

    def detection(self) -> Mapping[str, Estimate] | None:
        """Precision, recall, F1 and false alarms of messages, with a bootstrap over episodes.

        False alarms are the share of honest messages that were taken for an attacker's. None if the rule
        judges nobody.
        """
        if self.flagged is None:
            return None
        hit, missed, wrong, right = self.flagged
        times = resampled(noise.generator("trust", "detection"), len(hit), RESAMPLES)
        hits, misses, wrongs, rights = times @ hit, times @ missed, times @ wrong, times @ right
        with np.errstate(invalid="ignore", divide="ignore"):
            found = {
                "precision": hits / (hits + wrongs),
                "recall": hits / (hits + misses),
                "f1": 2 * hits / (2 * hits + wrongs + misses),
                "false_alarms": wrongs / (wrongs + rights),
            }
        return {name: resampled_estimate(of, len(hit)) for name, of in found.items()}

    @property
    def time_to_detection(self) -> float:
        """Median of how many messages it takes until an attacker is found, of those that are; NaN if none."""
        found = [n for n in self.first if n]
        return float(np.median(found)) if found else float("nan")


def under(point: OperatingPoint, rule: str, attack: str, share: float) -> OperatingPoint:
    """The operating point with a rule and attackers; every part of the attack has the same share.

    A rule may have a cap on weights: `linear:weight_cap=0.3`.
    """
    text = "+".join(f"{part}:share={share:.10g}" for part in attack.split("+") if part)
    consensus, *settings = rule.split(":")
    pairs = dict(setting.partition("=")[::2] for setting in settings)
    if pairs.keys() - {"weight_cap"}:
        raise UserError(f"--rules {printable(rule)}: a rule may have a weight_cap, such as {CAPPED}")
    more: dict[str, Any] = {key: setting_of(key, value) for key, value in pairs.items()}
    name = f"{point.name} · {rule}" + (f" · {text}" if text else "")
    return replace(point, name=name, consensus=consensus, attack=text, **more)


def names_of(option: str, text: str, usual: Sequence[str], known: Sequence[str]) -> tuple[str, ...]:
    """The names of a list such as `liar,brake`, or the usual ones for `all`. Raises UserError."""
    if text == "all":
        return tuple(usual)
    names = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    for name in names:
        for part in name.split("+"):
            if part.partition(":")[0] not in known:
                raise unknown(option, part.partition(":")[0], ("all", *known))
            if "share=" in part:
                raise UserError(f"{option} {printable(name)}: give shares with --share")
    return names


def shares_of(text: str) -> tuple[float, ...]:
    """Shares above 0 of a list such as `0,1/3,2/3`; peace is always played. Raises UserError."""
    found = []
    for part in text.split(","):
        above, slash, below = part.strip().partition("/")
        try:
            share = float(above) / (float(below) if slash else 1.0)
        except (ValueError, ZeroDivisionError):
            share = np.nan
        if not 0 <= share <= 1:
            raise UserError(f"--share {printable(text)}: give shares from 0 to 1, such as 0,1/3,2/3")
        found.append(share)
    if not any(found):
        raise UserError(f"--share {printable(text)}: nobody attacks; give a share above 0 as well: 0,1/3")
    return tuple(dict.fromkeys(share for share in found if share))


def play(run: ReplayedRun, point: OperatingPoint, seeds: Sequence[int], of: tuple[str, str, float]) -> Cell:
    """Play one cell: a rule, an attack and a share."""
    at = under(point, *of)
    world = FrozenWorld(run.dataset, [at], seeds)
    parts = [part for [part] in walk(world, [at], run.asked_in(world, [at]), run.spec.ties)]
    ends = world.ends(at)
    place = {number: n for n, number in enumerate(world.numbers.tolist())}
    row = {seed: n for n, seed in enumerate(seeds)}
    cells = [
        np.array([row[s] * len(place) + place[e] for e, s in part.due.episodes], dtype=int) for part in parts
    ]
    nats = np.concatenate([_nats(run, part) for part in parts])
    flagged, first = _flagged(parts, len(place), place)
    means = mean_by_place(nats, np.concatenate(cells), len(seeds) * len(place)).reshape(len(seeds), -1)
    means[np.isnan(ends["success_rate"])] = np.nan  # left out
    return Cell(*of, ends["success_rate"], ends["unsafe_rate"], means, flagged, first)


def _nats(run: ReplayedRun, part: Decided[Scene]) -> Floats:
    """-ln of what each decision's policy gives to safe actions, (n,); NaN where none is safe."""
    forest = run.dataset.forest
    at = np.array([forest.place[scene.id] for scene in part.moments])[part.due.at]
    return negative_log_likelihood(part.result.fused, forest.safe[at])


def _flagged(
    parts: Sequence[Decided[Scene]], episodes: int, place: Mapping[int, int]
) -> tuple[Floats | None, tuple[int, ...]]:
    counts = np.zeros((4, episodes))
    heard: dict[tuple[int, int, int], int] = {}
    first: dict[tuple[int, int, int], int] = {}
    judged = False
    for part in parts:
        trust, attackers = part.result.trust, part.said.attackers
        for n, h in zip(*np.nonzero(~np.isnan(trust)), strict=True):
            judged = True
            who = (*part.due.episodes[n], int(h))
            suspect, attacks = bool(trust[n, h] < TRUSTED), bool(attackers[n, h])
            counts[(0 if suspect else 1) if attacks else (2 if suspect else 3), place[who[0]]] += 1
            if attacks:
                heard[who] = heard.get(who, 0) + 1
                if suspect:
                    first.setdefault(who, heard[who])
    return (counts if judged else None), tuple(first.get(who, 0) for who in heard)


@dataclass(frozen=True)
class Bench:
    """All cells of a study."""

    name: str  # of the run
    source: str  # its dataset
    condition: str  # the operating point that is attacked
    seeds: tuple[int, ...]  # of the channel
    cells: Mapping[tuple[str, str, float], Cell]  # by rule, attack and share
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
        """A cell."""
        return self.cells[rule, attack, share]

    def success(self, *of: Any) -> Estimate:
        """Success, over episodes."""
        return over_episodes(SUCCESS, self.at(*of).success)

    def price(self, rule: str) -> Estimate:
        """What a rule costs while nobody attacks: its success less the linear pool's, paired."""
        return difference(SUCCESS, self.at(rule).success.T, self.at(BASE).success.T)

    def loss(self, rule: str, attack: str, share: float) -> Estimate:
        """What an attack takes from a rule: success under it less success in peace, paired."""
        return difference(SUCCESS, self.at(rule, attack, share).success.T, self.at(rule).success.T)

    @cached_property
    def holm(self) -> Mapping[tuple[str, str, float], float]:
        """P of no difference to the linear pool under the same attack, by Holm's method over the grid."""
        places = [of for of in self.cells if of[0] != BASE and of[1] not in (PEACE, EXCLUDED)]
        p_values = {
            of: p
            for of in places
            if (p := p_value(SUCCESS, self.cells[of].success.T, self.at(BASE, *of[1:]).success.T)) is not None
        }
        return dict(zip(p_values, holm(list(p_values.values())), strict=True))

    def clear(self, *of: Any) -> bool:
        """Whether a rule differs from the linear pool under an attack by more than chance explains."""
        return self.holm.get(of, 1.0) <= LEVEL

    def worst(self, rule: str, share: float) -> str:
        """The attack under which it succeeds least."""
        return min(self.attacks, key=lambda attack: self.success(rule, attack, share).value)

    def mean(self, rule: str, share: float) -> Estimate:
        """Success as a mean over all attacks, over episodes."""
        each = [self.at(rule, attack, share).success for attack in self.attacks]
        return over_episodes(SUCCESS, np.mean(each, axis=0))


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
    if point.attack or EGO_PROMPT in rules:
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
        run.manifest(), str(run.run.manifest.identity), asdict(point), list(seeds), versions(),
        code_sha256("**/*.py"),
    ]  # fmt: skip
    kept, cells = Cells(out / "cells.jsonl", digest(depends_on)), dict[tuple[str, str, float], Cell]()
    more(len(every))
    for rule, attack, share in every:
        key = rule, attack, share
        if values := kept.get(*key):
            first, flagged = values.pop("first"), values.pop("flagged")
            success, unsafe, nats = (np.array(values[k], dtype=float) for k in ("success", "unsafe", "nats"))
            judged = None if flagged is None else np.array(flagged, dtype=float)
            cell = Cell(rule, attack, share, success, unsafe, nats, judged, tuple(first))
        else:
            cell = play(run, point, seeds, key)
            run.settle()
            kept.add(key, **{k: v for k, v in vars(cell).items() if k not in ("rule", "attack", "share")})
        cells[key] = cell
        progress(1)
    never = FrozenWorld(run.dataset, [alone := OperatingPoint("never asks", None)], seeds)
    for _ in walk(never, [alone], run.asked_in(never, [alone]), run.spec.ties):
        pass
    run.settle()
    caveats = tuple(text for text in (run.lost, run.left_out and run.leaves_out) if text)
    success = never.ends(alone)["success_rate"]
    return Bench(run.name, run.run.source, condition, tuple(seeds), cells, success, caveats)
