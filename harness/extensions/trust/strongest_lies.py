"""Play the strongest lies against consensus rules, and count the liars that a scene withstands."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from harness.coordination.intents import Intents
from harness.coordination.operating_point import OperatingPoint
from harness.core.arrays import Bools, Floats
from harness.evaluate.walk import walk
from harness.extensions.trust.attackers import attackers_among
from harness.extensions.trust.attacks import Jump, Spoof, attacks_of
from harness.extensions.trust.lies import (
    CLAIMS,
    PLACES,
    VOICES,
    WORDS,
    is_certainty_enough,
    is_likeliest_taken,
)
from harness.extensions.trust.worst import TRUST, Courses, Search
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

    # which episodes still succeed, 1 or 0, by the space of lies; of words alone where the ego's
    # model reads messages
    success: Mapping[str, Floats]
    unsafe: Floats  # which episodes end unsafely by words that are to do this, 1 or 0
    # how many liars it takes to lose an episode by words, if they are the right ones: 0 if it is
    # lost without; one more than are tried if these do not suffice
    liars: Floats
    # which episodes succeed whatever liars say; less than what lies leave for the rule `trust`
    # alone, with which not every lie is tried. None where that is not known
    at_least: Floats | None

    def values(self) -> dict[str, Floats]:
        """Return the arrays by name, flat."""
        values = {**self.success, "unsafe": self.unsafe, "liars": self.liars}
        return values if self.at_least is None else {**values, "at_least": self.at_least}

    def with_lie(self, space: str, success: Floats, unsafe: Floats, liars: int) -> "StrongestLies":
        """Return what lies do of which one more, of a space of lies, was played.

        It leaves the episodes in `success`, (S, E), 1 or 0, ends those in `unsafe` unsafely, and
        is of up to so many `liars`. A lie of a space belongs to wider ones, too.
        """
        wider = list(CLAIMS)[list(CLAIMS).index(space) :]
        left = dict(self.success)
        for each in wider:
            if each in left:
                left[each] = np.fmin(left[each], success)
        if space != WORDS:
            return replace(self, success=left)
        takes = np.where(success == 0, np.minimum(self.liars, liars), self.liars)
        at_least = None if self.at_least is None else np.fmin(self.at_least, success)
        return StrongestLies(left, np.fmax(self.unsafe, unsafe), takes, at_least)

    @classmethod
    def of(cls, values: Mapping[str, Floats]) -> "StrongestLies":
        """Return the strongest lies whose `values` these are."""
        success = {space: values[space] for space in CLAIMS if space in values}
        return cls(success, values["unsafe"], values["liars"], values.get("at_least"))


def space_of(attack: str) -> str:
    """Return which space of lies an attack such as `liar+spoof` is in, a key of `lies.CLAIMS`."""
    attacks = attacks_of(attack)
    if any(each.adds and not each.in_objects for each in attacks):
        return VOICES
    return PLACES if any(isinstance(each, (Spoof, Jump)) for each in attacks) else WORDS


def why_not_searched(point: OperatingPoint) -> str:
    """Return why no strongest lie is looked for under a condition, in words; empty if it is."""
    if point.stream is not None:
        return "messages come unasked"
    if point.elsewhere is not None:
        return "messages come from other scenes"
    return "what helpers say decides who is heard" if point.radio.helper_rounds else ""


def strongest_lies(
    run: ReplayedRun, point: OperatingPoint, share: float, seeds: Sequence[int]
) -> StrongestLies | None:
    """Find the lies that do most harm under a condition, on a run's episodes.

    None for a rule of a package that has memory, of which not all can be followed.

    The condition, `point`, has no attack; `share` is that of the helpers that lie, and `seeds` are
    those of the channel. The run's model is asked in all scenes that lies lead to.
    """
    searches = dict[str, Search]()
    for name, search in _searches(run, point, share):
        searches[name] = replace(search, point=point.changed(name=name))
    conditions = [search.point for search in searches.values()]
    run.check(conditions)
    courses = Courses(run.dataset, list(searches.values()), seeds, run.spec.ties, run)
    for _ in walk(courses, conditions, run, run.spec.ties):
        pass
    if courses.unsearchable:
        return None
    lost, success = courses.lost, {}
    any_lie = np.zeros_like(lost[UNHARMED])
    for space in _spaces(point):
        for each in CLAIMS[space]:
            any_lie = any_lie | lost[_name(each)]
        success[space] = 1.0 - any_lie
    is_exact = is_certainty_enough(point) and not point.has_fusion_call
    at_least = success[WORDS] if is_exact else None
    if BOUND in lost:
        at_least = 1.0 - lost[BOUND]
    choices = _choices(run.vehicles - 1)
    liars = np.full(any_lie.shape, 1.0 + max(len(chosen) for chosen in choices))
    for chosen in reversed(choices):
        liars[lost[_name(chosen)]] = len(chosen)
    return StrongestLies(success, lost[UNHARMED].astype(float), liars, at_least)


def _searches(
    run: ReplayedRun, point: OperatingPoint, share: float
) -> Iterator[tuple[str, Search]]:
    forest, liars = run.dataset.forest, partial(attackers_among, share)
    succeeds, unharmed = forest.safe, forest.avoids_harm
    if run.dataset.scenario.parameters.limits == 1:  # of old datasets, where each failure is unsafe
        unharmed = np.isfinite(forest.earliest_s)
    for space in _spaces(point):
        for claims in CLAIMS[space]:
            yield _name(claims), Search(point, liars, succeeds, claims)
    yield UNHARMED, Search(point, liars, unharmed)
    is_arithmetic = not point.has_fusion_call and is_likeliest_taken(point)
    if point.fusion.consensus == TRUST and is_arithmetic:
        yield BOUND, Search(point, liars, succeeds, bounds=True)
    for chosen in _choices(run.vehicles - 1):
        yield _name(chosen), Search(point, partial(_named, chosen), succeeds)


def _spaces(point: OperatingPoint) -> list[str]:
    """Return the spaces of lies that are searched: of words alone, where a model reads messages."""
    return [WORDS] if point.has_fusion_call else list(CLAIMS)


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
    return np.isin(draws.numbers, chosen) & np.isfinite(truth.range_m)
