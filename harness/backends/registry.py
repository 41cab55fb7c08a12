"""Which engines there are, what each can do, and the backend that answers for it.

Importing this loads no engine. A package from outside adds one by an entry point of the group
`swarmdrive.backends`: its name is the engine's name in cards, its value a `Registration`.
"""

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Literal

from harness.core import extras
from harness.core.errors import UserError, printable, unknown

if TYPE_CHECKING:
    from harness.backends.base import AnswerMode, Backend
    from harness.backends.cards import Card

GROUP = "swarmdrive.backends"


@dataclass(frozen=True)
class Capabilities:
    """What an engine can do. Other rooms ask for this, never for an engine's name.

    Attributes:
        language_model: a language model wrote the answers, so they take time that can be measured, and it can
            be asked to fuse messages.
        answer_modes: how it can be asked.
        thinks: whether it can be asked to think first: `always`, if its `card` says so, or `never`.
        renders: it is a `harness.backends.base.Rendering`, so its answers can be cached and a check can show
            what its model reads.
        has_weights: it loads weights here, so they can be pulled, and a device and a number format chosen.
        asks_helpers: helpers are asked as well as the ego.
        closed_loop: it answers for scenes that are new, not only for recorded ones.
        own_latency: it is a `harness.backends.base.Timed`: its answers were timed before.
        reference: a driver that a report holds models against.
        samples: it heeds a request's `temperature` and `sample`, but for a `readout`.
    """

    language_model: bool = True
    answer_modes: "tuple[AnswerMode, ...]" = ("json", "constrained", "readout")
    thinks: Literal["always", "card", "never"] = "always"
    renders: bool = True
    has_weights: bool = False
    asks_helpers: bool = True
    closed_loop: bool = True
    own_latency: bool = False
    reference: bool = False
    samples: bool = False


@dataclass(frozen=True)
class Registration:
    """One engine.

    Attributes:
        opens: `module:function`, called with a card and the options of `open_backend`; returns a backend.
        capabilities: what it can do.
        card_keys: keys of a card that mean something to this engine and not to every other.
        required_keys: keys of that kind that its cards must have.
        packages: packages that it needs, by the name of the module that must be there.
        install: the command that installs them.
        finds: `module:function`, which returns where a card's weights lie and raises UserError if nowhere;
            for an engine that has weights.
        sees: `module:function`, which returns the tokens that a card's own image processor makes of a picture
            of the card's size, without loading its weights; empty where there is no such way.
    """

    opens: str
    capabilities: Capabilities
    card_keys: tuple[str, ...] = ()
    required_keys: tuple[str, ...] = ()
    packages: Mapping[str, str] = field(default_factory=dict)
    install: str = ""
    finds: str = ""
    sees: str = ""

    @property
    def allowed_keys(self) -> tuple[str, ...]:
        """Keys that its cards may have and not all others."""
        return (*self.required_keys, *self.card_keys)


_RULE = Capabilities(language_model=False, answer_modes=("json",), thinks="never", renders=False)
_WEIGHTS = ("revision", "sha256", "gated")
BUILT_IN: Mapping[str, Registration] = {
    "proxy": Registration("harness.backends.proxy:open", _RULE, card_keys=("failures",)),
    "driver": Registration(
        "harness.backends.driver:open",
        replace(_RULE, asks_helpers=False, reference=True),
        card_keys=("privileged",),
    ),
    "replay": Registration(
        "harness.backends.replay:open", Capabilities(renders=False, closed_loop=False, own_latency=True)
    ),
    "transformers": Registration(
        "harness.backends.transformers.engine:open",
        Capabilities(has_weights=True, samples=True),
        card_keys=(*_WEIGHTS, "dtype", "vision"),
        required_keys=("weights",),
        packages={"torch": "torch", "transformers": "transformers"},
        install=extras.install("transformers"),
        finds="harness.backends.weights:find_checkpoint",
        sees="harness.backends.transformers.processor:tokens",
    ),
    "llama-cpp": Registration(
        "harness.backends.llama_cpp.backend:open",
        Capabilities(has_weights=True, samples=True),
        card_keys=(*_WEIGHTS, "file", "quantisation", "vision", "projector"),
        required_keys=("weights",),
        packages={"llama_cpp": "llama-cpp-python"},
        install=extras.install("llama-cpp"),
        finds="harness.backends.weights:find_gguf",
    ),
    "openai": Registration(
        "harness.backends.openai.backend:open",
        Capabilities(thinks="card", samples=True),
        card_keys=("vision",),
        required_keys=("weights", "server"),
    ),
}


