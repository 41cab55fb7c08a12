"""Registry of engines: what each can do, and how the backend of a card is opened.

Importing this loads no engine. An external package adds one by an entry point of the group
`swarmdrive.backends`: its name is the engine's name in cards, and its value is a `Registration`.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from harness.backends.base import AnswerMode, Backend
from harness.backends.engine_of_package import EngineOfPackage
from harness.core import extras
from harness.core.at_once import AUTO, AtOnce
from harness.core.config import convert
from harness.core.errors import UserError, printable, unknown
from harness.core.plugins import Plugins
from harness.core.strangers import aside, strangers, worded
from harness.runs.answerers import Answerers

if TYPE_CHECKING:
    from harness.backends.card import Card


@dataclass(frozen=True)
class Capabilities:
    """Hold what an engine, the program that runs a model, can do.

    Other code tests these fields, never an engine's name. `language_model` is false for rules,
    `answer_modes` are the ways in which it can answer, and `thinks` says which models are asked to
    think first: `always` all, `card` those whose model card (TOML file) says that they can, `never`
    none. `renders` says that prompts can be shown as its model reads them, `has_weights` that it
    loads some, `asks_helpers` that helpers are asked as well as the ego, and `closed_loop` that it
    answers for new scenes. With `own_latency` its answers were timed earlier; a `reference` is a
    driver that reports compare models with; `samples` says that it heeds a temperature, `from_file`
    that another program wrote its answers, so that nothing is asked or timed here, and `adapts`
    that it finds how many requests its servers take at once.
    """

    # whether it is a model that reads prompts, whose answers are timed and which can fuse messages
    language_model: bool = True
    # the ways in which it can answer (`Request.answer`)
    answer_modes: tuple[AnswerMode, ...] = ("json", "constrained", "readout", "decision")
    thinks: Literal["always", "card", "never"] = "always"  # if its `card` says so
    # is `Rendering`: its answers can be cached, a check can show what its model reads
    renders: bool = True
    # loads weights, which can be pulled, and has a device and a number format
    has_weights: bool = False
    asks_helpers: bool = True  # whether helpers are asked as well as the ego
    closed_loop: bool = True  # whether it answers for new scenes and not only for recorded ones
    own_latency: bool = False  # is `Timed`: its answers were timed earlier
    reference: bool = False  # whether it is a driver that a report compares models with
    # whether it heeds a request's `temperature` and `sample` (never if it is `bare`)
    samples: bool = False
    # whether its answers come from a file of another program: nothing is asked or timed here
    from_file: bool = False
    adapts: bool = False  # whether its `batch_size` may be `auto`: what its servers take well


@dataclass(frozen=True)
class Registration:
    """Describe an engine: what it can do, what its model cards need, and how a backend is opened.

    `opens`, `finds`, `prepares` and `sees` name functions of a model card (the TOML file that
    describes a model) as `module:function`: they open a backend, find the weights, prepare fetched
    ones, and count the tokens of a picture; empty for none. `answers` is a version that goes up
    when the engine answers a request otherwise than before. `card_keys` are further keys that its
    cards may have, `required_keys` those of them that they must have. `packages` has the packages
    that it needs by the name of their module, and `install` is the command that installs them.
    """

    # `module:function`, called with a card and the options of `open_backend`; returns a backend
    opens: str
    capabilities: Capabilities  # what the engine can do
    # the version of its answers, which its `identity()` states: it goes up when the engine answers
    # a request otherwise than before, which tests/conformance/test_answer_versions.py notices
    answers: int = 1
    # card keys that this engine understands and not every engine does
    card_keys: tuple[str, ...] = ()
    required_keys: tuple[str, ...] = ()  # such keys that its cards must have
    packages: Mapping[str, str] = field(default_factory=dict)  # that it needs, by the module's name
    install: str = ""  # the command that installs them
    # For an engine that has weights, `module:function` of a card, each empty if there is no such
    # thing:
    finds: str = ""  # returns the path of its weights, or raises UserError
    prepares: str = ""  # makes weights ready that were just fetched
    # returns the tokens that its image processor makes of a picture, without loading weights
    sees: str = ""

    @property
    def allowed_keys(self) -> tuple[str, ...]:
        return (*self.required_keys, *self.card_keys)


_RULE = Capabilities(language_model=False, answer_modes=("json",), thinks="never", renders=False)
_DECIDES = Capabilities(answer_modes=("decision",), thinks="never")
_ASKS = replace(_DECIDES, adapts=True)
_WEIGHTS = ("revision", "sha256", "gated", "adapter")
BUILT_IN: Mapping[str, Registration] = {
    "proxy": Registration("harness.backends.proxy:open", _RULE, card_keys=("failures",)),
    "driver": Registration(
        "harness.backends.driver:open",
        replace(_RULE, asks_helpers=False, reference=True),
        card_keys=("privileged",),
    ),
    "replay": Registration(
        "harness.backends.replay:open",
        Capabilities(renders=False, closed_loop=False, own_latency=True),
    ),
    "answers-file": Registration(
        "harness.backends.answers_file:open",
        Capabilities(answer_modes=("json",), renders=False, closed_loop=False, from_file=True),
    ),
    "transformers": Registration(
        "harness.backends.transformers.engine:open",
        Capabilities(has_weights=True, samples=True),
        card_keys=(*_WEIGHTS, "dtype", "file", "quantisation", "vision", "system"),
        required_keys=("weights",),
        packages={"torch": "torch", "transformers": "transformers"},
        install=extras.install("transformers"),
        finds="harness.backends.weights:find_weights",
        prepares="harness.backends.transformers.engine:checkpoint",
        sees="harness.backends.transformers.eyes:count_tokens",
    ),
    "llama-cpp": Registration(
        "harness.backends.llama_cpp.backend:open",
        Capabilities(has_weights=True, samples=True),
        card_keys=(*_WEIGHTS, "file", "quantisation", "vision", "projector", "system"),
        required_keys=("weights",),
        packages={"llama_cpp": "llama-cpp-python"},
        install=extras.install("llama-cpp"),
        finds="harness.backends.weights:find_gguf",
    ),
    "openai": Registration(
        "harness.backends.openai.backend:open",
        Capabilities(thinks="card", samples=True, adapts=True),
        # 2: an answer that was broken off is none, a refusal and parts of a content are read;
        # 3: so is a whole in a stream, whose end alone is none, and counts are bounded by thoughts
        answers=3,
        card_keys=("vision", "system", "price"),
        required_keys=("weights", "server"),
    ),
    **{
        wire: Registration(
            f"harness.backends.decisions.wires:open_{wire}",
            _ASKS,
            card_keys=("vision", "price"),
            required_keys=("weights", "server"),
        )
        for wire in ("systemone", "decisions")
    },
    "sparrow": Registration(
        "harness.backends.decisions.sparrow:open",
        _DECIDES,
        required_keys=("weights",),
        packages={"sparrow_decider": "sparrow-decider"},
        install=extras.install("sparrow"),
        finds="harness.backends.decisions.sparrow:find",
    ),
}


class Engines(Plugins[Registration]):
    """Hold the registrations of all engines by name; those of packages are checked and copied."""

    def _load(self, name: str) -> Registration:
        package_registration = super()._load(name)
        what = self.of_package(name)
        with worded(what, door=aside):
            fields = {
                **vars(package_registration),
                "capabilities": dict(vars(package_registration.capabilities)),
            }
            return convert(fields, Registration, what)


ENGINES = Engines("swarmdrive.backends", Registration, BUILT_IN)


def registration(engine: str, where: str = "") -> Registration:
    """Return the registration of an engine by name.

    Raises UserError if there is none, or a package's engine does not load.
    """
    entry = ENGINES.get(engine)
    if entry is None:
        raise unknown(f"engine of {where}" if where else "engine", engine, ENGINES)
    return entry


def capabilities(engine: str) -> Capabilities:
    """Return what an engine can do, by its name.

    Raises UserError if there is none of that name, or a package's engine does not load.
    """
    return registration(engine).capabilities


def reads_prompts(engine: str) -> bool:
    """Return whether an engine's models read prompts, unlike rules; true for one not installed."""
    entry = ENGINES.get(engine)
    return entry is None or entry.capabilities.language_model


