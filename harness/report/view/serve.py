"""Serves a folder of runs on the loopback interface, and on no other."""

import errno
import secrets
import socket
from collections.abc import Callable
from pathlib import Path

import uvicorn

from harness.core.errors import UserError
from harness.report.view.access import TOKEN
from harness.report.view.app import app

LOOPBACK = "127.0.0.1"


def serve(folder: Path, port: int, listening: Callable[[str], None]) -> None:
    """Serve until Ctrl-C.

    Args:
        folder: the runs.
        port: 0 for a free one.
        listening: called with the address, which holds the token, as soon as it is listened on.

    Raises:
        UserError: the port is not available.
    """
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((LOOPBACK, port))
            listener.listen()
        except OSError as error:
            what = "is in use" if error.errno == errno.EADDRINUSE else f"is not available ({error.strerror})"
            raise UserError(f"--port {port} {what}; give another, or 0 for a free one") from None
        token = secrets.token_urlsafe()
        listening(f"http://{LOOPBACK}:{listener.getsockname()[1]}/?{TOKEN}={token}")
        config = uvicorn.Config(
            app(folder, token), log_level="critical", access_log=False, lifespan="off", ws="none",
            proxy_headers=False, server_header=False, timeout_graceful_shutdown=1,
        )  # fmt: skip
        uvicorn.Server(config).run(sockets=[listener])
