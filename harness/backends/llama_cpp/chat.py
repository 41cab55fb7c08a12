"""The chat template of a GGUF file, rendered as transformers does, with llama.cpp's own tokenizer."""

import json
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any, Protocol

from jinja2 import TemplateError, nodes
from jinja2.ext import Extension
from jinja2.parser import Parser
from jinja2.sandbox import ImmutableSandboxedEnvironment

from harness.backends.chat import Chat
from harness.core.errors import UserError, printable


class Vocabulary(Protocol):
    """The tokenizer of a GGUF file; `harness.backends.llama_cpp.model.LlamaModel` is one."""

    template: str
    specials: dict[str, str]
    bos: int | None
    vocabulary: int

    def encode(self, text: str) -> list[int]: ...
    def decode(self, ids: Sequence[int]) -> str: ...
    def pieces(self, ids: Sequence[int]) -> list[str]: ...


class GgufChat(Chat):
    """A GGUF file's tokenizer and chat template."""

    def __init__(self, name: str, vocabulary: Vocabulary, image_token: str | None = None) -> None:
        self.name = name
        self.image_token = image_token
        self.template = vocabulary.template
        self._vocabulary = vocabulary
        try:
            self._compiled = _environment().from_string(self.template)
        except TemplateError as error:
            raise UserError(
                f"model {name!r}: its chat template is no Jinja ({printable(error)}); give another GGUF file"
            ) from None

    @property
    def bos(self) -> int | None:
        return self._vocabulary.bos

    def encode(self, prompt: str) -> list[int]:
        return self._vocabulary.encode(prompt)

    def decode(self, ids: Sequence[int]) -> str:
        return self._vocabulary.decode(ids)

    def pieces(self, ids: Sequence[int]) -> list[str]:
        return self._vocabulary.pieces(ids)

    def _candidates(self, letters: str) -> Sequence[int]:
        return range(self._vocabulary.vocabulary)

    def _apply(self, messages: list[dict[str, str]], switch: Mapping[str, bool]) -> str:
        return self._compiled.render(
            messages=messages,
            tools=None,
            documents=None,
            add_generation_prompt=True,
            **self._vocabulary.specials,
            **switch,
        )


class _Generation(Extension):
    """The tag `{% generation %}`, which marks a model's turns for training; its content is rendered."""

    tags = {"generation"}  # noqa: RUF012 jinja2 declares it so

    def parse(self, parser: Parser) -> list[nodes.Node]:
        """Return the content of the block."""
        next(parser.stream)
        return parser.parse_statements(("name:endgeneration",), drop_needle=True)


def _environment() -> ImmutableSandboxedEnvironment:
    """Build the Jinja environment with the names that templates on the hub expect."""

    def raise_exception(message: str) -> None:
        raise TemplateError(message)

    def tojson(value: Any, **options: Any) -> str:  # Jinja's own filter escapes for HTML
        return json.dumps(value, **{"ensure_ascii": False, **options})

    built = ImmutableSandboxedEnvironment(
        trim_blocks=True, lstrip_blocks=True, extensions=[_Generation, "jinja2.ext.loopcontrols"]
    )
    built.filters["tojson"] = tojson
    built.globals["raise_exception"] = raise_exception
    built.globals["strftime_now"] = lambda form: datetime.now().strftime(form)
    return built
