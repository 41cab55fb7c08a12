"""The application of `harness serve`: a model's decisions by two wire shapes, and nothing else.

A request names no file, address or code: its texts are data of a question, and its pictures come
with it. Who may ask is decided before its body is read; browsers' pages of other sites may not,
since they cannot send JSON without leave, and names other than this machine's are refused (DNS
rebinding) where only it is served.
"""

import asyncio
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from secrets import compare_digest
from typing import Any
from urllib.parse import urlsplit

import msgspec
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from harness.backends import base
from harness.core import web
from harness.core.errors import Unanswered, UserError, one_line, printable
from harness.extensions.decide import decisions, systemone
from harness.extensions.decide.acts import Acts
from harness.extensions.decide.asked import Answered, Enquiry, Refusal, answered
from harness.extensions.decide.desk import AGAIN_S, PLACES, Desk
from harness.extensions.decide.model import ServedModel

MOST_BYTES = 2**20  # of a request
MOST_SEEN_BYTES = 5 * 2**20  # of one with a picture
MOST_PASSED_BYTES = 64 * 2**20  # of one that is read to its end, so that its sender hears of it
BODY_S = 30.0  # within which a request must have come
ANSWER_S = 120.0  # within which it is answered; a client's usual patience
CONNECTIONS = 128  # open at the same time
# statuses of requests whose body was not read, or not to its end
UNREAD = (401, 403, 404, 405, 408, 413)
_OVERFLOW = "context overflow"


@dataclass(frozen=True)
class Shape:
    """Describe one HTTP API for decisions: the path of its POST request, and its JSON.

    `body` is the msgspec type that a request's JSON is decoded to. `read` makes the questions of a
    decoded body, and may raise Refusal; `write` makes the response, as values for JSON, of the
    served model's name and the answers in the order of these questions.
    """

    path: str  # path of the POST request
    body: type[Any]  # msgspec type of the request's JSON
    read: Callable[[Any], Enquiry]  # from the body to questions
    # from model name and answers to JSON
    write: Callable[[str, Sequence[Answered]], dict[str, Any]]


SHAPES = (
    Shape("/v1/systemone", systemone.Body, systemone.read, systemone.write),
    Shape("/v1/decisions", decisions.Body, decisions.read, decisions.write),
)


