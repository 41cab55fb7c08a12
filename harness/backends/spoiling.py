"""Good answers spoilt in known ways, as small language models spoil theirs: for a proxy with failures."""

import re
from collections.abc import Sequence

from harness.backends.base import FinishReason
from harness.backends.failures import Failures
from harness.core import noise as luck


def drawn(failures: Failures, request_id: str) -> tuple[str | None, float]:
    """How a request's text fails, None if it does not, and how many seconds the answer is slow.

    Drawn for the id alone, so neither batch nor order, prompt nor condition changes it.
    """
    text, slow = luck.uniforms((2,), "proxy failure", request_id).tolist()
    slow_s = failures.slow_s if slow < failures.slow_tail else 0.0
    for how, share in failures.texts.items():
        if text < share:
            return how, slow_s
        text -= share
    return None, slow_s


def spoilt(text: str, how: str, actions: Sequence[str]) -> tuple[str, FinishReason]:
    """A good answer, which ends in compact JSON, spoilt in one of the ways of `Failures`."""
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
