"""Answers of a model behind any server that speaks OpenAI's chat completions."""

import asyncio
import time
import weakref
from collections.abc import Coroutine, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from threading import Thread, current_thread
from typing import Any, TypeVar

from harness.backends.base import Completion, Request, per_token_s
from harness.backends.cards import Card
from harness.backends.openai.farm import Farm
from harness.backends.openai.http import Client, Reply
from harness.backends.openai.shapes import Said, body, digest_url, read
from harness.backends.openai.stream import ASKED
from harness.backends.servers import Server
from harness.core.files import canonical_json

T = TypeVar("T")
_CLOSED_S = 5.0  # in which connections are closed


def open(card: Card, *, batch_size: int = 8, **_: Any) -> "OpenAIBackend":
    """Reach a card's servers.

    Raises:
        UserError: nobody listens there, one refuses the key, the key is none, or models differ.
    """
    if card.server is None:
        raise ValueError(f"card {card.name} has no server")
    return OpenAIBackend(card, card.server, batch_size)


class OpenAIBackend:
    """A model behind one or several servers.

    Requests are asked at the same time, each by itself, so that `complete` may be called while another call
    is at work. Connections stay open between calls.

    Attributes:
        window: requests that it has under way at most.
    """

    def __init__(self, card: Card, server: Server, batch_size: int) -> None:
        self._card = card
        self._server = server
        self._batch_size = batch_size
        self.window = batch_size * len(server.urls)
        self._streams = True  # until it refuses to
        client = Client(server)
        self._farm = Farm(client, server, card.name, card.weights or "", batch_size)
        self._loop = _Loop(client)
        weakref.finalize(self, self._loop.end)
        self._loop.run(self._farm.open())

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """One completion per request, in the same order.

        Where a server has one request alone, `seconds` is the time from asking to the last byte, failed
        attempts and the waits between them included; an answer that never came has spent its time, too. The
        first takes a connection, which the others go on with. One that is asked to be timed is streamed. No
        other is: some servers count no tokens in a stream, or part thoughts otherwise.

        Raises:
            UserError: no server is left, or one has come back with another model.
        """
        return self._loop.run(self._all(requests))

    def rendered(self, requests: Sequence[Request]) -> list[str]:
        """What the server is sent for each request, its picture by digest; it renders the messages itself."""
        return [canonical_json(body(self._card, self._server, r, digest_url)) for r in requests]

    def identity(self) -> dict[str, Any]:
        """The model, by what its servers say of it. Weights that are changed unsaid are not seen.

        Where any of several may answer, it does not matter which they are.
        """
        model = self._farm.model
        version = {} if model.version is None else {"version": model.version}
        where = {} if self._server.any_may_answer else {"base_url": self._server.base_url}
        return {
            "engine": "openai",
            "server": self._server.kind,
            **where,
            "model": self._card.weights,
            "listed": model.listed,
            **version,
        }

    async def _all(self, requests: Sequence[Request]) -> list[Completion]:
        together = min(self._batch_size, len(requests))
        if together == 1 and any(request.timed for request in requests):  # the next knows how the last went
            return [await self._answer(request, together) for request in requests]
        return await asyncio.gather(*(self._answer(request, together) for request in requests))

    async def _answer(self, request: Request, together: int) -> Completion:
        reply = await self._asked(request, together == 1 and request.timed)
        end_s = time.perf_counter()
        if together == 1 and not reply.alone:  # another call's were there
            together = self._batch_size
        seconds = end_s - reply.begun_s if together == 1 else None
        said = Said(error=reply.fault) if reply.fault else read(reply.payload, request)
        first_at_s, tokens = reply.first_at_s, said.completion_tokens
        if request.answer == "readout":
            first_at_s, tokens = end_s, 1
        first_s = None if seconds is None or first_at_s is None or said.error else first_at_s - reply.begun_s
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
        asked = partial(body, self._card, self._server, request)
        decision = request.id.partition("/")[0]
        if not streamed or not self._streams or request.answer == "readout":
            return await self._farm.post(decision, asked)
        reply = await self._farm.post(decision, lambda: {**asked(), **ASKED})
        if reply.status in (None, 200) or "stream" not in (reply.fault or "").lower():
            return reply
        self._streams = False
        plain = await self._farm.post(decision, asked)
        return replace(plain, retries=reply.retries + 1 + plain.retries, begun_s=reply.begun_s)


class _Loop:
    """An event loop in a thread of its own, with a client's connections, until it is ended."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._loop = asyncio.new_event_loop()
        self._thread = Thread(target=self._work, daemon=True)
        self._thread.start()
        self.run(client.__aenter__())

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """The result of some work in the loop, which is cancelled where this is interrupted."""
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def end(self) -> None:
        """Close the connections; what still waits is cancelled."""
        with suppress(RuntimeError):  # ended already
            self._loop.call_soon_threadsafe(self._loop.stop)
        if current_thread() is not self._thread:
            self._thread.join(_CLOSED_S)

    def _work(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.get_loop().run_forever()
            runner.run(self._client.__aexit__())
