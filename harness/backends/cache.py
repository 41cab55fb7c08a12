"""Completions kept between runs: a question that was answered is not asked again.

The cache is a help and nothing else. A run's rows hold its answers, and where the file gives trouble the run
goes on without it.
"""

import os
import sqlite3
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from harness import __version__
from harness.backends.base import Completion, Rendering, Request
from harness.backends.completion_file import CompletionFile
from harness.core.errors import printable
from harness.core.files import digest, sha256_bytes

T = TypeVar("T")

# Fields of a request that decide nothing of its answer. Every other field is in the key.
NOT_IN_KEY = {
    "id": "names the place in a run; the model never reads it",
    "messages": "in the rendered prompt, with what the chat template adds to them (some write the date)",
    "view": "no language model reads it",
    "truth": "no language model reads it",
    "scenario": "no language model reads it; its actions are a field of their own",
}
# The program's own part in an answer: how it is asked for and put into text.
_CODE = ("backends/**/*.py", "prompts/answer_schema.py", "prompts/readout.py", "core/rounding.py")


def default_file() -> Path:
    """`completions.sqlite` in `$SWARMDRIVE_CACHE`, else in the user's cache folder."""
    if moved := os.environ.get("SWARMDRIVE_CACHE"):
        return Path(moved) / "completions.sqlite"
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(caches) / "swarmdrive-harness" / "completions.sqlite"


def key(identity: Mapping[str, Any], prompt: str, request: Request) -> str:
    """Hex digest of all that decides an answer; no prompt and no secret can be read out of it.

    How many requests went through the engine together is left out: in float32 company changes no answer. In
    16 bits it may move one by rounding, with a cache or without; the identity holds the number format.
    """
    asked = {f.name: getattr(request, f.name) for f in fields(request) if f.name not in NOT_IN_KEY}
    return digest({"identity": identity, "prompt": prompt, "asked": asked, "code": _code_sha256()})


@cache
def _code_sha256() -> str:
    """So that a program that asks otherwise finds no old answers."""
    package = Path(__file__).parent.parent
    files = sorted(file for pattern in _CODE for file in package.glob(pattern))
    return digest([__version__, *(sha256_bytes(file.read_bytes()) for file in files)])


class Cached:
    """A backend whose answers are kept, but for errors. One that was kept has no seconds."""

    def __init__(self, backend: Rendering, file: Path) -> None:
        self._backend = backend
        self._identity = backend.identity()
        self._file: CompletionFile | None = CompletionFile(file)

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """One completion per request, in the same order; the backend is asked for those that are not kept."""
        prompts = self._backend.rendered(requests)
        keys = [key(self._identity, p, r) for p, r in zip(prompts, requests, strict=True)]
        kept = self._try(lambda file: file.find(keys)) or {}
        owed = [r for k, r in zip(keys, requests, strict=True) if k not in kept]
        asked = iter(self._backend.complete(owed) if owed else [])
        done = [
            replace(kept[k], request_id=r.id) if k in kept else next(asked)
            for k, r in zip(keys, requests, strict=True)
        ]
        good = {k: c for k, c in zip(keys, done, strict=True) if c.error is None and not c.cached}
        if good:
            self._try(lambda file: file.add(good))
        return done

    def identity(self) -> dict[str, Any]:
        """The backend's: what was kept was said by the same model."""
        return self._identity

    def _try(self, work: Callable[[CompletionFile], T]) -> T | None:
        """What some work on the file gives; None where the file gives trouble, now or before."""
        if self._file is None:
            return None
        try:
            return work(self._file)
        except (sqlite3.Error, OSError) as error:
            print(
                f"harness: completion cache {printable(self._file.path)}: {printable(error)}; "
                "this run goes on without it; delete the file, or set SWARMDRIVE_CACHE to another folder",
                file=sys.stderr,
            )
            self._file = None
            return None
