"""The calibrated proxy: intents in the paper's occluded intersection,
by mechanism and not by panel.

The story of an episode. A danger comes from one of three approaches, and the ego cannot see it. The
ego guesses, and in some episodes guesses wrong; whoever sees the approach, the witness, knows,
except in the episodes that nobody reads rightly. Helper h watches approach h; the nearest helper
watches the likeliest one, and helpers past the third watch nothing new. The other helpers share the
ego's guess. Once the ego has fused the witness's message it keeps what it learnt, though not its
certainty: it goes on asking. Decisions before the last leave time to mend them; the last one
decides.

The intents go through trigger, channel, consensus and scoring like any model's.

What decides success is drawn stratified. Every seed has each kind of episode, by where the danger
comes from and who reads it rightly, in its share to within one, and each link's luck is spread
evenly over each kind.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from operator import attrgetter
from typing import Any

import numpy as np

from harness.coordination.intents import Intents
from harness.coordination.operating_point import OperatingPoint
from harness.core import noise
from harness.core.arrays import Bools, Floats, Ints, any_of
from harness.core.quantiles import normal_quantile, normal_share
from harness.evaluate.walk import Decided, Due
from harness.radio.channel import Draws
from harness.studies.axes import Setting
from harness.studies.play import WalkResult, walk_through

VERSION = "3"
ACTIONS = 3
CUT = 2.45  # standard deviations either side; .70 to .946 nats for the ego
STEPS = 6  # decisions an episode: 18 messages are three replies each
CHUNK = 2000  # episodes that are played together

# Declared geometry, metres. The witness stands beside the conflict, so that Equation 2 hears it
# best.
EGO_M, WITNESS_M, OTHERS_M = 25.0, 6.0, 20.0
FIRST_RANGE_M, RANGE_STEP_M = 15.0, 10.0
PAYLOAD_BITS = 800.0  # declared: an intent, a position and a few words
TIES = "first"  # no two actions that these intents lead to are alike


@dataclass(frozen=True)
class Parameters:
    """Hold the parameters of the calibrated proxy, which draws intents in place of a model.

    An intent is a vehicle's probabilities of the ego's actions; the danger is the vehicle that the
    ego would meet if it drove on. Entropies of intents are in nats. All numbers are computed by
    `fit.py` from results that the SwarmDrive paper states; none depends on what the paper's study
    varies.
    """

    # share of episodes whose danger comes from the approach that the nearest helper watches
    left_share: float = 0.406
    right_share: float = 0.282  # the same for the second helper; the rest comes from the third's
    # share of episodes in which an ego that does not see the danger intends rightly
    guess_right: float = 0.689
    # share of episodes in which one that does see it intends rightly, `guess_right` or more
    know_right: float = 0.953
    ego_nats: float = 0.823  # mean entropy of the ego's intent
    ego_sd_nats: float = 0.0502  # its standard deviation over decisions
    others_nats: float = 0.625  # mean entropy of a helper that sees no danger
    others_sd_nats: float = 0.01  # its standard deviation
    witness_nats: float = 0.45  # entropy of the helper that sees the danger
    inference_s: float = 0.145  # seconds of one inference


# Every number that was chosen with rows of the paper (`paper_numbers.csv`) in sight, and those
# rows.
FITTED_ON: Mapping[str, tuple[str, ...]] = {
    "left_share": ("B2", "B6"),
    "right_share": ("B3",),
    "guess_right": ("A3",),
    "know_right": ("B9",),
    "ego_nats": ("A10", "A11", "B16", "B18"),  # all decisions are above .7 nats
    "ego_sd_nats": ("A10", "A11", "B16", "B18"),
    "others_nats": ("B13", "B15"),  # no helper is above .65 nats, and all are above .6
    "others_sd_nats": ("B13", "B15"),
    "witness_nats": ("B15",),
    "inference_s": ("A2",),
    "CUT (harness/extensions/paper/calibrated.py)": ("B20",),  # no decision is above .95 nats
    "STEPS (harness/extensions/paper/calibrated.py)": ("A8", "A9"),
    # the witness decides
    "WITNESS_M, EGO_M, OTHERS_M (harness/extensions/paper/calibrated.py)": ("B9",),
    "6g jitter (harness/radio/profiles.py)": ("A6",),
    "density-coupled loss (harness/radio/constant.py)": ("B6", "B7", "B8"),
}


@dataclass(frozen=True)
class _Drawn:
    """E episodes of S decisions as n = E x S rows; H helpers."""

    right: Ints  # the action that is right in each row's episode, (n,)
    intents: Intents  # what every vehicle intends, the ego as long as it guesses
    knowing: Floats  # the ego's intent once it has heard the witness, (n, A)
    witness: Bools  # which helper sees the danger, (n, H)
    draws: Draws  # of the channel; a link is up or down for a whole episode

    def step(self, number: int) -> "_Drawn":
        """Return the rows of one step."""
        at = np.arange(number, len(self.right), STEPS)
        return _Drawn(
            self.right[at],
            self.intents.take(at),
            self.knowing[at],
            self.witness[at],
            self.draws.take(at),
        )

    def nearest(self, helpers: int) -> "_Drawn":
        """Return the same with only the first helpers, whose draws no other moves."""
        draws = Draws(self.draws.link[:, :helpers], self.draws.jitter[:, :helpers])
        return replace(
            self,
            intents=self.intents.of_first(helpers),
            witness=self.witness[:, :helpers],
            draws=draws,
        )


def _below(parts: Sequence[_Drawn]) -> _Drawn:
    """Return drawn parts, one below the other."""

    def joint(name: str) -> Any:
        return np.concatenate([attrgetter(name)(part) for part in parts])

    return _Drawn(
        joint("right"),
        Intents.joined([part.intents for part in parts]),
        joint("knowing"),
        joint("witness"),
        Draws(joint("draws.link"), joint("draws.jitter")),
    )


class CalibratedWorld:
    """Play drawn episodes as a world: all decisions of one step, of all episodes at once.

    There is no simulator: what vehicles intend is drawn at random by fitted parameters. Episodes of
    all channel seeds are in one row, the first seed's first, and an episode is known by its index
    in it. The danger is the vehicle that the ego would meet. An ego that has fused the message of
    the witness (the helper that sees the danger) knows of it from its next decision on. The last
    decision of an episode decides its success.
    """

    def __init__(self, steps: Sequence[_Drawn], seeds: Sequence[int], numbers: Ints) -> None:
        # of all seeds, one below the other, with as many episodes each as `numbers`
        self._steps = steps
        self._seed, self._episode = np.repeat(seeds, len(numbers)), np.tile(numbers, len(seeds))
        self._step = -1
        self._knows = np.zeros(len(self._seed), dtype=bool)
        self.success: Bools = self._knows

    def observe(self) -> Sequence[int]:
        """Begin the next step of all episodes; return their indices, none after the last step.

        A step is one decision of each episode.
        """
        self._step += 1
        if self._step == STEPS:
            return ()
        self._now = self._steps[self._step]
        return range(len(self._knows))

    def __call__(self, decision_points: Sequence[int]) -> Intents:
        """Return the intents of all vehicles at this step, in every episode.

        The decision points are not read: all intents are drawn.
        """
        ego_intents = np.where(self._knows[:, None], self._now.knowing, self._now.intents.own)
        return replace(self._now.intents, own=ego_intents)

    def others(self, *_: Any, **__: Any) -> Any:
        """Raise NotImplementedError, as no model can be asked here: all intents are drawn.

        It stands in for the methods of a world by which models would be asked, whatever their
        arguments. An intent is a vehicle's probabilities of actions.
        """
        raise NotImplementedError

    helpers = streamed = fusion_call = call_of_agents = others

    def due(self, point: OperatingPoint) -> Due:
        """Return the decisions of this step, one in every episode, with the channel's random draws.

        All operating points (settings of radio, asking and fusion) have the same; `point` is not
        read.
        """
        return Due(np.arange(len(self._knows)), self._episode, self._seed, self._now.draws)

    def outlook(self, *_: Any) -> None:
        """Return None: vehicles of this study have no positions, see nothing and claim nothing.

        It stands in for the methods of a world by which positions and sights are asked for,
        whatever their arguments.
        """

    site = claims = plans = listed = outlook

    def step(self, decided: Sequence[Decided[int]]) -> None:
        """Update which egos know of the danger, and whether each episode's last action is right.

        The danger is the vehicle that a cruising ego would meet. `decided` has the one batch of
        this step's decisions, of all episodes.
        """
        [part] = decided
        self._knows = self._knows | any_of(part.result.on_time & self._now.witness)
        self.success = part.result.action == self._now.right


class Calibrated:
    """Play operating points with the calibrated proxy, as a source of results for studies.

    An operating point is the settings of radio, asking and fusion. The proxy stands for a model: it
    draws intents (probabilities of actions) by parameters fitted to numbers of the SwarmDrive
    paper.

    Attributes:
        name: what reports call it.
        same_episodes: false, since each seed has episodes of its own.
        episodes: number of episodes of each seed.
        parameters: what intents are drawn by.
    """

    name = "calibrated proxy"
    same_episodes = False

    def __init__(self, episodes: int, parameters: Parameters | None = None) -> None:
        self.parameters = parameters or Parameters()
        self.episodes = episodes
        # all points of a panel have the same draws
        self._of_seeds = lru_cache(maxsize=2)(self._drawn)

    def manifest(self) -> dict[str, Any]:
        """Return as plain values by what intents (probabilities of actions) are drawn, for records.

        It has the version of the proxy (a rule in place of a model), its parameters, and the rows
        of the paper's numbers that it was fitted on.
        """
        rows = sorted({row for rows in FITTED_ON.values() for row in rows})
        return {
            "proxy_model_version": VERSION,
            "calibration_label": f"fitted on rows {', '.join(rows)} of the "
            "paper; all others are predictions",
            "parameters": asdict(self.parameters),
            "fitted_on": {name: list(rows) for name, rows in FITTED_ON.items()},
            "episodes_per_seed": self.episodes,
        }

    def walked(
        self, settings: Sequence[Setting], seeds: Sequence[int]
    ) -> Iterator[Iterable[WalkResult]]:
        """Yield the results of each grid point with all channel seeds, in chunks of some episodes.

        A grid point is an operating point (settings of radio, asking and fusion) with a number of
        vehicles. A chunk has at most `CHUNK` episodes of each seed: who decided what, and how the
        episodes ended.
        """
        most = max((setting.vehicles for setting in settings), default=1) - 1
        for setting in settings:
            yield self._walked(setting, most, seeds)

    def _walked(self, setting: Setting, most: int, seeds: Sequence[int]) -> Iterator[WalkResult]:
        for first in range(0, self.episodes, CHUNK):
            numbers = first + np.arange(min(CHUNK, self.episodes - first))
            steps = self._of_seeds(tuple(seeds), most, first)
            if setting.vehicles <= most:
                steps = [step.nearest(setting.vehicles - 1) for step in steps]
            world = CalibratedWorld(steps, seeds, numbers)
            [(columns, places)] = walk_through(world, [setting.point], world, seeds, numbers, TIES)
            success = world.success.reshape(len(seeds), len(numbers)).astype(float)
            ends = {
                "success_rate": success,
                "unsafe_rate": 1.0 - success,
                "late_rate": np.zeros_like(success),
            }
            yield WalkResult(numbers, ends, columns, places)

    def _drawn(self, seeds: tuple[int, ...], helpers: int, first: int) -> Sequence[_Drawn]:
        """Return the rows of each step."""
        drawn = _below([self._draw(seed, helpers, first) for seed in seeds])
        return [drawn.step(number) for number in range(STEPS)]

    def _draw(self, seed: int, helpers: int, first: int) -> _Drawn:
        """A helper's draws do not depend on how many there are,
        nor an episode's on the operating point.
        """
        p, e = self.parameters, min(CHUNK, self.episodes - first)
        n = e * STEPS
        base = noise.generator("calibrated", seed, first)
        approaches = (p.left_share, p.right_share, 1.0 - p.left_share - p.right_share)
        # Read rightly by everybody, by those who see the danger, by nobody.
        readers = (p.guess_right, p.know_right - p.guess_right, 1.0 - p.know_right)
        upto = np.cumsum(np.outer(readers, approaches))[:-1]
        kind = np.searchsorted(upto, stratified(base, np.zeros(e, dtype=int)), side="right")
        reader, approach = np.divmod(kind, len(approaches))
        right = base.integers(ACTIONS, size=e)
        wrong = (right + base.integers(1, ACTIONS, size=e)) % ACTIONS
        ego_nats = spread(p.ego_nats, p.ego_sd_nats, base.random(n))
        guess = np.where(reader == 0, right, wrong)
        know = np.where(reader <= 1, right, wrong)

        link = np.empty((n, helpers, 2))
        jitter, unsure = np.empty((n, helpers)), np.empty((n, helpers))
        for h in range(helpers):
            generator = noise.generator("calibrated", seed, first, h)
            crossings = np.stack([stratified(generator, kind), stratified(generator, kind)], axis=1)
            link[:, h] = np.repeat(crossings, STEPS, axis=0)
            jitter[:, h], unsure[:, h] = generator.random((2, n))
        witness = np.repeat(approach[:, None] == np.arange(helpers), STEPS, axis=0)
        nats = np.where(witness, p.witness_nats, spread(p.others_nats, p.others_sd_nats, unsure))
        guessed, knew = (np.repeat(top, STEPS) for top in (guess, know))
        top = np.where(witness, knew[:, None], guessed[:, None])
        intents = Intents(
            own=peaked(ego_nats, guessed),
            helpers=peaked(nats, top),
            valid=np.ones((n, helpers), dtype=bool),
            distance_m=np.insert(np.where(witness, WITNESS_M, OTHERS_M), 0, EGO_M, axis=1),
            range_m=np.broadcast_to(
                FIRST_RANGE_M + RANGE_STEP_M * np.arange(helpers), (n, helpers)
            ),
            payload_bits=np.full((n, helpers), PAYLOAD_BITS),
            inference_s=np.full((n, 1 + helpers), p.inference_s),
        )
        return _Drawn(
            np.repeat(right, STEPS), intents, peaked(ego_nats, knew), witness, Draws(link, jitter)
        )


def stratified(generator: np.random.Generator, kinds: Ints) -> Floats:
    """Return uniform draws in [0, 1), (n,), spread more evenly than chance within each kind of row.

    `kinds`, (n,), has the kind of each of n rows, as whole numbers. Of the k rows of one kind, each
    of the k equal parts of [0, 1) has one, so that means over rows vary less. One such column for
    each dimension is a Latin hypercube (McKay, Beckman and Conover 1979).
    """
    # a kind's rows together, in random order
    order = np.lexsort((generator.random(len(kinds)), kinds))
    _, first, count = np.unique(kinds[order], return_index=True, return_counts=True)
    place = np.arange(len(kinds)) - np.repeat(first, count)
    drawn = np.empty(len(kinds))
    drawn[order] = (place + generator.random(len(kinds))) / np.repeat(count, count)
    return drawn


def peaked(nats: Floats, top: Ints) -> Floats:
    """Return intents `(..., A)` of given entropies `nats`, with the most on the action `top`.

    An intent is a vehicle's probabilities of A actions. `nats` and `top`, the index of an action,
    are `(...)`. The rest is shared evenly by the other actions.
    """
    entropies, shares = _by_entropy()
    most = np.interp(nats, entropies, shares)[..., None]
    return np.where(
        np.asarray(top)[..., None] == np.arange(ACTIONS), most, (1 - most) / (ACTIONS - 1)
    )


@lru_cache(maxsize=1)
def _by_entropy() -> tuple[Floats, Floats]:
    share = np.linspace(1.0, 1 / ACTIONS, 4001)[1:-1]
    rest = (1 - share) / (ACTIONS - 1)
    return -share * np.log(share) - (1 - share) * np.log(rest), share


def spread(mean: float, sd: float, uniforms: Floats) -> Floats:
    """Return normal draws with mean `mean` and standard deviation `sd`, made of uniform ones.

    `uniforms` are draws in [0, 1), `(...)`, as is the result. The distribution is cut at `CUT`
    standard deviations on either side.
    """
    below = normal_share(-CUT)
    return np.asarray(mean + sd * normal_quantile(below + (1 - 2 * below) * uniforms))


# beside runs in a sweep; a seed has as many episodes as in the paper's sweeps
SWEPT = Calibrated(300)
