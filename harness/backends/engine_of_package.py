"""The door to a package's engine:
it gets copies of requests, and what it answers is checked and copied.

So it answers what was asked, in the order that it was asked, with numbers that can be, and fails in
one line, a UserError.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from harness.backends.base import OF_LETTERS, Backend, Completion, Request, Served, forget
from harness.backends.token_counts import too_few
from harness.core.config import convert
from harness.core.errors import UserError, printable
from harness.core.plugins import line_or_none, texts
from harness.core.strangers import worded

if TYPE_CHECKING:
    from harness.backends.card import Card
    from harness.backends.registry import Capabilities
    from harness.runs.records import Latency

N = TypeVar("N", None, int)
SILENT = "the engine gives no reason"
MOST_REQUESTS = 100_000  # at once, or in one batch
UNSTATED = object()


class EngineOfPackage:
    """Guard the backend of an engine that another package adds: check and copy what it returns.

    That is its answers and what it states of itself. What is malformed becomes a one-line
    UserError. All other attributes are passed on to that backend.
    """

    def __init__(self, backend: Backend, card: "Card", can: "Capabilities") -> None:
        self._backend, self._what = backend, f"engine {printable(card.engine)}"
        self._delays_s = {0.0, card.slow_s}
        self._can = can

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        with worded(self._what):
            completions = list(self._backend.complete([_copy(request) for request in requests]))
            if len(completions) != len(requests):
                raise ValueError(f"it gives {len(completions)} answers to {len(requests)} requests")
            pairs = zip(requests, completions, strict=True)
            return [self._checked(request, completion) for request, completion in pairs]

    def _checked(self, request: Request, completion: Completion) -> Completion:
        """Return a plain copy. Raises UserError for a field that no completion can have."""
        if not isinstance(completion, Completion):
            raise TypeError(f"it gives a {type(completion).__name__} and no Completion")
        where = f"{self._what}, answer {printable(request.id)}"
        fields = {name: _plain(value) for name, value in vars(completion).items()}
        if fields.get("request_id") != request.id:
            raise UserError(
                f"{where}: request_id is {printable(repr(fields.get('request_id')))}; give answers "
                "in the order of the requests, each with its request's id"
            )
        if (fields.get("error") is not None) != (fields.get("finish_reason") == "error"):
            raise UserError(f"{where}: an error has finish_reason error, and nothing else has")
        completion = convert(fields, Completion, where)
        if completion.slow_s not in self._delays_s:
            raise UserError(
                f"{where}: slow_s is {completion.slow_s:g}, which its card does not declare"
            )
        for name in () if request.bare else OF_LETTERS:
            if getattr(completion, name) is not None:
                raise UserError(f"{where}: {name} is stated, which only a read-out has")
        counts = (completion.prompt_tokens, completion.completion_tokens)
        if few := too_few(request, self._can, completion.text, *counts):
            raise UserError(f"{where}: {few}, too few; count them all, or state None")
        return replace(completion, error=SILENT) if completion.error == "" else completion

    def identity(self) -> dict[str, Any]:
        with worded(self._what):
            identity = self._backend.identity()
            if not isinstance(identity, dict):
                raise TypeError(f"its identity is a {type(identity).__name__} and no dict")
            plain: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(identity))
            return plain

    @property
    def window(self) -> int:
        return self._number("window", 0)

    @property
    def batch_size(self) -> int | None:
        return self._number("batch_size", None)

    @property
    def doubt(self) -> str | None:
        with worded(self._what):
            return line_or_none(getattr(self._backend, "doubt", None), "a doubt")

    @property
    def several(self) -> Sequence[str]:
        with worded(self._what):
            return texts(getattr(self._backend, "several", ()), "several")

    def served(self) -> list[Served]:
        with worded(self._what):
            taken: Any = getattr(self._backend, "served", list)()
            return [convert(dict(vars(each)), Served, f"{self._what}, served") for each in taken]

    def rendered(self, requests: Sequence[Request]) -> list[str]:
        with worded(self._what):
            backend: Any = self._backend
            prompts = texts(backend.rendered([_copy(each) for each in requests]), "rendered")
            if len(prompts) != len(requests):
                raise ValueError(f"it renders {len(prompts)} of {len(requests)} requests")
            for prompt in prompts:
                prompt.encode()  # which no lone surrogate lets itself be
            return prompts

    def latency(self) -> "Latency":
        from harness.runs.records import Latency  # imported here because it is slow

        with worded(self._what):
            backend: Any = self._backend
            latency_json = msgspec.json.encode(backend.latency())
            return convert(msgspec.json.decode(latency_json), Latency, f"{self._what}, latency")

    def forget(self) -> None:
        with worded(self._what):
            forget(self._backend)

    def _number(self, name: str, unstated: N) -> int | N:
        """Return a number of requests that a backend states.
        Raises UserError for what is none.
        """
        with worded(self._what):
            number = getattr(self._backend, name, unstated)
            if number is unstated:
                return unstated
            if type(number) is not int or not 0 <= number <= MOST_REQUESTS:
                value = printable(repr(number))
                raise ValueError(f"{name} {value} is no number of requests, 0 to {MOST_REQUESTS}")
            return number

    def __getattr__(self, name: str) -> Any:
        with worded(self._what):
            attribute = getattr(self._backend, name, UNSTATED)
        if attribute is UNSTATED:
            raise AttributeError(name)
        return attribute


def _plain(value: object) -> object:
    """Return a text or number of a subclass, such as NumPy's, as one that files can hold."""
    if isinstance(value, str):
        return str.__str__(value)
    if isinstance(value, float):
        return float.__float__(value)
    return value


def _copy(request: Request) -> Request:
    return request.alike(messages=tuple(dict(message) for message in request.messages))
