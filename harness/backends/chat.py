"""A model's chat template and tokenizer: render messages to the prompt that it reads, and encode that."""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from typing import Any

from harness.backends.card import Thinking
from harness.backends.chat_template import FIRST_USER, ChatTemplate, Refused, unsaid, with_system
from harness.core.errors import UserError, printable
from harness.prompts.readout import spelt

_LONGEST = 8  # characters of a letter's longest token: `<0x41>`, or a letter with blanks

_MARK = re.compile(r"<[^<>\s]+>|\[/?[A-Z_]+\]")  # a token that stands for no text, by its looks
_ANSWER = "Keep 7 m/s."
_TURN = ({"role": "user", "content": "?"}, {"role": "assistant", "content": _ANSWER})


class Chat:
    """A tokenizer with its chat template.

    Attributes:
        name: name of the model.
        template: the template's Jinja text.
        image_token: token that the template writes for a picture; None if the model takes none.
        system: where the system text stands: `first-user`, or None for a message of its own.
    """

    image_token: str | None = None
    system: str | None = None

    def __init__(
        self, name: str, tokenizer: Any, image_token: str | None = None, system: str | None = None
    ) -> None:
        self.tokenizer = tokenizer
        self._begin(name, str(tokenizer.get_chat_template()), image_token, system)

    def _begin(self, name: str, template: str, image_token: str | None, system: str | None) -> None:
        self.name, self.template = name, template
        self.image_token, self.system = image_token, system
        self._compiled = ChatTemplate(name, template)

    @property
    def specials(self) -> Mapping[str, Any]:
        """Texts of special tokens by their name in a chat template, such as `bos_token`."""
        specials: Mapping[str, Any] = self.tokenizer.special_tokens_map
        return specials

    @property
    def bos(self) -> int | None:
        """Id of the token that begins a sequence; None if there is none."""
        token: int | None = self.tokenizer.bos_token_id
        return token

    @property
    def _switch(self) -> bool:
        return "enable_thinking" in self.template

    @property
    def thinking(self) -> Thinking:
        """What the template can do: `switch`, `none`, or `always` if its prompt always opens a thought."""
        if self._switch:
            return "switch"
        prompt = self.render(({"role": "user", "content": "?"},), thinking=False)
        return "always" if prompt.rstrip().endswith("<think>") else "none"

    @cached_property
    def turn_end(self) -> int | None:
        """Id of the token that the template writes after an answer; None if it writes no such token."""
        with suppress(UserError):
            text = self._apply(self._shown(_TURN), thinking=False, add_generation_prompt=False)
            _, said, rest = text.rpartition(_ANSWER)
            tokens = self.encode(rest.lstrip()) if said else []
            # A mark that is a token of its own stands for no text, or is at least written like one.
            if tokens and (not self.decode(tokens[:1]) or _MARK.fullmatch(self.pieces(tokens[:1])[0])):
                return tokens[0]
        return None

    @property
    def ends(self) -> tuple[int, ...]:
        """Ids of the tokens that end a turn by the template: one at most."""
        return () if self.turn_end is None else (self.turn_end,)

    def render(self, messages: Sequence[Mapping[str, str]], *, thinking: bool) -> str:
        """Render messages to the prompt that the model reads, with `image_token` for a picture.

        Raises:
            UserError: the template refuses the messages, or leaves out a text of them.
        """
        shown = self._shown(with_system(messages, self.system))
        try:
            prompt = self._apply(shown, thinking=thinking)
        except Refused as error:
            raise UserError(f"{error}; {self._way_out(messages, thinking)}") from None
        if (lacking := unsaid(shown, prompt)) is not None:
            turn = next(n for n, message in enumerate(shown, 1) if message is lacking)
            raise UserError(
                f"model {printable(self.name)!r}: its chat template leaves out or changes the text of "
                f"message {turn} of {len(shown)}, the {printable(lacking['role'])}'s, or moves it; the model "
                f"would not read what it is asked; {self._way_out(messages, thinking)}"
            )
        return prompt

    def _way_out(self, messages: Sequence[Mapping[str, str]], thinking: bool) -> str:
        """Return what helps where a template has no place for one of the messages."""
        joined = self._shown(with_system(messages, FIRST_USER))
        if len(joined) < len(messages) and not self.system:
            with suppress(UserError):
                if unsaid(joined, self._apply(joined, thinking=thinking)) is None:
                    return (
                        f'a card with system = "{FIRST_USER}" puts the system text into the first user turn'
                    )
        return "use a prompt with roles that it knows, or a model with another template"

    def _shown(self, messages: Sequence[Mapping[str, str]]) -> list[dict[str, Any]]:
        """Convert messages for the template. A picture's token written inside a text is broken up."""
        token = self.image_token
        if token is None:
            return [dict(message) for message in messages]
        texts = [{**m, "content": m["content"].replace(token, f"{token[0]} {token[1:]}")} for m in messages]
        return in_parts(texts, {"type": "image"})

    def _apply(self, messages: list[dict[str, Any]], *, thinking: bool, **values: Any) -> str:
        switch = {"enable_thinking": thinking} if self._switch else {}
        return self._compiled.render(messages, **self.specials, **switch, **values)

    def encode(self, prompt: str) -> list[int]:
        """Return the token ids of a rendered prompt, in which the template has already written any BOS."""
        ids: list[int] = self.tokenizer(prompt, add_special_tokens=False)["input_ids"]
        return ids

    def decode(self, ids: Sequence[int]) -> str:
        """Return the text of an answer without special tokens. Qwen3's `<think>` is not one, and stays."""
        text: str = self.tokenizer.decode(ids, skip_special_tokens=True, clean_up_tokenization_spaces=False)
        return text

    @property
    def vocabulary(self) -> int:
        """Number of tokens."""
        return len(self.tokenizer)

    def pieces(self, ids: Sequence[int]) -> list[str]:
        """Return the text of each single token, with special tokens; incomplete bytes become U+FFFD."""
        return [
            self.tokenizer.decode([i], skip_special_tokens=False, clean_up_tokenization_spaces=False)
            for i in ids
        ]

    def spellings(self, letters: str) -> dict[str, list[int]]:
        """Return the ids of all tokens that are each letter: alone, with blanks around it, or as a byte."""
        found: dict[str, list[int]] = {letter: [] for letter in letters}
        candidates = self._candidates(letters)
        for token, piece in zip(candidates, self.pieces(candidates), strict=True):
            if (letter := spelt(piece)) in found:
                found[letter].append(token)
        return found

    def _candidates(self, letters: str) -> Sequence[int]:
        """Return the ids of the tokens whose texts may be one of the letters."""
        return [
            token for text, token in self.tokenizer.get_vocab().items()
            if len(text) <= _LONGEST and (text.startswith("<0x") or any(x in text for x in letters))
        ]  # fmt: skip


def in_parts(messages: Sequence[Mapping[str, str]], picture: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Convert messages to contents that are lists of parts, as models with vision take them.

    Args:
        messages: chat messages with text; one with the key `image` gets the picture before its text.
        picture: the part that stands for the picture.
    """
    return [
        {"role": m["role"], "content": [picture] * ("image" in m) + [{"type": "text", "text": m["content"]}]}
        for m in messages
    ]
