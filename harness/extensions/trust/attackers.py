"""Draw the attackers of a condition, and return what the ego then hears.

Attackers are drawn once for each seed of the channel and layout. So every rule, prompt and model
faces the same ones, in frozen scenes, sweeps and the closed loop. Where several agents decide, they
are those whom the ego faces where it alone decides: each is one vehicle that attacks whoever asks,
and the ego attacks nobody.
"""

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import lru_cache
from typing import Any

import numpy as np

from harness.coordination.intents import OF_EGO, WITH_EGO, Intents
from harness.coordination.sent import SentIntents
from harness.core import noise
from harness.core.arrays import Bools, Floats, Ints, check_distributions, check_shape, read_only
from harness.core.errors import UserError
from harness.core.strangers import is_ours, label, worded
from harness.evaluate.draws import OF_ANOTHER_AGENT
from harness.extensions.trust.attacks import Attack, Turn, attackers
from harness.radio.channel import Draws
from harness.radio.fading import Trips


class Attackers:
    """Play the attackers of one condition: helpers that send something else than they intend.

    A condition is an operating point: settings of radio, asking and fusion. It is made from the
    attacks, in the order in which they act, and remembers what helpers intended at past steps,
    which some attacks repeat. It is a `Speaker`, which says what helpers send.
    """

    def __init__(self, attacks: Sequence[Attack]) -> None:
        self._attacks = attacks
        steps = max((attack.steps for attack in attacks), default=0)
        self._memory = _Memory(steps)

    def said(self, truth: Intents, draws: Draws, episode: Ints, seed: Ints) -> SentIntents:
        """Return what every vehicle sends in n decisions of one step, after the attacks.

        Args:
            truth: what the vehicles truly intend (their probabilities of actions), for n decisions.
            draws: the channel's random numbers, for the same decisions.
            episode: number of each decision's episode, `(n,)`.
            seed: channel seed of each decision, `(n,)`.

        Raises UserError if the world has no layouts (drawn start situations), by which attackers
        are drawn.
        """
        episodes = list(zip(episode.tolist(), seed.tolist(), strict=True))
        if draws.trips is None:
            raise UserError(
                "attacks need layouts, and the paper's study has none; leave attack out"
            )
        uniforms = _uniforms(draws.trips, draws.numbers)
        of_step = _of_helpers(uniforms[..., 1], draws.trips)
        first, past = self._memory.recall(truth.helpers, draws.numbers, episodes)
        sent = truth
        attacking = np.zeros(truth.valid.shape, dtype=bool)
        for attack in self._attacks:
            drawn = _drawn(attack.share, truth, draws.trips, uniforms)
            turn = Turn(truth, drawn, first, past, of_step)
            sent = _acted(attack, sent, turn)
            attacking |= drawn
        if sent.voice_of is None:
            return SentIntents(sent, draws, attacking)
        voices = np.take_along_axis(attacking, sent.voice_of, axis=-1)
        return SentIntents(sent, draws.of_helpers(sent.voice_of), voices)


