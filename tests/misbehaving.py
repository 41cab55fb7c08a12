"""A server that speaks OpenAI's chat completions as badly as a test wants."""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, NamedTuple

LISTED = {
    "data": [{"id": "m", "owned_by": "tests", "created": 1}, {"id": "n", "owned_by": "tests"}]
}


class Asked(NamedTuple):
    """One request as the server saw it, and where to write the answer."""

    path: str
    headers: dict[str, str]
    body: Any
    number: int  # of all that were asked for a completion, from 0
    handler: BaseHTTPRequestHandler

    def reply(self, body: Any, status: int = 200, **headers: str) -> None:
        """Answer as a decent server does: JSON, or bytes as they are."""
        data = body if isinstance(body, bytes) else json.dumps(body).encode()
        self.handler.send_response(status)
        for name, value in {"content_length": str(len(data)), **headers}.items():
            self.handler.send_header(name.replace("_", "-"), value)
        self.handler.end_headers()
        self.handler.wfile.write(data)

    def stream(self, *pieces: Any, between: Callable[[], Any] = lambda: None) -> None:
        """Answer as a decent server streams:
        an event a piece, or bytes as they are, and hang up.
        """
        self.raw(b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream; charset=utf-8\r\n\r\n")
        for piece in pieces:
            self.raw(piece if isinstance(piece, bytes) else event(piece))
            between()

    def raw(self, data: bytes) -> None:
        """Write bytes in place of an answer, and hang up."""
        self.handler.wfile.write(data)
        self.handler.wfile.flush()
        self.handler.close_connection = True


Play = Callable[[Asked], None]


class Server(ThreadingHTTPServer):
    """Answers every completion by `play`, and remembers what it was asked."""

    daemon_threads = True

    def __init__(self, play: Play, listed: Play, path: str) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.play, self.listed, self.path = play, listed, path
        self.asked: list[Asked] = []
        self.lock = threading.Lock()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}{self.path}"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that hangs up is no news."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # a connection that stays open would wait 40 ms for each answer
    server: Server

    def do_GET(self) -> None:
        self.server.listed(Asked(self.path, dict(self.headers), None, -1, self))

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        # Ollama is asked by POST, too, for what it says of a model.
        if not self.path.endswith(("/chat/completions", "/systemone", "/decisions")):
            self.server.listed(Asked(self.path, dict(self.headers), body, -1, self))
            return
        with self.server.lock:
            asked = Asked(self.path, dict(self.headers), body, len(self.server.asked), self)
            self.server.asked.append(asked)
        self.server.play(asked)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""


def event(piece: Any) -> bytes:
    """A piece of a stream."""
    return f"data: {json.dumps(piece)}\n\n".encode()


def pieces(
    *texts: str, finish_reason: str | None = "stop", usage: bool = True, **first: Any
) -> list[Any]:
    """A completion in pieces, as vLLM sends it:
    who speaks, each text, why it ends, and the tokens' count.
    """
    deltas = [{"role": "assistant", "content": "", **first}, *({"content": text} for text in texts)]
    made: list[Any] = [
        {"choices": [{"index": 0, "delta": delta, "finish_reason": None}]} for delta in deltas
    ]
    if finish_reason:
        made.append({"choices": [{"index": 0, "delta": {}, "finish_reason": finish_reason}]})
    if usage:
        counted = {"prompt_tokens": 12, "completion_tokens": len(texts) + 1}
        made.append({"choices": [], "usage": counted})
    return [*made, b"data: [DONE]\n\n"]


def tokens_of(asked: Asked) -> int:
    """As many tokens as a question of this length may have; what times answers takes no fewer."""
    return len(json.dumps(asked.body)) // 4


def completion(
    content: Any = "hello", finish_reason: str = "stop", **message: Any
) -> dict[str, Any]:
    """What a decent server answers."""
    choice = {
        "index": 0,
        "finish_reason": finish_reason,
        "message": {"content": content, **message},
    }
    return {"choices": [choice], "usage": {"prompt_tokens": 12, "completion_tokens": 20}}


def read_out(*likeliest: tuple[str, float]) -> dict[str, Any]:
    """A completion with the log-probabilities of its first token."""
    made = completion("A", "length")
    top = [{"token": token, "logprob": logprob} for token, logprob in likeliest]
    made["choices"][0]["logprobs"] = {"content": [{**top[0], "top_logprobs": top}]}
    return made


def usual(asked: Asked) -> None:
    """List two models."""
    asked.reply(LISTED)


@contextmanager
def serving(play: Play, listed: Play = usual, path: str = "/v1") -> Iterator[Server]:
    server = Server(play, listed, path)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
