"""One model behind one or several servers:
distribute requests, retry, and set broken servers aside.

Requests with the same key go to the same server, whose cache holds the beginning of their prompts:
each key ranks the servers by a hash (rendezvous hashing), so that adding or removing one moves few
keys. A server whose queue is empty takes requests from the end of the longest queue, so that none
is idle.
"""

import asyncio
import sys
from collections import Counter, deque
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from hashlib import blake2b
from time import perf_counter
from typing import Any

import msgspec

from harness.backends.openai.http import Client, Reply
from harness.backends.openai.pace import BUSY, Pace
from harness.backends.openai.statements import Model, read_statement
from harness.backends.servers import Server
from harness.core.at_once import AtOnce, most_at_once
from harness.core.errors import Unanswered, UserError, printable
from harness.core.parallel import share

# wait before the first retry, doubled with each; and its limit
FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 30.0
BROKEN = 3  # failures in a row after which a server is set aside


@dataclass(eq=False)
class _ServerState:
    """The state of one server."""

    url: str
    pace: Pace  # how many requests it may have at a time
    queue: "deque[_Pending]" = field(default_factory=deque)
    busy: int = 0  # number of requests that it works on
    sent: int = 0  # number of requests that it has been sent so far
    failures: int = 0  # failed attempts since it last answered
    pauses: int = 0  # waits for it since it last answered
    unreached: int = 0  # failed attempts to reach it since it was set aside
    fault: str = ""  # its last failure
    aside: bool = False  # whether it is set aside: it gets no requests until it answers again
    rests_until_s: float = 0.0  # by `perf_counter`: it has asked for no requests until then

    @property
    def rest_s(self) -> float:
        """Return the seconds until it may get requests again, 0 or less if it may now."""
        return self.rests_until_s - perf_counter()

    @property
    def has_room(self) -> bool:
        return self.busy < self.pace.limit and self.rest_s <= 0 and not self.aside


@dataclass(eq=False)
class _Pending:
    """A pending request: its body, built when it is sent, the future of its reply,
    and failures by server.
    """

    key: str
    body: Callable[[], Mapping[str, Any]]
    reply: "asyncio.Future[Reply]"
    failed: Counter[_ServerState] = field(default_factory=Counter)
    excused: int = 0  # failures that are no attempts: a server had too many requests at a time
    begun_s: float | None = None


def pause_s(times: int) -> float:
    """Return the seconds to wait before the next attempt at a server, after `times` waits in a row.

    They double with each wait, up to `LONGEST_WAIT_S`.
    """
    return float(min(FIRST_WAIT_S * 2 ** min(times, 32), LONGEST_WAIT_S))


