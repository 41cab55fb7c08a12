"""What a served model reads: a server that can tell is asked whether every message's text is among
it.
"""

import asyncio
import json
from collections.abc import Sequence
from typing import Any

from harness.backends.base import Request
from harness.backends.card import Card
from harness.backends.chat_template import FIRST_USER, Messages, lost_message
from harness.backends.openai.http import Client
from harness.backends.openai.shapes import body, digest_url
from harness.backends.servers import Server
from harness.core.errors import UserError, printable

LONGER = 1.5  # times as many characters have more tokens


class PromptCheck:
    """Check that a served model reads every message, before its first answer.

    It is checked once for the ego's prompt and once for the helpers'. llama-server renders messages
    (`/apply-template`), and vLLM counts their tokens (`/tokenize`), without an answer. Of another
    server only the token counts of its answers are known: `fault` says if they do not grow with the
    prompts. Prompts with pictures are not checked.
    """

    def __init__(self, client: Client, card: Card, server: Server) -> None:
        self._client, self._card, self._server = client, card, server
        self._asked: set[str] = set()  # roles
        # characters and tokens of prompts that were answered
        self._shortest = self._longest = (0, 0)
        self._alone = asyncio.Lock()

    async def check(self, requests: Sequence[Request]) -> None:
        """Ask the servers about the first request of each role, `ego` and `helper`.

        Raises UserError if the chat template leaves out a message's text.
        """
        if self._server.kind not in ("llama-server", "vllm"):
            return
        async with self._alone:
            for request in requests:
                if request.role not in self._asked and request.image is None:
                    for base in self._server.urls:
                        await self._ask(base, body(self._card, self._server, request, digest_url))
                    self._asked.add(request.role)

    def fault(self, request: Request, tokens: int | None) -> str | None:
        """Return a sentence if a server seems to have cut a prompt, by its token count; else None.

        `tokens` is how many prompt tokens it states for `request`. Some servers, such as Ollama,
        cut long prompts to their context without saying so.
        """
        if (
            tokens is None
            or request.image is not None
            or self._server.kind in ("llama-server", "vllm")
        ):
            return None
        here = sum(len(message["content"]) for message in request.messages), tokens
        self._shortest = min(self._shortest if self._shortest[0] else here, here)
        self._longest = max(self._longest, here)
        (few, few_tokens), (many, many_tokens) = self._shortest, self._longest
        if many < LONGER * few or many_tokens > few_tokens:
            return None
        return (
            f"counts {few_tokens} tokens in a prompt of {few} characters and {many_tokens} in one "
            f"of {many}; it may cut prompts, or count only what it did not have in its cache: look "
            "at its context length and log"
        )

    async def _ask(self, base: str, fields: dict[str, Any]) -> None:
        messages: Messages = fields["messages"]
        if self._server.kind == "llama-server":
            prompt = await self._field(base, "/apply-template", "prompt", fields)
            lacking = lost_message(messages, prompt) if isinstance(prompt, str) else None
        else:
            without_first = {**fields, "messages": messages[1:]}
            count = await self._field(base, "/tokenize", "count", fields)
            fewer = await self._field(base, "/tokenize", "count", without_first)
            counted = type(count) is int and type(fewer) is int
            lacking = messages[0] if counted and count <= fewer else None
        if lacking is not None:
            way = "" if self._card.system else f'; or give its card system = "{FIRST_USER}"'
            raise UserError(
                f"{self._card.shown}: the chat template at {printable(base)} leaves out or changes "
                f"the {printable(lacking['role'])}'s text, so the model would not read what it is "
                f"asked; start the server with the template that the model was trained with{way}"
            )

    async def _field(self, base: str, path: str, field: str, fields: dict[str, Any]) -> Any:
        """Return a field of what a server says of messages; None if it does not say."""
        keys = ("model", "messages", "chat_template_kwargs")
        content = json.dumps({key: fields[key] for key in keys if key in fields}).encode()
        reply = await self._client.get(base, base.removesuffix("/v1") + path, content)
        return reply.payload.get(field) if isinstance(reply.payload, dict) else None
