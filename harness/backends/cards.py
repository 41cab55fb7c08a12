"""The model cards that are found here, and the card that a user names.

A card is one file, `models/<name>.toml`; `<name>:<engine>` is the same model on another engine that the file
names. A directory, a GGUF file, a hub id and `replay:RUN_DIR` get a card on the spot.
"""

import json
import os.path
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from harness.backends.card import Card, Dtype, Latency, LatencySource, Thinking, read
from harness.backends.registry import engines
from harness.backends.vision import Vision, of_checkpoint
from harness.core import resources
from harness.core.config import convert
from harness.core.errors import UserError, printable, unknown

__all__ = ["Card", "Dtype", "Latency", "LatencySource", "Thinking", "argument", "each_engine", "load",
           "load_all", "names", "resolve"]  # fmt: skip

_HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")
_TEMPLATE_FILES = ("chat_template.jinja", "tokenizer_config.json")
PROJECTOR = "mmproj-"  # how a GGUF file of one begins
_SWITCH = b"enable_thinking"  # what a chat template calls its thinking switch
_GGUF_HEAD = 1 << 25  # bytes of a GGUF file that hold its vocabulary and its template


def names() -> list[str]:
    """Names of all card files, sorted."""
    return resources.names("models")


def load(name: str) -> Card:
    """The card of a name, or of `<name>:<engine>`.

    Raises:
        UserError: there is no such card, it names no such engine, or its file has a mistake.
    """
    stem, _, engine = name.partition(":")
    if stem not in names():
        raise unknown("model", name, names())
    found = each_engine(stem)
    if engine and engine not in {card.engine for card in found}:
        raise unknown(f"engine of model {stem}", engine, [card.engine for card in found])
    return next(card for card in found if engine in ("", card.engine))


def load_all() -> list[Card]:
    """Every card, on each of its engines."""
    return [card for name in names() for card in each_engine(name)]


def each_engine(stem: str) -> list[Card]:
    """The card of a file's name on each of its engines. Raises UserError if the file has a mistake."""
    return read(resources.find("models", f"{stem}.toml"))


def resolve(text: str, engine: str | None = None) -> Card:
    """The card of a name, `replay:RUN_DIR`, a path or a hub id, tried in this order.

    Args:
        text: what the user wrote.
        engine: what to run it on, where there is a choice; None for its own.
    """
    if engine is not None and engine not in engines():
        raise unknown("engine", engine, engines())
    stem, _, named = text.partition(":")
    if stem in names():
        card = load(f"{stem}:{engine}" if engine and not named else text)
    else:
        card = _on_the_spot(text, engine)
    if engine not in (None, card.engine):
        raise UserError(f"--engine {engine}: {printable(text)!r} runs on {card.engine}; leave it out")
    return card


def argument(card: Card) -> str:
    """What `--model` was given, or anything that resolves to the same card."""
    if card.name.partition(":")[0] in names() and load(card.name) == card:
        return card.name
    return f"replay:{card.weights}" if card.engine == "replay" else str(card.weights)


def _on_the_spot(text: str, engine: str | None) -> Card:
    kind, _, rest = text.partition(":")
    if kind == "replay":
        run = _path(rest)
        if run is None or not run.is_dir():
            raise UserError(
                f"model {printable(text)!r}: no such run directory; give replay: and the directory of a run"
            )
        return replace(
            _made(f"replay:{run.name}", "replay", str(run), "Answers of a run"), vision=_stated(run)
        )
    where = _path(text)
    if where is not None and where.is_dir():
        return _of_directory(text, where, engine)
    if where is not None and where.suffix == ".gguf":
        return _of_file(text, where)
    if _HUB_ID.fullmatch(text) and not text.endswith(".gguf"):
        return _made(text, "transformers", text, "Hub model without a card")
    if "/" in text:
        raise UserError(
            f"model {printable(text)!r} is no directory, no .gguf file and no hub id; "
            "give an existing path, or an id such as Qwen/Qwen3-4B"
        )
    hint = (
        "; or a directory with a config.json, a .gguf file, a hub id such as Qwen/Qwen3-4B, or replay:RUN_DIR"
    )
    raise unknown("model", text, names(), hint)


def _of_directory(text: str, where: Path, engine: str | None) -> Card:
    files = sorted(file for file in where.glob("*.gguf") if not file.name.startswith(PROJECTOR))
    if (where / "config.json").is_file() and engine != "llama-cpp":
        card = _made(where.name, "transformers", str(where), "Local directory", _thinking(where))
        return replace(card, vision=_vision(text, where))
    if len(files) == 1:
        return _of_file(text, files[0])
    if files:
        raise UserError(
            f"model directory {printable(text)!r} holds {len(files)} .gguf files; give one of them"
        )
    raise UserError(
        f"model directory {printable(text)!r} holds no config.json and no .gguf file; "
        "give the directory of a transformers checkpoint, or a .gguf file"
    )


def _of_file(text: str, file: Path) -> Card:
    """The card of a GGUF file, with the projector that lies beside it under its name."""
    card = _made(file.stem, "llama-cpp", str(file), "Local GGUF file", _gguf_thinking(file))
    beside = file.with_name(f"{PROJECTOR}{file.name}")
    vision = _vision(text, file.parent) if beside.is_file() else None
    return replace(card, vision=vision, projector=beside.name if vision else None)


def _path(text: str) -> Path | None:
    """What is at a path, absolute; None for any other text, however odd (`os.path` never raises)."""
    path = os.path.expanduser(text)
    return Path(path).resolve() if os.path.exists(path) else None


def _made(name: str, engine: str, weights: str, description: str, thinking: Thinking = "none") -> Card:
    latency = Latency("paper", None, "none declared: the paper's")
    return Card(name, engine, description, latency, weights=weights, thinking=thinking)


def _thinking(checkpoint: Path) -> Thinking:
    """Whether a checkpoint's chat template knows the thinking switch, read without loading it."""
    files = (checkpoint / name for name in _TEMPLATE_FILES)
    return "switch" if any(_SWITCH in f.read_bytes() for f in files if f.is_file()) else "none"


def _stated(run: Path) -> Vision | None:
    """How the model of a run took pictures; None too where nothing can be read, which opening it says."""
    with suppress(OSError, ValueError, TypeError, KeyError, UserError):
        stated = json.loads((run / "run.json").read_bytes())["model"]["vision"]
        return stated and convert(stated, Vision, "vision")
    return None


def _vision(text: str, checkpoint: Path) -> Vision | None:
    """How a checkpoint takes pictures, by its small files. Raises UserError where they do not say."""
    try:
        config, processor = (
            json.loads(file.read_bytes()) if file.is_file() else {}
            for file in (checkpoint / "config.json", checkpoint / "preprocessor_config.json")
        )
        return of_checkpoint(config, processor)
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise UserError(
            f"model directory {printable(text)!r}: its config does not say how it takes pictures "
            f"({printable(repr(error), 120)}); write a card with a [vision] for it"
        ) from None


def _gguf_thinking(file: Path) -> Thinking:
    """Whether the chat template in a GGUF file knows the thinking switch, read without parsing the file."""
    with file.open("rb") as data:
        return "switch" if _SWITCH in data.read(_GGUF_HEAD) else "none"
