"""A model's chat template and tokenizer: render messages to the prompt that it reads, and encode that."""

from collections.abc import Mapping, Sequence
from typing import Any

from harness.backends.cards import Thinking
from harness.core.errors import UserError, printable
from harness.prompts.readout import spelt

_LONGEST = 8  # characters of a letter's longest token: `<0x41>`, or a letter with blanks


class Chat:
    """A tokenizer with its chat template.

    Attributes:
        name: name of the model.
        template: the template's Jinja text.
        image_token: token that the template writes for a picture; None if the model takes none.
    """

    image_token: str | None = None

    def __init__(self, name: str, tokenizer: Any, image_token: str | None = None) -> None:
        self.name = name
        self.tokenizer = tokenizer
        self.template = str(tokenizer.get_chat_template())
        self.image_token = image_token

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

    def render(self, messages: Sequence[Mapping[str, str]], *, thinking: bool) -> str:
        """Render messages to the prompt that the model reads, with `image_token` for a picture.

        Raises:
            UserError: the template refuses the messages.
        """
        from jinja2 import TemplateError

        switch = {"enable_thinking": thinking} if self._switch else {}
        try:
            return self._apply(self._shown(messages), switch)
        except TemplateError as error:
            raise UserError(
                f"model {self.name!r}: its chat template refuses the messages "
                f"({printable(error)}); use a prompt with roles that it knows"
            ) from None

    def _shown(self, messages: Sequence[Mapping[str, str]]) -> list[dict[str, Any]]:
        """Convert messages for the template. A picture's token written inside a text is broken up."""
        token = self.image_token
        if token is None:
            return [dict(message) for message in messages]
        texts = [{**m, "content": m["content"].replace(token, f"{token[0]} {token[1:]}")} for m in messages]
        return in_parts(texts, {"type": "image"})

    def _apply(self, messages: list[dict[str, Any]], switch: Mapping[str, bool]) -> str:
        text: str = self.tokenizer.apply_chat_template(
            messages, tokenize=False, add_generation_prompt=True, **switch
        )
        return text

    def encode(self, prompt: str) -> list[int]:
        """Return the token ids of a rendered prompt, in which the template has already written any BOS."""
        ids: list[int] = self.tokenizer(prompt, add_special_tokens=False)["input_ids"]
        return ids

    def decode(self, ids: Sequence[int]) -> str:
        """Return the text of an answer without special tokens. Qwen3's `<think>` is not one, and stays."""
        text: str = self.tokenizer.decode(ids, skip_special_tokens=True, clean_up_tokenization_spaces=False)
        return text

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
