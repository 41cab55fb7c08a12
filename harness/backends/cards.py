"""The model cards by name: read their files, and find the card that a user or a run names.

A card is one file, `models/<name>.toml`; `<name>:<engine>` is the same model on another engine that the file
lists. A model without a file gets its card from `harness.backends.local_cards`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from harness.backends.card import Card, Dtype, Latency, LatencySource, Thinking
from harness.backends.local_cards import local_card
from harness.backends.registry import ENGINES, registration
from harness.core import resources
from harness.core.config import convert, toml
from harness.core.errors import UserError, printable, unknown

__all__ = ["Card", "Dtype", "Latency", "LatencySource", "Thinking", "argument", "each_engine", "load",
           "load_all", "names", "own", "resolve"]  # fmt: skip

# Keys that only some engines understand; a `Registration` says which.
_ENGINE_KEYS = ("weights", "server", "revision", "sha256", "gated", "dtype", "file", "quantisation",
                "failures", "privileged", "vision", "projector", "system")  # fmt: skip
# Keys that a model may set again for each further engine.
_PER_ENGINE = ("latency", "weights", "file", "revision", "sha256", "gated", "dtype", "quantisation",
               "server", "projector")  # fmt: skip
# Keys that decide no answer, or whose effect is in the identity of the opened model.
_PLACE = ("description", "latency", "weights", "file", "revision", "sha256", "gated", "dtype", "quantisation",
          "licence", "projector", "letters")  # fmt: skip
_SERVER_PLACE = ("base_url", "key_env", "timeout_s", "retries")


def names() -> list[str]:
    """Return the sorted names of all card files."""
    return resources.names("models")


def load(name: str) -> Card:
    """Load a card by `<name>` or `<name>:<engine>`. Raises UserError if there is none or it has a mistake."""
    stem, _, engine = name.partition(":")
    if stem not in names():
        raise unknown("model", name, names())
    cards = {card.engine: card for card in each_engine(stem)}
    if engine and engine not in cards:
        raise unknown(f"engine of model {stem}", engine, cards)
    return cards[engine or next(iter(cards))]


def load_all() -> list[Card]:
    """Load all cards, on each of their engines."""
    return [card for name in names() for card in each_engine(name)]


def resolve(text: str, engine: str | None = None) -> Card:
    """Return the card of a name, `replay:RUN_DIR`, a path or a hub id, tried in this order.

    It runs on `engine`, if there is a choice. Raises UserError if there is no such model or engine, or the
    model does not run on the engine.
    """
    if engine is not None:
        registration(engine)
    stem, _, named = text.partition(":")
    if stem in names():
        card = load(f"{stem}:{engine}" if engine and not named else text)
    elif (local := local_card(text, engine)) is not None:
        card = local
    else:
        hint = (
            "a directory with a config.json, a .gguf file, a hub id such as Qwen/Qwen3-4B, or replay:RUN_DIR"
        )
        raise unknown("model", text, names(), f"; or {hint}")
    if engine not in (None, card.engine):
        raise UserError(f"--engine {engine}: {printable(text)!r} runs on {card.engine}; leave it out")
    return card


def argument(card: Card) -> str:
    """Return a value of `--model` that resolves to this card."""
    if card.name.partition(":")[0] in names() and load(card.name) == card:
        return card.name
    return f"replay:{card.weights}" if card.engine == "replay" else str(card.weights)


def own(stated: Card, given: Sequence[Card], where: str, hint: str) -> Card:
    """Return the user's own card of the model that a run names. What the run says of it opens nothing.

    Only the name of the card that the run states is looked up; the rest is compared. Cards that the user gave
    come before the card files. Raises UserError, with `where` and `hint`, if there is no such card or it
    differs.
    """
    name = printable(stated.name)
    card = next((card for card in given if card.name == stated.name), None)
    if card is None:
        if stated.name.partition(":")[0] not in names():
            raise UserError(f"{where}: its model {name} is none of your cards; {hint}")
        card = load(stated.name)
    if differing := _differing(card, stated):
        raise UserError(
            f"{where}: its model {name} is not what it was ({', '.join(differing)} of your card differs); "
            "restore the card, or run again"
        )
    return card


def _differing(card: Card, stated: Card) -> list[str]:
    """Return the keys in which two cards of a model differ so that answers may differ.

    Where it lies and what people read may change: the identity of the opened model says what answers.
    """
    for part in ("server", "vision"):
        if bool(getattr(card, part)) != bool(getattr(stated, part)):
            return [f"[{part}]"]
    same = {key: getattr(stated, key) for key in _PLACE}
    if card.server and stated.server:
        same["server"] = replace(card.server, **{key: getattr(stated.server, key) for key in _SERVER_PLACE})
    card = replace(card, **same)
    return [f.name for f in fields(Card) if getattr(card, f.name) != getattr(stated, f.name)]


@dataclass(frozen=True)
class _File(Card):
    """The content of a card file: a card, and what is different on other engines."""

    engines: dict[str, Any] = field(default_factory=dict)


def each_engine(stem: str) -> list[Card]:
    """Read a file's card on each of its engines, the default one first. Raises UserError on a mistake."""
    return _read(resources.find("models", f"{stem}.toml"))


