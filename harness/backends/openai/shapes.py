"""Build the JSON request for an OpenAI-compatible server, and read its answer.

Whatever a server promises, `harness.parsing.parse` decides whether an answer is valid.
"""

import math
from base64 import b64encode
from collections.abc import Callable, Mapping
from typing import Any

from harness.backends.base import Completion, FinishReason, Request, failed
from harness.backends.card import Card
from harness.backends.chat import in_parts
from harness.backends.chat_template import with_system
from harness.backends.openai.constraint import broken, constraint
from harness.backends.openai.endings import ending
from harness.backends.openai.said import NoText, in_texts, refusal, thought
from harness.backends.servers import MOST_LOGPROBS, Kind, Server
from harness.backends.token_counts import MOST_TOKENS, least_tokens
from harness.core.errors import UserError
from harness.core.image import Image
from harness.prompts.readout import answer_json, letters, spelt

_REMEDY = (
    "use --answer json, or a server that keeps to it; the kind in its card says how it is asked"
)
# Temperature 0 is not enough: by default some servers penalise repetition (llama_cpp.server by 1.1,
# vLLM by the checkpoint's generation_config.json), and JSON repeats itself.
_PENALTY: Mapping[Kind, str] = {
    "vllm": "repetition_penalty",
    "llama-server": "repeat_penalty",
    "llama-cpp-python": "repeat_penalty",
    "lm-studio": "repeat_penalty",
}
# Tokens are drawn from the whole vocabulary; by default some servers draw from the likeliest only.
_ALL: Mapping[Kind, Mapping[str, int]] = {
    kind: {"top_k": -1 if kind == "vllm" else 0, "min_p": 0} for kind in _PENALTY
}


def data_url(image: Image) -> str:
    """Return a picture as a `data:` URL with its PNG bytes, as servers take it."""
    return f"data:image/png;base64,{b64encode(image.png()).decode()}"


def digest_url(image: Image) -> str:
    """Return a short URL with a picture's digest, for requests that are shown or stored."""
    return f"sha256:{image.sha256}"


def body(
    card: Card, server: Server, request: Request, url: Callable[[Image], str] = data_url
) -> dict[str, Any]:
    """Return the JSON body of one chat completion request, not streamed.

    `card` is the model card, the TOML file that describes a model, and `server` its `[server]`
    table; `url` makes the URL that stands for the request's picture. Raises UserError if the
    request has a temperature and the card sends none.
    """
    picture = request.image and {"type": "image_url", "image_url": {"url": url(request.image)}}
    messages: list[Any] = []
    for message in with_system(request.messages, card.system):
        if picture and "image" in message:
            messages += in_parts([message], picture)
        else:  # text, not parts, since not every server and chat template takes them
            messages.append(dict(message))
    json_body: dict[str, Any] = {
        "model": card.weights,
        "messages": messages,
        "max_tokens": request.max_tokens,
        "temperature": request.temperature or 0,
        "seed": request.sample,
        "stream": False,
    }
    if server.kind in _PENALTY:
        json_body[_PENALTY[server.kind]] = 1.0
    if request.temperature:
        json_body |= {"top_p": 1, **_ALL.get(server.kind, {})}
    if card.thinking == "switch":
        json_body["chat_template_kwargs"] = {"enable_thinking": request.thinking}
    if request.answer == "constrained":
        json_body |= constraint(server.kind, request.shape)
    if request.bare:
        json_body |= {
            "max_tokens": 1,
            "logprobs": True,
            "top_logprobs": server.top_logprobs or MOST_LOGPROBS,
        }
    if server.fields is None:
        return json_body
    if request.temperature and server.fields.temperature is False:
        raise UserError(
            f"{card.shown}: its card sends no temperature, and {request.temperature:g} is "
            "asked for; leave --temperature out"
        )
    return server.fields.applied(json_body)


