"""Where a card contradicts what its weights say of themselves. The card holds; a person may correct it."""

import json
from collections.abc import Iterator
from pathlib import Path

from harness.backends.cards import Card
from harness.backends.gguf import Said, said
from harness.backends.weights import located
from harness.core.errors import printable
from harness.core.files import text_of


def at_odds(card: Card) -> Iterator[str]:
    """Yield a line for each contradiction; a shorter context than the weights' is a choice, and none.

    Raises:
        UserError: the weights are not found.
    """
    where = located(card)
    of = said(where) if where.is_file() else Said(context_tokens=_context(where))
    if card.licence and of.licence and card.licence.casefold() != of.licence.casefold():
        yield (
            f"licence {printable(card.licence)} by its card, {printable(of.licence)} by its file; "
            "correct the card, or ask who made the file"
        )
    if card.context_tokens and of.context_tokens and card.context_tokens > of.context_tokens:
        yield (
            f"context of {card.context_tokens} tokens by its card, {of.context_tokens} by its weights: what "
            "is longer was never trained; lower context_tokens"
        )


def _context(checkpoint: Path) -> int | None:
    """Return the longest sequence that a checkpoint's config allows; None if it does not say."""
    try:
        config = json.loads(text_of(checkpoint / "config.json", "record"))
        longest = config.get("text_config", config).get("max_position_embeddings")
    except (OSError, ValueError, AttributeError, RecursionError):
        return None
    return longest if isinstance(longest, int) else None
