"""Messages and repair turns that take the most tokens, to find the longest prompts."""

from collections.abc import Mapping, Sequence
from typing import Any

from harness.prompts.answer_schema import EVIDENCE_CHARS
from harness.prompts.versions import Prompt

ERROR_CHARS = 120  # most characters of the parser's message


def dense(characters: int) -> str:
    """Return digits and spaces in turn, of this many characters.

    Each is one token for Qwen's tokenizers, the most that ASCII text takes.
    """
    return ("1 2 3 4 5 6 7 8 9 " * characters)[:characters]


EVIDENCE = dense(EVIDENCE_CHARS)


def densest_messages(senders: Sequence[str], actions: Sequence[str]) -> list[Mapping[str, Any]]:
    """Return for each sender the message that takes the most tokens, as `Prompt.render` takes it.

    `senders` are helpers' ids, `actions` the names of meta-actions. The messages serve to find the
    longest prompt.
    """
    share = round(1 / len(actions), 2)
    return [
        {
            "sender": sender,
            "evidence": EVIDENCE,
            "risk": "medium",
            "intent": (share,) * len(actions),
            "recommended_maneuver": max(actions, key=len),
            "confidence": share,
        }
        for sender in senders
    ]


def densest_plans(senders: Sequence[str], actions: Sequence[str]) -> list[Mapping[str, Any]]:
    """Return for each sender the plan that takes the most tokens, as `Prompt.render` takes it.

    A plan is what a vehicle that decides for itself says it will do. `senders` are vehicles' ids,
    `actions` the names of meta-actions. The plans serve to find the longest prompt.
    """
    share = round(1 / len(actions), 2)
    return [
        {
            "sender": sender,
            "number": 10 + n,
            "intent": (share,) * len(actions),
            "reaches_s": 100.5,
            "lost_s": 10.5,
        }
        for n, sender in enumerate(senders)
    ]


def densest_repair(
    prompt: Prompt, role: str, actions: tuple[str, ...], words: Mapping[str, str]
) -> tuple[Mapping[str, str], ...]:
    """Return the longest two messages that a repair turn adds to a chat of a prompt version.

    A repair turn asks again after an answer that could not be parsed: the two are an answer of the
    greatest length, and the request to write it again. `role` is `ego` or `helper`, `actions` are
    the names of meta-actions, and `words` texts by which the scenario describes itself.
    """
    request = prompt.repair(role, dense(ERROR_CHARS), actions, words)
    answer = dense(prompt.most_answer_tokens(role))
    return {"role": "assistant", "content": answer}, {"role": "user", "content": request}
