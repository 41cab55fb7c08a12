"""The parameters that every scenario has:
times, limits of the ego, and what vehicles know of each other.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from typing import Any, ClassVar, Literal, get_args

from harness.core.config import changed
from harness.core.errors import UserError, printable, unknown
from harness.radio.channel import Physical
from harness.radio.profiles import CHANNELS
from harness.world.ambient import AMBIENTS, DAY, Ambient

BeaconRule = Literal["fixed", "cam"]
MOST_DECISIONS, MOST_SPEEDS = 10, 20
MOST_FRAMES = 20_000  # in an episode; each takes time and memory
# What a parameter may be at least and at most, by the unit at the end of its name. Places, and
# times that are offsets, may lie before their origin; who stands still arrives nowhere.
BOUNDS = {
    "noise_m": (0.0, 100.0), "noise_mps": (0.0, 100.0), "offset_s": (-100.0, 100.0),
    "speed_mps": (0.1, 200.0),
    "_s": (0.0, MOST_FRAMES), "_m": (-1000.0, 1000.0), "_mps": (0.0, 200.0), "_mps2": (0.0, 200.0),
    "_hz": (0.0, 1000.0), "_share": (0.0, 1.0), "_shares": (0.0, 1.0),
}  # fmt: skip
WITNESSES = ("any", "each", "drawn", "0", "1", "2", "3")
VERSIONS = (1, 2)
CLOCKS = ("together", "apart")
ROUNDING_FRAMES = 1e-6  # a latency of 0.14 s is 7 frames and not 7.000000000000001


def frames(latency_s: float, simulation_hz: int) -> int:
    """Return a latency, `latency_s`, in whole frames of the simulation, rounded up.

    `simulation_hz` is the number of frames a second.
    """
    return math.ceil(latency_s * simulation_hz - ROUNDING_FRAMES)


@dataclass(frozen=True)
class Parameters:
    """Hold the parameters that every scenario has; a scenario adds its own in a subclass.

    A unit ends a name where there is one: `_s`, `_m`, `_mps` (m/s), `_mps2` (m/s2), `_rad` or
    `_hz`; a `_share` or `_loss` is a probability. The ego steps through `target_speeds_mps` by its
    actions, `decisions` times in an episode, every `decision_period_s`, and acts `decision_lag_s`
    after it has seen. It fails after `time_limit_s`, or if it arrives later than the driver that
    sees everything by more than `delay_allowance_s` (`harmless_allowance_s` where no danger is, if
    `limits` is 2).

    A beacon is what a vehicle broadcasts about itself, at times that `beacon_rule` says, over the
    radio named `beacon_channel` or with `beacon_loss`, and with normal errors of the standard
    deviations `beacon_noise_`; there are none under `perfect_knowledge`. `ambient` names light and
    weather, and `witnesses` says how many helpers have the danger in sight at first (`any`, `each`,
    `drawn` or a number). `limits` and `perception` are versions of the rules by which an arrival is
    late, and by which a vehicle that no sensor reports hides others. Raises UserError if a value is
    out of bounds.
    """

    # parameters of a subclass that were added later, as in `LATER`
    additions: ClassVar[tuple[tuple[str, Any], ...]] = ()
    # speeds that SLOWER, IDLE and FASTER step through, m/s
    target_speeds_mps: tuple[float, ...] = (0.0, 7.0, 14.0)
    braking_mps2: float = 8.0  # hardest braking, m/s2
    acceleration_mps2: float = 3.0  # hardest acceleration, m/s2
    decisions: int = 6  # number of decisions in an episode
    decision_period_s: float = 1.0  # seconds between two decisions
    # seconds from seeing to acting, below the period, in decision trees and for reference drivers:
    # the paper's inference. Until then the ego keeps to its last action
    decision_lag_s: float = 0.145
    simulation_hz: int = 50  # frames a second
    # seconds after which an ego that has not reached its goal has failed
    time_limit_s: float = 10.0
    # seconds later than the full-view driver, which sees everything, at which an ego may still
    # reach its goal
    delay_allowance_s: float = 1.0
    # the same in a layout without a danger, where `limits` is 2: half of what one needless SLOWER
    # costs (`benchmarks/caution.py`)
    harmless_allowance_s: float = 0.25
    # whether the ego and the helpers know each other's true state instead of beacons
    perfect_knowledge: bool = False
    # when a vehicle sends a beacon: `fixed`, or `cam`, depending on its motion (ETSI EN 302 637-2);
    # `harness.world.beacons` has the sources of these parameters
    beacon_rule: BeaconRule = "fixed"
    beacon_hz: float = 10.0  # beacons a second; under `cam`, checks a second whether one is due
    beacon_delay_s: float = 0.02  # seconds from a beacon's pose until receivers have it
    beacon_loss: float = 0.08  # probability that a receiver does not receive a beacon
    # physical radio that gives this loss on each link instead, and settings of its own, each
    # behind `+`
    beacon_channel: str = ""
    beacon_noise_m: float = 0.2  # standard deviation of a beacon's position on each axis, m
    beacon_noise_mps: float = 0.1  # standard deviation of a beacon's speed, m/s
    beacon_noise_rad: float = 0.0035  # standard deviation of a beacon's heading, radians
    ambient: str = DAY  # light and weather, one of `harness.world.ambient`
    # how many helpers have the danger in sight at the first decision: `0` to `3`; `each` of these
    # in turn, by the layout seed modulo 4; `drawn` evenly from these; or `any`, as many as the
    # scene happens to give
    witnesses: str = "any"
    radio_share: float = 0.0  # probability that a vehicle which does not help sends beacons, too
    # version of the rule that says which delay is a failure (`harness.world.outcome`), and of the
    # reference planner, by whose time it is one
    limits: int = 1
    # version of what sensors make of a vehicle that they do not report: it hides who is behind it
    # (1), or hides nothing (2), so that nothing tells of it
    perception: int = 1

    def __post_init__(self) -> None:
        speeds, total_frames = len(self.target_speeds_mps), self.time_limit_s * self.simulation_hz
        bounds = {
            "target_speeds_mps": (0 < speeds <= MOST_SPEEDS, f"1 to {MOST_SPEEDS} speeds"),
            "decisions": (1 <= self.decisions <= MOST_DECISIONS, f"from 1 to {MOST_DECISIONS}"),
            "decision_period_s": (self.decision_period_s > 0, "seconds above 0"),
            "simulation_hz": (0 < self.simulation_hz <= 1000, "from 1 to 1000"),
            "time_limit_s": (
                0 < total_frames <= MOST_FRAMES,
                f"above 0, and {MOST_FRAMES} frames at most",
            ),
            "ambient": (self.ambient in AMBIENTS, " or ".join(AMBIENTS)),
            "beacon_rule": (
                self.beacon_rule in get_args(BeaconRule),
                " or ".join(get_args(BeaconRule)),
            ),
            "perfect_knowledge": (isinstance(self.perfect_knowledge, bool), "true or false"),
            "beacon_hz": (
                0 < self.beacon_hz <= self.simulation_hz,
                f"above 0, at most {self.simulation_hz}",
            ),
            "beacon_delay_s": (0 <= self.beacon_delay_s <= 1, "seconds from 0 to 1"),
            "beacon_loss": (0 <= self.beacon_loss < 1, "a probability from 0, below 1"),
            "beacon_noise_rad": (0 <= self.beacon_noise_rad <= 7, "from 0 to 7"),
            "witnesses": (self.witnesses in WITNESSES, " or ".join(WITNESSES)),
            **{
                name: (getattr(self, name) in VERSIONS, "1 or 2")
                for name in ("limits", "perception")
            },
        }
        for field in fields(self):
            value = getattr(self, field.name)
            least, most = next(
                (BOUNDS[unit] for unit in BOUNDS if field.name.endswith(unit)), (None, None)
            )
            if least is not None and bounds.get(field.name, (True, ""))[0]:
                fits = all(
                    least <= each <= most
                    for each in (value if isinstance(value, tuple) else [value])
                )
                bounds[field.name] = fits, f"from {least:g} to {most:g}"
        for name, (fits, allowed) in bounds.items():
            if not fits:
                raise UserError(
                    f"scenario: {name} is {printable(getattr(self, name))}; it must be {allowed}"
                )
        beacon_radio(self.beacon_channel)

    @property
    def light(self) -> Ambient:
        return AMBIENTS[self.ambient]

    def stated(self) -> dict[str, Any]:
        """Return the parameters by name, as the manifest of a dataset or run states them.

        Some were added to the harness later (`LATER`). One of these is left out while its value
        says that all is as before it was added, so that older digests stay valid.
        """
        return {k: v for k, v in asdict(self).items() if (k, v) not in self.later}

    @property
    def later(self) -> Sequence[tuple[str, Any]]:
        """Return the parameters that were added later, with the values of the earlier behaviour."""
        return *LATER, *self.additions

    @property
    def lag_frames(self) -> int:
        """Return `decision_lag_s`, the time from seeing to acting, in frames of the simulation."""
        return frames(self.decision_lag_s, self.simulation_hz)

    def allowance_s(self, danger: str | None) -> float:
        """Return how many s later than the full-view driver an ego may arrive and still succeed.

        The full-view driver is the reference that sees everything. `danger` is the direction that
        the layout's danger comes from, None without one: then, where `limits` is 2, less delay is
        allowed.
        """
        return self.delay_allowance_s if danger or self.limits == 1 else self.harmless_allowance_s

    def due_frame(self, step: int) -> int:
        """Return the number of the frame in which a decision is to be made, counted from the start.

        `step` is the decision's index from 0. From `decisions` on, it is the frame of the time
        limit.
        """
        due_s = self.time_limit_s if step >= self.decisions else step * self.decision_period_s
        return round(due_s * self.simulation_hz)


@dataclass(frozen=True)
class Witnessed(Parameters):
    """Hold the parameters of a scenario in which the number of witnesses can be declared.

    A witness is a helper that has the danger in sight at the first decision: `each` is 0 to 3 of
    them in turn. `radio_share` is the probability that a vehicle which does not help broadcasts its
    place, too; `limits` and `perception` are versions of rules (`Parameters`). The defaults are
    those of the suite `v2v-safety-2`, a set of datasets. Raises UserError if a value is out of
    bounds.
    """

    witnesses: str = "each"
    radio_share: float = 0.25
    limits: int = 2
    perception: int = 2


@dataclass(frozen=True)
class Shared(Parameters):
    """Hold the parameters of a scenario whose helpers may be agents, with goals of their own.

    An agent is a vehicle that decides for itself (`Scenario.seats`). `agent_share` is the
    probability that one which could does. Under `clock` `together` all decide at the same times,
    under `apart` each at times of its own. The other fields, such as `decisions` and
    `time_limit_s`, are those of `Parameters`, with other defaults. Raises UserError if a value is
    out of bounds.
    """

    # probability that a vehicle which could decide does so, the ego aside: 1 makes all of them
    # agents. Which ones do belongs to the layout, and those of a lower share are among those of a
    # higher one
    agent_share: float = 0.0
    # whether agents decide at the same times (`together`), or each at times of its own, in quarters
    # of a period after the others (`apart`); which belongs to the layout
    clock: str = "together"
    # time for whoever gave way to go on, and decisions for it: fewer would make a deadlock of every
    # stop
    decisions: int = 10
    time_limit_s: float = 14.0
    limits: int = 2
    perception: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.clock not in CLOCKS:
            raise UserError(
                f"scenario: clock is {printable(self.clock)}; it must be {' or '.join(CLOCKS)}"
            )


# Parameters that were added later, with the values of the earlier behaviour.
LATER = (
    ("ambient", DAY), ("beacon_rule", "fixed"), ("beacon_channel", ""),
    ("witnesses", "any"), ("radio_share", 0.0), ("limits", 1), ("perception", 1),
    ("harmless_allowance_s", 0.25),
)  # fmt: skip


@lru_cache(maxsize=64)
def beacon_radio(text: str) -> Physical | None:
    """Return the radio that the parameter `beacon_channel` names; None if it is empty.

    `text` is the name of a physical radio with settings, each behind `+`:
    `NAME+density_per_km=120`. Raises UserError if there is no such radio or setting, or if it has
    one loss for all links.
    """
    if not text:
        return None
    name, *settings = text.split("+")
    if name not in CHANNELS:
        raise unknown("beacon_channel", name, CHANNELS)
    values: dict[str, str] = {}
    for setting in settings:
        key, _, value = setting.partition("=")
        values[key] = value
    radio = changed(CHANNELS[name], values, f"beacon_channel {name}")
    if not isinstance(radio, Physical):
        raise UserError(
            f"scenario: beacon_channel is {printable(text)}, which has one loss for all links; "
            "it must be a physical radio, or set beacon_loss"
        )
    return radio


# Parameters in which the scenes of the suites of a scenario with lookouts differ.
SCENES = ("witnesses", "radio_share", "limits", "perception")
SUITES: dict[str, dict[str, Any]] = {
    "v2v-safety": dict(zip(SCENES, ("any", 0.0, 1, 1), strict=True)),
    "v2v-safety-2": dict(zip(SCENES, ("each", 0.25, 2, 2), strict=True)),
}

# Parameters that change neither the vehicles nor their driving, but only what is known of them.
DIALS = tuple(
    field.name
    for field in fields(Parameters)
    if field.name.startswith(("beacon_", "perfect_", "ambient"))
)
# Further ones that a name may set: what counts, and where the scenario has lookouts, who has a
# radio.
SETTABLE = (*DIALS, "limits", "perception")
WITNESSED = (*SETTABLE, "witnesses", "radio_share")
SHARED = (*SETTABLE, "agent_share", "clock")
