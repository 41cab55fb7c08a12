"""Play the strongest lies against consensus rules, and count the liars that a scene withstands."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, combinations

import numpy as np

from harness.coordination.intents import Intents
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.rules import RULES
from harness.coordination.trust import Trust
from harness.core.arrays import Bools, Floats
from harness.evaluate.walk import walk
from harness.extensions.trust.attackers import attackers_among
from harness.extensions.trust.attacks import Jump, Spoof, attacks_of
from harness.extensions.trust.lies import CLAIMS, PLACES, VOICES, WORDS
from harness.extensions.trust.worst import Courses, Search
from harness.radio.channel import Draws
from harness.studies.replayed_run import ReplayedRun

MOST = 2  # liars of whom every choice is tried, if there are few
MOST_CHOICES = 20  # sets of liars that are tried
UNHARMED, BOUND = "unharmed", "bound"  # names of searches


@dataclass(frozen=True)
class StrongestLies:
    """Hold what the strongest lies do to one consensus rule, for S channel seeds and E episodes.

    Words alone, from a true place, are one space of lies; in the others liars also claim false
    places, or to be several (`lies.CLAIMS`). Arrays are (S, E).
    """

    success: Mapping[str, Floats]  # which episodes still succeed, 1 or 0, by the space of lies
    unsafe: Floats  # which episodes end unsafely by words that are to do this, 1 or 0
    # which episodes succeed whatever liars say; less than what lies leave for the rule `trust`
    # alone, with which not every lie is tried
    at_least: Floats
    # how many liars it takes to lose an episode by words, if they are the right ones: 0 if it is
    # lost without; one more than are tried if these do not suffice
    liars: Floats

    def values(self) -> dict[str, Floats]:
        """Return the arrays by name, flat."""
        names = ("unsafe", "at_least", "liars")
        return {**self.success, **{name: getattr(self, name) for name in names}}

    @classmethod
    def of(cls, values: Mapping[str, Floats]) -> "StrongestLies":
        """Return the worst case whose `values` these are."""
        success = {space: values[space] for space in CLAIMS}
        return cls(success, values["unsafe"], values["at_least"], values["liars"])


def space_of(attack: str) -> str:
    """Return which space of lies an attack such as `liar+spoof` is in, a key of `lies.CLAIMS`."""
    attacks = attacks_of(attack)
    if any(each.adds for each in attacks):
        return VOICES
    return PLACES if any(isinstance(each, (Spoof, Jump)) for each in attacks) else WORDS


def strongest_lies(
    run: ReplayedRun, point: OperatingPoint, share: float, seeds: Sequence[int]
) -> StrongestLies:
    """Find the lies that do most harm under a condition, on a run's episodes.

    The condition, `point`, has no attack; `share` is that of the helpers that lie, and `seeds` are
    those of the channel. The run's model is asked in all scenes that lies lead to.
    """
    searches = dict[str, Search]()
    for name, search in _searches(run, point, share):
        searches[name] = replace(search, point=point.changed(name=name))
    courses = Courses(run.dataset, list(searches.values()), seeds, run.spec.ties)
    conditions = [search.point for search in searches.values()]
    for _ in walk(courses, conditions, run, run.spec.ties):
        pass
    lost, success = courses.lost, {}
    any_lie = np.zeros_like(lost[UNHARMED])
    for space, claims in CLAIMS.items():
        for each in claims:
            any_lie = any_lie | lost[_name(each)]
        success[space] = 1.0 - any_lie
    at_least = 1.0 - lost[BOUND] if BOUND in lost else success[WORDS]
    choices = _choices(run.vehicles - 1)
    liars = np.full(any_lie.shape, 1.0 + max(len(chosen) for chosen in choices))
    for chosen in reversed(choices):
        liars[lost[_name(chosen)]] = len(chosen)
    return StrongestLies(success, lost[UNHARMED].astype(float), at_least, liars)


def _searches(
    run: ReplayedRun, point: OperatingPoint, share: float
) -> Iterator[tuple[str, Search]]:
    forest, liars = run.dataset.forest, partial(attackers_among, share)
    succeeds, unharmed = forest.safe, forest.avoids_harm
    if run.dataset.scenario.parameters.limits == 1:  # of old datasets, where each failure is unsafe
        unharmed = np.isfinite(forest.earliest_s)
    for claims in chain(*CLAIMS.values()):
        yield _name(claims), Search(point, liars, succeeds, claims)
    yield UNHARMED, Search(point, liars, unharmed)
    if isinstance(RULES[point.fusion.consensus], Trust):
        yield BOUND, Search(point, liars, succeeds, bounds=True)
    for chosen in _choices(run.vehicles - 1):
        yield _name(chosen), Search(point, partial(_named, chosen), succeeds)


def _name(liars: str | tuple[int, ...]) -> str:
    """Return the name of a search that is to end success: by what is claimed, or by who lies."""
    return f"success · {liars}"


def _choices(helpers: int) -> list[tuple[int, ...]]:
    """Return the sets of liars that are tried: none, each helper, each pair if there are few."""
    choices = list[tuple[int, ...]]()
    for count in range(MOST + 1):
        more = list(combinations(range(helpers), count))
        if len(choices) + len(more) <= MOST_CHOICES:
            choices += more
    return choices


def _named(chosen: Sequence[int], truth: Intents, draws: Draws) -> Bools:
    liars = np.zeros(truth.valid.shape, dtype=bool)
    liars[:, list(chosen)] = True
    return liars & np.isfinite(truth.range_m)
