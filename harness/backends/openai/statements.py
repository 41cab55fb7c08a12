"""What a server states of its model: weights, template, context and version, as far as its kind tells.

All of it is part of the model's identity, so that other weights under the same name are asked again. What
only says when or where a server was started, or what it is doing, is left out.
"""

import json
import math
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

from harness.backends.openai.http import Reply
from harness.backends.servers import Kind
from harness.core.errors import printable
from harness.core.files import sha256_bytes

Ask = Callable[[str, bytes | None], Awaitable[Reply]]  # a path beside `/v1`, and JSON to send
Fact = str | int | float | bool
_LISTED = ("id", "owned_by", "root", "max_model_len")
# Keys that say nothing of a model, at any depth: dates, permissions, prices, and what the server is doing.
_PASSING = frozenset({
    "active", "created", "created_at", "expires_at", "last_used", "loaded", "loaded_context_length",
    "modified_at", "object", "per_request_limits", "permission", "permissions", "pricing", "state", "status",
    "updated_at", "uptime",
})  # fmt: skip
_MOST_FACTS, _MOST_DEPTH = 64, 4
_SHOWN = 100  # longest text that is kept as it is; of longer ones, such as templates, the digest is kept
_EXACT = 2**53  # integers beyond are no JSON numbers that every program reads alike
_WEIGHTS = ("digest", "n_params", "size")  # last names of facts that change if the weights do, as a rule


class Model(NamedTuple):
    """A server's statement about its model."""

    listed: dict[str, Any] | None = None  # name, owner, root and length in the server's list
    version: str | None = None  # version of the server; None if it does not tell
    states: Mapping[str, Fact] = {}  # everything else, by dotted names; long texts as digests

    @property
    def tells_weights(self) -> bool:
        """Whether other weights under the same name would show, as a rule: by a digest or their size."""
        return any(name.rpartition(".")[2] in _WEIGHTS for name in self.states)

    def covers(self, earlier: "Model") -> bool:
        """Return whether it states all that an earlier one did; a server that is loading states less."""
        lists = earlier.listed is None or self.listed is not None
        tells_version = earlier.version is None or self.version is not None
        return lists and tells_version and earlier.states.keys() <= self.states.keys()


async def read_statement(kind: Kind, weights: str, models: Any, ask: Ask) -> Model:
    """Return what a server states of a model, by its answer to `/v1/models` and what else it is asked.

    A server with one model accepts any name for it.
    """
    if (entry := _entry(models, "data", weights)) is None:
        return Model()
    listed = {
        k: v if type(v) is int and abs(v) <= _EXACT else printable(v) for k in _LISTED if (v := entry.get(k))
    }
    facts = {name: value for name, value in entry.items() if name not in _LISTED}
    version = None
    if kind in _MORE:
        version, more = await _MORE[kind](weights, ask)
        facts |= more
    return Model(listed, printable(version) if isinstance(version, str) else None, _flat(facts))


async def _vllm(weights: str, ask: Ask) -> tuple[Any, dict[str, Any]]:
    return _dict(await ask("/version", None)).get("version"), {}


async def _llama_server(weights: str, ask: Ask) -> tuple[Any, dict[str, Any]]:
    props = _dict(await ask("/props", None))
    settings = props.get("default_generation_settings")
    settings = settings if isinstance(settings, dict) else {}
    path = props.get("model_path")
    facts = {name: props.get(name) for name in ("chat_template", "modalities", "bos_token", "eos_token")} | {
        "file": path.replace("\\", "/").rpartition("/")[2] if isinstance(path, str) else None,
        "n_ctx": settings.get("n_ctx", props.get("n_ctx")),
        # What it does where a request says nothing: penalties, DRY, XTC.
        "sampling": _text(settings["params"]) if isinstance(settings.get("params"), dict) else None,
    }
    return props.get("build_info"), facts


async def _ollama(weights: str, ask: Ask) -> tuple[Any, dict[str, Any]]:
    version = _dict(await ask("/api/version", None)).get("version")
    tag = _entry(_dict(await ask("/api/tags", None)), "models", weights) or {}
    show = _dict(await ask("/api/show", json.dumps({"model": weights}).encode()))
    facts = {name: tag.get(name) for name in ("digest", "size", "details")}
    for name in ("template", "parameters", "system", "details", "model_info", "projector_info"):
        if (value := show.get(name)) is not None:
            facts[name] = value if name == "details" else _text(value)
    return version, facts


async def _lm_studio(weights: str, ask: Ask) -> tuple[Any, dict[str, Any]]:
    return None, _entry(_dict(await ask("/api/v0/models", None)), "data", weights) or {}


_MORE: Mapping[Kind, Callable[[str, Ask], Awaitable[tuple[Any, dict[str, Any]]]]] = {
    "vllm": _vllm, "llama-server": _llama_server, "ollama": _ollama, "lm-studio": _lm_studio,
}  # fmt: skip


def _dict(reply: Reply) -> dict[str, Any]:
    return reply.payload if isinstance(reply.payload, dict) else {}


def _entry(payload: Any, key: str, weights: str) -> dict[str, Any] | None:
    """Return the entry of a model in a list of models, or the only one; None if there is none."""
    listed = payload.get(key) if isinstance(payload, dict) else None
    entries = [entry for entry in listed if isinstance(entry, dict)] if isinstance(listed, list) else []
    for name in (weights, f"{weights}:latest"):  # Ollama adds the tag
        for entry in entries:
            if name in (entry.get("id"), entry.get("name"), entry.get("model")):
                return entry
    return entries[0] if len(entries) == 1 else None


def _flat(facts: Mapping[str, Any]) -> dict[str, Fact]:
    """Return facts by dotted names, sorted. Of too many, the last are one digest."""
    flat = dict(sorted(_leaves(facts, "")))
    if len(flat) > _MOST_FACTS:
        names = list(flat)
        rest = {name: flat.pop(name) for name in names[_MOST_FACTS - 1 :]}
        flat["more"] = _digest(json.dumps(rest))
    return flat


def _leaves(facts: Mapping[str, Any], above: str, depth: int = 1) -> Iterator[tuple[str, Fact]]:
    for name, value in facts.items():
        if name in _PASSING or value is None or value == "":
            continue
        at = f"{above}{printable(name, _SHOWN)}"
        if isinstance(value, dict) and depth < _MOST_DEPTH:
            yield from _leaves(value, f"{at}.", depth + 1)
        else:
            yield at, _fact(value)


def _fact(value: Any) -> Fact:
    if isinstance(value, bool) or (isinstance(value, int) and abs(value) <= _EXACT):
        return value
    if isinstance(value, float) and math.isfinite(value):
        return value
    text = value if isinstance(value, str) else _text(value)
    return printable(text) if len(text) <= _SHOWN else _digest(text)


def _text(value: Any) -> str:
    with suppress(RecursionError):
        return value if isinstance(value, str) else json.dumps(value, sort_keys=True)
    return "nested too deeply"


def _digest(text: str) -> str:
    return f"sha256:{sha256_bytes(text.encode('utf-8', 'replace'))}"