class ServerPool:
    """Distribute requests over a model's servers, retry them, and avoid broken servers.

    `model` is what all servers state of their model. It works in one event loop, inside `async
    with` of the client.
    """

    def __init__(
        self,
        client: Client,
        settings: Server,
        name: str,
        weights: str,
        at_once: AtOnce,
        path: str,
    ) -> None:
        """Prepare a pool, which `open` connects.

        Each server gets at most `at_once` requests at a time, from all workers together, at `path`
        behind its base URL; `auto` finds the number. `name` is the model's in messages, `weights`
        its name at the servers.
        """
        self._client, self._settings = client, settings
        self._name, self._weights = printable(name), weights
        self._most, self._path = most_at_once(at_once), path
        self._servers = [_ServerState(url, Pace(at_once)) for url in settings.urls]
        self._pending: set[_Pending] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._woken = False
        self._refused: Exception | None = None
        self._first = self._servers[0]
        self._ranked = lru_cache(maxsize=1 << 12)(self._rank)
        self.model = Model()

    async def open(self) -> None:
        """Ask every server for its model; one that does not answer is avoided if another does.

        Raises UserError if two have different models, Unanswered if none answers or one refuses the
        key.
        """
        models = await asyncio.gather(*(self._look(server) for server in self._servers))
        answering = {
            server: model for server, model in zip(self._servers, models, strict=True) if model
        }
        if not answering:
            raise Unanswered(
                f"no server answers at {self._faults()}; start the server, or fix --server or the "
                "card's base_url"
            )
        self._first, self.model = next(iter(answering.items()))
        for server, model in answering.items():
            self._agree(server, model)
        for server in self._servers:
            if server not in answering:
                self._set_aside(server)

    async def post(self, key: str, build: Callable[[], Mapping[str, Any]]) -> Reply:
        """Return a server's reply to a request, after retries if they are needed.

        `key` ranks the servers, so that requests with one key share a prompt cache; `build` returns
        the request's JSON body when it is sent. If a server is busy (429), breaks down (5xx), is
        not reached or takes too long, the request is tried again: at once at another server, or at
        the same one after the wait that it asks for, during which it gets no other request, or else
        a doubling one. Raises UserError if one has come back with another model, Unanswered if no
        server is left.
        """
        if self._refused:
            raise self._refused
        pending = _Pending(key, build, asyncio.get_running_loop().create_future())
        self._pending.add(pending)
        try:
            self._enqueue(pending)
            return await pending.reply
        finally:
            self._pending.discard(pending)

    # -- who is asked
    # ---------------------------------------------------------------------------------------

    def _rank(self, key: str) -> list[_ServerState]:
        if len(self._servers) == 1:
            return self._servers
        weights = {
            s: blake2b(f"{s.url} {key}".encode(), digest_size=8).digest() for s in self._servers
        }
        return sorted(self._servers, key=weights.__getitem__)

    def _enqueue(self, *requests: _Pending) -> None:
        """Queue requests at their key's server,
        or at the next that is up and has failed them less often.
        """
        for pending in requests:
            queue = min(self._ranked(pending.key), key=lambda s: (s.aside, pending.failed[s])).queue
            queue.insert(0 if pending.failed else len(queue), pending)  # a retry goes first
        self._wake()

    def _wake(self) -> None:
        """Hand out requests once all ready coroutines have queued theirs."""
        if not self._woken:
            self._woken = True
            asyncio.get_running_loop().call_soon(self._hand_out)

    def _hand_out(self) -> None:
        """Give every server that is neither aside nor at rest as many requests as it may have."""
        self._woken = False
        for take in (self._next, self._steal):  # first each server's own queue
            for server in self._servers:
                while server.has_room and (pending := take(server)):
                    server.busy += 1
                    self._run(self._work(server, pending))

    def _next(self, server: _ServerState) -> _Pending | None:
        while server.queue:
            # its caller may have been cancelled
            if not (pending := server.queue.popleft()).reply.done():
                return pending
        return None

    def _steal(self, server: _ServerState) -> _Pending | None:
        """Take the next request from a server's own queue,
        or else one from the end of the longest queue.
        """
        if not server.has_room:
            return None
        if pending := self._next(server):
            return pending
        queue = max((peer.queue for peer in self._servers), key=len)
        return queue.pop() if queue and not queue[-1].failed[server] else None

    async def _work(self, server: _ServerState, pending: _Pending | None) -> None:
        while pending:
            try:
                await self._ask(server, pending)
            except Exception as error:  # a bug, which the caller must see
                if not pending.reply.done():
                    pending.reply.set_exception(error)
            server.busy -= 1
            if pending := self._steal(server):
                server.busy += 1

    def _run(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)  # the event loop holds only weak references to tasks
        task.add_done_callback(self._tasks.discard)

    async def _ask(self, server: _ServerState, pending: _Pending) -> None:
        """Send a request until it is answered, another server may answer it,
        or no attempt is left.
        """
        while True:
            server.sent += 1
            nth, first, turn = server.sent, server.busy == 1, server.pace.turn
            sent_s = perf_counter()
            pending.begun_s = sent_s if pending.begun_s is None else pending.begun_s
            reply = await self._client.post(
                server.url, self._path, msgspec.json.encode(pending.body())
            )
            alone = first and server.sent == nth and share(self._most) == self._most
            reply = msgspec.structs.replace(
                reply,
                retries=pending.failed[server],
                begun_s=pending.begun_s,
                alone=alone,
                url=server.url,
            )
            if not reply.again:
                server.failures = server.pauses = 0
                full = server.busy >= server.pace.limit
                if full and server.pace.answered(turn, perf_counter() - sent_s):
                    self._wake()
                break
            pending.failed[server] += 1
            had_too_many = reply.status in BUSY and server.pace.refused(turn)
            pending.excused += had_too_many
            if reply.after_s is not None:
                self._rest(server, reply.after_s)
            if reply.status != 429 and not had_too_many:
                server.failures, server.fault = server.failures + 1, reply.fault or ""
                if server.failures >= BROKEN and not server.aside:
                    self._set_aside(server)
            if any(not pending.failed[other] for other in self._servers if not other.aside):
                self._enqueue(pending)
                return
            if had_too_many:
                self._enqueue(pending)
                return
            attempts = pending.failed.total() - pending.excused
            if attempts > self._settings.retries:
                break
            if reply.after_s is None:
                await asyncio.sleep(pause_s(attempts - 1))
            while (rest_s := server.rest_s) > 0:
                await asyncio.sleep(rest_s)
            if server.aside:
                self._enqueue(pending)
                return
        if not pending.reply.done():
            pending.reply.set_result(reply)

    def _rest(self, server: _ServerState, after_s: float) -> None:
        """Send a server no request for the seconds that it asks for, `LONGEST_WAIT_S` at most."""
        wait_s = min(after_s, LONGEST_WAIT_S)
        server.rests_until_s = max(server.rests_until_s, perf_counter() + wait_s)
        asyncio.get_running_loop().call_later(wait_s, self._hand_out)

    # -- who breaks down
    # ------------------------------------------------------------------------------------

    def _set_aside(self, server: _ServerState) -> None:
        """Send a server no more requests until it answers again,
        and move its queue to other servers.
        """
        server.aside = True
        if len(self._servers) > 1:
            self.say(f"server {printable(server.url)} is set aside ({server.fault})")
        self._run(self._await(server))
        self._enqueue_again(server)

    def _enqueue_again(self, *servers: _ServerState) -> None:
        waiting = [pending for server in servers for pending in server.queue]
        for server in servers:
            server.queue.clear()
        self._enqueue(*waiting)

    async def _await(self, server: _ServerState) -> None:
        """Ask a server that was set aside for its model, after longer and longer pauses,
        until it answers.
        """
        try:
            while True:
                await asyncio.sleep(pause_s(server.pauses))
                server.pauses += 1
                model = await self._look(server)
                if model and model.covers(self.model):
                    break
                server.unreached += 1
                if all(s.aside and s.unreached > self._settings.retries for s in self._servers):
                    left = (
                        f"model {self._name!r}: no server is left: {self._faults()}; start one "
                        "again"
                    )
                    self._end(Unanswered(left))
            self._agree(server, model)
        except Exception as error:  # a bug ends the run, too; nothing else awaits this task
            self._refused = error
            self._end(error)
            return
        # one more sets it aside
        server.aside, server.unreached, server.failures = False, 0, BROKEN - 1
        if len(self._servers) > 1:
            self.say(f"server {printable(server.url)} is there again")
        self._enqueue_again(*(s for s in self._servers if s.aside))

    def _end(self, error: Exception) -> None:
        for pending in list(self._pending):
            if not pending.reply.done():
                pending.reply.set_exception(error)

    def _faults(self) -> str:
        return "; ".join(f"{printable(server.url)} ({server.fault})" for server in self._servers)

    def say(self, line: str) -> None:
        print(f"harness: model {self._name!r}: {line}", file=sys.stderr)

    # -- what they have
    # -------------------------------------------------------------------------------------

    async def _look(self, server: _ServerState) -> Model | None:
        """Ask a server for its statement about the model; None if it does not answer."""
        reply = await self._client.get(server.url, server.url + "/models")
        server.fault = reply.fault or ""
        if reply.unreached or (reply.again and self._settings.any_may_answer):
            return None
        if reply.status == 401:
            raise Unanswered(
                f"model {self._name!r}: its server refuses the key ({reply.fault}); "
                f"set {self._settings.key_env} in the environment"
            )
        beside = server.url.removesuffix("/v1")

        async def ask(path: str, content: bytes | None) -> Reply:
            return await self._client.get(server.url, beside + path, content)

        return await read_statement(self._settings.kind, self._weights, reply.payload, ask)

    def _agree(self, server: _ServerState, model: Model) -> None:
        """Raise UserError unless a server has the same model as the first one."""
        url, weights = printable(server.url), printable(self._weights)
        if self._settings.any_may_answer and model.listed is None:
            raise UserError(
                f"model {self._name!r}: server {url} lists no {weights} at {url}/models, so it may "
                "have another model than others; fix weights in the card, or what is served"
            )
        if self.model.listed is not None and model != self.model:
            first = f"server {printable(self._first.url)} has {_statement(self.model, model)}"
            raise UserError(
                f"model {self._name!r}: {first}, and server {url} {_statement(model, self.model)}; "
                "serve the same model, by the same version"
            )


def _statement(model: Model, other: Model) -> str:
    """Return a statement's name and version, and what else it states otherwise than another,
    in one line.
    """
    differing = {k: v for k, v in model.states.items() if other.states.get(k) != v}
    facts = {**(model.listed or {}), "version": model.version, **differing}
    return " ".join(
        f"{key}={printable(value, 80)}" for key, value in facts.items() if value is not None
    )
