"""How every consensus rule fares under every attack, cell by cell, and what differs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from harness.core import noise
from harness.core.arrays import Floats, Ints
from harness.core.multiplicity import LEVEL
from harness.core.statistics import Estimate, resampled, resampled_estimate
from harness.extensions.trust.strongest_lies import StrongestLies
from harness.runs.success import Success
from harness.studies.study import corrected

RESAMPLES = 2000
Key = tuple[str, str, float]  # rule, attack, share
PEACE, EXCLUDED = "", "absent"
BASE = "linear"


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
