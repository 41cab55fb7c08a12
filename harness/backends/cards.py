"""The model cards by name: those of files, and those made for a model that has none.

A model without a file is a directory, a GGUF file, a hub id, `replay:RUN_DIR`,
or a served one by its URL.
"""

import json
import os.path
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from harness.backends import adapters
from harness.backends.base import Letters
from harness.backends.card import Card, Latency, System, Thinking, read_cards
from harness.backends.gguf import read_facts
from harness.backends.registry import registration
from harness.backends.servers import meant
from harness.backends.vision import Vision, read_vision
from harness.core import resources
from harness.core.config import convert
from harness.core.errors import UserError, printable, sayable, unknown
from harness.core.files import bytes_of, text_of

TAUGHT = "training.json"  # stands beside weights that were taught here
SERVED = ("http", "https", "openai")  # what a served model begins with, before a colon
ANSWERS_FILE = "answers-file"  # the engine of answers that another program wrote
PROJECTOR = "mmproj-"  # prefix of a projector's GGUF file
_HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")
_TEMPLATE_FILES = ("chat_template.jinja", "tokenizer_config.json")
_SWITCH = b"enable_thinking"  # name of the thinking switch in chat templates
# Keys that decide no answer, or whose effect is in the identity of the opened model.
_PLACE = (
    "description",
    "latency",
    "weights",
    "file",
    "revision",
    "sha256",
    "gated",
    "dtype",
    "quantisation",
    "licence",
    "projector",
    "letters",
    "adapter",
    "price",
)
_SERVER_PLACE = ("base_url", "key_env", "timeout_s", "retries")


def names() -> list[str]:
    """Return the sorted names of all model cards: those of the user's project and those that ship.

    A model card is a TOML file that describes a model; its name is the file's, without `.toml`.
    """
    return resources.names("models")


def each_engine(stem: str) -> list[Card]:
    """Return the model's descriptions in `models/<stem>.toml`, one for each engine that it lists.

    Such a file is a model card. `stem` is its name without `.toml`. An engine is the program that
    runs the model; the default one's description is first. Raises UserError for a mistake in the
    file.
    """
    return read_cards(resources.find("models", f"{stem}.toml"))


def load(name: str) -> Card:
    """Return the model card named `<name>` or `<name>:<engine>`, the default engine's without one.

    A model card is the TOML file that describes a model. Raises UserError if there is none, or its
    file has a mistake.
    """
    stem, _, engine = name.partition(":")
    if stem not in names():
        raise _no_card(name)
    cards = {card.engine: card for card in each_engine(stem)}
    if engine and engine not in cards:
        raise unknown(f"engine of model {stem}", engine, cards)
    return cards[engine or next(iter(cards))]


def load_all() -> list[Card]:
    """Return all model cards, one for each engine that a TOML file of `models/` lists.

    A model card describes a model on one engine, the program that runs it.
    """
    return [card for name in names() for card in each_engine(name)]


def resolve(text: str, engine: str | None = None) -> Card:
    """Return the model card, which describes a model, for `text` as typed after `--model`.

    The text is the name of a card's TOML file, a server's URL, `replay:RUN_DIR`, a path or a hub
    id, tried in this order. `engine` chooses the engine if there is a choice. The server at a URL
    is asked what it serves. Raises UserError if there is no such model or engine, or the model does
    not run on the engine; Unanswered if no server answers.
    """
    if engine is not None:
        registration(engine)
    stem, _, named = text.partition(":")
    if stem in names():
        card = load(f"{stem}:{engine}" if engine and not named else text)
    elif (local := _local_card(text, engine)) is not None:
        card = local
    else:
        hint = (
            "a directory with a config.json, a .gguf file, a hub id such as Qwen/Qwen3-4B, the URL "
            "of a server such as http://127.0.0.1:8080/v1, or replay:RUN_DIR"
        )
        raise _no_card(text, f"; or {hint}")
    if engine not in (None, card.engine):
        raise UserError(
            f"--engine {engine}: {printable(text)!r} runs on {card.engine}; leave it out"
        )
    return card


def of_answers(name: str, file: str) -> Card:
    """Return the model card of answers that another program wrote to the file `file`.

    `name` is what the user calls the model that answered. It opens no model of that name. Raises
    UserError if terminals cannot show it.
    """
    return _new_card(name, ANSWERS_FILE, file, "Answers of another program")


def argument(card: Card) -> str:
    """Return the text after `--model` that names the model of this card.

    It is the card's name if a file has this card, or else its server's URL, run, path or hub id.
    """
    if card.name.partition(":")[0] in names() and load(card.name) == card:
        return card.name
    if card.server:
        return f"{card.server.urls[0]}#{card.weights}"
    if card.engine == "replay":
        return f"replay:{card.weights}"
    if card.engine == ANSWERS_FILE:
        return card.name
    return card.adapter or card.weights or card.name


