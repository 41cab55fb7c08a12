"""One HTTP request to a server, with deadlines, limits, and a key that never appears in output.

Nothing that a server does raises an exception: answers and failures are both data.
"""

import asyncio
import json
import math
import time
from email.utils import parsedate_to_datetime
from typing import Any
from urllib.parse import urlsplit
from urllib.request import getproxies, proxy_bypass

import aiohttp
from msgspec import Struct
from yarl import URL

from harness.backends.openai.faults import error_words, fault_in, may_pass, plain_text
from harness.backends.openai.stream import Stream
from harness.backends.openai.unpacking import Packed, Unpacker
from harness.backends.servers import Server
from harness.core.depth import shallow
from harness.core.errors import UserError, printable

CONNECT_S = 10.0  # a running server answers sooner
KEPT_S = 4.0  # time that an idle connection stays open: uvicorn, and so vLLM, closes it after 5
COMPLETIONS = "/chat/completions"
MOST_BYTES = 4 * 2**20  # an answer has a few thousand
MOST_SHOWN = 40  # characters of a body that is no JSON
SHORTEST_SECRET = 8  # shorter keys are no secrets: many local servers are given `EMPTY`
_HEADERS = {"Content-Type": "application/json", "Accept-Encoding": "identity"}
# Errors that mean that there was no connection.
_UNREACHED = (
    aiohttp.ClientConnectorError,
    aiohttp.ConnectionTimeoutError,
    aiohttp.InvalidURL,
    UnicodeError,
)


class Reply(Struct, frozen=True):
    """Hold what came of one request to a server: a JSON value, or a fault in words.

    `payload` is the JSON, `status` the HTTP status, and `url` the address of the server that
    replied. On a fault, `fault` says why there is no payload, `unreached` that there was no
    connection at all, and `again` whether another attempt may succeed; the server wants that
    `after_s` seconds later. `retries` counts failed attempts before. `begun_s` and `first_at_s` are
    when the first attempt began and the first text came, in seconds of `time.perf_counter`; `alone`
    says that the server had no other request of this program.
    """

    payload: Any = None  # the JSON value; None on a fault
    fault: str | None = None  # why there is no payload; printable and of limited length
    status: int | None = None  # HTTP status, or that of an error in an answer with 200
    unreached: bool = False  # whether there was no connection at all
    again: bool = False  # whether another attempt may succeed
    after_s: float | None = None  # seconds that the server asks to wait before another attempt
    first_at_s: float | None = None  # when the first text of a stream came, by `perf_counter`
    retries: int = 0  # earlier failed attempts at the server that gave this reply
    begun_s: float = 0.0  # when the first attempt began, by `time.perf_counter`
    alone: bool = False  # whether the server had no other request of this program at the time
    url: str = ""  # address of the server that replied


