"""The card of a model behind a URL: its server says what it serves,
and what it answers tells its kind.

A served model is `URL`, or `URL#NAME` where its server has several. `openai:NAME` is one at the
base URL in `OPENAI_BASE_URL`, else at OpenAI's.
"""

import asyncio
import os
import re
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from harness.backends.card import Card, Latency
from harness.backends.chat_template import needs_first_user
from harness.backends.openai.http import Client, Reply
from harness.backends.openai.kinds import SERVER_KINDS, kind_of
from harness.backends.servers import Kind, Server
from harness.core.errors import Unanswered, UserError, printable

PREFIX = "served:"  # of a card's name: such a model is none of the card files
BASE, KEY = "OPENAI_BASE_URL", "OPENAI_API_KEY"
OPENAI = "https://api.openai.com/v1"
LONGEST, SHOWN = 200, 8  # characters of a model's name; names in an error
_PATH = re.compile(r"[/~]|[A-Za-z]:[/\\]")  # how the name of a file or a folder begins


class _Listed(NamedTuple):
    """A model in a server's list."""

    id: str
    owner: str
    decides: bool  # whether it says that it is a decision model


def served_card(text: str) -> Card:
    """Return a model card (a description of a model) after asking a server what it serves.

    `text` is a base `URL`, `URL#NAME` for one of several models, or `openai:NAME` for the server at
    `OPENAI_BASE_URL` or OpenAI's own. The key in `OPENAI_API_KEY`, if there is one, goes to that
    server. Raises UserError if the text is no base URL or does not say which of several models is
    meant, Unanswered if no server answers or it refuses the key.
    """
    address, _, name = text.partition("#")
    if address.startswith("openai:"):
        address, name = os.environ.get(BASE) or OPENAI, text.removeprefix("openai:")
    try:
        server = Server(_base(address))
    except ValueError as error:  # whose words show no URL, since it may hold a password
        raise UserError(f"--model: {error}") from None
    with ThreadPoolExecutor(1) as thread:  # a notebook has an event loop in this one
        return thread.submit(asyncio.run, _ask(server, name)).result()


def _base(address: str) -> str:
    """Return a base URL; without a path, it is the one that every kind of server has."""
    try:
        parts = urlsplit(address)
        bare = parts.path in ("", "/") and not parts.query
    except ValueError:
        bare = False
    return f"{address.rstrip('/')}/v1" if bare else address.rstrip("/")


async def _ask(server: Server, name: str) -> Card:
    url = server.urls[0]
    async with Client(server) as client:
        replies: dict[tuple[str, bytes | None], Reply] = {}

        async def ask(path: str, content: bytes | None) -> Reply:
            if (path, content) not in replies:
                place = url.removesuffix("/v1") + path
                replies[path, content] = await client.get(url, place, content)
            return replies[path, content]

        model = _chosen(url, await client.get(url, f"{url}/models"), name)
        kind: Kind = "vllm" if model.owner == "vllm" else await kind_of(ask)
        template, thinking = await SERVER_KINDS[kind].reads(model.id, ask)
    return Card(
        f"{PREFIX}{_short(model.id)}",
        "systemone" if model.decides else "openai",
        f"Served by {'a server' if kind == 'generic' else kind}",
        Latency("paper", None, "none declared: the paper's"),
        weights=model.id,
        thinking="none" if model.decides else thinking,
        server=Server(server.base_url, kind),
        system="first-user"
        if template and not model.decides and needs_first_user(template)
        else None,
    )


def _chosen(url: str, reply: Reply, name: str) -> _Listed:
    """Return the model of a name, or the only one. Raises what `served_card` raises."""
    address = printable(url)
    if reply.unreached or reply.again:
        raise Unanswered(
            f"no server answers at {address} ({reply.fault}); start it, or fix --model"
        )
    if reply.status in (401, 403):
        raise Unanswered(
            f"the server at {address} refuses the key ({reply.fault}); set {KEY} in the environment"
        )
    listed = {model.id: model for model in _listed(reply.payload)}
    if not listed and not name:
        raise UserError(
            f"{address}/models lists no model "
            f"({reply.fault or 'the list is empty, none of OpenAI, or of unusable names'}); give "
            f"the base URL up to and with /v1, or the model's name as well: --model {address}#NAME"
        )
    alike = [
        model
        for key, model in listed.items()
        if name in (key, _short(key), key.removesuffix(":latest"))
    ]
    if len(alike) == 1:
        return alike[0]
    if not listed:  # some servers have no list
        if len(name) > LONGEST or not name.isprintable():
            raise UserError(
                f"--model: {printable(name)} is no model's name; give one that {address} knows"
            )
        return _Listed(name, "", False)
    if not name and len(listed) == 1:
        return next(iter(listed.values()))
    names = sorted(printable(each) for each in listed)
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    reason = f"has no model {printable(name)!r}" if name else f"serves {len(names)} models"
    raise UserError(
        f"{address} {reason}: {', '.join(names[:SHOWN])}{more}; give one, as --model "
        f"'{address}#{names[0]}'"
    )


def _listed(payload: Any) -> list[_Listed]:
    """Return the models in a server's answer to `/models`; what has no usable name is left out."""
    listed = payload.get("data") if isinstance(payload, dict) else None
    models = []
    for entry in listed if isinstance(listed, list) else []:
        name = entry.get("id") if isinstance(entry, dict) else None
        if isinstance(name, str) and 0 < len(name) <= LONGEST and name.isprintable():
            about = entry.get("architecture")
            outputs = (about if isinstance(about, dict) else entry).get("output_modalities")
            decides = isinstance(outputs, list) and "decisions" in outputs
            models.append(_Listed(name, str(entry.get("owned_by", "")), decides))
    return models


def _short(name: str) -> str:
    """Return a model's name for people: of a file or a folder, the last part of its path."""
    if not (name.endswith(".gguf") or _PATH.match(name)):
        return name
    return name.replace("\\", "/").rstrip("/").rpartition("/")[2].removesuffix(".gguf") or name
