"""Bound token counts by their texts: latency and energy follow from them."""

import math
from typing import TYPE_CHECKING

from harness.backends.base import Request

if TYPE_CHECKING:
    from harness.backends.registry import Capabilities

MOST_TOKENS = 10**7  # more than any context; what is counted beyond is no count
MOST_CHARACTERS = 16  # of a token, on average over a text: whoever counts fewer has not counted


def least_tokens(characters: int) -> int:
    """Return the fewest tokens that a text of so many characters can have."""
    return math.ceil(characters / MOST_CHARACTERS)


def too_few(
    request: Request,
    can: "Capabilities",
    text: str,
    prompt_tokens: int | None,
    completion_tokens: int | None,
) -> str | None:
    """Return which stated token count is too small for its text, as a phrase; None if none is.

    It guards latency and energy, which are computed from these counts. `text` is the answer to
    `request`, `can` says what the engine can do, and the counts are those of prompt and answer,
    None if unknown. The text of an answer by letters' probabilities is not the model's own, so its
    tokens are not held against it; nor are those of a server's prompt, which it may have cut.
    """
    of_prompt = sum(len(message["content"]) for message in request.messages)
    of_text = 0 if request.bare or not can.language_model else len(text)
    for tokens, characters, what in (
        (prompt_tokens, of_prompt if can.has_weights else 0, "prompt"),
        (completion_tokens, of_text, "text"),
    ):
        if tokens is not None and tokens < least_tokens(characters):
            return f"{tokens} tokens of a {what} with {characters} characters"
    return None
