"""The messages that take the most tokens, to count a fusion call's prompt with."""

from collections.abc import Mapping, Sequence
from typing import Any

from harness.prompts.answer_schema import EVIDENCE_CHARS

# Digits and spaces in turn: a token a character for Qwen's tokenizers, and ASCII text has never more.
EVIDENCE = ("1 2 3 4 5 6 7 8 9 " * EVIDENCE_CHARS)[:EVIDENCE_CHARS]


def densest_messages(senders: Sequence[str], actions: Sequence[str]) -> list[Mapping[str, Any]]:
    """A message from each sender as `Prompt.render` takes it, its evidence as long and dense as allowed."""
    share = round(1 / len(actions), 2)
    return [
        {
            "sender": sender, "evidence": EVIDENCE, "risk": "medium", "intent": (share,) * len(actions),
            "recommended_maneuver": max(actions, key=len), "confidence": share,
        }
        for sender in senders
    ]  # fmt: skip
