"""A model card: what a model is, what it may see and where its latency comes from.

A card is one file, `models/<name>.toml`. A directory with a config.json, a hub id and `replay:RUN_DIR`
get a card on the spot.
"""

import os.path
import re
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from harness.errors import UserError, printable, unknown
from harness.resources import folder

Engine = Literal["proxy", "driver", "replay", "transformers", "llama-cpp"]
Dtype = Literal["float32", "bfloat16", "auto"]
Thinking = Literal["none", "switch", "always"]
LatencySource = Literal["card", "measured"]
WEIGHTED: tuple[Engine, ...] = ("transformers", "llama-cpp")  # engines that load weights here

_HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")
_TEMPLATE_FILES = ("chat_template.jinja", "tokenizer_config.json")


@dataclass(frozen=True)
class Latency:
    """Time of one answer.

    Attributes:
        source: `card` takes `inference_s` as it stands; `measured` takes each run's own batch-1 seconds.
        inference_s: declared seconds of one answer; None when measured.
        basis: where the number comes from: "cited: ...", "declared: ...", or "measured: machine, date".
    """

    source: LatencySource
    inference_s: float | None
    basis: str


@dataclass(frozen=True)
class Card:
    """One model.

    Attributes:
        name: file stem of the card, name of the directory, hub id, or `replay:<run>`.
        engine: which backend answers.
        description: one line for people.
        latency: time of one answer.
        weights: directory (absolute, or relative to the cards) or hub id; the run's directory for `replay`;
            None if model-free.
        file: name of the GGUF file in `weights`; None where `weights` is the file, or needs none.
        revision: branch, tag or commit on the hub; None is its default branch.
        dtype: number format of the weights; `auto` is the checkpoint's own.
        context_tokens: most tokens of prompt and answer together; None takes the checkpoint's own.
        thinking: `switch` if its chat template can turn thinking on and off, `always` if it cannot be off.
        privileged: sees the truth behind the occlusion: an upper reference, never a contestant.
        licence: SPDX id of the weights.
        max_new_tokens: most tokens of an answer, where the model needs another bound than its prompt's.
        thinking_tokens: most tokens of a thought, on top of the answer's where the model is asked to think.
    """

    name: str
    engine: Engine
    description: str
    latency: Latency
    weights: str | None = None
    file: str | None = None
    revision: str | None = None
    dtype: Dtype = "auto"
    context_tokens: int | None = None
    thinking: Thinking = "none"
    privileged: bool = False
    licence: str | None = None
    max_new_tokens: int | None = None
    thinking_tokens: int = 2048


_CARD_KEYS: Mapping[str, type] = {
    "engine": str,
    "description": str,
    "latency": dict,
    "weights": str,
    "file": str,
    "revision": str,
    "dtype": str,
    "context_tokens": int,
    "thinking": str,
    "privileged": bool,
    "licence": str,
    "max_new_tokens": int,
    "thinking_tokens": int,
}
_LATENCY_KEYS: Mapping[str, type] = {"source": str, "inference_s": float, "basis": str}
_CHOICES = {
    "engine": get_args(Engine),
    "dtype": get_args(Dtype),
    "thinking": get_args(Thinking),
    "source": get_args(LatencySource),
}


def names() -> list[str]:
    """Names of the cards at hand, sorted."""
    return sorted(path.stem for path in folder("models").glob("*.toml"))


def load(name: str) -> Card:
    """The card of a name. Raises UserError for an unknown name and for every mistake in its file."""
    if name not in names():
        raise unknown("model", name, names())
    path = folder("models") / f"{name}.toml"
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"model card {path} is no TOML: {printable(error)}; mend the file") from None
    return _card(name, table, f"model card {path}")


