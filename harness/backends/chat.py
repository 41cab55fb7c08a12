"""A model's chat template and tokenizer:
render messages to the prompt that it reads, and encode that.
"""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from typing import Any, Protocol

from harness.backends.card import Thinking
from harness.backends.chat_template import (
    FIRST_USER,
    ChatTemplate,
    Refused,
    lost_message,
    with_system,
)
from harness.core.errors import UserError, printable
from harness.prompts.readout import spelt

_LONGEST = 8  # characters of a letter's longest token: `<0x41>`, or a letter with blanks

_MARK = re.compile(r"<[^<>\s]+>|\[/?[A-Z_]+\]")  # a token that stands for no text, by its looks
_ANSWER = "Keep 7 m/s."
_TURN = ({"role": "user", "content": "?"}, {"role": "assistant", "content": _ANSWER})


class Tokenizer(Protocol):
    """Describe a model's tokenizer that has a chat template.

    `template` is the template's Jinja text, and `specials` the texts of special tokens by their
    name there. `bos` is the id of the token that begins a sequence, None if there is none, and
    `vocabulary` the number of tokens.
    """

    template: str  # the template's Jinja text
    # texts of special tokens by their name in a template, such as `bos_token`
    specials: Mapping[str, str]
    bos: int | None  # id of the token that begins a sequence; None if there is none
    vocabulary: int  # number of tokens

    def encode(self, text: str) -> list[int]:
        """Return the token ids of a rendered prompt; no BOS is added to what the template wrote."""
        ...

    def decode(self, ids: Sequence[int]) -> str:
        """Return the text of token ids, without special tokens (of which `<think>` is none)."""
        ...

    def pieces(self, ids: Sequence[int]) -> list[str]:
        """Return each token's own text, of special ones too; incomplete bytes become U+FFFD."""
        ...

    def candidates(self, letters: str) -> Sequence[int]:
        """Return ids of all tokens whose text may be one of these letters, and perhaps others.

        They are then looked at one by one.
        """
        ...


class HubTokenizer:
    """Wrap a tokenizer of the package transformers, to be used as a `Tokenizer` here.

    It turns texts into token ids and back, and has the model's chat template.
    """

    def __init__(self, hub: Any) -> None:
        self.hub = hub
        self.template = str(hub.get_chat_template())
        self.specials: Mapping[str, str] = hub.special_tokens_map
        self.bos: int | None = hub.bos_token_id
        self.vocabulary = len(hub)

    def encode(self, text: str) -> list[int]:
        ids: list[int] = self.hub(text, add_special_tokens=False)["input_ids"]
        return ids

    def decode(self, ids: Sequence[int]) -> str:
        return self._text(ids, skip_special_tokens=True)

    def pieces(self, ids: Sequence[int]) -> list[str]:
        return [self._text([i], skip_special_tokens=False) for i in ids]

    def candidates(self, letters: str) -> Sequence[int]:
        short = [(text, i) for text, i in self.hub.get_vocab().items() if len(text) <= _LONGEST]
        wanted = set(letters)
        return [i for text, i in short if text.startswith("<0x") or not wanted.isdisjoint(text)]

    def _text(self, ids: Sequence[int], skip_special_tokens: bool) -> str:
        options = {
            "skip_special_tokens": skip_special_tokens,
            "clean_up_tokenization_spaces": False,
        }
        text: str = self.hub.decode(ids, **options)
        return text