def read(payload: Any, request: Request, kind: Kind = "generic") -> Completion:
    """Return the completion in a server's reply to a chat completion request, without its time.

    `payload` is the reply's decoded JSON, and `kind` the kind of server (its program, such as
    `vllm`). A malformed reply, or one that breaks the constraint that this kind of server was sent,
    gives a completion with an error in one sentence. The text of a refusal is that of the model
    that refuses.
    """
    try:
        choice = payload["choices"][0]
        message = in_texts(choice["message"])
        content, thinks, refuses = message.get("content"), thought(message), refusal(message)
        end, usage = ending(choice.get("finish_reason")), payload.get("usage") or {}
        count, prompt_tokens = usage.get("completion_tokens"), tokens_in(usage.get("prompt_tokens"))
        parts = [part for part in (content, thinks, refuses) if isinstance(part, str)]
        written = sum(map(len, parts))
    except NoText as error:
        return failed(request, str(error))
    except (LookupError, TypeError, AttributeError):
        return failed(request, "the answer is no chat completion")
    if refuses or end == "refused" or (end == "filtered" and not content):
        words = refuses or (content if isinstance(content, str) else "")
        tokens = tokens_in(count, written)
        return Completion(request.id, words, prompt_tokens, tokens, "refusal", None, 1)
    if request.bare:
        return _read_out(choice, request, prompt_tokens, tokens_in(count))
    if not isinstance(content, str) and not (content is None and thinks):
        if "content" not in message:
            return failed(request, "the answer is no chat completion")
        named = "null" if content is None else type(content).__name__
        calls = ", and it calls a tool" if message.get("tool_calls") else ""
        return failed(request, f"the answer's content is no text but {named}{calls}")
    # An answer that a server's content filter cut off counts as cut off.
    finish_reason: FinishReason = "length" if end in ("cut", "filtered") else "stop"
    content = content or ""
    if request.answer == "constrained" and (
        fault := broken(kind, request, content, ended=finish_reason == "stop")
    ):
        return failed(
            request, f"the server did not keep to the constraint that was sent: {fault}; {_REMEDY}"
        )
    text = _with_thought(thinks, content, finish_reason, request.thinking)
    tokens = tokens_in(count, max(written, len(text)))
    return Completion(request.id, text, prompt_tokens, tokens, finish_reason, None, 1)


def _with_thought(
    thought: str | None, content: str, finish_reason: FinishReason, is_thinking: bool
) -> str:
    """Restore the text as the model wrote it, if the server took out the thought:
    the parser looks for it.

    An answer that was cut off with nothing after the thought was cut off inside it,
    so it stays open.
    """
    if not thought and not (is_thinking and thought is not None):
        return content
    if finish_reason == "length" and not content.strip():
        return f"<think>\n{thought}"
    return f"<think>\n{thought}\n</think>\n\n{content}"


def _read_out(
    choice: Mapping[str, Any],
    request: Request,
    prompt_tokens: int | None,
    completion_tokens: int | None,
) -> Completion:
    """Read the letters' probabilities from the list of the likeliest tokens.

    A letter counts in each of its spellings, with a blank before it or without. One that is not
    listed is at most as likely as the least likely listed token, and all such letters together have
    at most the remaining probability; each gets the most that it can have. `label_mass` counts the
    listed letters only.
    """
    try:
        likeliest = choice["logprobs"]["content"][0]["top_logprobs"]
        listed = [(spelt(str(t["token"])), math.exp(float(t["logprob"]))) for t in likeliest]
    except (LookupError, TypeError, ValueError, OverflowError):
        return failed(request, "the server gives no log-probabilities")
    names = letters(request.actions)
    total = math.fsum(p for _, p in listed)
    if not 0 < total <= 1.001:
        return failed(request, "the server's log-probabilities are none")
    parts_of: dict[str, list[float]] = {name: [] for name in names}
    for token, p in listed:
        if token in parts_of:
            parts_of[token].append(p)
    letter_p = {name: math.fsum(parts) for name, parts in parts_of.items()}
    mass = math.fsum(letter_p.values())
    if not mass:
        return failed(
            request, f"none of the letters {names} is among the {len(listed)} likeliest tokens"
        )
    missing = [name for name, parts in parts_of.items() if not parts]
    least_listed_p = min(p for _, p in listed)
    rest_p = max(0.0, 1.0 - total) / max(1, len(missing))
    for name in missing:
        letter_p[name] = min(least_listed_p, rest_p)
    text = answer_json(request.actions, list(letter_p.values()))
    tokens = prompt_tokens, completion_tokens
    return Completion(request.id, text, *tokens, "stop", None, 1, label_mass=min(1.0, mass))


def answering_model(payload: Any) -> str | None:
    """Return the model that a server names in its reply; None if it names none.

    `payload` is the reply's decoded JSON.
    """
    model = payload.get("model") if isinstance(payload, dict) else None
    return model if isinstance(model, str) else None


def tokens_in(value: Any, characters: int = 0) -> int | None:
    """Return a token count that a server states, or None if it cannot be one.

    `value` is what it states of a text of `characters` characters, 0 if unknown. None if it is no
    whole number, or too small or large for such a text: latency and energy are computed from it.
    """
    is_count = type(value) is int and least_tokens(characters) <= value <= MOST_TOKENS
    return value if is_count else None