class _Memory:
    """What helpers intended at the first step of each play of an episode, and at its last K.

    Helpers are known by their numbers in the episode.
    """

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._rows: dict[tuple[int, int], int] = {}
        # of each row the first intents, then those of K past steps, the last one first
        self._intended = np.empty((0, 1 + steps, 0, 0))
        self._helpers = np.empty(0, dtype=int)  # how many there were at the first step

    def recall(
        self, intents: Floats, numbers: Ints, episodes: Sequence[tuple[int, int]]
    ) -> tuple[Floats, Floats]:
        """Return the first intents (n, H, A) and those of K past steps (n, K, H, A);
        NaN without a step. Those of this step, `intents` of helpers with `numbers` (n, H), are
        remembered.
        """
        rows = np.array([self._rows.setdefault(place, len(self._rows)) for place in episodes], int)
        self._grow(int(numbers.max(initial=-1)) + 1, intents.shape[2])
        intended, row = self._intended[rows], rows[:, None]
        of_helpers = np.take_along_axis(intended, numbers[:, None, :, None], axis=2)
        was_there = numbers < self._helpers[row]
        first = np.where(was_there[..., None], of_helpers[:, 0], intents)
        if self._steps:
            self._intended[rows, 2:] = intended[:, 1:-1]
            self._intended[rows, 1] = np.nan
            self._intended[row, 1, numbers] = intents
        new = self._helpers[rows] == 0
        self._intended[row[new], 0, numbers[new]] = intents[new]
        self._helpers[rows[new]] = intents.shape[1]
        return first, of_helpers[:, 1:]

    def _grow(self, helpers: int, actions: int) -> None:
        rows, _, most, _ = self._intended.shape
        shape = len(self._rows), 1 + self._steps, max(most, helpers), actions
        if shape != self._intended.shape:
            intended = np.full(shape, np.nan)
            intended[:rows, :, :most] = self._intended if rows else np.nan
            self._intended = intended
            self._helpers = np.append(self._helpers, np.zeros(shape[0] - rows, dtype=int))


def attackers_among(share: float, truth: Intents, draws: Draws) -> Bools:
    """Return which of H helpers attack in n decisions, `(n, H)`, of a share of those present.

    `truth` says who is present, and `draws` have the keys of the channel's random numbers. The
    same helpers attack in all decisions of an episode, as long as the same are present.
    """
    assert draws.trips is not None
    return _drawn(share, truth, draws.trips, _uniforms(draws.trips, draws.numbers))


def _drawn(share: float, truth: Intents, trips: Trips, uniforms: Floats) -> Bools:
    drawn = attackers(share, np.isfinite(truth.range_m), uniforms[..., 0])
    return np.asarray(_of_helpers(drawn, trips))


def _acted(attack: Attack, sent: Intents, turn: Turn) -> Intents:
    """Let an attack act. A package's cannot write to what it gets,
    and says only what a message can hold.

    Raises UserError if it fails, changes what is not an attacker's,
    or lets a voice say no distribution.
    """
    if is_ours(attack):
        return attack.act(sent, turn)
    with worded(label("attack", attack)):
        after = attack.act(read_only(sent), read_only(turn))
        if after.claims and sent.claims:  # the map is nobody's claim
            claims = replace(after.claims, from_road_m=sent.claims.from_road_m)
            after = replace(after, claims=claims)
        if after.voice_of is None:
            site, outlook, plans = sent.site, sent.outlook, sent.plans
            after = replace(after, site=site, outlook=outlook, plans=plans, numbers=sent.numbers)
            _refuse_of_others(sent, after, turn.attackers)
        else:
            check_shape("voices", after.voice_of, after.helpers.shape[:2])
            if np.any((after.voice_of < 0) | (after.voice_of >= sent.helpers.shape[1])):
                raise ValueError("a voice of nobody who is there")
            if sent.voice_of is None:
                after = _with_honest_voices(sent, after, turn.attackers)
        intents = sent.helpers
        if after.voice_of is not None:
            intents = np.take_along_axis(intents, after.voice_of[..., None], axis=1)
        # whose model was not asked, as of lists of objects, says nothing that could be one
        answered = after.valid & ~np.isnan(intents).any(axis=-1)
        check_distributions("intents", after.helpers, answered)
        if not np.array_equal(after.own, sent.own, equal_nan=True):
            raise ValueError("it changes the ego's own intent")
    return after


