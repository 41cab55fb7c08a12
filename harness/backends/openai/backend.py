"""Answers of a model behind any server that speaks OpenAI's chat completions."""

import asyncio
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from harness.backends.base import Completion, Request, per_token_s
from harness.backends.cards import Card
from harness.backends.openai.http import Client, Reply
from harness.backends.openai.shapes import Said, body, digest_url, read
from harness.backends.openai.stream import ASKED
from harness.backends.servers import Server
from harness.core.errors import UserError, printable
from harness.core.files import canonical_json

_PATH = "/chat/completions"
_LISTED = ("id", "owned_by", "root", "max_model_len")  # no dates: a server says when it was started


def open(card: Card, *, batch_size: int = 8, **_: Any) -> "OpenAIBackend":
    """Reach a card's server.

    Raises:
        UserError: nobody listens there, it refuses the key, or the key is none.
    """
    if card.server is None:
        raise ValueError(f"card {card.name} has no server")
    return OpenAIBackend(card, card.server, batch_size)


class OpenAIBackend:
    """A model behind a server. Requests of a batch are asked at the same time, each by itself."""

    def __init__(self, card: Card, server: Server, batch_size: int) -> None:
        self._card = card
        self._server = server
        self._batch_size = batch_size
        self._client = Client(server, batch_size)
        self._streams = True  # until it refuses to
        self._listed = asyncio.run(self._look())

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """One completion per request, in the same order.

        Where requests are asked one at a time, `seconds` is the time from asking to the last byte, failed
        attempts and the waits between them included; an answer that never came has spent its time, too. The
        first of a call takes a connection, which the others go on with. One that is asked to be timed is
        streamed. No other is: some servers count no tokens in a stream, or part thoughts otherwise.
        """
        return asyncio.run(self._all(requests))

    def rendered(self, requests: Sequence[Request]) -> list[str]:
        """What the server is sent for each request, its picture by digest; it renders the messages itself."""
        return [canonical_json(body(self._card, self._server, r, digest_url)) for r in requests]

    def identity(self) -> dict[str, Any]:
        """The server and its model, by what it says of it. Weights that it changes unsaid are not seen."""
        return {
            "engine": "openai",
            "server": self._server.kind,
            "base_url": self._server.base_url,
            "model": self._card.weights,
            "listed": self._listed,
        }

    async def _all(self, requests: Sequence[Request]) -> list[Completion]:
        together = min(self._batch_size, len(requests))
        gate = asyncio.Semaphore(self._batch_size)

        async def ask(request: Request) -> Completion:
            async with gate:
                return await self._answer(request, together)

        async with self._client:
            return await asyncio.gather(*map(ask, requests))

    async def _answer(self, request: Request, together: int) -> Completion:
        start_s = time.perf_counter()
        reply = await self._asked(request, together == 1 and request.timed)
        end_s = time.perf_counter()
        seconds = end_s - start_s if together == 1 else None
        said = Said(error=reply.fault) if reply.fault else read(reply.payload, request)
        first_at_s, tokens = reply.first_at_s, said.completion_tokens
        if request.answer == "readout":
            first_at_s, tokens = end_s, 1
        first_s = None if seconds is None or first_at_s is None or said.error else first_at_s - start_s
        return Completion(
            request_id=request.id,
            text=said.text,
            prompt_tokens=said.prompt_tokens,
            completion_tokens=said.completion_tokens,
            finish_reason=said.finish_reason,
            seconds=seconds,
            batch_size=together,
            error=said.error,
            label_mass=said.label_mass,
            retries=reply.retries,
            first_token_s=first_s,
            token_s=None if seconds is None else per_token_s(seconds, first_s, tokens),
        )

    async def _asked(self, request: Request, streamed: bool) -> Reply:
        """The server's reply; a server that will not stream is asked again, and never to stream again."""
        asked = body(self._card, self._server, request)
        if not streamed or not self._streams or request.answer == "readout":
            return await self._client.post(_PATH, asked)
        reply = await self._client.post(_PATH, {**asked, **ASKED})
        if reply.status in (None, 200) or "stream" not in (reply.fault or "").lower():
            return reply
        self._streams = False
        plain = await self._client.post(_PATH, asked)
        return replace(plain, retries=reply.retries + 1 + plain.retries)

    async def _look(self) -> dict[str, Any] | None:
        """What the server's list says of the model; None where it has no list, or the model is not on it."""
        async with self._client:
            reply = await self._client.get("/models")
        if reply.status == 401:
            raise UserError(
                f"model {printable(self._card.name)!r}: its server refuses the key ({reply.fault}); "
                f"set {self._server.key_env} in the environment"
            )
        data = reply.payload.get("data") if isinstance(reply.payload, dict) else None
        models = [entry for entry in data if isinstance(entry, dict)] if isinstance(data, list) else []
        named = [entry for entry in models if entry.get("id") == self._card.weights]
        # A server with one model answers to any name.
        for entry in named or (models if len(models) == 1 else []):
            return {k: v if type(v) is int else printable(v) for k in _LISTED if (v := entry.get(k))}
        return None
