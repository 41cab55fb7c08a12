"""The backend of a model behind any server that speaks OpenAI's chat completions,
or another `Wire`.
"""

import asyncio
import json
import time
import weakref
from collections import deque
from collections.abc import Coroutine, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from threading import Thread, current_thread
from typing import Any, TypeVar

from msgspec import structs

from harness.backends.base import Completion, Request, Served, failed, per_token_s
from harness.backends.card import Card
from harness.backends.openai.http import Client, Reply
from harness.backends.openai.pool import ServerPool
from harness.backends.openai.prompt_check import PromptCheck
from harness.backends.openai.shapes import answering_model, data_url, digest_url
from harness.backends.openai.stream import ASKED, BROKE_OFF
from harness.backends.openai.wire import CHAT, Wire
from harness.backends.orders import average_orders
from harness.backends.registry import BUILT_IN
from harness.core.at_once import AtOnce, most_at_once
from harness.core.errors import UserError, printable
from harness.core.files import canonical_json

T = TypeVar("T")
_MOST_SERVED = 1 << 20  # answers whose servers are kept until somebody asks
_CLOSED_S = 5.0  # longest wait for connections to close


def open(card: Card, *, batch_size: AtOnce = 8, **_: Any) -> "OpenAIBackend":
    """Return the backend of the model behind the servers that a model card names.

    `card` is what a model's TOML file states. Each server gets at most `batch_size` requests at a
    time; with `auto`, as many as it takes without refusals and in good time. Options for models in
    this process are ignored. Raises UserError if the servers' models differ, Unanswered if none
    answers or one refuses the key.
    """
    return OpenAIBackend(card, batch_size)


class OpenAIBackend:
    """Answer requests by a model behind one or several servers with OpenAI's API.

    Requests are sent concurrently, at most `window` at once and each by itself, so `complete` may
    be called during another call. Connections stay open between calls.
    """

    def __init__(self, card: Card, batch_size: AtOnce, wire: Wire = CHAT) -> None:
        """Connect to a card's servers. Raises as `open`, and ValueError if the card has none."""
        if (server := card.server) is None:
            raise ValueError(f"card {card.name} has no server")
        self._card = card
        self._server = server
        self._wire = wire
        self._batch_size = most_at_once(batch_size)
        self.window = self._batch_size * len(server.urls)
        self._streams = True  # until a server refuses to stream
        self._served = deque[Served](maxlen=_MOST_SERVED)
        self._named_other = False  # whether a server was said to name another model
        self._cuts = False  # whether a server was said to cut prompts
        client = Client(server)
        self._pool = ServerPool(
            client, server, card.name, card.weights or "", batch_size, wire.path
        )
        self._prompts = PromptCheck(client, card, server)
        self._loop = _Loop(client)
        weakref.finalize(self, self._loop.end)
        self._loop.run(self._pool.open())
        if misfit := wire.misfit(self._pool.model.states):
            raise UserError(f"{card.shown}: its server says that it {misfit}")

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """Return one completion per request, in the same order.

        If a server has one request alone, `seconds` is the time from sending it to the last byte,
        with failed attempts and the waits between them; an answer that never came has its time,
        too. The first request opens a connection, which later ones reuse. Only `timed` requests are
        streamed: in a stream some servers count no tokens, or separate thoughts differently. Raises
        Unanswered if no server is left, and UserError if one has come back with another model.
        """
        return self._loop.run(self._all(requests))

    def rendered(self, requests: Sequence[Request]) -> list[str]:
        """Return the JSON that the server is sent for each request; a picture is a digest."""
        return [
            canonical_json(self._wire.body(self._card, self._server, r, digest_url))
            for r in requests
        ]

    def identity(self) -> dict[str, Any]:
        """Return what decides answers, by name, as far as the servers state it of their model.

        If any of several servers may answer, their URLs are not part of it: `several` has them.
        """
        model = self._pool.model
        version = {} if model.version is None else {"version": model.version}
        where = {} if self._server.any_may_answer else {"base_url": self._server.base_url}
        states = {"states": dict(model.states)} if model.states else {}
        named = {"model": self._card.weights, "listed": model.listed}
        engine = self._wire.engine
        ours = {"engine": engine, "answers": BUILT_IN[engine].answers, "server": self._server.kind}
        return {**ours, **where, **named, **version, **states}

    @property
    def several(self) -> Sequence[str]:
        """Return the servers' addresses if any of them may answer; empty if there is only one."""
        return self._server.urls if self._server.any_may_answer else ()

    @property
    def doubt(self) -> str | None:
        """Return why cached answers may be of other weights, or None.

        It is None if servers state a digest or size of their weights.
        """
        if self._pool.model.tells_weights:
            return None
        return (
            f"{self._card.shown}: some answers come from the completion cache, and its "
            "server does not say which weights it has; if these have changed since, use --no-cache"
        )

    def served(self) -> list[Served]:
        taken: list[Served] = []
        with suppress(IndexError):  # the loop's thread may add some, and another may take some
            while True:
                taken.append(self._served.popleft())
        return taken

    async def _all(self, requests: Sequence[Request]) -> list[Completion]:
        if not self._wire.decides:
            await self._prompts.check(requests)
        together = min(self._batch_size, len(requests))
        # One at a time: if a server refuses to stream, the next request must know.
        if together == 1 and any(request.timed for request in requests):
            return [await self._answer(request, together) for request in requests]
        return await asyncio.gather(*(self._answer(request, together) for request in requests))

    async def _answer(self, request: Request, together: int) -> Completion:
        if not request.orders:
            return await self._answer_once(request, together)
        orders = [
            request.alike(messages=each, orders=()) for each in (request.messages, *request.orders)
        ]
        if together == 1:  # asked alone, they are asked one after the other: their times add up
            completions = [await self._answer_once(order, together) for order in orders]
        else:
            completions = await asyncio.gather(
                *(self._answer_once(order, together) for order in orders)
            )
        return _over_orders(request, completions)

    async def _answer_once(self, request: Request, together: int) -> Completion:
        reply = await self._reply(request, together == 1 and request.timed)
        end_s = time.perf_counter()
        if together == 1 and not reply.alone:  # requests of another call ran at the same time
            together = self._batch_size
        seconds = end_s - reply.begun_s if together == 1 else None
        if reply.fault:
            answer = failed(request, self._hinted(reply))
        else:
            answer = self._wire.read(reply.payload, request, self._server.kind)
        self._note(request, reply, answer)
        first_at_s, tokens = reply.first_at_s, answer.completion_tokens
        if request.bare:
            first_at_s, tokens = end_s, 1
        first_s = None
        if seconds is not None and first_at_s is not None and not answer.error:
            first_s = first_at_s - reply.begun_s
        return replace(
            answer,
            server=reply.url,
            seconds=seconds,
            batch_size=together,
            retries=reply.retries,
            first_token_s=first_s,
            token_s=None if seconds is None else per_token_s(seconds, first_s, tokens),
        )

    def _note(self, request: Request, reply: Reply, answer: Completion) -> None:
        """Keep which server gave an answer;
        say once if it names another model than it was asked for.
        """
        model, name = answering_model(reply.payload), self._card.weights
        if model not in (None, name, f"{name}:latest", (self._pool.model.listed or {}).get("id")):
            model, url = printable(model), printable(reply.url)
            if not self._named_other:
                self._named_other = True
                self._pool.say(
                    f"server {url} was asked for {printable(name)}, and says that {model} answers"
                )
        if not answer.error:
            self._served.append(Served(request.id, reply.url, model))
        if not self._cuts and (fault := self._prompts.fault(request, answer.prompt_tokens)):
            self._cuts = True
            self._pool.say(f"server {printable(reply.url)} {fault}")

    def _hinted(self, reply: Reply) -> str:
        """Return a reply's fault, and what to do about it."""
        return "; ".join(filter(None, (reply.fault, self._wire.remedy(reply))))

    async def _reply(self, request: Request, streamed: bool) -> Reply:
        """Ask for a reply. If the server refuses to stream, ask again without,
        and stream no more.
        """
        json_body = partial(self._wire.body, self._card, self._server, request, data_url)
        decision = request.id.partition("/")[0]
        if not streamed or not self._streams or request.bare:
            return await self._pool.post(decision, json_body)
        reply = await self._pool.post(decision, lambda: {**json_body(), **ASKED})
        fault = (reply.fault or "").lower()
        if reply.status in (None, 200) or fault.startswith(BROKE_OFF) or "stream" not in fault:
            return reply
        self._streams = False
        plain = await self._pool.post(decision, json_body)
        return structs.replace(
            plain, retries=reply.retries + 1 + plain.retries, begun_s=reply.begun_s
        )