class Chat:
    """Render messages to prompts by a model's chat template, and encode these by its tokenizer.

    The template writes `image_token` for a picture; None if the model takes none. `system` says
    where the system text stands: at the beginning of the first user turn (`first-user`), or in a
    message of its own (None).
    """

    def __init__(
        self,
        name: str,
        tokenizer: Tokenizer,
        image_token: str | None = None,
        system: str | None = None,
    ) -> None:
        self.name = name
        self.tokenizer = tokenizer
        self.image_token = image_token
        self.system = system
        self.template = tokenizer.template
        self.bos = tokenizer.bos
        self.vocabulary = tokenizer.vocabulary
        self.encode, self.decode, self.pieces = tokenizer.encode, tokenizer.decode, tokenizer.pieces
        self._compiled = ChatTemplate(name, self.template)

    @property
    def subject(self) -> str:
        return f"model {printable(self.name)!r}"

    @property
    def _switch(self) -> bool:
        return "enable_thinking" in self.template

    @property
    def thinking(self) -> Thinking:
        """Return how the template opens thoughts: `always`, `none`, or if a `switch` is on.

        The switch is a variable of the template, which is set for each prompt.
        """
        if self._switch:
            return "switch"
        prompt = self.render(({"role": "user", "content": "?"},), thinking=False)
        return "always" if prompt.rstrip().endswith("<think>") else "none"

    @cached_property
    def turn_end(self) -> int | None:
        """Return the id of the token that ends an answer in the chat template; None without one."""
        with suppress(UserError):
            text = self._apply(
                self._template_messages(_TURN), thinking=False, add_generation_prompt=False
            )
            _, answer, rest = text.rpartition(_ANSWER)
            tokens = self.encode(rest.lstrip()) if answer else []
            # A mark that is a token of its own stands for no text, or is at least written like one.
            if tokens and (
                not self.decode(tokens[:1]) or _MARK.fullmatch(self.pieces(tokens[:1])[0])
            ):
                return tokens[0]
        return None

    @property
    def ends(self) -> tuple[int, ...]:
        return () if self.turn_end is None else (self.turn_end,)

    def render(self, messages: Sequence[Mapping[str, str]], *, thinking: bool) -> str:
        """Return the prompt of chat messages, as the model reads it up to its answer.

        `messages` are dicts with `role` and `content`; `thinking` says whether the model is asked
        to think first. A picture stands in the text as `image_token`. Raises UserError if the
        template refuses the messages, or leaves out a text of them.
        """
        template_messages = self._template_messages(with_system(messages, self.system))
        try:
            prompt = self._apply(template_messages, thinking=thinking)
        except Refused as error:
            raise UserError(f"{error}; {self._way_out(messages, thinking)}") from None
        if (lacking := lost_message(template_messages, prompt)) is not None:
            turn = next(n for n, message in enumerate(template_messages, 1) if message is lacking)
            raise UserError(
                f"{self.subject}: its chat template leaves out or changes the text of message "
                f"{turn} of {len(template_messages)}, the {printable(lacking['role'])}'s, or moves "
                f"it; the model would not read what it is asked; "
                f"{self._way_out(messages, thinking)}"
            )
        return prompt

    def _way_out(self, messages: Sequence[Mapping[str, str]], thinking: bool) -> str:
        """Return what helps where a template has no place for one of the messages."""
        joined = self._template_messages(with_system(messages, FIRST_USER))
        if len(joined) < len(messages) and not self.system:
            with suppress(UserError):
                if lost_message(joined, self._apply(joined, thinking=thinking)) is None:
                    return (
                        f'a card with system = "{FIRST_USER}" puts the system text into the first '
                        "user turn"
                    )
        return "use a prompt with roles that it knows, or a model with another template"

    def _template_messages(self, messages: Sequence[Mapping[str, str]]) -> list[dict[str, Any]]:
        """Convert messages for the template.
        A picture's token written inside a text is broken up.
        """
        token = self.image_token
        if token is None:
            return [dict(message) for message in messages]
        texts = [
            {**m, "content": m["content"].replace(token, f"{token[0]} {token[1:]}")}
            for m in messages
        ]
        return in_parts(texts, {"type": "image"})

    def _apply(self, messages: list[dict[str, Any]], *, thinking: bool, **values: Any) -> str:
        switch = {"enable_thinking": thinking} if self._switch else {}
        return self._compiled.render(messages, **self.tokenizer.specials, **switch, **values)

    def spellings(self, letters: str) -> dict[str, list[int]]:
        """Return, by letter, the ids of all tokens that stand for that letter.

        `letters` is a text such as `ABC`. Such a token is the letter alone, with blanks around it,
        or as a byte.
        """
        tokens: dict[str, list[int]] = {letter: [] for letter in letters}
        candidates = self.tokenizer.candidates(letters)
        for token, piece in zip(candidates, self.pieces(candidates), strict=True):
            if (letter := spelt(piece)) in tokens:
                tokens[letter].append(token)
        return tokens


def in_parts(
    messages: Sequence[Mapping[str, str]], picture: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Return chat messages whose contents are lists of parts, as models with vision take them.

    `messages` are dicts with `role` and `content`. One with the key `image` gets `picture`, the
    part that stands for it, before its text.
    """
    return [
        {
            "role": m["role"],
            "content": [picture] * ("image" in m) + [{"type": "text", "text": m["content"]}],
        }
        for m in messages
    ]
