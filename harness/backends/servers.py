"""Where a served model is asked. A card is a public file: it names the key's variable and holds no secret."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args
from urllib.parse import urlsplit

from harness.core.errors import UserError, printable

Kind = Literal["generic", "vllm", "llama-server", "ollama", "lm-studio", "llama-cpp-python"]
KINDS = get_args(Kind)
KEYS: Mapping[str, type] = {
    "base_url": str,
    "kind": str,
    "key_env": str,
    "timeout_s": float,
    "retries": int,
}
MOST_RETRIES = 10
_VARIABLE = re.compile(r"[A-Z][A-Z0-9_]{0,63}")


@dataclass(frozen=True)
class Server:
    """A server that speaks OpenAI's chat completions.

    Attributes:
        base_url: up to and with `/v1`; http or https, without credentials, query or fragment.
        kind: decides how a constrained answer is asked for; `generic` is OpenAI's own way.
        key_env: environment variable with the key. It need not be set for a server that asks for none.
        timeout_s: longest that one attempt may take, from connecting to the last byte, in seconds.
        retries: attempts after the first, where the server was busy, broke down or was not reached.
    """

    base_url: str
    kind: Kind = "generic"
    key_env: str = "OPENAI_API_KEY"
    timeout_s: float = 120.0
    retries: int = 3

    @property
    def tells_thinking(self) -> bool:
        """Whether a request can turn thinking on and off."""
        return self.kind in ("vllm", "llama-server")


def read(table: Mapping[str, Any], where: str) -> Server:
    """A card's table, whose keys and types were checked. Raises UserError for values that cannot be meant."""
    # What is refused is not shown: it may hold a password.
    if fault := _fault(table["base_url"]):
        raise UserError(f"{where}: base_url {fault}; give one such as http://127.0.0.1:8080/v1")
    if not _VARIABLE.fullmatch(table.get("key_env", "OPENAI_API_KEY")):
        raise UserError(
            f"{where}: key_env is no name of an environment variable (capitals, digits, _); "
            "set the key in the environment, never in a card"
        )
    timeout_s, retries = table.get("timeout_s", 1), table.get("retries", 0)
    if not 0 < timeout_s < float("inf"):
        raise UserError(f"{where}: timeout_s = {timeout_s}; allowed: seconds, more than 0")
    if not 0 <= retries <= MOST_RETRIES:
        raise UserError(f"{where}: retries = {printable(retries, 20)}; allowed: 0 to {MOST_RETRIES}")
    return Server(**table)


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
