"""The `[server]` table of a card: the address of a served model, and how it is asked.

A card is a public file: it names the environment variable of the key and holds no secret.
"""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from sys import float_info
from typing import Annotated, Any, Literal, get_args
from urllib.parse import urlsplit

from msgspec import Meta

from harness.core.errors import UserError

Kind = Literal["generic", "vllm", "llama-server", "ollama", "lm-studio", "llama-cpp-python"]
KINDS = get_args(Kind)
MOST_LOGPROBS = 20  # most log-probabilities of one token that OpenAI and vLLM give
# An address without a scheme or with one misspelt. It has no place for a password, so it may be
# shown.
_ADDRESS = re.compile(
    r"(?P<scheme>[a-z]{3,6}(?::/{1,2}|//))?"
    r"(?P<host>(?:\[[\da-f:.]+\]|localhost|[\w-]+(?:\.[\w-]+)+|[\w-]+(?=:))(?::\d{2,5})?)"
    r"(?P<path>/[\w./-]*)?",
    re.ASCII | re.IGNORECASE,
)
_VARIABLE = re.compile(r"[A-Z][A-Z0-9_]{0,63}")
_NAME = Meta(
    pattern=r"^[a-z][a-z0-9_]{0,63}\Z", description="true, false or another name of the field"
)
_Sent = bool | Annotated[str, _NAME]
_Listed = Annotated[int, Meta(ge=1, le=MOST_LOGPROBS, description=f"1 to {MOST_LOGPROBS}")]
# Fields that say what is asked, how the answer comes, or how often; no other field may take their
# names.
_RESERVED = frozenset(
    {
        "model",
        "messages",
        "prompt",
        "input",
        "stream",
        "stream_options",
        "logprobs",
        "top_logprobs",
        "n",
        "best_of",
        "response_format",
        "structured_outputs",
        "grammar",
        "json_schema",
        "chat_template",
        "chat_template_kwargs",
        "tools",
        "tool_choice",
        "functions",
        "function_call",
        "stop",
        "user",
        "store",
        "metadata",
    }
)


@dataclass(frozen=True)
class Fields:
    """Say how a server is sent request fields that some servers refuse or call by other names.

    Each is true (sent as it is), false (left out), or the name under which it is sent, as in
    `max_tokens = "max_completion_tokens"`. These are the most tokens of an answer, and how its
    tokens are drawn: `temperature`, the `seed` of the answer among several to one question, and
    `top_p`, `top_k`, `min_p`, `repetition_penalty` and `repeat_penalty`, which are sent with the
    values that change nothing. No other field can be changed. Raises ValueError for a name that
    another field has.
    """

    max_tokens: _Sent = True  # most tokens of the answer
    temperature: _Sent = True  # that of `--temperature`. Left out, the server draws as it likes.
    seed: _Sent = True  # number of the answer among several to one question
    top_p: _Sent = True  # 1, if answers are drawn
    top_k: _Sent = True  # all tokens, if answers are drawn
    min_p: _Sent = True  # 0, if answers are drawn
    repetition_penalty: _Sent = True  # 1, for `vllm`
    repeat_penalty: _Sent = True  # 1, for the kinds of llama.cpp

    def __post_init__(self) -> None:
        names = [alias for alias in vars(self).values() if isinstance(alias, str)]
        for name, alias in self.changed.items():
            if alias in _RESERVED or alias in vars(self) or names.count(str(alias)) > 1:
                raise ValueError(
                    f"{name} is sent as {alias}, the name of another field; give one of its own"
                )

    @property
    def changed(self) -> Mapping[str, str | bool]:
        """Return the request fields that a server is sent otherwise, by their usual name.

        The value is false for one that is left out, else the name under which it is sent.
        """
        return {name: alias for name, alias in vars(self).items() if alias is not True}

    def applied(self, body: Mapping[str, Any]) -> dict[str, Any]:
        """Return a request's JSON body in which fields are left out or renamed for a server.

        `body` has them under their usual names.
        """
        sent = {name: vars(self).get(name, True) for name in body}
        return {
            name if alias is True else alias: body[name]
            for name, alias in sent.items()
            if alias is not False
        }


# environment variable: names of further variables, with commas, that cards may use
KEYS = "SWARMDRIVE_KEYS"
# Words of which one is in the name of a variable that holds a key of models, such as
# AZURE_OPENAI_API_KEY.
_OF_MODELS = {
    "ANTHROPIC",
    "CEREBRAS",
    "COHERE",
    "DASHSCOPE",
    "DEEPINFRA",
    "DEEPSEEK",
    "FIREWORKS",
    "GEMINI",
    "GROQ",
    "LITELLM",
    "LLAMA",
    "LLM",
    "LMSTUDIO",
    "MISTRAL",
    "MOONSHOT",
    "NVIDIA",
    "OLLAMA",
    "OPENAI",
    "OPENROUTER",
    "SAMBANOVA",
    "SGLANG",
    "TGI",
    "TOGETHER",
    "TOGETHERAI",
    "VLLM",
    "XAI",
    "ZAI",
}