def resolve(text: str) -> Card:
    """The card that a user means by a name, `replay:RUN_DIR`, a directory or a hub id, tried so."""
    if text in names():
        return load(text)
    kind, _, rest = text.partition(":")
    if kind == "replay":
        run = _directory(rest)
        if run is None:
            raise UserError(
                f"model {printable(text)!r}: no such run directory; give replay: and the directory of a run"
            )
        return _on_the_spot(f"replay:{run.name}", "replay", str(run), "Answers of a run")
    where = _directory(text)
    if where is not None:
        if not (where / "config.json").is_file():
            raise UserError(
                f"model directory {printable(text)!r} holds no config.json; "
                "give the directory of a transformers checkpoint"
            )
        return _on_the_spot(where.name, "transformers", str(where), "Local directory", _thinking(where))
    if _HUB_ID.fullmatch(text):
        return _on_the_spot(text, "transformers", text, "Hub model without a card")
    if "/" in text:
        raise UserError(
            f"model {printable(text)!r} is no directory and no hub id; "
            "give an existing directory, or an id such as Qwen/Qwen3-4B"
        )
    hint = "; or a directory with a config.json, a hub id such as Qwen/Qwen3-4B, or replay:RUN_DIR"
    raise unknown("model", text, names(), hint)


def _directory(text: str) -> Path | None:
    """An existing directory, absolute; None for any other text, however odd (`os.path` never raises)."""
    path = os.path.expanduser(text)
    return Path(path).resolve() if os.path.isdir(path) else None


def _on_the_spot(
    name: str, engine: Engine, weights: str, description: str, thinking: Thinking = "none"
) -> Card:
    latency = Latency("measured", None, "batch-1 seconds of the run")
    return Card(name, engine, description, latency, weights=weights, thinking=thinking)


def _thinking(checkpoint: Path) -> Thinking:
    """Whether a checkpoint's chat template knows the thinking switch, read without loading it."""
    files = (checkpoint / name for name in _TEMPLATE_FILES)
    known = any("enable_thinking" in f.read_text(errors="replace") for f in files if f.is_file())
    return "switch" if known else "none"


def _card(name: str, table: Mapping[str, Any], where: str) -> Card:
    _check(table, where, _CARD_KEYS, required=("engine", "description", "latency"))
    latency = table["latency"]
    _check(latency, f"{where} [latency]", _LATENCY_KEYS, required=("source", "basis"))
    seconds = latency.get("inference_s")
    if (latency["source"] == "card") != (seconds is not None):
        raise UserError(f'{where} [latency]: inference_s goes with source = "card", and only with it')
    if seconds is not None and not 0 <= seconds < float("inf"):
        raise UserError(f"{where} [latency]: inference_s = {seconds}; allowed: seconds, 0 or more")
    for key in ("context_tokens", "max_new_tokens", "thinking_tokens"):
        if table.get(key, 1) < 1:
            raise UserError(f"{where}: {key} = {table[key]}; allowed: 1 or more")
    if (table["engine"] in WEIGHTED) != ("weights" in table):
        raise UserError(f"{where}: weights go with engine = {' or '.join(WEIGHTED)}, and only with it")
    if "file" in table and table["engine"] != "llama-cpp":
        raise UserError(f'{where}: file = {printable(table["file"])!r}; only engine = "llama-cpp" has one')
    if table.get("privileged") and table["engine"] != "driver":
        raise UserError(f'{where}: privileged = true; only engine = "driver" may see the truth')
    return Card(name=name, **{**table, "latency": Latency(latency["source"], seconds, latency["basis"])})


def _check(table: Mapping[str, Any], where: str, keys: Mapping[str, type], required: Collection[str]) -> None:
    """Refuse unknown keys, missing keys, wrong types and values that are none of the choices."""
    for key, value in table.items():
        if key not in keys:
            raise unknown(f"key in {where}", key, keys)
        kind = keys[key]
        # By exact type: a bool is an int to isinstance. TOML writes 0 seconds as an integer.
        if type(value) is not kind and not (kind is float and type(value) is int):
            raise UserError(f"{where}: {key} = {printable(value)!r}; allowed: a {kind.__name__}")
        if value not in _CHOICES.get(key, (value,)):
            raise unknown(f"{key} in {where}", str(value), _CHOICES[key])
    for key in required:
        if key not in table:
            raise UserError(f"{where} has no {key}; add it")
