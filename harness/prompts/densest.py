"""The messages and the repair turns that take the most tokens, to count prompts with."""

from collections.abc import Mapping, Sequence
from typing import Any

from harness.prompts.answer_schema import EVIDENCE_CHARS
from harness.prompts.versions import Prompt

ERROR_CHARS = 120  # of the parser's sentence, at most


def dense(characters: int) -> str:
    """Digits and spaces in turn: a token a character for Qwen's tokenizers, and ASCII text has never more."""
    return ("1 2 3 4 5 6 7 8 9 " * characters)[:characters]


EVIDENCE = dense(EVIDENCE_CHARS)


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


def densest_repair(
    prompt: Prompt, role: str, actions: tuple[str, ...], words: Mapping[str, str]
) -> tuple[Mapping[str, str], ...]:
    """What a repair turn adds to a chat: an answer of all tokens that it may have, and what is said of it."""
    said = prompt.repair(role, dense(ERROR_CHARS), actions, words)
    answer = dense(prompt.max_answer_tokens[role])
    return {"role": "assistant", "content": answer}, {"role": "user", "content": said}