def find_own(stated_card: Card, given: Sequence[Card], where: str, hint: str) -> Card:
    """Return the user's own model card for the model that a run's record states.

    A model card is the TOML file that describes a model. So a run, which may be a stranger's, opens
    nothing of its own: only the name is taken from it.

    Args:
        stated_card: the model card in the run's record.
        given: cards to look the name up in first; then the card files are searched.
        where: names the run in messages.
        hint: what to do, for the message if there is no such card.

    Raises:
        UserError: there is no such card, or it differs in what decides answers.
    """
    name = printable(stated_card.name)
    card = next((card for card in given if card.name == stated_card.name), None)
    if card is None:
        if stated_card.name.partition(":")[0] not in names():
            lost = (
                resources.card_to_copy(stated_card.name)
                or f"its model {name} is none of your cards; {hint}"
            )
            raise UserError(f"{where}: {lost}")
        card = load(stated_card.name)
    if differing := _differing(card, stated_card):
        raise UserError(
            f"{where}: its model {name} is not what it was ({', '.join(differing)} of your card "
            "differs); restore the card, or run again"
        )
    return card


def _no_card(model: str, hint: str = "") -> UserError:
    """Build the error for a model that has no card here; `hint` says what else would be a model."""
    lost = resources.card_to_copy(model)
    return UserError(lost) if lost else unknown("model", model, names(), hint)


def _differing(card: Card, stated_card: Card) -> list[str]:
    """Return the keys in which two cards of a model differ so that answers may differ.

    Where it lies and what people read may change:
    the identity of the opened model says what answers.
    """
    for part in ("server", "vision"):
        if bool(getattr(card, part)) != bool(getattr(stated_card, part)):
            return [f"[{part}]"]
    same = {key: getattr(stated_card, key) for key in _PLACE}
    if card.server and stated_card.server:
        same["server"] = replace(
            card.server, **{key: getattr(stated_card.server, key) for key in _SERVER_PLACE}
        )
    card = replace(card, **same)
    return [f.name for f in fields(Card) if getattr(card, f.name) != getattr(stated_card, f.name)]


def _local_card(text: str, engine: str | None) -> Card | None:
    """Return the card of a URL, `replay:RUN_DIR`, a path or a hub id, or None;
    on `engine` if it can choose.

    Raises UserError if there is no such file or run, or it does not say how to open it.
    """
    kind, _, rest = text.partition(":")
    if kind in SERVED:
        from harness.backends.openai.by_url import served_card  # imports aiohttp, which takes time

        return served_card(text)
    if kind == "replay":
        run = _path(rest)
        if run is None or not run.is_dir():
            raise UserError(
                f"model {printable(text)!r}: no such run directory; give replay: and the directory "
                "of a run"
            )
        return _run_card(run)
    path = _path(text)
    if path is not None and path.is_dir():
        return _directory_card(text, path, engine)
    if path is not None and path.suffix == ".gguf":
        return _gguf_card(text, path, engine)
    if _HUB_ID.fullmatch(text) and not text.endswith(".gguf"):
        return _new_card(text, "transformers", text, "Hub model without a card")
    address, mark, _ = text.partition("#")
    if re.search(r":\d|//", address) and (url := meant(address)):
        raise UserError(
            f"model {printable(text)!r} is no path; the URL of a server begins with http://: give "
            f"{url}{'#NAME' if mark else ''}"
        )
    if "/" in text:
        raise UserError(
            f"model {printable(text)!r} is no directory, no .gguf file and no hub id; "
            "give an existing path, or an id such as Qwen/Qwen3-4B"
        )
    return None


def _new_card(name: str, engine: str, weights: str, description: str, **settings: Any) -> Card:
    latency = Latency("paper", None, "none declared: the paper's")
    sayable("model", name)
    return Card(name, engine, description, latency, weights=weights, **settings)


def _run_card(run: Path) -> Card:
    """Return the card of a run's answers; an unreadable run fails only when it is opened."""
    record: dict[str, Any] = {}
    vision: Vision | None = None
    letters: Letters = "raw"
    with suppress(OSError, ValueError, UserError):
        record = json.loads(text_of(run / "run.json", "record"))
    with suppress(TypeError, ValueError, LookupError, UserError):
        table = record["model"]["vision"]
        vision = table and convert(table, Vision, "vision")
    with suppress(AttributeError):
        letters = "cyclic" if record.get("letters") == "cyclic" else "raw"
    name = f"replay:{run.name}"
    return _new_card(name, "replay", str(run), "Answers of a run", vision=vision, letters=letters)