def is_from_file(answerers: Answerers) -> bool:
    """Return whether a run's answers came from a file of another program, and nothing was asked.

    `answerers` says who was asked in the run, or in the first of those that it replays.
    """
    entry = ENGINES.get(str(answerers.model.get("engine")))
    return entry is not None and entry.capabilities.from_file


def open_backend(
    card: "Card", *, device: str | None = None, dtype: str | None = None, batch_size: AtOnce = 8
) -> Backend:
    """Return the backend of the model that a model card describes, with its weights loaded.

    A model card is what a TOML file of `models/` says. The options are for engines with weights.
    The device is `cpu`, or a GPU: `cuda` or `cuda:N` of transformers, `gpu` of llama.cpp; None
    takes a GPU if there is any. `dtype` is a number format instead of the card's; `batch_size` the
    most requests that go through the engine together, or `auto` where servers answer, which is 8
    for a rule. Raises UserError if a package or the weights are missing, an option is wrong, or a
    file does not load.
    """
    engine = registration(card.engine)
    if package := missing_package(card.engine):
        raise UserError(
            f"{card.shown} needs {package}, which is not installed; run `{engine.install}`"
        )
    if batch_size == AUTO:
        batch_size = AUTO if engine.capabilities.adapts else 8
    elif batch_size < 1:
        raise UserError(f"batch size {batch_size}; allowed: 1 or more")
    options = {"device": device, "dtype": dtype, "batch_size": batch_size}
    what = f"engine {printable(card.engine)}"
    if card.engine in BUILT_IN:
        with strangers(what):
            backend: Backend = import_object(engine.opens)(card, **options)
        return backend
    with worded(what):
        return EngineOfPackage(
            import_object(engine.opens)(card, **options), card, engine.capabilities
        )


