"""The calibrated proxy: intents in the paper's occluded intersection, by mechanism and not by panel.

The story of an episode. A danger comes from one of three approaches, and the ego cannot see it. The ego
guesses, and in some episodes guesses wrong; whoever sees the approach, the witness, knows, except in the
episodes that nobody reads rightly. Helper h watches approach h; the nearest helper watches the likeliest one,
and helpers past the third watch nothing new. The other helpers share the ego's guess. Once the ego has fused
the witness's message it keeps what it learnt, though not its certainty: it goes on asking. Decisions before
the last leave time to mend them; the last one decides.

The intents go through trigger, channel, consensus and scoring like any model's.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from harness.coordination.channel import Draws
from harness.coordination.coordinate import fuse
from harness.coordination.exchange import exchange
from harness.coordination.intents import Intents
from harness.coordination.operating_point import OperatingPoint
from harness.core import noise
from harness.core.arrays import Bools, Floats, Ints
from harness.evaluate.scoring import Scored, outcome
from harness.evaluate.success import Table
from harness.studies.entropies import ACTIONS, peaked, spread

VERSION = "2"
STEPS = 6  # decisions an episode: 18 messages are three replies each
CHUNK = 2000  # episodes that are played together

# Declared geometry, metres. The witness stands beside the conflict, so that Equation 2 hears it best.
EGO_M, WITNESS_M, OTHERS_M = 25.0, 6.0, 20.0
FIRST_RANGE_M, RANGE_STEP_M = 15.0, 10.0
PAYLOAD_BITS = 800.0  # declared: an intent, a position and a few words


@dataclass(frozen=True)
class Parameters:
    """All that is fitted (`harness/studies/fit.py`); nothing of it knows a panel or a grid point.

    Attributes:
        left_share: share of episodes whose danger comes from the approach that the nearest helper watches.
        right_share: the same for the second helper; the rest comes from the third's.
        guess_right: share of episodes in which an ego that does not see the danger intends rightly.
        know_right: share of episodes in which one that does see it intends rightly.
        ego_nats: mean entropy of the ego's intent.
        ego_sd_nats: its standard deviation over decisions.
        others_nats: mean entropy of a helper that sees no danger.
        others_sd_nats: its standard deviation.
        witness_nats: entropy of the helper that sees the danger.
        inference_s: seconds of one inference.
    """

    left_share: float = 0.406
    right_share: float = 0.282
    guess_right: float = 0.689
    know_right: float = 0.953
    ego_nats: float = 0.823
    ego_sd_nats: float = 0.0502
    others_nats: float = 0.625
    others_sd_nats: float = 0.01
    witness_nats: float = 0.45
    inference_s: float = 0.145


# What each parameter was fitted on, by the rows of the paper's numbers (`paper_numbers.csv`).
FITTED_ON: Mapping[str, tuple[str, ...]] = {
    "left_share": ("B2", "B6"),
    "right_share": ("B3",),
    "guess_right": ("A3",),
    "know_right": ("B9",),
    "ego_nats": ("B18",),
    "ego_sd_nats": ("B18",),
    "others_nats": ("B15",),
    "others_sd_nats": ("B15",),
    "witness_nats": ("B15",),
    "inference_s": ("A2",),
    "6g jitter (harness/coordination/channel.py)": ("A6",),
    "density-coupled loss (harness/coordination/channel.py)": ("B6", "B7"),
}


@dataclass(frozen=True)
class _Drawn:
    """E episodes of S decisions as n = E x S rows; H helpers.

    Attributes:
        laid: which actions are safe; none is ever late.
        known: what every vehicle intends, the ego as long as it guesses.
        told: the ego's intent once it has heard the witness, (n, A).
        witness: which helper sees the danger, (n, H).
        links: the channel's draws; a link is up or down for a whole episode.
    """

    laid: Table
    known: Intents
    told: Floats
    witness: Bools
    links: Draws


class Calibrated:
    """The proxy as a source of scored decisions.

    Attributes:
        name: what reports call it.
        same_episodes: a seed has episodes of its own.
    """

    name = "calibrated proxy"
    same_episodes = False

    def __init__(self, episodes: int, parameters: Parameters | None = None) -> None:
        self.parameters = parameters or Parameters()
        self.episodes = episodes
        self._draw = lru_cache(maxsize=6)(self._drawn)

    def manifest(self) -> dict[str, Any]:
        """What a reader needs to know of where the intents come from."""
        rows = sorted({row for rows in FITTED_ON.values() for row in rows})
        return {
            "proxy_model_version": VERSION,
            "calibration_label": f"fitted on rows {', '.join(rows)} of the paper; all others are predictions",
            "parameters": asdict(self.parameters),
            "fitted_on": {name: list(rows) for name, rows in FITTED_ON.items()},
            "episodes_per_seed": self.episodes,
        }

    def scored(self, point: OperatingPoint, vehicles: int, seed: int) -> Iterator[tuple[Table, Scored]]:
        """Episodes of one seed with so many vehicles, the ego included, at one operating point.

        They come `CHUNK` at a time, which bounds memory and keeps the arrays in the processor's cache.
        """
        for first in range(0, self.episodes, CHUNK):
            yield self._scored(point, vehicles, seed, first)

    def _scored(self, point: OperatingPoint, vehicles: int, seed: int, first: int) -> tuple[Table, Scored]:
        """An ego that has fused the witness's message knows from its next decision on."""
        drawn = self._draw(seed, vehicles - 1, first)
        heard = exchange(point, drawn.known, drawn.links)
        # Who asks and who is heard depends on entropies, which knowing does not change.
        told = np.any(heard.on_time & drawn.witness, axis=1).reshape(-1, STEPS)
        knew = np.insert(np.logical_or.accumulate(told, axis=1)[:, :-1], 0, False, axis=1).reshape(-1, 1)
        heard = replace(heard, own=np.where(knew, drawn.told, heard.own))
        return drawn.laid, outcome(drawn.laid, point, seed, fuse(point, heard, drawn.known))

    def _drawn(self, seed: int, helpers: int, first: int) -> _Drawn:
        """A helper's draws do not depend on how many there are, nor an episode's on the operating point."""
        p, e = self.parameters, min(CHUNK, self.episodes - first)
        n = e * STEPS
        base = noise.generator("calibrated", seed, first)
        approach = np.searchsorted(np.cumsum([p.left_share, p.right_share]), base.random(e), side="right")
        skill = base.random(e)
        right = base.integers(ACTIONS, size=e)
        wrong = (right + base.integers(1, ACTIONS, size=e)) % ACTIONS
        ego_nats = spread(p.ego_nats, p.ego_sd_nats, base.random(n))
        guess = np.where(skill < p.guess_right, right, wrong)
        know = np.where(skill < p.know_right, right, wrong)

        link, jitter, unsure = np.empty((n, helpers, 2)), np.empty((n, helpers)), np.empty((n, helpers))
        for h in range(helpers):
            own = noise.generator("calibrated", seed, first, h)
            link[:, h] = np.repeat(own.random((e, 2)), STEPS, axis=0)
            jitter[:, h], unsure[:, h] = own.random((2, n))
        witness = np.repeat(approach[:, None] == np.arange(helpers), STEPS, axis=0)
        nats = np.where(witness, p.witness_nats, spread(p.others_nats, p.others_sd_nats, unsure))
        guessed, knew = (np.repeat(top, STEPS) for top in (guess, know))
        top = np.where(witness, knew[:, None], guessed[:, None])
        known = Intents(
            own=peaked(ego_nats, guessed), helpers=peaked(nats, top), valid=np.ones((n, helpers), dtype=bool),
            distance_m=np.insert(np.where(witness, WITNESS_M, OTHERS_M), 0, EGO_M, axis=1),
            range_m=np.broadcast_to(FIRST_RANGE_M + RANGE_STEP_M * np.arange(helpers), (n, helpers)),
            payload_bits=np.full((n, helpers), PAYLOAD_BITS),
            inference_s=np.full((n, 1 + helpers), p.inference_s),
        )  # fmt: skip
        laid = Table(
            index=np.arange(n).reshape(e, STEPS), episodes=first + np.arange(e), seeds=np.full(e, seed),
            safe=_safe(right), delay_s=np.zeros((n, ACTIONS)), allowance_s=0.0,
        )  # fmt: skip
        return _Drawn(laid, known, peaked(ego_nats, knew), witness, Draws(link, jitter))


def _safe(right: Ints) -> Bools:
    """Which action is safe at which decision, (n, A): all of them, until the last, where one is."""
    table = np.ones((len(right), STEPS, ACTIONS), dtype=bool)
    table[:, -1] = right[:, None] == np.arange(ACTIONS)
    return table.reshape(-1, ACTIONS)