def _directory_card(text: str, where: Path, engine: str | None) -> Card:
    if (where / adapters.CONFIG).is_file():
        return _adapted(f"model directory {printable(text)!r}", where, engine)
    files = sorted(file for file in where.glob("*.gguf") if not file.name.startswith(PROJECTOR))
    if (where / "config.json").is_file() and engine != "llama-cpp":
        return _new_card(
            where.name,
            "transformers",
            str(where),
            "Local directory",
            thinking=_thinking(where),
            vision=_vision(text, where),
            system=_system(_template(where)),
            letters=_letters(where),
        )
    if len(files) == 1:
        return _gguf_card(text, files[0], engine)
    if files:
        raise UserError(
            f"model directory {printable(text)!r} holds {len(files)} .gguf files; give one of them"
        )
    raise UserError(
        f"model directory {printable(text)!r} holds no config.json and no .gguf file; "
        "give the directory of a transformers checkpoint, or a .gguf file"
    )


def _adapted(subject: str, where: Path, engine: str | None) -> Card:
    """Return the card of the model that an adapter names as its base, with the adapter."""
    named = adapters.read_config(where, subject).get("base_model_name_or_path")
    path = _path(str(named))
    if path and path.is_dir() and (path / adapters.CONFIG).is_file():
        raise UserError(f"{subject} is an adapter of an adapter; give one of a whole model")
    base = resolve(str(named), engine)
    if base.adapter or not registration(base.engine).capabilities.has_weights:
        raise UserError(
            f"{subject} is an adapter of {printable(named)!r}, which is no model with weights alone"
        )
    _, _, other = base.name.partition(":")
    return replace(
        base,
        name=f"{where.name}:{other}" if other else where.name,
        adapter=str(where),
        description=f"Local adapter of {base.name}",
        letters=_letters(where),
    )


def _gguf_card(text: str, file: Path, engine: str | None) -> Card:
    """Make the card of a GGUF file, of what the file says of itself.

    On llama-cpp the projector beside it goes with it, which has the same name behind its prefix.
    """
    facts = read_facts(file)
    if facts.decision:
        raise UserError(
            f"model {printable(text)!r} is a decision model ({printable(facts.decision, 30)}), "
            "which no engine opens here; serve it by llama-server, and copy "
            "models/systemone-example.toml"
        )
    engine = engine if engine and _reads_gguf(engine) else "llama-cpp"
    projector = file.with_name(f"{PROJECTOR}{file.name}")
    vision = _vision(text, file.parent) if engine == "llama-cpp" and projector.is_file() else None
    return _new_card(
        file.stem,
        engine,
        str(file),
        f"Local GGUF file{f': {printable(facts.name)}' if facts.name else ''}",
        thinking="switch" if _SWITCH in (facts.template or "").encode() else "none",
        licence=facts.licence and printable(facts.licence),
        system=_system(facts.template),
        letters=_letters(file.parent),
        vision=vision,
        projector=projector.name if vision else None,
    )


def _reads_gguf(engine: str) -> bool:
    """Return whether an engine opens GGUF files: it finds its weights as llama-cpp does, or is
    transformers, which unpacks them.
    """
    return engine == "transformers" or registration(engine).finds == registration("llama-cpp").finds


def _path(text: str) -> Path | None:
    path = os.path.expanduser(text)
    return Path(path).resolve() if os.path.exists(path) else None


def _thinking(checkpoint: Path) -> Thinking:
    """Return `switch` if a checkpoint's chat template has the thinking switch;
    reads the file's text only.
    """
    files = (checkpoint / name for name in _TEMPLATE_FILES)
    return (
        "switch" if any(_SWITCH in bytes_of(f, "record") for f in files if f.is_file()) else "none"
    )


def _letters(weights: Path) -> Letters | None:
    """Return `raw` for what was taught here: its training used one order of the letters."""
    return "raw" if (weights / TAUGHT).is_file() else None


def _vision(text: str, checkpoint: Path) -> Vision | None:
    """Return how a checkpoint takes pictures, from its config files.
    Raises UserError if they do not say.
    """
    try:
        config, processor = (
            json.loads(text_of(file, "record")) if file.is_file() else {}
            for file in (checkpoint / "config.json", checkpoint / "preprocessor_config.json")
        )
        return read_vision(config, processor)
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(
            f"model directory {printable(text)!r}: its config does not say how it takes pictures "
            f"({printable(repr(error), 120)}); write a card with a [vision] for it"
        ) from None


def _system(template: str | None) -> System | None:
    """Return how a card made on the spot gives the system text,
    so that its chat template takes it.
    """
    from harness.backends.chat_template import needs_first_user  # imports Jinja, as few cards do

    return "first-user" if template and needs_first_user(template) else None


def _template(checkpoint: Path) -> str | None:
    """Return a checkpoint's chat template;
    None if its files do not say, which opening it reports.
    """
    with suppress(OSError, ValueError, AttributeError, RecursionError):
        if (file := checkpoint / _TEMPLATE_FILES[0]).is_file():
            return text_of(file)
        template = json.loads(text_of(checkpoint / _TEMPLATE_FILES[1], "record")).get(
            "chat_template"
        )
        return template if isinstance(template, str) else None
    return None
