"""Each kind of server: how it is known, and what it is asked of itself and of its model."""

import asyncio
import json
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from harness.backends.card import Thinking
from harness.backends.openai.http import Reply
from harness.backends.servers import Kind

Ask = Callable[[str, bytes | None], Awaitable[Reply]]  # a path beside `/v1`, and JSON to send
Statement = tuple[Any, dict[str, Any]]  # the server's version, and what it states of its model
SWITCH = "enable_thinking"  # name of the thinking switch in chat templates


class ServerKind:
    """Describe how a server program (vLLM, Ollama, ...) is recognised, and what it can tell.

    This base class is of a server that has nothing but a list of models.
    """

    path = ""  # where it tells that it is one; empty if nowhere

    def is_one(self, payload: Mapping[str, Any]) -> bool:
        """Return whether a server runs this program, by what it answered at a path that tells it.

        `payload` is the decoded JSON object that the server returned for this kind's `path`.
        """
        return False

    async def states(self, model: str, ask: Ask) -> Statement:
        """Return the server's version, None if unknown, and a dict of what it states of a model.

        The dict has facts by dotted names, such as a digest of the weights. `model` is the model's
        name there. `ask` requests a path of the server, given the path beside `/v1` and JSON to
        post (None for a GET), and returns its reply.
        """
        return None, {}

    async def reads(self, model: str, ask: Ask) -> tuple[str, Thinking]:
        """Return a model's chat template, empty if unknown, and how the model thinks.

        That is `switch` if a request can turn it on and off, `none` else or if unknown. `model` is
        the model's name there. `ask` requests a path of the server, given the path beside `/v1` and
        JSON to post (None for a GET), and returns its reply.
        """
        return "", "none"


class LlamaServer(ServerKind):
    """Describe how llama.cpp's own server, llama-server, is recognised, and what it tells."""

    path = "/props"

    def is_one(self, payload: Mapping[str, Any]) -> bool:
        return "default_generation_settings" in payload

    async def states(self, model: str, ask: Ask) -> Statement:
        props = fields_of(await ask(self.path, None))
        settings = props.get("default_generation_settings")
        settings = settings if isinstance(settings, dict) else {}
        path = props.get("model_path")
        named = ("chat_template", "modalities", "bos_token", "eos_token")
        facts = {name: props.get(name) for name in named}
        facts["file"] = (
            path.replace("\\", "/").rpartition("/")[2] if isinstance(path, str) else None
        )
        facts["n_ctx"] = settings.get("n_ctx", props.get("n_ctx"))
        # What it does where a request says nothing: penalties, DRY, XTC.
        sampling = settings.get("params")
        facts["sampling"] = as_text(sampling) if isinstance(sampling, dict) else None
        return props.get("build_info"), facts

    async def reads(self, model: str, ask: Ask) -> tuple[str, Thinking]:
        template = fields_of(await ask(self.path, None)).get("chat_template")
        if not isinstance(template, str):
            return "", "none"
        return template, "switch" if SWITCH in template else "none"


class LMStudio(ServerKind):
    """Describe how LM Studio's server is recognised, and what it tells."""

    path = "/api/v0/models"

    def is_one(self, payload: Mapping[str, Any]) -> bool:
        return isinstance(payload.get("data"), list)

    async def states(self, model: str, ask: Ask) -> Statement:
        return None, entry_of(fields_of(await ask(self.path, None)), "data", model) or {}


class Ollama(ServerKind):
    """Describe how Ollama's server is recognised, and what it tells."""

    path = "/api/version"

    def is_one(self, payload: Mapping[str, Any]) -> bool:
        return isinstance(payload.get("version"), str)

    async def states(self, model: str, ask: Ask) -> Statement:
        version = fields_of(await ask(self.path, None)).get("version")
        tag = entry_of(fields_of(await ask("/api/tags", None)), "models", model) or {}
        show = await self._show(model, ask)
        facts = {name: tag.get(name) for name in ("digest", "size", "details")}
        for name in ("template", "parameters", "system", "details", "model_info", "projector_info"):
            if (value := show.get(name)) is not None:
                facts[name] = value if name == "details" else as_text(value)
        return version, facts

    async def reads(self, model: str, ask: Ask) -> tuple[str, Thinking]:
        can = (await self._show(model, ask)).get("capabilities")
        return "", "always" if isinstance(can, list) and "thinking" in can else "none"

    async def _show(self, model: str, ask: Ask) -> dict[str, Any]:
        return fields_of(await ask("/api/show", json.dumps({"model": model}).encode()))


class LlamaCppPython(ServerKind):
    """Describe how llama-cpp-python's server is recognised, and what it tells."""

    path = "/openapi.json"

    def is_one(self, payload: Mapping[str, Any]) -> bool:
        return "llama.cpp Python API" in str(payload.get("info"))[:500]


class VLLM(ServerKind):
    """Describe what vLLM's server tells, which is recognised by its list of models."""

    async def states(self, model: str, ask: Ask) -> Statement:
        return fields_of(await ask("/version", None)).get("version"), {}

    async def reads(self, model: str, ask: Ask) -> tuple[str, Thinking]:
        """Return no template, and `switch` if a request can turn thinking on and off, else `none`.

        It can if that changes how many tokens `/tokenize` counts in the same messages. `model` is
        the model's name there; `ask` requests a path of the server.
        """
        chat = {"model": model, "messages": [{"role": "user", "content": "?"}]}
        counts = []
        for on in (True, False):
            body = json.dumps({**chat, "chat_template_kwargs": {SWITCH: on}}).encode()
            counts.append(fields_of(await ask("/tokenize", body)).get("count"))
        return "", "switch" if None not in counts and counts[0] != counts[1] else "none"


# In the order in which they are believed: llama-server has paths of Ollama's as well.
SERVER_KINDS: Mapping[Kind, ServerKind] = {
    "llama-server": LlamaServer(),
    "lm-studio": LMStudio(),
    "ollama": Ollama(),
    "llama-cpp-python": LlamaCppPython(),
    "vllm": VLLM(),
    "generic": ServerKind(),
}


async def kind_of(ask: Ask) -> Kind:
    """Return the kind of a server (its program), by what it answers at each kind's `path`.

    `ask` requests a path of the server. It is `generic` if none fits.
    """
    probed_kinds = {kind: server for kind, server in SERVER_KINDS.items() if server.path}
    replies = await asyncio.gather(*(ask(server.path, None) for server in probed_kinds.values()))
    for (kind, server), reply in zip(probed_kinds.items(), replies, strict=True):
        if reply.status == 200 and server.is_one(fields_of(reply)):
            return kind
    return "generic"


def fields_of(reply: Reply) -> dict[str, Any]:
    """Return the JSON object of a server's reply; an empty dict if it is no object."""
    return reply.payload if isinstance(reply.payload, dict) else {}


def entry_of(payload: Any, key: str, model: str) -> dict[str, Any] | None:
    """Return the entry of a model in a list of models that a server states; None if there is none.

    `payload` is the decoded JSON, which has the list at `key`, and `model` the model's name. A
    list's only entry is taken whatever its name.
    """
    listed = payload.get(key) if isinstance(payload, dict) else None
    entries = (
        [entry for entry in listed if isinstance(entry, dict)] if isinstance(listed, list) else []
    )
    for name in (model, f"{model}:latest"):  # Ollama adds the tag
        for entry in entries:
            if name in (entry.get("id"), entry.get("name"), entry.get("model")):
                return entry
    return entries[0] if len(entries) == 1 else None


def as_text(value: Any) -> str:
    """Return what a server states as text: a text as it is, any other value as JSON."""
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True)