class Service:
    """Answer HTTP requests for decisions of one model; `app` returns its web application.

    A decision is a question with listed options, of which the model gives each a probability.
    Requests that come together are answered together.
    """

    def __init__(
        self,
        model: ServedModel,
        batch_size: int = 1,
        token: str | None = None,
        local: bool = True,
        acts: Acts | None = None,
        places: int = PLACES,
        answer_s: float = ANSWER_S,
    ) -> None:
        """Start the queue to the model.

        Args:
            model: the model that answers.
            batch_size: most questions that the model is asked together.
            token: the API key that clients must give; None asks for none.
            local: whether only this machine is served.
            acts: says how to act on answers under a condition; None without one.
            places: most questions that may wait.
            answer_s: seconds within which a request must be answered.
        """
        self._model, self._token, self._local, self._answer_s = model, token, local, answer_s
        self._acts = acts
        self._desk = Desk(model.backend, batch_size, places)

    def app(self) -> Starlette:
        """Return the Starlette application: POST at each path of `SHAPES`, and GET `/v1/models`."""
        routes = [Route("/v1/models", self._models, methods=["GET"])]
        routes += [Route(shape.path, self._answerer(shape), methods=["POST"]) for shape in SHAPES]
        handlers: Any = {HTTPException: self._missing, Exception: self._bug}
        return Starlette(routes=routes, exception_handlers=handlers)

    async def _models(self, request: Request) -> Response:
        try:
            self._admit(request)
        except Refusal as refusal:
            return _refused(refusal)
        return JSONResponse({"object": "list", "data": [self._model.listed()]})

    def _answerer(self, shape: Shape) -> Callable[[Request], Any]:
        async def answer(request: Request) -> Response:
            try:
                self._admit(request)
                return JSONResponse(await self._answer(shape, await self._body(request)))
            except Refusal as refusal:
                return _refused(refusal)

        return answer

    def _admit(self, request: Request) -> None:
        """Raise Refusal unless who asks may."""
        headers = request.headers
        if self._local:
            try:
                host = urlsplit(f"//{headers.get('host', '')}").hostname
            except ValueError:
                host = None
            if host not in web.NAMES:
                raise Refusal(
                    "this machine is called 127.0.0.1 or localhost here", 403, "forbidden"
                )
        if "origin" in headers:
            raise Refusal("pages of other sites are not served", 403, "forbidden")
        if self._token is not None:
            kind, _, given = headers.get("authorization", "").partition(" ")
            if kind.lower() != "bearer" or not compare_digest(
                given.strip().encode(), self._token.encode()
            ):
                raise Refusal("give the server's token as the API key", 401, "invalid_api_key")

    async def _body(self, request: Request) -> bytes:
        kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
        if (
            kind != "application/json"
            or request.headers.get("content-encoding", "identity") != "identity"
        ):
            raise Refusal(
                "a request is JSON, as application/json and not compressed", code="content_type"
            )
        most = MOST_SEEN_BYTES if self._model.sees else MOST_BYTES
        data, length = bytearray(), 0
        try:
            async with asyncio.timeout(BODY_S):
                async for chunk in request.stream():
                    length += len(chunk)
                    if length > MOST_PASSED_BYTES:
                        break
                    data += chunk if length <= most else b""
        except TimeoutError:
            raise Refusal(f"the request did not come within {BODY_S:g} s", 408, "timeout") from None
        except ClientDisconnect:
            raise Refusal("the client is gone", 400, "gone") from None
        if length > most:
            raise Refusal(f"the request has more than {most} bytes", 413, "too_large")
        return bytes(data)

    async def _answer(self, shape: Shape, body: bytes) -> dict[str, Any]:
        enquiry, requests = await run_in_threadpool(self._read, shape, body)
        try:
            async with asyncio.timeout(self._answer_s):
                completions = await self._desk.ask(requests)
        except TimeoutError:
            raise Refusal(f"no answer within {self._answer_s:g} s", 503, "timeout") from None
        except Unanswered as error:
            raise Refusal(one_line(error), 503, "no_answer") from None
        except UserError as error:  # such as a chat template that refuses the texts
            raise Refusal(one_line(error)) from None
        for completion in completions:
            _raise(completion)
        pairs = zip(enquiry.questions, completions, strict=True)
        answers = [answered(*pair) for pair in pairs]
        if self._acts:
            answers = [self._acts.of(answer) for answer in answers]
        return shape.write(self._model.name, answers)

    def _read(self, shape: Shape, body: bytes) -> tuple[Enquiry, list[base.Request]]:
        try:
            enquiry = shape.read(msgspec.json.decode(body, type=shape.body))
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise Refusal(f"not what POST {shape.path} takes: {one_line(error)}") from None
        return enquiry, self._model.requests(enquiry)

    def _missing(self, request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        paths = ", ".join(["GET /v1/models", *(f"POST {shape.path}" for shape in SHAPES)])
        where = printable(f"{request.method} {request.url.path}")
        return _refused(
            Refusal(f"nothing answers {where}; there is {paths}", error.status_code, "not_found")
        )

    def _bug(self, request: Request, error: Exception) -> Response:
        traceback.print_exception(error)
        return _refused(Refusal("the server failed; its terminal says why", 500, "bug"))


def _raise(completion: base.Completion) -> None:
    """Raise Refusal if a question got no answer, with the engine's words."""
    if completion.error is None:
        return
    words = printable(completion.error, 300)
    if completion.error.startswith(_OVERFLOW):
        raise Refusal(words, code="context_length_exceeded")
    raise Refusal(f"the model gave no answer: {words}", 502, "no_answer")


def _refused(refusal: Refusal) -> Response:
    """Return an error as OpenAI writes one."""
    kind = {429: "rate_limit_error"}.get(
        refusal.status, "server_error" if refusal.status >= 500 else "invalid_request_error"
    )
    error = {"message": refusal.words, "type": kind, "param": None, "code": refusal.code}
    headers = {"retry-after": str(AGAIN_S)} if refusal.status in (429, 503) else {}
    if refusal.status in UNREAD:
        headers["connection"] = "close"  # what is left of it is not read
    return JSONResponse({"error": error}, refusal.status, headers)
