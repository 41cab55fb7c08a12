"""Asking a server for JSON: deadlines, retries, bounds, and a key that gets out nowhere.

Nothing that a server does raises: what it answers, and how it fails, is data.
"""

import asyncio
import json
import math
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from email.utils import parsedate_to_datetime
from typing import Any, Self

import httpx

from harness.backends.openai.stream import Stream
from harness.backends.servers import Server
from harness.core.errors import UserError, printable

CONNECT_S = 10.0  # a machine that is there answers sooner
FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 30.0  # before the first retry, doubled with each; at most
MOST_BYTES = 4 * 2**20  # an answer has a few thousand
SHORTEST_SECRET = 8  # `EMPTY` is what many local servers are given, and may stand in any text


@dataclass(frozen=True)
class Reply:
    """What came of asking.

    Attributes:
        payload: the JSON value; None on a fault.
        retries: attempts that failed before the last.
        fault: why there is no payload, printable and bounded.
        status: of HTTP; None where none came.
        again: whether another attempt may do better.
        after_s: seconds that the server asks to wait before it.
        first_at_s: when the first text of a stream came, by `time.perf_counter`; None where none was seen.
    """

    payload: Any = None
    retries: int = 0
    fault: str | None = None
    status: int | None = None
    again: bool = False
    after_s: float | None = None
    first_at_s: float | None = None


class Client:
    """Asks one server, inside `async with`. Redirects are not followed, since the key would go with them."""

    def __init__(self, server: Server, concurrency: int) -> None:
        self._server = server
        self._concurrency = concurrency
        self._key = _key(server)
        self._certificates = httpx.create_ssl_context()  # takes longer than many an answer
        self._http: httpx.AsyncClient

    async def __aenter__(self) -> Self:
        headers = {"Content-Type": "application/json", "Accept-Encoding": "identity"}
        if self._key:
            headers["Authorization"] = f"Bearer {self._key}"
        self._http = httpx.AsyncClient(
            headers=headers,
            verify=self._certificates,
            timeout=httpx.Timeout(None, connect=CONNECT_S),
            limits=httpx.Limits(max_connections=self._concurrency),
        )
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._http.aclose()

    async def get(self, path: str) -> Reply:
        """One attempt. Raises UserError if there is nobody to be asked."""
        try:
            return await self._once("GET", path, None, min(CONNECT_S, self._server.timeout_s))
        except (httpx.ConnectError, httpx.ConnectTimeout, httpx.InvalidURL, UnicodeError) as error:
            raise UserError(
                f"nobody answers at {printable(self._server.base_url)} ({self._shown(_said(error))}); "
                "start the server, or mend base_url in the model's card"
            ) from None
        except (httpx.RequestError, TimeoutError) as error:
            return Reply(fault=self._shown(_said(error)))

    async def post(self, path: str, body: Mapping[str, Any]) -> Reply:
        """Ask until there is an answer, or the server's retries are used up.

        A server that is busy (429), breaks down (5xx), is not reached or takes too long is asked again, after
        the time that it asks for or one that doubles.
        """
        content = json.dumps(body).encode()
        retries = 0
        while True:
            try:
                reply = await self._once("POST", path, content, self._server.timeout_s)
            except TimeoutError:
                reply = Reply(fault=f"no whole answer within {self._server.timeout_s:g} s", again=True)
            except (
                httpx.InvalidURL,
                UnicodeError,
            ):  # httpx reads where a redirect leads though none is followed
                reply = Reply(fault="a redirect to what is no address, which is not followed")
            except httpx.RequestError as error:
                reply = Reply(fault=self._shown(_said(error)), again=True)
            if not reply.again or retries == self._server.retries:
                return replace(reply, retries=retries)
            wait_s = FIRST_WAIT_S * 2**retries if reply.after_s is None else reply.after_s
            await asyncio.sleep(min(wait_s, LONGEST_WAIT_S))
            retries += 1

    async def _once(self, method: str, path: str, content: bytes | None, within_s: float) -> Reply:
        url = self._server.base_url.rstrip("/") + path
        data, stream = bytearray(), Stream()
        async with (
            asyncio.timeout(within_s),  # of the whole attempt: a server may drip for ever
            self._http.stream(method, url, content=content) as response,
        ):
            streamed = response.headers.get("content-type", "").startswith("text/event-stream")
            async for chunk in response.aiter_raw():
                data += chunk
                if len(data) > MOST_BYTES:
                    return Reply(fault=f"the answer is longer than {MOST_BYTES} bytes")
                if streamed:
                    stream.take(chunk, time.perf_counter())
        status = response.status_code
        if streamed and status == 200:
            if stream.fault:
                return Reply(fault=self._shown(stream.fault), status=status, again=stream.again)
            # Put together before the key is looked for, since pieces may cut through it.
            payload, _ = self._payload(json.dumps(stream.payload()).encode())
            return Reply(payload, status=status, first_at_s=stream.first_at_s)
        payload, readable = self._payload(bytes(data))
        if status == 200:
            return Reply(payload, fault=None if readable else "the answer is no JSON", status=status)
        if 300 <= status < 400:
            return Reply(fault=f"HTTP {status}: a redirect, which is not followed", status=status)
        message = _message(payload) if readable else bytes(data).decode("utf-8", "replace")
        return Reply(
            fault=f"HTTP {status}: {self._shown(message)}",
            status=status,
            again=status == 429 or status >= 500,
            after_s=_after_s(response.headers.get("retry-after")),
        )

    def _payload(self, data: bytes) -> tuple[Any, bool]:
        """The JSON value without the key, however it was escaped, and whether there is one."""
        try:
            payload = json.loads(data.decode("utf-8", "replace"))
            if self._key:
                # Written again, since JSON knows many spellings of one text.
                payload = json.loads(self._without_key(json.dumps(payload, ensure_ascii=False)))
        except (ValueError, RecursionError):
            return None, False
        return payload, True

    def _without_key(self, text: str) -> str:
        if not self._key or len(self._key) < SHORTEST_SECRET:
            return text
        return text.replace(json.dumps(self._key)[1:-1], "[key]").replace(self._key, "[key]")

    def _shown(self, text: str) -> str:
        # Before it is cut, or half of the key might stay.
        return printable(" ".join(self._without_key(text).split()), 200)


def _key(server: Server) -> str | None:
    key = os.environ.get(server.key_env, "").strip()
    if not (key.isascii() and key.isprintable()) or " " in key:
        raise UserError(f"the key in {server.key_env} holds characters that no key has; set it again")
    return key or None


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def _message(payload: Any) -> str:
    """What an error says: servers put it under `error`, `error.message`, `message` or `detail`."""
    while isinstance(payload, dict):
        found = [payload[name] for name in ("error", "message", "detail") if payload.get(name)]
        payload = found[0] if found else json.dumps(payload)
    return str(payload)


def _after_s(text: str | None) -> float | None:
    """Seconds that a Retry-After asks for, as a number or a date; None if it says nothing readable."""
    if text is None:
        return None
    try:
        seconds = float(text)
    except ValueError:
        try:
            seconds = parsedate_to_datetime(text).timestamp() - time.time()
        except (ValueError, OverflowError):
            return None
    return None if math.isnan(seconds) else max(seconds, 0.0)