def engines() -> list[str]:
    """Names of all engines: those built in, then the plug-ins."""
    from importlib.metadata import entry_points

    return list(dict.fromkeys([*BUILT_IN, *sorted(entry_points(group=GROUP).names)]))


def find(engine: str) -> Registration | None:
    """The registration of an engine; None if there is none of that name.

    Raises:
        UserError: a plug-in of that name does not load.
    """
    return BUILT_IN.get(engine) or _plug_in(engine)


@cache
def _plug_in(engine: str) -> Registration | None:
    from importlib.metadata import entry_points

    for entry in entry_points(group=GROUP, name=engine):
        try:
            loaded = entry.load()
        except Exception as error:  # whatever a package's import may raise
            raise UserError(
                f"engine {printable(engine)!r}: {printable(entry.value)} does not load ({printable(error)}); "
                "fix the package that registers it, or uninstall it"
            ) from error
        if isinstance(loaded, Registration):
            return loaded
        raise UserError(
            f"engine {printable(engine)!r}: {printable(entry.value)} is a {type(loaded).__name__}; "
            "it must be a harness.backends.registry.Registration"
        )
    return None


def registration(engine: str) -> Registration:
    """The registration of an engine. Raises UserError if there is none, or a plug-in fails."""
    if (found := find(engine)) is None:
        raise unknown("engine", engine, engines())
    return found


def capabilities(engine: str) -> Capabilities:
    """What an engine can do. Raises UserError if there is none of that name, or a plug-in fails."""
    return registration(engine).capabilities


def registrations() -> dict[str, Registration]:
    """Every engine by its name, but for plug-ins that do not load."""
    loaded = {}
    for engine in engines():
        with suppress(UserError):
            loaded[engine] = registration(engine)
    return loaded


def open_backend(
    card: "Card", *, device: str | None = None, dtype: str | None = None, batch_size: int = 8
) -> "Backend":
    """The backend of a card, weights loaded. Engines without weights take the options and need none of them.

    Args:
        card: the model.
        device: `cpu`, `cuda` or `cuda:N`; None is CUDA where there is any.
        dtype: number format in place of the card's.
        batch_size: most requests that go through the engine together.

    Raises:
        UserError: a package or the weights are missing, an option cannot be, or a file does not load.
    """
    engine = registration(card.engine)
    if package := missing_package(card.engine):
        raise UserError(
            f"model {printable(card.name)!r} needs {package}, which is not installed; run `{engine.install}`"
        )
    if batch_size < 1:
        raise UserError(f"batch size {batch_size}; allowed: 1 or more")
    backend: Backend = resolve(engine.opens)(card, device=device, dtype=dtype, batch_size=batch_size)
    return backend


def opened(card: "Card", device: str | None, dtype: str | None, batch_size: int) -> "Backend":
    """This process's backend of a card, opened once (see `open_backend`)."""
    return _opened_in(os.getpid(), card, device, dtype, batch_size)


# A forked process has its parent's, and may not ask it: two at one pipe read each other's answers.
@lru_cache(maxsize=8)
def _opened_in(
    process: int, card: "Card", device: str | None, dtype: str | None, batch_size: int
) -> "Backend":  # fmt: skip
    return open_backend(card, device=device, dtype=dtype, batch_size=batch_size)


def resolve(place: str) -> Any:
    """What is at `module:name`; its module is imported."""
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


def missing_package(engine: str) -> str | None:
    """Name of the package that an engine lacks to run here; None if none."""
    packages = registration(engine).packages
    return next((package for module, package in packages.items() if find_spec(module) is None), None)


def missing(card: "Card") -> str | None:
    """What a card lacks to run here, in a word: a package's name or `weights`. None if nothing."""
    if package := missing_package(card.engine):
        return package
    try:
        if finds := registration(card.engine).finds:
            resolve(finds)(card)
    except UserError:
        return "weights"
    return None


def processor_tokens(card: "Card") -> int | None:
    """Tokens that a card's own image processor makes of a picture of the card's size; None if not here."""
    if missing(card) or not (sees := registration(card.engine).sees):
        return None
    tokens: int = resolve(sees)(card)
    return tokens
