"""Where a served model is asked. A card is a public file: it names the key's variable and holds no secret."""

import re
from dataclasses import dataclass
from sys import float_info
from typing import Annotated, Literal, get_args
from urllib.parse import urlsplit

from msgspec import Meta

Kind = Literal["generic", "vllm", "llama-server", "ollama", "lm-studio", "llama-cpp-python"]
KINDS = get_args(Kind)
_VARIABLE = re.compile(r"[A-Z][A-Z0-9_]{0,63}")


@dataclass(frozen=True)
class Server:
    """A server that speaks OpenAI's chat completions.

    Attributes:
        base_url: up to and with `/v1`; http or https, without credentials, query or fragment. A list is of
            servers that each have the model, any of which may answer; each has to list it then.
        kind: decides how a constrained answer is asked for; `generic` is OpenAI's own way.
        key_env: environment variable with the key. It need not be set for a server that asks for none.
        timeout_s: longest that one attempt may take, from connecting to the last byte, in seconds.
        retries: attempts after the first, where a server was busy, broke down or was not reached; at least
            one at each of several.
    """

    base_url: str | tuple[str, ...]
    kind: Kind = "generic"
    key_env: str = "OPENAI_API_KEY"
    timeout_s: Annotated[float, Meta(gt=0, le=float_info.max, description="seconds, more than 0")] = 120.0
    retries: Annotated[int, Meta(ge=0, le=10, description="0 to 10")] = 3

    def __post_init__(self) -> None:
        # What is refused is not shown: it may hold a password.
        if fault := next(filter(None, map(_fault, self.urls)), None if self.urls else "is an empty list"):
            raise ValueError(f"base_url {fault}; give one such as http://127.0.0.1:8080/v1")
        if len(set(self.urls)) < len(self.urls):
            raise ValueError("base_url names a server twice; name each once")
        if not _VARIABLE.fullmatch(self.key_env):
            raise ValueError(
                "key_env is no name of an environment variable (capitals, digits, _); "
                "set the key in the environment, never in a card"
            )

    @property
    def urls(self) -> tuple[str, ...]:
        """The base URL of each server, without a slash at its end."""
        given = (self.base_url,) if isinstance(self.base_url, str) else self.base_url
        return tuple(url.rstrip("/") for url in given)

    @property
    def any_may_answer(self) -> bool:
        """Whether the model is what its servers list, wherever they are."""
        return not isinstance(self.base_url, str)

    @property
    def tells_thinking(self) -> bool:
        """Whether a request can turn thinking on and off."""
        return self.kind in ("vllm", "llama-server")


def _fault(url: str) -> str | None:
    """What keeps a text from being a base URL, None if nothing."""
    try:
        parts = urlsplit(url)
        host = bool(parts.hostname) and parts.port != 0  # a port that is no number raises
    except ValueError:
        return "is no URL"
    if "@" in parts.netloc:
        return "holds credentials; set the key in the environment"
    if parts.scheme not in ("http", "https") or not host:
        return "is no http or https URL with a host"
    if not url.isascii() or not url.isprintable() or " " in url or "?" in url or "#" in url:
        return "holds a query, a fragment or characters that no base URL has"
    return None