def _read(path: Path) -> list[Card]:
    where = f"model card {path}"
    table = _with_latency(toml(path, where))
    engines = convert(table, _File, where, name=path.stem).engines
    table.pop("engines", None)
    cards = [_card(table, where, path.stem)]
    shared = {key: value for key, value in table.items() if key not in _PER_ENGINE}
    if cards[0].latency.source == "paper":  # a declared latency does not hold for another engine
        shared["latency"] = table["latency"]
    for engine, settings in engines.items():
        at = f"{where} [engines.{printable(engine)}]"
        registered = None if engine == table["engine"] else ENGINES.get(engine)
        if registered is None or "weights" not in registered.allowed_keys:
            allowed = [name for name in _engines_with("weights") if name != table["engine"]]
            raise unknown(f"engine in {where}", engine, allowed)
        if not isinstance(settings, dict):
            raise UserError(f"{at} = {printable(settings)!r}; allowed: a table")
        for key in settings:
            if key not in _PER_ENGINE:
                raise unknown(f"key in {at}", key, _PER_ENGINE)
        whole = _with_latency({**shared, **settings, "engine": engine})
        cards.append(_card(whole, at, f"{path.stem}:{engine}"))
    return cards


def _with_latency(table: dict[str, Any]) -> dict[str, Any]:
    """Add to a card's table the `inference_s` that is left out if no time is declared."""
    latency = table.get("latency")
    return {**table, "latency": {"inference_s": None, **latency}} if isinstance(latency, dict) else table


def _card(table: dict[str, Any], where: str, name: str) -> Card:
    card = convert(table, Card, where, name=name)
    if (engine := ENGINES.get(card.engine)) is None:
        raise unknown(f"engine in {where}", card.engine, ENGINES)
    for key in _ENGINE_KEYS:
        lacking = key in engine.required_keys and key not in table
        if lacking or (key in table and key not in engine.allowed_keys):
            shown = f"[{key}]" if key in ("server", "failures", "vision") else key
            takers = " or ".join(_engines_with(key))
            raise UserError(f"{where}: {shown} goes with engine = {takers}, and only with it")
    if "projector" in engine.allowed_keys and bool(card.vision) != bool(card.projector):
        raise UserError(
            f"{where}: [vision] and projector go together on {card.engine}: give the name of its mmproj "
            "file, or leave both out"
        )
    if card.server and card.thinking == "switch" and not card.server.tells_thinking:
        raise UserError(
            f'{where} [server]: thinking = "switch" needs the kind vllm or llama-server, which a request can '
            "tell; else set it at the server, and here none or always"
        )
    if card.failures and card.failures.slow_tail and card.latency.source != "card":
        raise UserError(f'{where} [failures]: a slow tail goes with a latency whose source = "card"')
    return card


def _engines_with(key: str) -> list[str]:
    return [engine for engine, registered in ENGINES.usable().items() if key in registered.allowed_keys]
