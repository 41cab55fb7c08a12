"""A model that is served on loopback, in a thread of this process."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from harness.backends import cards
from harness.backends.base import Backend
from harness.backends.card import Card
from harness.backends.registry import open_backend
from harness.core import web
from harness.extensions.decide.app import Service
from harness.extensions.decide.model import ServedModel, served


@contextmanager
def answering(
    model: str | Card, backend: Backend | None = None, letters: Any = None, **how: Any
) -> Iterator[str]:
    """The base URL of a model's server, up to and including /v1."""
    agent = served(cards.load(model) if isinstance(model, str) else model, letters)
    service = Service(ServedModel(agent, backend or open_backend(agent.card, batch_size=1)), **how)
    server = web.server_of(service.app())
    with socket.socket(proto=socket.IPPROTO_TCP) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        thread = threading.Thread(target=server.run, args=([listener],), daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{listener.getsockname()[1]}/v1"
        finally:
            server.should_exit = True
            thread.join(10)


def asking(wire: str, url: str, **changes: Any) -> Backend:
    """This program's own client of a server, by one of the wire shapes."""
    card = cards.load(f"{wire}-example")
    assert card.server is not None
    settings = {"base_url": url, "kind": "generic", **changes}
    return open_backend(replace(card, server=replace(card.server, **settings)), batch_size=1)