def _with_honest_voices(sent: Intents, after: Intents, attackers: Bools) -> Intents:
    """Return the voices that an attack added to, where those of honest helpers are as they were.

    Raises ValueError if it changes, leaves out or doubles one.
    """
    voice_of = after.voice_of
    assert voice_of is not None
    before = replace(sent.of_helpers(voice_of), voice_of=voice_of)
    site, outlook, plans = before.site, before.outlook, before.plans
    after = replace(after, site=site, outlook=outlook, plans=plans, numbers=before.numbers)
    present = np.isfinite(after.range_m)
    honest = present & ~np.take_along_axis(attackers, voice_of, axis=1)
    _refuse_of_others(before, after, ~honest)
    for owners, is_honest, attack, range_m in zip(
        voice_of, honest, attackers, sent.range_m, strict=True
    ):
        expected = np.flatnonzero(~attack & np.isfinite(range_m))
        if not np.array_equal(np.sort(owners[is_honest]), expected):
            raise ValueError("a helper that is no attacker has no voice, or more than one")
    return after


def _refuse_of_others(sent: Intents, after: Intents, attackers: Bools) -> None:
    """Raise ValueError if an attack changes what is the ego's,
    or a helper's that is no attacker.
    """
    nobody = np.zeros(attackers.shape, dtype=bool)
    before, now = ({"silent": nobody, **each.arrays(), **_claimed(each)} for each in (sent, after))
    if changed := sorted(before.keys() ^ now.keys()):
        raise ValueError(f"it adds or leaves out {', '.join(changed)}")
    for name, values in now.items():
        check_shape("intents" if name == "helpers" else name, values, before[name].shape)
        if values.dtype.kind not in ("b" if before[name].dtype == bool else "iuf"):
            raise ValueError(f"{name} of type {values.dtype}, not {before[name].dtype}")
        others = (
            ~np.insert(attackers, 0, False, axis=1) if name in (*WITH_EGO, "xy_m") else ~attackers
        )
        if name in (*OF_EGO, "time_s", "error_m"):
            others = np.ones(len(attackers), dtype=bool)
        if not np.array_equal(values[others], before[name][others], equal_nan=True):
            raise ValueError(f"it changes {name} of the ego, or of a helper that is no attacker")


def _claimed(intents: Intents) -> dict[str, Any]:
    """Return the arrays of what helpers claim, by name."""
    claims, arrays = intents.claims, dict[str, Any]()
    if claims is None:
        return arrays
    for field in fields(claims):
        value = getattr(claims, field.name)
        if isinstance(value, np.ndarray):
            arrays[field.name] = value
    return arrays


def _uniforms(trips: Trips, numbers: Ints) -> Floats:
    """Return two draws for each helper of the ego, one of the episode and one of the step,
    (n, H, 2).
    """
    most = int(numbers.max(initial=-1)) + 1
    keys = zip(trips.seed.tolist(), (trips.layout_seed % OF_ANOTHER_AGENT).tolist(), strict=True)
    uniforms = np.array(
        [_helper_uniforms(seed, layout, trips.steps, most) for seed, layout in keys]
    )
    uniforms = np.take_along_axis(uniforms, numbers[..., None], axis=1)
    of_step = uniforms[np.arange(len(uniforms)), :, 1 + trips.step]
    return np.stack([uniforms[..., 0], of_step], axis=-1)


def _of_helpers(values: Any, trips: Trips) -> Any:
    """Return values (n, H) of the ego's helpers as those of who decides,
    whose first helper is the ego.

    Of the ego itself they are 0, or False.
    """
    agent, helper = trips.layout_seed[:, None] // OF_ANOTHER_AGENT, np.arange(values.shape[1])
    if not agent.any():
        return values
    of_helpers = np.take_along_axis(
        values, np.where((helper < agent) & (helper > 0), helper - 1, helper), axis=1
    )
    return np.where((agent > 0) & (helper == 0), 0, of_helpers).astype(values.dtype)


# The draws of one helper follow those of another, so more helpers in a batch change no earlier
# draw.
@lru_cache(maxsize=1 << 14)
def _helper_uniforms(seed: int, layout_seed: int, steps: int, helpers: int) -> Floats:
    return noise.uniforms((helpers, 1 + steps), "attackers", seed, layout_seed)
