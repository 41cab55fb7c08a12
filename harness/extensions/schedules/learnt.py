"""Define learnt schedules: small networks in files `schedules/*.toml`.

A network says what asking a helper is worth from what the ego knows before. `harness study schedule
learn` writes the file, with what it was learnt from.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np

from harness.coordination.scheduling import ScheduleInputs
from harness.core.arrays import Floats
from harness.core.config import between, convert, toml
from harness.core.errors import UserError, printable
from harness.core.files import read_once

FAR_S, FAR_M = 6.0, 100.0  # scales of times and distances; a longer time counts as FAR_S
INPUTS = (
    "entropy",  # of the ego's intent, its probabilities of actions, nats
    "margin",  # 1 less the lead of its likeliest action's probability over the next
    "most careful",  # the probability of its first action
    "least careful",  # that of its last
    "unseen, most",  # share of the region that the ego sees least of which it does not see
    "unseen, mean",  # the mean of such shares over regions: where a danger may come from
    "added, most",  # largest share of a region that the helper sees and the ego does not
    "added, mean",  # the mean of such shares over regions
    "range",  # distance from helper to ego, in units of `FAR_M`
    "helper to zone",  # the helper's distance to the conflict zone, in the same unit
    "ego to zone",  # the ego's
    "seconds to zone",  # until the ego is there at its speed, `FAR_S` at most, in units of it
    "others nearer",  # number of helpers that may be asked and are nearer to the ego
    "others",  # number of other helpers that may be asked
)


@dataclass(frozen=True)
class Network:
    """Hold a network with one hidden layer of tanh units: F inputs, J units, one output.

    The inputs are `INPUTS`, the output the expected gain in success from asking one helper.
    `centre` (F,) is taken from the inputs, which are then divided by `scale` (F,). `into` (F, J)
    and `bias` (J,) make the units of them, `out` (J,) and `base` the output of these. Call it with
    inputs (..., F).
    """

    centre: Floats  # what is subtracted from each input, (F,)
    scale: Floats  # what each input is then divided by, (F,)
    into: Floats  # weights from the inputs to the units, (F, J)
    bias: Floats  # bias of each unit, (J,)
    out: Floats  # weights from the units to the output, (J,)
    base: float  # bias of the output

    def __call__(self, inputs: Floats) -> Floats:
        """Return the output `(...)` for the F inputs `(..., F)`."""
        units = np.tanh(((inputs - self.centre) / self.scale) @ self.into + self.bias)
        return np.asarray(units @ self.out + self.base)


@dataclass(frozen=True)
class Learnt:
    """Decide whom the ego asks by the gain in success that a network expects of each helper alone.

    It is a schedule, a rule for whom to ask: a helper is asked if its gain is above `threshold`, or
    above the threshold of the condition (settings of radio, asking and fusion), if that has one.
    `needs` names what it reads beside intents and positions: `outlook`, what each vehicle sees of
    where a danger may come from.
    """

    network: Network  # from `inputs` to the gain in success probability
    threshold: float  # gain above which a helper is asked, unless the condition has its own
    needs: ClassVar[tuple[str, ...]] = ("outlook",)

    def worth(self, known: ScheduleInputs) -> Floats:
        """Return the expected gain in success from asking each of H helpers, `(..., H)`.

        `known` has what the ego knows before it asks, with leading axes `(...)`. The gain is a
        difference of shares, -1 to 1, and NaN for a helper that may not be asked.
        """
        return np.where(known.may_ask, self.network(inputs(known)), np.nan)


@dataclass(frozen=True)
class Weights:
    """Hold the numbers of a `Network` as a schedule's file states them; sizes are not checked yet.

    A schedule is a rule for whom the ego asks. The network has F inputs and J hidden units.
    `centre` and `scale` have F numbers, by which inputs are moved and divided; `into` has F rows of
    J weights, `bias` and `out` J numbers each; `base` is the bias of the output.
    """

    centre: tuple[float, ...]  # what is subtracted from each input, F numbers
    scale: tuple[Annotated[float, between(1e-6, 1e6)], ...]  # what each is then divided by, F
    into: tuple[tuple[float, ...], ...]  # weights from the inputs to the units, F rows of J
    bias: tuple[float, ...]  # bias of each unit, J numbers
    out: tuple[float, ...]  # weights from the units to the output, J numbers
    base: float  # bias of the output


@dataclass(frozen=True)
class Stated:
    """Hold the content of a schedule's file in `schedules/`: a learnt rule of whom the ego asks.

    A helper is asked if the gain in success that the network expects of it is above the threshold.
    """

    description: str  # one sentence
    command: str  # the command that made the file
    learnt_from: tuple[str, ...]  # the runs that it was learnt from, with their layout seeds
    tuned_on: tuple[str, ...]  # the runs on which the threshold was chosen, with their layout seeds
    # the settings of radio, asking and fusion under which it was learnt, as they are typed
    condition: str
    threshold: float  # the schedule's threshold
    # names of the network's inputs, numbers that the ego knows of a helper; must be `INPUTS`
    inputs: tuple[str, ...]
    network: Weights  # the network's weights

    def schedule(self, where: str) -> Learnt:
        """Return the schedule, the rule for whom the ego asks; `where` names the file in messages.

        Raises UserError if its inputs are not `INPUTS`, or its weights have other sizes.
        """
        f, j = len(INPUTS), len(self.network.bias)
        shapes = {
            "centre": (f,),
            "scale": (f,),
            "into": (f, j),
            "bias": (j,),
            "out": (j,),
            "base": (),
        }
        arrays: dict[str, Any] = {}
        for name, shape in shapes.items():
            try:
                arrays[name] = np.array(getattr(self.network, name), dtype=float)
            except ValueError:  # rows of several lengths
                arrays[name] = np.empty(0)
            if self.inputs != INPUTS or arrays[name].shape != shape:
                raise UserError(
                    f"{where} has other inputs or sizes than the program; learn it again"
                )
        return Learnt(Network(**arrays), self.threshold)


def inputs(facts: ScheduleInputs) -> Floats:
    """Return the network's F inputs for each of H helpers, `(..., H, F)`, in the order of `INPUTS`.

    `facts` has what the ego knows before it asks, with leading axes `(...)`. Inputs are arbitrary
    for a helper that may not be asked.
    """
    outlook, may_ask = facts.outlook, facts.may_ask
    assert outlook is not None
    ranked = np.sort(facts.own, axis=-1)
    range_m = np.where(may_ask, facts.range_m, np.inf)
    nearer = (range_m[..., None, :] < range_m[..., :, None]).sum(axis=-1)
    ego_inputs = (
        facts.entropy_nats,
        1.0 - ranked[..., -1] + ranked[..., -2:-1].sum(axis=-1),
        facts.own[..., 0],
        facts.own[..., -1],
        outlook.unseen.max(axis=-1, initial=0.0),
        outlook.mean(outlook.unseen),
        facts.distance_m[..., 0] / FAR_M,
        np.minimum(outlook.to_zone_s, FAR_S) / FAR_S,
        may_ask.sum(axis=-1) - 1.0,
    )
    entropy, margin, careful, bold, unseen_most, unseen, ego_m, to_zone, others = (
        np.broadcast_to(column[..., None], may_ask.shape) for column in ego_inputs
    )
    columns = (
        entropy,
        margin,
        careful,
        bold,
        unseen_most,
        unseen,
        outlook.added.max(axis=-1, initial=0.0),
        outlook.mean(outlook.added),
        facts.range_m / FAR_M,
        facts.distance_m[..., 1:] / FAR_M,
        ego_m,
        to_zone,
        nearer,
        others,
    )
    return np.stack(columns, axis=-1)


@read_once
def read(path: Path) -> Learnt:
    """Read a learnt schedule, a rule for whom the ego asks, from its TOML file.

    Raises UserError if the file is wrong.
    """
    where = f"schedule file {printable(path)}"
    return convert(toml(path, where), Stated, where).schedule(where)
