"""One model behind one or several servers: which of them is asked, and what becomes of one that breaks down.

Requests with the same key go to the same server, which has the beginning of their prompts in its cache: each
key ranks the servers by a hash (rendezvous hashing), so that one more or less moves few keys. A server with
nothing left of its own takes from the end of the longest queue, so that none is idle.
"""

import asyncio
import json
import sys
from collections import Counter, deque
from collections.abc import Callable, Coroutine, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from hashlib import blake2b
from time import perf_counter
from typing import Any, NamedTuple

from harness.backends.openai.http import Client, Reply
from harness.backends.servers import Kind, Server
from harness.core.errors import UserError, printable

FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 30.0  # before the first retry, doubled with each; at most
BROKEN = 3  # failures with no answer between them, after which a server is set aside
_PATH = "/chat/completions"
_LISTED = ("id", "owned_by", "root", "max_model_len")  # no dates: a server says when it was started
# Where kinds of servers say which version they are, beside `/v1`, and under which key.
_VERSION: Mapping[Kind, tuple[str, str]] = {
    "vllm": ("/version", "version"),
    "llama-server": ("/props", "build_info"),
    "ollama": ("/api/version", "version"),
}


class Model(NamedTuple):
    """What a server says of the model that it has.

    Attributes:
        listed: its entry in the server's list; None where there is no list, or the model is not on it.
        version: the server's own; None where it does not say.
    """

    listed: dict[str, Any] | None = None
    version: str | None = None


@dataclass(eq=False)
class _Place:
    """One of the servers.

    Attributes:
        url: its base URL.
        queue: requests that wait for it.
        busy: how many it has.
        begun: how many it was given so far.
        failures: attempts that failed since it last answered.
        pauses: how often it was waited for since it last answered.
        lost: how often it was looked for in vain since it was last there.
        fault: how it failed last.
        aside: whether it is asked nothing until it is there again.
    """

    url: str
    queue: "deque[_Owed]" = field(default_factory=deque)
    busy: int = 0
    begun: int = 0
    failures: int = 0
    pauses: int = 0
    lost: int = 0
    fault: str = ""
    aside: bool = False


@dataclass(eq=False)
class _Owed:
    """A request, made once it is asked; where its reply is awaited; how often it failed at which server."""

    key: str
    body: Callable[[], Mapping[str, Any]]
    reply: "asyncio.Future[Reply]"
    failed: Counter[_Place] = field(default_factory=Counter)
    begun_s: float | None = None


def pause_s(times: int) -> float:
    """Seconds to wait after so many waits in a row."""
    return float(min(FIRST_WAIT_S * 2 ** min(times, 32), LONGEST_WAIT_S))


