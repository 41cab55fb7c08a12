"""How often a stand-in for a language model fails on purpose, so that what is counted can be known."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from harness.core.errors import UserError


@dataclass(frozen=True)
class Failures:
    """Shares of all answers, each drawn for its request alone; the rest is answered well.

    A text is spoilt in one way at most; being slow comes on top.

    Attributes:
        fence: the answer stands in a code fence. Recovered.
        prose: the answer stands between sentences. Recovered.
        truncation: cut off inside its JSON. Failed, `truncated_json`.
        nan: one probability is NaN. Failed, `non_finite`.
        unknown_action: no action's name is one of the scenario's. Failed, `unknown_action`.
        unclosed_think: stands in a thought that never ends. Failed, `truncated_reasoning`.
        slow_tail: takes `slow_s` longer than the card's latency.
        slow_s: seconds, more than 0 where there is a slow tail.
    """

    fence: float = 0.0
    prose: float = 0.0
    truncation: float = 0.0
    nan: float = 0.0
    unknown_action: float = 0.0
    unclosed_think: float = 0.0
    slow_tail: float = 0.0
    slow_s: float = 0.0

    @property
    def texts(self) -> dict[str, float]:
        """The shares of the spoilt texts by their names, in order."""
        return {name: rate for name, rate in asdict(self).items() if not name.startswith("slow_")}


KEYS: Mapping[str, type] = dict.fromkeys(asdict(Failures()), float)


def read(table: Mapping[str, Any], where: str) -> Failures:
    """A card's table, whose keys and types were checked. Raises UserError for values that cannot be meant."""
    for name, value in table.items():
        most = float("inf") if name == "slow_s" else 1.0
        if not 0 <= value <= most or value == float("inf"):
            allowed = "seconds, 0 or more" if name == "slow_s" else "a share, 0 to 1"
            raise UserError(f"{where}: {name} = {value}; allowed: {allowed}")
    failures = Failures(**table)
    total = sum(failures.texts.values())
    if total > 1 + 1e-9:
        raise UserError(f"{where}: the shares of spoilt texts sum to {total:.4g}; allowed: 1 at most")
    if (failures.slow_tail > 0) != (failures.slow_s > 0):
        raise UserError(f"{where}: slow_tail and slow_s go together; give both, or neither")
    return failures