class Client:
    """Send HTTP requests to a model's servers, with one key that is never shown.

    It is used as an asynchronous context. Redirects are not followed, since they would carry the
    key.
    """

    def __init__(self, server: Server) -> None:
        self._server = server
        self._key = _key(server)
        self._proxies = {url: _proxy(url) for url in server.urls}
        self._session: aiohttp.ClientSession

    async def __aenter__(self) -> "Client":
        key = {"Authorization": f"Bearer {self._key}"} if self._key else {}
        self._session = aiohttp.ClientSession(
            connector=aiohttp.TCPConnector(limit=0, keepalive_timeout=KEPT_S),
            headers={**_HEADERS, **key},
            timeout=aiohttp.ClientTimeout(total=None, sock_connect=CONNECT_S),
            cookie_jar=aiohttp.DummyCookieJar(),
            auto_decompress=False,
        )
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._session.close()

    async def get(self, base: str, url: str, content: bytes | None = None) -> Reply:
        """Return the reply to a GET of `url`, or to a POST of the JSON `content` if it is given.

        It is for what a server states of itself, within `CONNECT_S` seconds. `base` is the server's
        base URL, whose key is sent.
        """
        method = "GET" if content is None else "POST"
        return await self._once(method, base, url, content, min(CONNECT_S, self._server.timeout_s))

    async def post(self, base: str, path: str, content: bytes) -> Reply:
        return await self._once("POST", base, base + path, content, self._server.timeout_s)

    async def _once(
        self, method: str, base: str, url: str, content: bytes | None, within_s: float
    ) -> Reply:
        try:
            # for the whole attempt: a server may send bytes for ever
            async with asyncio.timeout(within_s):
                return await self._read(method, base, url, content)
        except (aiohttp.ClientError, UnicodeError) as error:
            kind, text = type(error).__name__, str(error)
            fault = self._printable_text(f"{kind}: {text}" if text else kind)
            return Reply(fault=fault, unreached=isinstance(error, _UNREACHED), again=True)
        except TimeoutError:
            return Reply(fault=f"no whole answer within {within_s:g} s", again=True)

    async def _read(self, method: str, base: str, url: str, content: bytes | None) -> Reply:
        data, stream = bytearray(), Stream()
        options: dict[str, Any] = {
            "data": content,
            "proxy": self._proxies[base],
            "allow_redirects": False,
        }
        async with self._session.request(method, URL(url, encoded=True), **options) as response:
            status, after_s = response.status, _after_s(response.headers.get("retry-after"))

            def fault(words: str, status: int = status, again: bool = False) -> Reply:
                return Reply(fault=words, status=status, again=again, after_s=after_s)

            streamed = response.content_type == "text/event-stream"
            try:
                unpacker = Unpacker(response.headers.get("content-encoding", ""))
                async for packed in response.content.iter_any():
                    chunk = unpacker.take(packed, MOST_BYTES + 1 - len(data))
                    data += chunk
                    if len(data) > MOST_BYTES:
                        return Reply(fault=f"the answer is longer than {MOST_BYTES} bytes")
                    if streamed:
                        stream.take(chunk, time.perf_counter())
            except Packed as packed_fault:
                return fault(str(packed_fault), again=may_pass(status))

        if streamed and status == 200:
            if stream.fault:
                code = stream.code if stream.again and stream.code else status
                return fault(self._printable_text(stream.fault), code, stream.again)
            # Put together before the key is looked for, since pieces may cut through it.
            payload, _ = self._payload(json.dumps(stream.payload()).encode())
            return Reply(payload, status=status, first_at_s=stream.first_at_s)
        payload, readable = self._payload(bytes(data))
        if status == 200:
            error = fault_in(
                payload if readable else plain_text(data), of_chat=url.endswith(COMPLETIONS)
            )
            if error is None:
                return Reply(
                    payload, fault=None if readable else self._no_json(data), status=status
                )
            words = f"with HTTP 200: {self._printable_text(error.words)}"
            if error.code is None:
                return fault(f"an error {words}", again=error.again)
            return fault(f"error {error.code} {words}", error.code, may_pass(error.code))
        if 300 <= status < 400:
            return fault(f"HTTP {status}: a redirect, which is not followed")
        message = error_words(payload) if readable else bytes(data).decode("utf-8", "replace")
        words = self._printable_text(message) or "an empty reply"
        return fault(f"HTTP {status}: {words}", again=may_pass(status))

    def _payload(self, data: bytes) -> tuple[Any, bool]:
        """Parse JSON and remove the key from it, however it is escaped.
        Returns the value and the success.
        """
        try:
            payload = shallow(json.loads(data.decode("utf-8-sig", "replace")))
            if self._key:
                # Encoded again first, since JSON has many spellings of one text.
                payload = json.loads(self._without_key(json.dumps(payload, ensure_ascii=False)))
        except (ValueError, RecursionError):
            return None, False
        return payload, True

    def _no_json(self, data: bytes | bytearray) -> str:
        """Return the fault of a body that is no JSON, with its beginning:
        it may be markup, or packed.
        """
        if not data:
            return "the answer is no JSON: it is empty"
        text = self._without_key(data[: MOST_SHOWN * 100].decode("utf-8", "replace"))
        return f"the answer is no JSON: it begins '{printable(text, MOST_SHOWN)}'"

    def _without_key(self, text: str) -> str:
        if not self._key or len(self._key) < SHORTEST_SECRET:
            return text
        return text.replace(json.dumps(self._key)[1:-1], "[key]").replace(self._key, "[key]")

    def _printable_text(self, text: str) -> str:
        # The key is removed before the text is cut, or half of it might stay.
        return printable(" ".join(self._without_key(text).split()), 200)


def _key(server: Server) -> str | None:
    key = server.key() or ""
    if not (key.isascii() and key.isprintable()) or " " in key:
        raise UserError(
            f"the key in {server.key_env} holds characters that no key has; set it again"
        )
    return key or None


def _proxy(url: str) -> str | None:
    parts, proxies = urlsplit(url), getproxies()
    if proxy_bypass(parts.hostname or ""):
        return None
    return proxies.get(parts.scheme) or proxies.get("all")


def _after_s(text: str | None) -> float | None:
    """Return the seconds of a Retry-After header, which is a number or a date;
    None if it is unreadable.
    """
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
