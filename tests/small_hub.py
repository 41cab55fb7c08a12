"""A hub of one's own: what `huggingface_hub` asks of one, for folders that lie in memory."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from urllib.parse import unquote, urlsplit

COMMIT = "0123456789abcdef0123456789abcdef01234567"


class Hub(ThreadingHTTPServer):
    """Serves repositories, files by name; `asked` has the paths of the files that were sent.

    A repository without files is gated. A file whose content is None breaks off in the middle.
    """

    def __init__(self, repositories: Mapping[str, Mapping[str, bytes | None]]) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.repositories = repositories
        self.asked: list[str] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


@contextmanager
def serving(repositories: Mapping[str, Mapping[str, bytes | None]]) -> Iterator[Hub]:
    with Hub(repositories) as hub:
        Thread(target=hub.serve_forever, daemon=True).start()
        yield hub
        hub.shutdown()


class _Handler(BaseHTTPRequestHandler):
    server: Hub
    protocol_version = "HTTP/1.1"

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def do_GET(self) -> None:
        self._answer(body=True)

    def _answer(self, body: bool) -> None:
        api, _, path = unquote(urlsplit(self.path).path).lstrip("/").partition("api/models/")
        name = "/".join((path or api).split("/")[:2])
        files = self.server.repositories.get(name)
        if files is None:
            self._send(404, b"{}", {"X-Error-Code": "RepoNotFound"}, body)
        elif not files:
            self._send(403, b"{}", {"X-Error-Code": "GatedRepo"}, body)
        elif path.startswith(f"{name}/revision/"):
            revision = path.removeprefix(f"{name}/revision/")
            if revision not in ("main", COMMIT):
                self._send(404, b"{}", {"X-Error-Code": "RevisionNotFound"}, body)
                return
            told = {"id": name, "sha": COMMIT, "siblings": [{"rfilename": f} for f in files]}
            self._send(200, json.dumps(told).encode(), {}, body)
        elif path.startswith(f"{name}/tree/"):
            entries = [
                {"type": "file", "path": f, "size": len(d or b""), "oid": _oid(d)}
                for f, d in files.items()
            ]
            self._send(200, json.dumps(entries).encode(), {}, body)
        else:
            revision, _, file = api.split("/resolve/", 1)[-1].partition("/")
            if file not in files:
                self._send(404, b"{}", {"X-Error-Code": "EntryNotFound"}, body)
                return
            if body:
                self.server.asked.append(file)
            # it has every commit, all alike
            commit = revision if len(revision) == len(COMMIT) else COMMIT
            self._send(
                200, files[file], {"ETag": f'"{_oid(files[file])}"', "X-Repo-Commit": commit}, body
            )

    def _send(
        self, status: int, data: bytes | None, headers: Mapping[str, str], body: bool
    ) -> None:
        self.send_response(status)
        for key, value in {"Content-Type": "application/json", **headers}.items():
            self.send_header(key, value)
        self.send_header("Content-Length", str(1000 if data is None else len(data)))
        self.end_headers()
        if body and data is None:
            self.wfile.write(b"half")
            self.close_connection = True
        elif body and data is not None:
            self.wfile.write(data)

    def log_message(self, *_: object) -> None:
        pass


def _oid(data: bytes | None) -> str:
    return hashlib.sha1(data or b"").hexdigest()
