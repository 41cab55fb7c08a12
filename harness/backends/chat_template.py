"""A chat template, which makes a model's prompt of messages.
It comes with weights, so from strangers.
"""

import json
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any, Literal

from jinja2 import TemplateError, nodes
from jinja2.ext import Extension
from jinja2.parser import Parser

from harness.core.errors import UserError, printable
from harness.core.templates import Sandbox, TooMuch

Messages = Sequence[Mapping[str, Any]]
# A card's `system`: the system text begins the first user turn.
FIRST_USER: Literal["first-user"] = "first-user"
_THOUGHT_ENDS = "</think>"
_REMEDY = "give another model, or mend the template"
_LONGEST_FORM = 100  # characters of a form of dates


class Refused(UserError):
    """Report that a model's chat template raises an error on some messages.

    Such is a system message where the template allows none.
    """


class ChatTemplate:
    """Render messages to a model's prompt by its chat template, compiled in a sandbox.

    A chat template is Jinja text that comes with the model's weights. What it writes is what the
    package transformers would write.
    """

    def __init__(self, name: str, text: str) -> None:
        """Compile the template of model `name`. Raises UserError if it is no Jinja, or too long."""
        self._shown = f"model {printable(name)!r}: its chat template"
        try:
            self._compiled = _environment().from_string(text)
        except TemplateError as error:
            raise UserError(f"{self._shown} is no Jinja ({printable(error)}); {_REMEDY}") from None

    def render(self, messages: Messages, **values: Any) -> str:
        """Return the prompt of some chat messages, dicts with `role` and `content`.

        `values` are further variables of the template by name, such as `enable_thinking`. Raises
        Refused if the template refuses the messages, and UserError if rendering takes too much time
        or memory.
        """
        given = {"tools": None, "documents": None, "add_generation_prompt": True, **values}
        try:
            return self._compiled.render(messages=messages, **given)
        except TooMuch as error:
            raise UserError(
                f"{self._shown} takes {printable(error)} to render; {_REMEDY}"
            ) from None
        except Exception as error:  # a template is a program and may fail in any way
            raise Refused(f"{self._shown} refuses the messages ({printable(error)})") from None


def with_system(messages: Messages, way: str | None) -> tuple[Mapping[str, Any], ...]:
    """Return chat messages with the system text where a model's template takes it.

    `way` is what the model's TOML file states as `system`: `first-user` puts it at the beginning of
    the first user message, None leaves it in a message of its own.
    """
    if way != FIRST_USER or len(messages) < 2 or messages[0]["role"] != "system":
        return tuple(messages)
    system, first, *rest = messages
    return ({**first, "content": f"{system['content']}\n\n{first['content']}"}, *rest)


def lost_message(messages: Messages, prompt: str) -> Mapping[str, Any] | None:
    """Return the first of a chat's messages whose text is missing in the rendered prompt.

    Messages are dicts with `role` and `content`. None if the prompt has all of them, in their turn.
    White space around a text does not matter, and thoughts of earlier turns may be left out.
    """
    at = 0
    for message in messages:
        text = _text(message["content"]).strip()
        place = prompt.find(text, at)
        if place < 0 and message["role"] == "assistant":
            text = text.rpartition(_THOUGHT_ENDS)[2].strip()
            place = prompt.find(text, at)
        if place < 0:
            return message
        at = place + len(text)
    return None


def needs_first_user(text: str) -> bool:
    """Return whether a chat template refuses a system message, but takes its text in the user's.

    `text` is the template's Jinja text.
    """
    messages = (
        {"role": "system", "content": "Be brief."},
        {"role": "user", "content": "Where to?"},
    )
    empty = {"bos_token": "", "eos_token": ""}
    try:
        template = ChatTemplate("", text)
        joined = with_system(messages, FIRST_USER)
        takes = lost_message(joined, template.render(joined, **empty)) is None
    except UserError:
        return False
    try:
        template.render(messages, **empty)
    except UserError:
        return takes
    return False


def _text(content: Any) -> str:
    """Return the text of a message's content, which may be a list of parts."""
    return (
        content if isinstance(content, str) else "".join(part.get("text", "") for part in content)
    )


class _Generation(Extension):
    """The tag `{% generation %}`, which marks a model's turns for training;
    its content is rendered.
    """

    tags = {"generation"}  # noqa: RUF012 jinja2 declares it so

    def parse(self, parser: Parser) -> list[nodes.Node]:
        next(parser.stream)
        return parser.parse_statements(("name:endgeneration",), drop_needle=True)


def _environment() -> Sandbox:
    """Build the Jinja environment with the names that templates on the hub expect."""

    def raise_exception(message: str) -> None:
        raise TemplateError(message)

    def strftime_now(form: str) -> str:
        if len(form) > _LONGEST_FORM:
            raise TooMuch(f"a date of {len(form)} characters")
        return datetime.now().strftime(form)

    built = Sandbox(
        trim_blocks=True, lstrip_blocks=True, extensions=[_Generation, "jinja2.ext.loopcontrols"]
    )
    built.add_filter("tojson", _tojson)
    built.globals |= {"raise_exception": raise_exception, "strftime_now": strftime_now}
    return built


def _tojson(value: Any, **options: Any) -> str:  # Jinja's own filter escapes for HTML
    return json.dumps(value, **{"ensure_ascii": False, **options})
