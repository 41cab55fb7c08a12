"""One model behind one or several servers: distribute requests, retry, and set broken servers aside.

Requests with the same key go to the same server, whose cache holds the beginning of their prompts: each key
ranks the servers by a hash (rendezvous hashing), so that adding or removing one moves few keys. A server
whose queue is empty takes requests from the end of the longest queue, so that none is idle.
"""

import asyncio
import json
import sys
from collections import Counter, deque
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from hashlib import blake2b
from time import perf_counter
from typing import Any

from harness.backends.openai.http import COMPLETIONS, Client, Reply
from harness.backends.openai.statements import Model, stated
from harness.backends.servers import Server
from harness.core.errors import Unanswered, UserError, printable

FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 30.0  # wait before the first retry, doubled with each; and its limit
BROKEN = 3  # failures in a row after which a server is set aside


@dataclass(eq=False)
class _Place:
    """The state of one server.

    Attributes:
        url: base URL.
        queue: requests that wait for it.
        busy: number of requests that it works on.
        begun: number of requests that it has been sent so far.
        failures: failed attempts since it last answered.
        pauses: waits for it since it last answered.
        lost: vain attempts to reach it since it was set aside.
        fault: its last failure.
        aside: whether it is set aside: it gets no requests until it answers again.
    """

    url: str
    queue: "deque[_Pending]" = field(default_factory=deque)
    busy: int = 0
    begun: int = 0
    failures: int = 0
    pauses: int = 0
    lost: int = 0
    fault: str = ""
    aside: bool = False


@dataclass(eq=False)
class _Pending:
    """A pending request: its body, built when it is sent, the future of its reply, and failures by server."""

    key: str
    body: Callable[[], Mapping[str, Any]]
    reply: "asyncio.Future[Reply]"
    failed: Counter[_Place] = field(default_factory=Counter)
    begun_s: float | None = None


def pause_s(times: int) -> float:
    """Return the seconds to wait after `times` waits in a row."""
    return float(min(FIRST_WAIT_S * 2 ** min(times, 32), LONGEST_WAIT_S))


