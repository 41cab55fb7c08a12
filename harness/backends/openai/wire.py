"""How a server is asked: the path beside its base URL, what it is sent,
and how its answer is read.
"""

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, NamedTuple

from harness.backends.base import Completion, Request
from harness.backends.card import Card
from harness.backends.openai import shapes
from harness.backends.openai.http import COMPLETIONS, Reply
from harness.backends.openai.statements import Fact
from harness.backends.servers import Fields, Kind, Server
from harness.core.image import Image


class Wire(NamedTuple):
    """Describe one API of servers: the path, how a request is written, how a reply is read.

    `engine` is what a model card (a model's TOML file) names as engine for servers that speak it.
    `body(card, server, request, url)` makes the JSON of a request, where `url` turns a picture into
    a URL; `read(payload, request, kind)` makes the completion of a reply's JSON from a kind of
    server, and `remedy(reply)` says what to do about a fault. `decides` says that decision models
    are asked, which give options probabilities and write no text.
    """

    engine: str  # the engine whose servers speak it
    path: str  # behind a server's base URL
    # returns the JSON body of a request; the function that it is given returns a picture's URL
    body: Callable[[Card, Server, Request, Callable[[Image], str]], dict[str, Any]]
    read: Callable[[Any, Request, Kind], Completion]  # returns what a reply's JSON answers
    # what to do about a fault, after its words; empty if nobody knows
    remedy: Callable[[Reply], str]
    decides: bool  # whether decision models are asked, which write nothing and render no chat

    def misfit(self, states: Mapping[str, Fact]) -> str | None:
        """Return why this API does not suit a model; None if it does, or nothing is known.

        `states` has what the model's server states of it, by dotted names. A decision model, which
        only gives options probabilities, writes no text, and other models answer no typed
        questions.
        """
        outputs = str(
            states.get("architecture.output_modalities", states.get("output_modalities", ""))
        )
        if not outputs or ("decisions" in outputs) == self.decides:
            return None
        if self.decides:
            return 'writes text and decides nothing; give a card with engine = "openai"'
        return (
            "is a decision model, which writes nothing; give a card with "
            'engine = "systemone" or "decisions", and --answer decision'
        )


def _remedy(reply: Reply) -> str:
    """Return which key of a card changes a field that a reply names."""
    fault = reply.fault or ""
    if reply.status not in (400, 422):
        return ""
    if "top_logprobs" in fault:
        return "set top_logprobs under [server] in its card"
    named = [field.name for field in fields(Fields) if field.name in fault]
    return f"its card can leave {named[0]} out or rename it: fields under [server]" if named else ""


CHAT = Wire("openai", COMPLETIONS, shapes.body, shapes.read, _remedy, decides=False)
