"""Serves a folder of runs on the loopback interface, and on no other."""

import secrets
from collections.abc import Callable
from pathlib import Path

from harness.core import web
from harness.extensions.view.access import TOKEN
from harness.extensions.view.app import app


def serve(folder: Path, port: int, listening: Callable[[str], None]) -> None:
    """Serve a folder of runs to browsers on this machine until Ctrl-C.

    Args:
        folder: the folder of runs.
        port: the TCP port on 127.0.0.1; 0 for a free one.
        listening: called with the address, which holds the secret token, once the server listens.

    Raises:
        UserError: the port is not available.
    """
    token = secrets.token_urlsafe()
    web.serve(
        app(folder, token), web.LOOPBACK, port, lambda url: listening(f"{url}/?{TOKEN}={token}")
    )
