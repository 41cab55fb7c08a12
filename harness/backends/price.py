"""The `[price]` table of a card: what a served model's tokens cost."""

from dataclasses import dataclass
from sys import float_info
from typing import Annotated

from msgspec import Meta

_Amount = Annotated[float, Meta(ge=0, le=float_info.max, description="0 or more")]
MILLION = 1e6


@dataclass(frozen=True)
class Price:
    """Hold what a million tokens of a served model cost, by its maker's price list.

    It is the table `[price]` of a model card (a TOML file that describes a model): `input` is the
    price of tokens that the model reads, `output` that of those that it writes, thoughts included,
    in `currency`, such as `USD`.
    """

    input: _Amount  # of those that the model reads
    output: _Amount  # of those that it writes, thoughts included
    # of both prices
    currency: Annotated[
        str, Meta(pattern=r"^[A-Z]{3}\Z", description="three capitals, such as USD")
    ]

    def of(self, read: float, written: float) -> float:
        """Return the cost in `currency` of `read` prompt tokens and `written` answer tokens."""
        return (read * self.input + written * self.output) / MILLION