def opened(card: "Card", device: str | None, dtype: str | None, batch_size: AtOnce) -> Backend:
    """Return the backend of the model that a card describes, opened only once in each process.

    `card` is the model card, the content of a model's TOML file. `device` says where the model
    runs, such as `cpu` or `cuda`, and `dtype` is the number format of its weights; None lets the
    engine or the card choose. `batch_size` is the most requests computed together. Raises UserError
    if the model cannot be opened, or an option is not allowed.
    """
    return _opened_in(os.getpid(), card, device, dtype, batch_size)


# Keyed by the process: a forked one inherits its parent's backend, and two that use one pipe would
# read each other's answers.
@lru_cache(maxsize=8)
def _opened_in(
    process: int, card: "Card", device: str | None, dtype: str | None, batch_size: AtOnce
) -> Backend:
    return open_backend(card, device=device, dtype=dtype, batch_size=batch_size)


def import_object(place: str) -> Any:
    """Return the object at a place `module:name`, after importing its module.

    Engines are named so, to be imported only when they are used.
    """
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


def engine_answer(card: "Card", place: str) -> Any:
    """Call a function of an engine with a model card, and return its result.

    Such is the path of the model's weights. A model card is the TOML file that describes a model,
    and an engine the program that runs it. `place` is where the function is, `module:name`, as the
    engine's registration has it.
    """
    with worded(f"engine {printable(card.engine)}", built_in=card.engine in BUILT_IN):
        return import_object(place)(card)


def missing_package(engine: str) -> str | None:
    """Return the first package that an engine needs and that is not installed, or None.

    `engine` is its name.
    """
    packages = registration(engine).packages
    return next(
        (package for module, package in packages.items() if find_spec(module) is None), None
    )


def missing(card: "Card") -> str | None:
    """Return what keeps the model that a card describes from running here; None if nothing does.

    A model card is the TOML file that describes a model. What is missing is the name of a package
    that is not installed, or `weights`.
    """
    if package := missing_package(card.engine):
        return package
    try:
        if registration(card.engine).finds:
            locate(card)
    except UserError:
        return "weights"
    return None


def locate(card: "Card") -> Path:
    """Return the path of the weights that a model card names, by the rules of its engine.

    A model card is the TOML file that describes a model. Raises UserError if they are not found.
    """
    where = engine_answer(card, registration(card.engine).finds)
    if not isinstance(where, Path):
        raise UserError(f"engine {printable(card.engine)} finds no path; repair its package")
    return where


def processor_tokens(card: "Card") -> int | None:
    """Return how many tokens a model's own image processor makes of one picture.

    `card` is its model card, which states the picture's size. None if its engine or weights are not
    installed, or take no pictures.
    """
    if missing(card) or not (sees := registration(card.engine).sees):
        return None
    tokens = engine_answer(card, sees)
    if type(tokens) is not int or tokens < 0:
        raise UserError(f"engine {printable(card.engine)} counts no tokens; repair its package")
    return tokens
