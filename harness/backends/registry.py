"""Which backend answers for which engine. A backend's module loads when a card of its engine is opened."""

from importlib import import_module
from types import ModuleType

from harness.backends.base import Backend
from harness.backends.cards import WEIGHTED, Card, Engine
from harness.core.errors import UserError

_OPEN: dict[Engine, str] = {
    "proxy": "harness.backends.proxy:open",
    "driver": "harness.backends.driver:open",
    "replay": "harness.backends.replay:open",
    "transformers": "harness.backends.transformers.engine:open",
    "llama-cpp": "harness.backends.llama_cpp.backend:open",
    "openai": "harness.backends.openai.backend:open",
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


def missing_package(engine: Engine) -> str | None:
    """Name of the package that an engine lacks to run here; None if none."""
    if engine not in WEIGHTED:
        return None
    lacking: str | None = _weighted(engine).missing_package()
    return lacking


def missing(card: Card) -> str | None:
    """What a card lacks to run here, in a word: a package's name or `weights`. None if nothing."""
    if card.engine not in WEIGHTED:
        return None
    if package := missing_package(card.engine):
        return package
    try:
        _weighted(card.engine).find(card)
    except UserError:
        return "weights"
    return None


def _weighted(engine: Engine) -> ModuleType:
    """The module that knows what an engine with weights needs, and where they lie; it loads no engine."""
    from harness.backends.llama_cpp import backend as llama_backend
    from harness.backends.transformers import checkpoint

    return checkpoint if engine == "transformers" else llama_backend