class Farm:
    """The servers of a model. It runs in one event loop, inside `async with` of the client.

    Attributes:
        model: the statement about the model in which all servers agree.
    """

    def __init__(self, client: Client, server: Server, name: str, weights: str, at_once: int) -> None:
        """Prepare a farm, which `open` connects.

        Args:
            client: sends single requests.
            server: the servers' URLs and the number of retries.
            name: name of the card, for messages.
            weights: the servers' name of the model.
            at_once: most requests that one server gets at once.
        """
        self._client, self._server, self._name, self._weights = client, server, printable(name), weights
        self._at_once = at_once
        self._places = [_Place(url) for url in server.urls]
        self._pending: set[_Pending] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._woken = False
        self._refused: Exception | None = None
        self._first = self._places[0]
        self._ranked = lru_cache(maxsize=1 << 12)(self._rank)
        self.model = Model()

    async def open(self) -> None:
        """Ask every server for its model. One that does not answer is set aside if another does.

        Raises:
            UserError: two have different models.
            Unanswered: none answers, or one refuses the key.
        """
        models = await asyncio.gather(*(self._look(place) for place in self._places))
        answering = {place: model for place, model in zip(self._places, models, strict=True) if model}
        if not answering:
            raise Unanswered(
                f"nobody answers at {self._faults()}; start the server, or fix base_url in the model's card"
            )
        self._first, self.model = next(iter(answering.items()))
        for place, model in answering.items():
            self._agree(place, model)
        for place in self._places:
            if place not in answering:
                self._set_aside(place)

    async def post(self, key: str, build: Callable[[], Mapping[str, Any]]) -> Reply:
        """Send a request; return the reply once there is an answer, or the retries are used up.

        If a server is busy (429), breaks down (5xx), is not reached or takes too long, the request is tried
        again: at once at another server, or at the same one after the wait that it asks for, or else a
        doubling one.

        Raises:
            UserError: one has come back with another model.
            Unanswered: no server is left.
        """
        if self._refused:
            raise self._refused
        pending = _Pending(key, build, asyncio.get_running_loop().create_future())
        self._pending.add(pending)
        try:
            self._queue(pending)
            return await pending.reply
        finally:
            self._pending.discard(pending)

    # -- who is asked ---------------------------------------------------------------------------------------

    def _rank(self, key: str) -> list[_Place]:
        """Return the servers in the order of a key."""
        if len(self._places) == 1:
            return self._places
        weights = {p: blake2b(f"{p.url} {key}".encode(), digest_size=8).digest() for p in self._places}
        return sorted(self._places, key=weights.__getitem__)

    def _queue(self, pending: _Pending) -> None:
        """Queue a request at its key's server, or at the next that is up and has failed it less often."""
        place = min(self._ranked(pending.key), key=lambda place: (place.aside, pending.failed[place]))
        (place.queue.appendleft if pending.failed else place.queue.append)(pending)  # a retry goes first
        self._wake()

    def _wake(self) -> None:
        """Schedule `_hand_out`, once, after all ready coroutines have queued their requests."""
        if not self._woken:
            self._woken = True
            asyncio.get_running_loop().call_soon(self._hand_out)

    def _hand_out(self) -> None:
        self._woken = False
        available = [place for place in self._places if not place.aside]
        for take in (self._own, self._take):  # first each server's own queue
            for place in available:
                while place.busy < self._at_once and (pending := take(place)):
                    place.busy += 1
                    self._run(self._work(place, pending))

    def _own(self, place: _Place) -> _Pending | None:
        """Take the next request from a server's own queue."""
        while place.queue:
            if not (pending := place.queue.popleft()).reply.done():  # its caller may have been cancelled
                return pending
        return None

    def _take(self, place: _Place) -> _Pending | None:
        """Take the next request from a server's own queue, or else one from the end of the longest queue."""
        if place.aside:
            return None
        if pending := self._own(place):
            return pending
        queue = max((other.queue for other in self._places), key=len)
        return queue.pop() if queue and not queue[-1].failed[place] else None

    async def _work(self, place: _Place, pending: _Pending | None) -> None:
        """Send a server one request after another until none is left for it."""
        while pending:
            try:
                await self._ask(place, pending)
            except Exception as error:  # a bug, which the caller must see
                if not pending.reply.done():
                    pending.reply.set_exception(error)
            pending = self._take(place)
        place.busy -= 1

    def _run(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)  # the event loop holds only weak references to tasks
        task.add_done_callback(self._tasks.discard)

    async def _ask(self, place: _Place, pending: _Pending) -> None:
        """Send a request until it is answered, another server may answer it, or no attempt is left."""
        while True:
            place.begun += 1
            nth, first = place.begun, place.busy == 1
            pending.begun_s = perf_counter() if pending.begun_s is None else pending.begun_s
            reply = await self._client.post(place.url, COMPLETIONS, json.dumps(pending.body()).encode())
            alone = first and place.begun == nth
            reply = replace(
                reply, retries=pending.failed[place], begun_s=pending.begun_s, alone=alone, url=place.url
            )
            if not reply.again:
                place.failures = place.pauses = 0
                break
            pending.failed[place] += 1
            if reply.status != 429:
                self._failed(place, reply)
            if any(not pending.failed[other] for other in self._places if not other.aside):
                self._queue(pending)
                return
            attempts = pending.failed.total()
            if attempts > self._server.retries:
                break
            wait_s = pause_s(attempts - 1) if reply.after_s is None else reply.after_s
            await asyncio.sleep(min(wait_s, LONGEST_WAIT_S))
            if place.aside:
                self._queue(pending)
                return
        if not pending.reply.done():
            pending.reply.set_result(reply)

    # -- who breaks down ------------------------------------------------------------------------------------

    def _failed(self, place: _Place, reply: Reply) -> None:
        place.failures += 1
        place.fault = reply.fault or ""
        if place.failures >= BROKEN and not place.aside:
            self._set_aside(place)

    def _set_aside(self, place: _Place) -> None:
        """Send a server no more requests until it answers again, and move its queue to other servers."""
        place.aside = True
        if len(self._places) > 1:
            self.say(f"server {printable(place.url)} is set aside ({place.fault})")
        self._run(self._await(place))
        self._queue_again(place)

    def _queue_again(self, *places: _Place) -> None:
        waiting = [pending for place in places for pending in place.queue]
        for place in places:
            place.queue.clear()
        for pending in waiting:
            self._queue(pending)

    async def _await(self, place: _Place) -> None:
        """Ask a server that was set aside for its model, after longer and longer pauses, until it answers."""
        try:
            while True:
                await asyncio.sleep(pause_s(place.pauses))
                place.pauses += 1
                model = await self._look(place)
                if model and model.covers(self.model):
                    break
                place.lost += 1
                if all(p.aside and p.lost > self._server.retries for p in self._places):
                    self._end(
                        Unanswered(
                            f"model {self._name!r}: no server is left: {self._faults()}; start one again"
                        )
                    )
            self._agree(place, model)
        except Exception as error:  # a bug ends the run, too; nothing else awaits this task
            self._refused = error
            self._end(error)
            return
        place.aside, place.lost, place.failures = False, 0, BROKEN - 1  # one more failure sets it aside
        if len(self._places) > 1:
            self.say(f"server {printable(place.url)} is there again")
        self._queue_again(*(p for p in self._places if p.aside))
        self._wake()

    def _end(self, error: Exception) -> None:
        for pending in list(self._pending):
            if not pending.reply.done():
                pending.reply.set_exception(error)

    def _faults(self) -> str:
        return "; ".join(f"{printable(place.url)} ({place.fault})" for place in self._places)

    def say(self, line: str) -> None:
        """Print a line about the model on stderr."""
        print(f"harness: model {self._name!r}: {line}", file=sys.stderr)

    # -- what they have -------------------------------------------------------------------------------------

    async def _look(self, place: _Place) -> Model | None:
        """Ask a server for its statement about the model; None if it does not answer.

        Raises:
            Unanswered: it refuses the key.
        """
        reply = await self._client.get(place.url, place.url + "/models")
        place.fault = reply.fault or ""
        if reply.unreached or (reply.again and self._server.any_may_answer):
            return None
        if reply.status == 401:
            raise Unanswered(
                f"model {self._name!r}: its server refuses the key ({reply.fault}); "
                f"set {self._server.key_env} in the environment"
            )
        beside = place.url.removesuffix("/v1")

        async def ask(path: str, content: bytes | None) -> Reply:
            return await self._client.get(place.url, beside + path, content)

        return await stated(self._server.kind, self._weights, reply.payload, ask)

    def _agree(self, place: _Place, model: Model) -> None:
        """Raise UserError unless a server has the same model as the first one."""
        url, weights = printable(place.url), printable(self._weights)
        if self._server.any_may_answer and model.listed is None:
            raise UserError(
                f"model {self._name!r}: server {url} lists no {weights} at {url}/models, so that nobody can "
                "tell whether it has the same model as others; fix weights in the card, or what is served"
            )
        if self.model.listed is not None and model != self.model:
            first = f"server {printable(self._first.url)} has {_shown(self.model, model)}"
            raise UserError(
                f"model {self._name!r}: {first}, and server {url} {_shown(model, self.model)}; serve "
                "the same model, by the same version"
            )


def _shown(model: Model, other: Model) -> str:
    """Return a statement's name and version, and what else it states otherwise than another, in one line."""
    differing = {k: v for k, v in model.states.items() if other.states.get(k) != v}
    facts = {**(model.listed or {}), "version": model.version, **differing}
    return " ".join(f"{key}={printable(value, 80)}" for key, value in facts.items() if value is not None)