class Farm:
    """The servers of a model. All of it runs in one event loop, inside `async with` of the client.

    Attributes:
        model: what all servers say of the model.
    """

    def __init__(self, client: Client, server: Server, name: str, weights: str, at_once: int) -> None:
        """A farm that is not open yet.

        Args:
            client: asks a server once.
            server: where the servers are, and how often a request is tried again.
            name: the card's, for messages.
            weights: what servers know the model by.
            at_once: most requests that one server has at once.
        """
        self._client, self._server, self._name, self._weights = client, server, printable(name), weights
        self._at_once = at_once
        self._places = [_Place(url) for url in server.urls]
        self._owed: set[_Owed] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._woken = False
        self._refused: Exception | None = None
        self._first = self._places[0]
        self._ranked = lru_cache(maxsize=1 << 12)(self._rank)
        self.model = Model()

    async def open(self) -> None:
        """Look at every server. One that does not answer is waited for, if another does.

        Raises:
            UserError: none answers, one refuses the key, or two have different models.
        """
        looked = await asyncio.gather(*(self._look(place) for place in self._places))
        there = {place: model for place, model in zip(self._places, looked, strict=True) if model}
        if not there:
            raise UserError(
                f"nobody answers at {self._faults()}; start the server, or fix base_url in the model's card"
            )
        self._first, self.model = next(iter(there.items()))
        for place, model in there.items():
            self._agree(place, model)
        for place in self._places:
            if place not in there:
                self._set_aside(place)

    async def post(self, key: str, body: Callable[[], Mapping[str, Any]]) -> Reply:
        """What a server answers, once there is an answer, or the retries are used up.

        A server that is busy (429), breaks down (5xx), is not reached or takes too long may be asked again:
        another one at once, the same after the time that it asks for or one that doubles.

        Raises:
            UserError: no server is left, or one has come back with another model.
        """
        if self._refused:
            raise self._refused
        owed = _Owed(key, body, asyncio.get_running_loop().create_future())
        self._owed.add(owed)
        try:
            self._queue(owed)
            return await owed.reply
        finally:
            self._owed.discard(owed)

    # -- who is asked ---------------------------------------------------------------------------------------

    def _rank(self, key: str) -> list[_Place]:
        """The servers, that of a key first."""
        if len(self._places) == 1:
            return self._places
        weights = {p: blake2b(f"{p.url} {key}".encode(), digest_size=8).digest() for p in self._places}
        return sorted(self._places, key=weights.__getitem__)

    def _queue(self, owed: _Owed) -> None:
        """Wait for the server of the key, or for the next that is there and has failed less often."""
        place = min(self._ranked(owed.key), key=lambda place: (place.aside, owed.failed[place]))
        (place.queue.appendleft if owed.failed else place.queue.append)(owed)  # who has waited goes first
        self._wake()

    def _wake(self) -> None:
        """Hand out what waits once all that is ready has queued."""
        if not self._woken:
            self._woken = True
            asyncio.get_running_loop().call_soon(self._hand_out)

    def _hand_out(self) -> None:
        self._woken = False
        there = [place for place in self._places if not place.aside]
        for take in (self._own, self._take):  # each its own first
            for place in there:
                while place.busy < self._at_once and (owed := take(place)):
                    place.busy += 1
                    self._run(self._work(place, owed))

    def _own(self, place: _Place) -> _Owed | None:
        """The next request that waits for a server."""
        while place.queue:
            if not (owed := place.queue.popleft()).reply.done():  # whoever asked may be gone
                return owed
        return None

    def _take(self, place: _Place) -> _Owed | None:
        """The same, or where there is none, one from the end of the longest queue."""
        if place.aside:
            return None
        if owed := self._own(place):
            return owed
        queue = max((other.queue for other in self._places), key=len)
        return queue.pop() if queue and not queue[-1].failed[place] else None

    async def _work(self, place: _Place, owed: _Owed | None) -> None:
        """Ask a server for one request after the other."""
        while owed:
            try:
                await self._ask(place, owed)
            except Exception as error:  # a bug, of which whoever asked has to hear
                if not owed.reply.done():
                    owed.reply.set_exception(error)
            owed = self._take(place)
        place.busy -= 1

    def _run(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)  # a loop keeps no task alive
        task.add_done_callback(self._tasks.discard)

    async def _ask(self, place: _Place, owed: _Owed) -> None:
        """Ask a server for a request until it answers, another one may, or there is no attempt left."""
        while True:
            place.begun += 1
            nth, first = place.begun, place.busy == 1
            owed.begun_s = perf_counter() if owed.begun_s is None else owed.begun_s
            reply = await self._client.post(place.url, _PATH, json.dumps(owed.body()).encode())
            alone = first and place.begun == nth
            reply = replace(reply, retries=owed.failed[place], begun_s=owed.begun_s, alone=alone)
            if not reply.again:
                place.failures = place.pauses = 0
                break
            owed.failed[place] += 1
            if reply.status != 429:
                self._failed(place, reply)
            if any(not owed.failed[other] for other in self._places if not other.aside):
                self._queue(owed)
                return
            attempts = owed.failed.total()
            if attempts > self._server.retries:
                break
            wait_s = pause_s(attempts - 1) if reply.after_s is None else reply.after_s
            await asyncio.sleep(min(wait_s, LONGEST_WAIT_S))
            if place.aside:
                self._queue(owed)
                return
        if not owed.reply.done():
            owed.reply.set_result(reply)

    # -- who breaks down ------------------------------------------------------------------------------------

    def _failed(self, place: _Place, reply: Reply) -> None:
        place.failures += 1
        place.fault = reply.fault or ""
        if place.failures >= BROKEN and not place.aside:
            self._set_aside(place)

    def _set_aside(self, place: _Place) -> None:
        """Ask a server nothing until it is there again; what waits for it goes elsewhere."""
        place.aside = True
        if len(self._places) > 1:
            self._say(f"server {printable(place.url)} is set aside ({place.fault})")
        self._run(self._await(place))
        self._queue_again(place)

    def _queue_again(self, *places: _Place) -> None:
        waiting = [owed for place in places for owed in place.queue]
        for place in places:
            place.queue.clear()
        for owed in waiting:
            self._queue(owed)

    async def _await(self, place: _Place) -> None:
        """Look for a server that was set aside after longer and longer pauses, until it is there again."""
        try:
            while True:
                await asyncio.sleep(pause_s(place.pauses))
                place.pauses += 1
                model = await self._look(place)
                if model and all(now is not None for now, was in zip(model, self.model, strict=True) if was):
                    break
                place.lost += 1
                if all(p.aside and p.lost > self._server.retries for p in self._places):
                    self._end(
                        UserError(
                            f"model {self._name!r}: no server is left: {self._faults()}; start one again, "
                            "and type the same command to continue"
                        )
                    )
            self._agree(place, model)
        except Exception as error:  # a bug ends the run as well; nobody else awaits this
            self._refused = error
            self._end(error)
            return
        place.aside, place.lost, place.failures = False, 0, BROKEN - 1  # one more failure sets it aside
        if len(self._places) > 1:
            self._say(f"server {printable(place.url)} is there again")
        self._queue_again(*(p for p in self._places if p.aside))
        self._wake()

    def _end(self, error: Exception) -> None:
        for owed in list(self._owed):
            if not owed.reply.done():
                owed.reply.set_exception(error)

    def _faults(self) -> str:
        return "; ".join(f"{printable(place.url)} ({place.fault})" for place in self._places)

    def _say(self, line: str) -> None:
        print(f"harness: model {self._name!r}: {line}", file=sys.stderr)

    # -- what they have -------------------------------------------------------------------------------------

    async def _look(self, place: _Place) -> Model | None:
        """What a server says of the model; None where nobody is there.

        Raises:
            UserError: it refuses the key.
        """
        reply = await self._client.get(place.url, place.url + "/models")
        place.fault = reply.fault or ""
        if reply.unreached or (reply.again and self._server.any_may_answer):
            return None
        if reply.status == 401:
            raise UserError(
                f"model {self._name!r}: its server refuses the key ({reply.fault}); "
                f"set {self._server.key_env} in the environment"
            )
        data = reply.payload.get("data") if isinstance(reply.payload, dict) else None
        models = [entry for entry in data if isinstance(entry, dict)] if isinstance(data, list) else []
        named = [entry for entry in models if entry.get("id") == self._weights]
        # A server with one model answers to any name.
        for entry in named or (models if len(models) == 1 else []):
            listed = {k: v if type(v) is int else printable(v) for k in _LISTED if (v := entry.get(k))}
            return Model(listed, await self._version(place))
        return Model()

    async def _version(self, place: _Place) -> str | None:
        if self._server.kind in _VERSION:
            path, key = _VERSION[self._server.kind]
            reply = await self._client.get(place.url, place.url.removesuffix("/v1") + path)
            with suppress(LookupError, TypeError):
                return printable(reply.payload[key])
        return None

    def _agree(self, place: _Place, model: Model) -> None:
        """Raise UserError unless a server has what the first one had."""
        url, weights = printable(place.url), printable(self._weights)
        if self._server.any_may_answer and model.listed is None:
            raise UserError(
                f"model {self._name!r}: server {url} lists no {weights} at {url}/models, so that nobody can "
                "tell whether it has the same model as others; fix weights in the card, or what is served"
            )
        if self.model.listed is not None and model != self.model:
            first = f"server {printable(self._first.url)} has {_shown(self.model)}"
            raise UserError(
                f"model {self._name!r}: {first}, and server {url} {_shown(model)}; serve the same model, by "
                "the same version"
            )


def _shown(model: Model) -> str:
    said = {**(model.listed or {}), "version": model.version}
    return " ".join(f"{key}={printable(value, 80)}" for key, value in said.items() if value is not None)
