"""The completion cache: keep completions between runs,
so that a model answers the same question only once.

What a server answered is kept under its address. A card may name several servers, whoever wrote it;
so an answer is taken only if the server that gave it is among those of today, or the user says in
the environment variable `SWARMDRIVE_SAME_SERVERS` that they serve the same.

The cache only saves time. A run's rows hold its answers, and if the file does not work,
the run continues without it.
"""

import json
import os
import sqlite3
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import fields, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, cast

import msgspec

from harness.backends.base import (
    Backend,
    Completion,
    Rendering,
    Request,
    Served,
    doubt,
    forget,
    keep_in,
    served,
    several,
    window,
)
from harness.backends.card import Card
from harness.backends.registry import ENGINES, capabilities
from harness.core import kept
from harness.core.config import LONGEST_S
from harness.core.errors import printable
from harness.core.files import digest

T = TypeVar("T")

# Fields of a request that do not affect its answer. Every other field is in the key.
NOT_IN_KEY = {
    "id": "names the place in a run; the model never reads it",
    "messages": "in the rendered prompt, with what the chat "
    "template adds to them (some write the date)",
    "question": "in the rendered prompt",
    "flips": "asked as a request of their own",
    "agent": "which model is asked; what it is, is in the identity",
    "timed": "how the answer is sent; whoever measures asks past the cache",
    "reasons_first": "how the answer is read; the prompt asks for it in words",
    "sums": "how the answer is read",
    "placeholders": "how the answer is read; they stand in the rendered prompt",
    "view": "no language model reads it",
    "truth": "no language model reads it",
    "scenario": "no language model reads it; its actions are a field of their own",
}
# Fields of a completion that describe one request's handling and not the answer.
_NOT_KEPT = (
    "request_id",
    "seconds",
    "first_token_s",
    "token_s",
    "error",
    "retries",
    "cached",
    "server",
)
_KEPT = tuple(f.name for f in fields(Completion) if f.name not in _NOT_KEPT)
_MOST = 10**9  # tokens of one answer, of any engine
_EXACT = ("float32", "F32")  # number formats in which a batch changes no answer
_WAIT_S = 30.0  # longest wait for another process that is writing
# Environment variable: addresses of servers that serve the same, with commas; * stands for any
# text.
SAME = "SWARMDRIVE_SAME_SERVERS"
_AT_ONCE = 500  # keys in one query; SQLite has a limit
_TABLE = (
    "CREATE TABLE IF NOT EXISTS completions (key TEXT PRIMARY KEY, answer TEXT NOT NULL) WITHOUT "
    "ROWID"
)
_HAS_CODE = "SELECT 1 FROM sqlite_master WHERE type IN ('view', 'trigger')"


def default_file() -> Path:
    """Return the SQLite file in which models' answers are kept between runs by default."""
    return kept.folder() / "completions.sqlite"


def key(
    identity: Mapping[str, Any], prompt: str, request: Request, batch_size: int | None = None
) -> str:
    """Return the hex digest under which a completion is cached; it reveals no prompt, no secret.

    It covers all that decides an answer.

    Args:
        identity: what `Backend.identity` returns.
        prompt: the text that the model reads.
        request: the question, with its answer mode and settings.
        batch_size: number of requests that are computed together, which moves answers by rounding
            if weights are quantised or have 16 bits; None for float32 weights, where it does not
            count.
    """
    request_fields = {
        f.name: getattr(request, f.name) for f in fields(request) if f.name not in NOT_IN_KEY
    }
    request_fields["image"] = request.image_sha256
    parts = {"identity": identity, "prompt": prompt, "asked": request_fields}
    return digest(parts if batch_size is None else {**parts, "batch_size": batch_size})


class CompletionFile:
    """Store completions in a SQLite file under keys, as the function `key` makes them.

    The file is opened for every call, so it may be deleted. Methods raise sqlite3.Error or OSError
    if it cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def find(self, keys: Sequence[str]) -> dict[str, Completion]:
        """Return those of the answers under `keys` that are stored, by key.

        The seconds that they took are unknown then, and their request id is empty.
        """
        rows: list[tuple[str, str]] = []
        with self._open() as file:
            for start in range(0, len(keys), _AT_ONCE):
                chunk = keys[start : start + _AT_ONCE]
                marks = ",".join("?" * len(chunk))
                rows += file.execute(
                    f"SELECT key, answer FROM completions WHERE key IN ({marks})", chunk
                )
        try:
            return {key: _completion(json.loads(answer)) for key, answer in rows}
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            raise sqlite3.DatabaseError(f"an answer is damaged: {error}") from None

    def add(self, completions: Mapping[str, Completion]) -> None:
        """Store answers by key, as the function `key` makes it.

        One that is stored already stays.
        """
        rows = []
        for place, completion in completions.items():
            answer = {name: getattr(completion, name) for name in _KEPT}
            # in ASCII: a completion may hold a lone surrogate, which cannot be written as UTF-8
            rows.append((place, json.dumps(answer)))
        with self._open() as file:
            file.execute("BEGIN IMMEDIATE")
            file.executemany("INSERT OR IGNORE INTO completions VALUES (?, ?)", rows)
            file.execute("COMMIT")

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        """Open the file, and make it if there is none."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with closing(sqlite3.connect(self.path, timeout=_WAIT_S, isolation_level=None)) as file:
            file.execute("PRAGMA journal_mode = WAL")
            file.execute("PRAGMA synchronous = NORMAL")
            file.execute(_TABLE)
            if file.execute(_HAS_CODE).fetchone():
                raise sqlite3.DatabaseError("it has a view or a trigger, which may never end")
            yield file