@dataclass(frozen=True)
class Server:
    """Describe the servers of a model and how they are asked: a model card's `[server]` table.

    A model card is the TOML file that describes a model. `base_url` has one URL or several, up to
    and with `/v1`; `kind` is the server program, which decides how a constrained answer is asked
    for; `key_env` names the environment variable with the key. `timeout_s` is the longest time of
    one attempt, in seconds, and `retries` the number of attempts after the first; `top_logprobs` is
    how many of the likeliest tokens are asked for where letters' probabilities are the answer, None
    for 20. `fields` are request fields that are left out or renamed. Raises ValueError for a URL or
    variable name that is not allowed, without showing the URL.
    """

    # URL up to and with `/v1`; http or https, without credentials, query or fragment. With a list
    # of servers, any of them may answer, and each must list the model.
    base_url: str | tuple[str, ...]
    # decides how a constrained answer is asked for; `generic` is OpenAI's own way
    kind: Kind = "generic"
    # environment variable with the key; it need not be set for a server without one. Its name tells
    # that it is a key of models (`readable`), or the user lists it in SWARMDRIVE_KEYS.
    key_env: str = "OPENAI_API_KEY"
    # longest time of one attempt, from connecting to the last byte, in seconds
    timeout_s: Annotated[
        float, Meta(gt=0, le=float_info.max, description="seconds, more than 0")
    ] = 120.0
    # attempts after the first, if a server was busy, broke down or was not reached; of several
    # servers, each is tried at least once
    retries: Annotated[int, Meta(ge=0, le=10, description="0 to 10")] = 3
    top_logprobs: _Listed | None = None  # asked for in a read-out; None: 20, the usual limit
    # fields of a request that it is sent otherwise; None if there are none
    fields: Fields | None = None

    def __post_init__(self) -> None:
        # A refused URL is not shown, since it may hold a password.
        if fault := next(
            filter(None, map(_fault, self.urls)), None if self.urls else "is an empty list"
        ):
            mended = next(
                filter(None, map(meant, self.urls)), "one such as http://127.0.0.1:8080/v1"
            )
            raise ValueError(f"base_url {fault}; give {mended}")
        if len(set(self.urls)) < len(self.urls):
            raise ValueError("base_url names a server twice; name each once")
        if not _VARIABLE.fullmatch(self.key_env):
            raise ValueError(
                "key_env is no name of an environment variable (capitals, digits, _); "
                "set the key in the environment, never in a card"
            )

    def key(self) -> str | None:
        """Return the API key to send to the model's server; None if no variable has one.

        The file that describes the model names the environment variable, and may come from a
        stranger, who could have a secret of the user's sent to his server. So UserError is raised
        unless the variable's name is that of a model's key, such as `OPENAI_API_KEY`, or the user
        lists it in `SWARMDRIVE_KEYS`.
        """
        if not self.key_env or not (key := os.environ.get(self.key_env, "").strip()):
            return None
        if not readable(self.key_env):
            raise UserError(
                f"key_env {self.key_env} is no name of a key of models, such as OPENAI_API_KEY or "
                f"VLLM_KEY, so it is not sent; if it holds one, set {KEYS}={self.key_env} in your "
                "environment"
            )
        return key

    @property
    def urls(self) -> tuple[str, ...]:
        urls = (self.base_url,) if isinstance(self.base_url, str) else self.base_url
        return tuple(url.rstrip("/") for url in urls)

    @property
    def any_may_answer(self) -> bool:
        """Return whether `base_url` is a list of servers, any of which may answer a request.

        The model's identity is then what they list, and has no address.
        """
        return not isinstance(self.base_url, str)

    @property
    def tells_thinking(self) -> bool:
        return self.kind in ("vllm", "llama-server")


def readable(variable: str) -> bool:
    """Return whether a model's TOML file may have this environment variable sent as a key.

    The key goes to the server that the file names. The name of the variable ends in KEY or TOKEN
    and has the word of a service or a server of models, or the user lists it in `SWARMDRIVE_KEYS`.
    """
    *words, last = variable.split("_")
    listed = {name.strip() for name in os.environ.get(KEYS, "").split(",")}
    return variable in listed or (last in ("KEY", "TOKEN") and not _OF_MODELS.isdisjoint(words))


def meant(address: str) -> str | None:
    """Return the base URL that a user may mean by an address without `http://`; None if unclear.

    It is for the advice in an error message.
    """
    match = _ADDRESS.fullmatch(address)
    if match is None or address.startswith(("http://", "https://")):
        return None
    scheme = "https" if (match["scheme"] or "").lower().startswith("https") else "http"
    path = (match["path"] or "").rstrip("/") or "/v1"
    return f"{scheme}://{match['host']}{path}"


def _fault(url: str) -> str | None:
    try:
        parts = urlsplit(url)
        host = bool(parts.hostname) and parts.port != 0  # raises if the port is not a number
    except ValueError:
        return "is no URL"
    if "@" in parts.netloc:
        return "holds credentials; set the key in the environment"
    if parts.scheme not in ("http", "https") or not host:
        return "is no http or https URL with a host"
    if not url.isascii() or not url.isprintable() or " " in url or "?" in url or "#" in url:
        return "holds a query, a fragment or characters that no base URL has"
    return None
