"""Which backend answers for which engine. A backend's module loads when a card of its engine is opened."""

from importlib import import_module

from harness.backends.base import Backend
from harness.cards import Card, Engine
from harness.errors import UserError

_OPEN: dict[Engine, str] = {
    "proxy": "harness.backends.proxy:open",
    "driver": "harness.backends.driver:open",
    "replay": "harness.backends.replay:open",
    "transformers": "harness.backends.transformers_engine:open",
    "llama-cpp": "harness.backends.llama_backend:open",
}


def open_backend(
    card: Card, *, device: str | None = None, dtype: str | None = None, batch_size: int = 8
) -> Backend:
    """The backend of a card, weights loaded. Engines without weights take the options and need none of them.

    Args:
        card: the model.
        device: `cpu`, `cuda` or `cuda:N`; None is CUDA where there is any.
        dtype: number format in place of the card's.
        batch_size: most requests that go through the engine together.
    """
    module, _, function = _OPEN[card.engine].partition(":")
    backend: Backend = getattr(import_module(module), function)(
        card, device=device, dtype=dtype, batch_size=batch_size
    )
    return backend


def missing(card: Card) -> str | None:
    """What a card lacks to run here, in a word: a package's name or `weights`. None if nothing."""
    if card.engine == "transformers":
        from harness.backends.checkpoint import find, missing_package
    elif card.engine == "llama-cpp":
        from harness.backends.llama_backend import find, missing_package
    else:
        return None
    if package := missing_package():
        return package
    try:
        find(card)
    except UserError:
        return "weights"
    return None