@lru_cache
def _say_once(line: str, identity: str) -> None:
    """Print a line about a model on stderr; a run has several caches of one model."""
    print(line, file=sys.stderr)


def _completion(kept: dict[str, Any]) -> Completion:
    """Return a stored completion. Raises ValueError or TypeError unless an engine can have given
    it.
    """
    done = msgspec.convert({**kept, "request_id": "", "seconds": None, "cached": True}, Completion)
    counts = (
        done.prompt_tokens,
        done.completion_tokens,
        done.batch_size,
        done.label_mass,
        done.letter_share,
    )
    has_only_kept_keys = kept.keys() <= set(_KEPT) and done.finish_reason != "error"
    counted = all(0 <= count <= _MOST for count in counts if count is not None)
    timed = 0 <= done.slow_s <= LONGEST_S
    if not (has_only_kept_keys and counted and timed):
        raise ValueError("no engine gives such a one")
    return done


def _sources(servers: Sequence[str]) -> tuple[dict[str, str], Sequence[str]]:
    """Return under what the answers of each of several servers are kept, by its address,
    and what is taken.

    That is the address; or, if the user says of all that they serve the same, the pattern that it
    fits. Then answers of all patterns of today are taken, and of no others: another day's said
    nothing of these servers.
    """
    patterns = [pattern.strip() for pattern in os.environ.get(SAME, "").split(",")]
    same: dict[str, str] = {}
    for server in servers:
        fitting = [pattern for pattern in patterns if fnmatchcase(server, pattern)]
        if not fitting:
            return {each: each for each in servers}, servers
        same[server] = f"same as {fitting[0]}"
    if not servers:
        return {}, servers
    return same, [f"same as {pattern}" for pattern in patterns]


def cached(backend: Backend, card: Card, file: Path | None) -> Backend:
    """Return a backend that looks for an answer in the file `file` before it asks `backend`.

    The file keeps answers between runs. `card` is the backend's model card, the TOML file that
    describes a model. `backend` itself is returned if `file` is None, or if its engine cannot show
    its prompts, by which answers are found.
    """
    if file is None:
        return backend
    keep_in(backend, file)
    if not capabilities(card.engine).renders:
        return backend
    engine = card.engine
    of_package = "" if ENGINES.is_ours(engine) else ENGINES.of_package(engine)
    return Cached(cast("Rendering", backend), file, of_package)


class Cached:
    """Answer requests from a cache, and ask another backend for what is not in it.

    Errors are not cached. A cached answer has no seconds.
    """

    def __init__(self, backend: Rendering, file: Path, of_package: str = "") -> None:
        self.backend = backend
        self._identity = backend.identity()
        identity: Mapping[str, Any] = self._identity
        if of_package:  # another engine may state the same of itself
            identity = {"engine": of_package, "identity": self._identity}
        exact = self._identity.get("dtype") in _EXACT
        self._batch_size: int | None = None if exact else getattr(backend, "batch_size", None)
        self._file: CompletionFile | None = CompletionFile(file)
        self.window = window(backend)
        self._doubt = doubt(backend)
        self._sources, taken = _sources(several(backend))
        # What an answer is kept under, by its source; None where the identity says who answers
        self._identities: dict[str | None, Mapping[str, Any]] = {None: identity}
        if self._sources:
            self._identities = {source: {**identity, "source": source} for source in taken}

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        prompts = self.backend.rendered(requests)
        keys = [self._keys(prompt, r) for prompt, r in zip(prompts, requests, strict=True)]
        every = [key for by_source in keys for key in by_source.values()]
        kept_completions = self._try(lambda file: file.find(every)) or {}
        if kept_completions and self._doubt:
            _say_once(f"harness: {self._doubt}", digest(self._identity))
        stored: list[Completion | None] = []
        for by_source in keys:
            matches = [
                kept_completions[key] for key in by_source.values() if key in kept_completions
            ]
            stored.append(matches[0] if matches else None)
        missing = [r for r, match in zip(requests, stored, strict=True) if match is None]
        answers = iter(self.backend.complete(missing) if missing else [])
        completions, new = list[Completion](), dict[str, Completion]()
        for request, by_source, match in zip(requests, keys, stored, strict=True):
            completion = next(answers) if match is None else replace(match, request_id=request.id)
            completions.append(completion)
            source = self._sources.get(completion.server or "")
            if source in by_source and completion.error is None and not completion.cached:
                new[by_source[source]] = completion
        if new:
            self._try(lambda file: file.add(new))
        return completions

    def _keys(self, prompt: str, request: Request) -> dict[str | None, str]:
        """Return where an answer to a request lies, by its source."""
        return {
            source: key(identity, prompt, request, self._batch_size)
            for source, identity in self._identities.items()
        }

    def identity(self) -> dict[str, Any]:
        return self._identity

    def forget(self) -> None:
        forget(self.backend)

    def served(self) -> list[Served]:
        return served(self.backend)

    def _try(self, work: Callable[[CompletionFile], T]) -> T | None:
        """Return the result of some work on the file; None once the file has failed."""
        if self._file is None:
            return None
        try:
            return work(self._file)
        except (sqlite3.Error, OSError) as error:
            print(
                f"harness: completion cache {printable(self._file.path)}: {printable(error)}; "
                "this run continues without it; delete the file, or set SWARMDRIVE_CACHE to "
                "another folder",
                file=sys.stderr,
            )
            self._file = None
            return None