def _over_orders(request: Request, completions: Sequence[Completion]) -> Completion:
    """Return the completion of a read-out over several orders;
    if one failed or is a refusal, that one.
    """
    retries = sum(completion.retries for completion in completions)
    for completion in completions:
        if completion.finish_reason != "stop":
            return replace(completion, request_id=request.id, retries=retries)

    def total(values: Iterable[Any]) -> Any:
        """Return the sum of some values; None if one is not known."""
        summands = list(values)
        return None if None in summands else sum(summands)

    # The shares come back as the actions' of the first order: each text names its letters by them.
    letters_p = []
    for completion in completions:
        shares = json.loads(completion.text)["action_distribution"]
        mass = completion.label_mass or 1.0
        letters_p.append([mass * shares[action] for action in request.actions])
    seconds = total(completion.seconds for completion in completions)
    costs = {"seconds": seconds, "first_token_s": seconds, "retries": retries}
    prompt_tokens = total(completion.prompt_tokens for completion in completions)
    average = asdict(average_orders(request.actions, letters_p))
    servers = {completion.server for completion in completions}
    server = servers.pop() if len(servers) == 1 else None
    return replace(completions[0], prompt_tokens=prompt_tokens, server=server, **costs, **average)


class _Loop:
    """An event loop in a thread of its own, with the connections of a client."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._loop = asyncio.new_event_loop()
        self._thread = Thread(target=self._work, daemon=True)
        self._thread.start()
        self.run(client.__aenter__())

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def end(self) -> None:
        """Close the connections and cancel all coroutines that still wait."""
        with suppress(RuntimeError):  # ended already
            self._loop.call_soon_threadsafe(self._loop.stop)
        if current_thread() is not self._thread:
            self._thread.join(_CLOSED_S)

    def _work(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.get_loop().run_forever()
            runner.run(self._client.__aexit__())
