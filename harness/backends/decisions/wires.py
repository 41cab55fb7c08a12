"""The two ways to ask a server of decision models: System One's, and that of OpenAI's decisions.

`POST /v1/systemone` is llama.cpp's (tools/server/README.md), Ollama's from 0.35 on, and what the
server of sparrow-decider answers; `POST /v1/decisions` is OpenAI's (openai-python,
types/decision_create_params.py and types/decision.py). Whatever a server promises,
`harness.parsing.parse` judges the probabilities, which are kept as they are stated.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from harness.backends.base import Completion, Request, failed
from harness.backends.card import Card
from harness.backends.openai.backend import OpenAIBackend
from harness.backends.openai.http import Reply
from harness.backends.openai.shapes import tokens_in
from harness.backends.openai.wire import Wire
from harness.backends.servers import Kind, Server
from harness.core.at_once import AtOnce
from harness.core.image import Image
from harness.prompts.decision import Question

NAME = "action"  # of the one question of a request
Shares = Iterable[tuple[Any, Any]]  # each option with its probability, as stated


def asked_of(request: Request) -> Question:
    """Return the typed question of a request: a text, and options to give probabilities to.

    Raises ValueError if the request has none, as it does in other answer modes than `decision`.
    """
    if request.question is None:
        raise ValueError(f"request {request.id} asks no question; only --answer decision does")
    return request.question


def questions(request: Request) -> dict[str, Any]:
    """Return the JSON body of a request's question for the API System One, `POST /v1/systemone`.

    It has the question's text, and its options in the order of the actions.
    """
    question = asked_of(request)
    meant: Any = {action: question.meanings[action] for action in request.actions}
    if question.kind == "score":
        meant = [meaning or action for action, meaning in meant.items()]
    elif question.kind == "noul":  # a model has words of its own for what nobody describes
        meant = {action: meaning for action, meaning in meant.items() if meaning}
    criteria = {"criteria": meant} if meant else {}
    return {NAME: {"type": question.kind, "instructions": question.instructions, **criteria}}


def _systemone(
    card: Card, server: Server, request: Request, url: Callable[[Image], str]
) -> dict[str, Any]:
    body = {
        "model": card.weights,
        "state": asked_of(request).state,
        "questions": questions(request),
    }
    return {**body, "images": [url(request.image)]} if request.image else body


def _decisions(
    card: Card, server: Server, request: Request, url: Callable[[Image], str]
) -> dict[str, Any]:
    question = asked_of(request)
    content: Any = question.state
    if request.image:
        picture = {"type": "input_image", "image_url": url(request.image)}
        parts = [picture, {"type": "input_text", "text": question.state}]
        content = [{"role": "user", "content": parts}]
    meant = {action: question.meanings[action] for action in request.actions}
    entry: dict[str, Any] = {"name": NAME, "instructions": question.instructions}
    if question.kind == "choice":
        choices = [{"value": a, "description": m} if m else {"value": a} for a, m in meant.items()]
        entry |= {"type": "choice", "choices": choices}
    elif question.kind == "score":
        entry |= {"type": "score", "levels": [{"label": m or a} for a, m in meant.items()]}
    else:  # a predicate has no place for what its outcomes mean
        described = [f"{action}: {meaning}" for action, meaning in meant.items() if meaning]
        entry |= {
            "type": "predicate",
            "instructions": "\n".join([question.instructions, *described]),
        }
    return {"model": card.weights, "input": content, "questions": [entry]}


def read_systemone(payload: Any, request: Request, kind: Kind = "generic") -> Completion:
    """Return the completion in a reply of `POST /v1/systemone`, without its time.

    `payload` is the reply's decoded JSON, `request` the question that it answers; `kind`, the kind
    of server, is not used. A malformed reply gives a completion with an error.
    """
    try:
        shares = _shares(payload["answers"][NAME], "noul", lambda listed: listed.items())
    except (LookupError, TypeError, AttributeError):
        return failed(request, "the answer is no decision: it has no probabilities of the question")
    return _completion(payload, request, shares)


def read_decisions(payload: Any, request: Request, kind: Kind = "generic") -> Completion:
    """Return the completion in a reply of `POST /v1/decisions`, without its time.

    `payload` is the reply's decoded JSON, `request` the question that it answers; `kind`, the kind
    of server, is not used. A malformed reply gives a completion with an error.
    """
    try:
        [answer] = payload["answers"]
        shares = _shares(
            answer,
            "probability",
            lambda listed: [(each["value"], each["probability"]) for each in listed],
        )
    except (LookupError, TypeError, AttributeError, ValueError):
        return failed(request, "the answer is no decision: it has no probabilities of the question")
    return _completion(payload, request, shares)


def _shares(answer: Any, yes: str, pairs: Callable[[Any], Shares]) -> Shares | None:
    """Return each option with its probability; None where the question is refused.

    `yes` is where the probability of a yes stands, `pairs` reads the list of a choice or of levels.
    """
    if answer["type"] == "refusal":
        return None
    if answer["type"] in ("noul", "predicate"):
        return ("true", answer[yes]), ("false", 1 - answer[yes])
    return pairs(answer["probabilities"])


def _completion(payload: Mapping[str, Any], request: Request, shares: Shares | None) -> Completion:
    usage = payload.get("usage")
    usage = usage if isinstance(usage, dict) else {}
    read = tokens_in(usage.get("input_tokens")) or None  # some count none
    if shares is None:
        return Completion(request.id, "", read, 0, "refusal", None, 1)
    # Written out, so that the parser sees an option that stands there twice.
    members = ",".join(f"{json.dumps(str(option))}:{json.dumps(share)}" for option, share in shares)
    return Completion(
        request.id, f'{{"action_distribution":{{{members}}}}}', read, 0, "stop", None, 1
    )


def _remedy(reply: Reply) -> str:
    if reply.status == 501:
        return (
            "its model is no decision model, or takes no pictures: serve another one, or give a "
            "card with "
            'engine = "openai", whose model decides by letters'
        )
    if reply.status == 404:
        return 'a card has engine = "systemone" for /v1/systemone and "decisions" for /v1/decisions'
    if reply.status in (400, 422):
        return (
            "it does not take this question, such as so many options, or options that are no "
            "single token"
        )
    return ""


SYSTEMONE = Wire("systemone", "/systemone", _systemone, read_systemone, _remedy, decides=True)
DECISIONS = Wire("decisions", "/decisions", _decisions, read_decisions, _remedy, decides=True)


def open_systemone(card: Card, *, batch_size: AtOnce = 8, **_: Any) -> OpenAIBackend:
    """Return the backend of a decision model whose servers answer `POST /v1/systemone`.

    A decision model gives each option of a typed question a probability, and writes no text. `card`
    is its model card, the TOML file that describes it, which has the servers' addresses; each
    server gets at most `batch_size` requests at a time, or finds it with `auto`. Options for models
    in this process, such as `device`, are ignored. Raises UserError if the servers' models differ
    or are no decision models, Unanswered if none answers or one refuses the key.
    """
    return OpenAIBackend(card, batch_size, SYSTEMONE)


def open_decisions(card: Card, *, batch_size: AtOnce = 8, **_: Any) -> OpenAIBackend:
    """Return the backend of a decision model whose servers answer OpenAI's `POST /v1/decisions`.

    A decision model gives each option of a typed question a probability, and writes no text. `card`
    is its model card, the TOML file that describes it, which has the servers' addresses; each
    server gets at most `batch_size` requests at a time, or finds it with `auto`. Options for models
    in this process, such as `device`, are ignored. Raises UserError if the servers' models differ
    or are no decision models, Unanswered if none answers or one refuses the key.
    """
    return OpenAIBackend(card, batch_size, DECISIONS)
