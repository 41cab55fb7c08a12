"""Serve an application by HTTP at one address, until Ctrl-C."""

import asyncio
import errno
import math
import socket
from collections.abc import Callable
from ipaddress import ip_address
from typing import Any

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from harness.core.errors import UserError, printable

LOOPBACK = "127.0.0.1"
BACKLOG = 512  # connections that wait to be taken
NAMES = (LOOPBACK, "localhost", "::1")  # of this machine, as who is on it writes them
HEAD_S = 10.0  # within which a request's head, its line and headers, must have come
# connections on which a head is waited for; of more, the one that took longest is closed
WAITING = 64


class HeadInTime(H11Protocol):
    """Limit how long a client may take to send a request's line and headers, in uvicorn's protocol.

    A connection is closed after `HEAD_S` seconds without a complete head. At most `WAITING`
    connections may wait for one; of more, the one that waited longest is closed.
    """

    # timer that closes the connection; None while no head is awaited
    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin the time limit of a new connection's first request; the event loop calls this."""
        super().connection_made(transport)
        self._watch()

    def data_received(self, data: bytes) -> None:
        """Handle bytes of a connection, and begin or end the time limit of a request's head.

        The event loop calls this; a head is the request's line and headers.
        """
        super().data_received(data)
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the time limit of a connection that is gone; the event loop calls this."""
        super().connection_lost(exc)
        self._relax()

    def _watch(self) -> None:
        if self.conn.their_state is not h11.IDLE:
            self._relax()
        elif self._late is None:
            self._late = self.loop.call_later(HEAD_S, self.transport.close)
            waiting = [
                each for each in self.connections if isinstance(each, HeadInTime) and each._late
            ]
            if len(waiting) > WAITING:
                oldest = min(waiting, key=HeadInTime._closes_at)
                oldest._relax()  # it is chosen once
                oldest.transport.close()

    def _closes_at(self) -> float:
        return self._late.when() if self._late else math.inf

    def _relax(self) -> None:
        if self._late is not None:
            self._late.cancel()
            self._late = None


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach a host name or address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def server_of(app: ASGIApp, **limits: Any) -> uvicorn.Server:
    """Return a uvicorn server for an ASGI application, with the harness's limits, not started.

    `limits` are further settings of `uvicorn.Config`, by name.
    """
    config = uvicorn.Config(
        app,
        log_level="critical",
        access_log=False,
        lifespan="off",
        ws="none",
        proxy_headers=False,
        server_header=False,
        timeout_graceful_shutdown=1,
        http=HeadInTime,
        **limits,
    )
    return uvicorn.Server(config)


def serve(
    app: ASGIApp, host: str, port: int, listening: Callable[[str], None], **limits: Any
) -> None:
    """Serve an application by HTTP until Ctrl-C.

    Args:
        app: the ASGI application.
        host: an address of this machine, such as `127.0.0.1`.
        port: 0 for a free one.
        listening: called with the base URL as soon as it is listened on.
        limits: further settings of `uvicorn.Config`, by name.

    Raises:
        UserError: the address or the port is not available.
    """
    unknown = (
        f"--host {printable(host)} is no address of this machine; give one, such as {LOOPBACK}"
    )
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM
        )[0]
    except (OSError, UnicodeError):
        raise UserError(unknown) from None
    # Without its protocol asyncio would not send at once, and each answer would take 40 ms longer.
    with socket.socket(family, kind, protocol) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind(address)
            listener.listen(BACKLOG)
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:
                raise UserError(unknown) from None
            what = (
                "is in use"
                if error.errno == errno.EADDRINUSE
                else f"is not available ({error.strerror})"
            )
            raise UserError(f"--port {port} {what}; give another, or 0 for a free one") from None
        name = f"[{host}]" if ":" in host else host
        listening(f"http://{name}:{listener.getsockname()[1]}")
        server_of(app, **limits).run(sockets=[listener])
