"""Serve an application by HTTP at one address, until Ctrl-C."""

import errno
import socket
from collections.abc import Callable
from ipaddress import ip_address
from typing import Any

import uvicorn
from starlette.types import ASGIApp

from harness.core.errors import UserError, printable

LOOPBACK = "127.0.0.1"
BACKLOG = 512  # connections that wait to be taken
NAMES = (LOOPBACK, "localhost", "::1")  # of this machine, as who is on it writes them


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches an address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def serve(app: ASGIApp, host: str, port: int, listening: Callable[[str], None], **limits: Any) -> None:
    """Serve until Ctrl-C.

    Args:
        app: the application.
        host: an address of this machine.
        port: 0 for a free one.
        listening: called with the base URL as soon as it is listened on.
        limits: further settings of uvicorn.

    Raises:
        UserError: the address or the port is not available.
    """
    unknown = f"--host {printable(host)} is no address of this machine; give one, such as {LOOPBACK}"
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
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
            what = "is in use" if error.errno == errno.EADDRINUSE else f"is not available ({error.strerror})"
            raise UserError(f"--port {port} {what}; give another, or 0 for a free one") from None
        name = f"[{host}]" if ":" in host else host
        listening(f"http://{name}:{listener.getsockname()[1]}")
        config = uvicorn.Config(
            app, log_level="critical", access_log=False, lifespan="off", ws="none", proxy_headers=False,
            server_header=False, timeout_graceful_shutdown=1, **limits,
        )  # fmt: skip
        uvicorn.Server(config).run(sockets=[listener])
