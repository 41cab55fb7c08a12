"""Define a device profile: an on-board computer as a file of `devices/` and a run's `run.json` state it."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

from harness.core.config import Count

Rate = Annotated[float, Meta(gt=0, description="a number above 0")]
Status = Literal["measured", "cited", "modelled", "assumed"]


class Speed(Struct, frozen=True):
    """How fast a computer answers one request with a model, and the energy of a token; None if unknown."""

    model: str  # the model of the row in the device profile
    prefill_tokens_per_s: Rate | None  # prompt tokens read in a second
    decode_tokens_per_s: Rate | None  # output tokens written in a second
    joules_per_prompt_token: Rate | None = None  # energy to read one token
    joules_per_output_token: Rate | None = None  # energy to write one token


class Constant(Struct, frozen=True):
    """A number of a device profile, above 0, and where it comes from."""

    value: Annotated[float, Meta(gt=0, description="a number above 0")]
    status: Status
    source: Annotated[str, Meta(min_length=1, description="where the number comes from")]


class DeviceRow(Struct, frozen=True, kw_only=True):
    """The rates of a device with one model; None where no source states them."""

    model: str  # the model's name; that of a card, if there is one
    billions: Annotated[float, Meta(gt=0, description="billions of weights, above 0")]  # billions of weights
    precision: str  # number format of the weights
    batch_size: Count  # requests that went through the device together when it was timed
    prefill_tokens_per_s: Constant | None = None  # prompt tokens read in a second
    decode_tokens_per_s: Constant | None = None  # output tokens written in a second for one request
    # energy to read one token, the device's idle draw included
    joules_per_prompt_token: Constant | None = None
    # energy to write one token, the device's idle draw included
    joules_per_output_token: Constant | None = None


class Device(Struct, frozen=True, kw_only=True):
    """A file of `devices/`: a computer that vehicles may have."""

    name: str  # the file's name
    description: str  # one sentence for lists
    power_mode: str  # the power mode in which it was timed
    rows: tuple[DeviceRow, ...]  # one row for each model
    # how a model without a row is timed: `weights` scales the nearest row inversely to the number of
    # weights; None refuses the model
    scaling: Literal["weights"] | None = None
    # its draw while it infers; a row without joules per token gets them from this
    load_watts: Constant | None = None
    idle_watts: Constant | None = None  # its draw while it waits
    transmit_dbm: Constant | None = None  # radiated power of its radio, if the channel states none
    amplifier_efficiency: Constant | None = None  # the share of the radio amplifier's draw that is radiated
    # least time on air of a message under a channel that states bits and bandwidth alone; None counts
    # only these
    frame_ms: Constant | None = None

    def __post_init__(self) -> None:
        names = [row.model for row in self.rows]
        if not names or len(set(names)) < len(names):
            raise ValueError("rows: give one or more, of different models")
