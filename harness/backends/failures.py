"""Deliberate failures of the proxy at known rates, so that a run's counts of failures can be checked."""

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated

from msgspec import Meta

from harness.backends.base import FinishReason
from harness.core.config import Seconds

Share = Annotated[float, Meta(ge=0, le=1, description="a share, 0 to 1")]


@dataclass(frozen=True)
class Failures:
    """The share of answers with each failure, drawn for each request on its own; the others are good.

    A text is spoilt in one way at most; any answer may be slow as well.
    """

    fence: Share = 0.0  # the answer is in a code fence. Recovered.
    prose: Share = 0.0  # the answer is between sentences. Recovered.
    truncation: Share = 0.0  # the answer is cut off inside its JSON. Failed, `truncated_json`.
    nan: Share = 0.0  # one probability is NaN. Failed, `non_finite`.
    unknown_action: Share = 0.0  # no action's name is one of the scenario's. Failed, `unknown_action`.
    unclosed_think: Share = 0.0  # the answer is in a thought that never ends. Failed, `truncated_reasoning`.
    slow_tail: Share = 0.0  # the answer takes `slow_s` seconds longer than the card's latency
    slow_s: Seconds = 0.0

    def __post_init__(self) -> None:
        if (total := sum(self.texts.values())) > 1 + 1e-9:
            raise ValueError(f"the shares of spoilt texts sum to {total:.4g}; allowed: 1 at most")
        if (self.slow_tail > 0) != (self.slow_s > 0):
            raise ValueError("slow_tail and slow_s go together; give both, or neither")

    @property
    def texts(self) -> dict[str, float]:
        """The shares of the spoilt texts by name."""
        return {name: rate for name, rate in asdict(self).items() if not name.startswith("slow_")}


def draw_failure(failures: Failures, request_id: str) -> tuple[str | None, float]:
    """Draw how a request's text fails (None if it does not), and by how many seconds its answer is slow.

    The draw depends on the id only, so batch, order, prompt and condition do not change it.
    """
    from harness.core import noise  # imports NumPy, which listing cards does not need

    text, slow = noise.uniforms((2,), "proxy failure", request_id).tolist()
    slow_s = failures.slow_s if slow < failures.slow_tail else 0.0
    for how, share in failures.texts.items():
        if text < share:
            return how, slow_s
        text -= share
    return None, slow_s


def spoil(text: str, how: str, actions: Sequence[str]) -> tuple[str, FinishReason]:
    """Spoil a good answer, which ends in compact JSON, in one of the ways of `Failures`."""
    match how:
        case "fence":
            return f"```json\n{text}\n```", "stop"
        case "prose":
            return f"Here is what I would do.\n\n{text}\n\nThis keeps a safe distance.", "stop"
        case "truncation":
            return text[: text.rindex(":") + 1], "length"
        case "nan":
            return re.sub(r":[\d.]+", ":NaN", text, count=1), "stop"
        case "unknown_action":
            for action in actions:
                text = text.replace(f'"{action}"', f'"NOT_{action}"')
            return text, "stop"
        case "unclosed_think":
            return f"<think>\nPerhaps {text}", "length"
    raise ValueError(f"no failure {how!r}")
