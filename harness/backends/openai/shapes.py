"""What is written to an OpenAI-compatible server, and how its answer is read.

Servers differ in how a constrained answer is asked for. Whatever they promise, `harness.parsing.parse` is
the judge.
"""

import json
import math
import re
from base64 import b64encode
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from harness.backends.base import FinishReason, Request
from harness.backends.cards import Card
from harness.backends.chat import in_parts
from harness.backends.servers import Kind, Server
from harness.core.files import canonical_json
from harness.core.image import Image
from harness.prompts.answer_schema import answer_schema
from harness.prompts.readout import letters, stated

TOP = 20  # most log-probabilities that servers give for one token
# Greedy is not enough: some servers punish repetition unless told otherwise (llama_cpp.server by 1.1, vLLM by
# what a checkpoint's generation_config.json says), and JSON repeats itself.
_PENALTY: Mapping[Kind, str] = {
    "vllm": "repetition_penalty",
    "llama-server": "repeat_penalty",
    "llama-cpp-python": "repeat_penalty",
    "lm-studio": "repeat_penalty",
}
# Drawing is from all tokens, which some servers cut to the likeliest unless told otherwise.
_ALL: Mapping[Kind, Mapping[str, int]] = {
    kind: {"top_k": -1 if kind == "vllm" else 0, "min_p": 0} for kind in _PENALTY
}


@dataclass(frozen=True)
class Said:
    """What a server's answer holds, in the fields of a completion; on an `error` nothing else counts."""

    text: str = ""
    finish_reason: FinishReason = "error"
    prompt_tokens: int | None = None
    completion_tokens: int | None = None
    label_mass: float | None = None
    error: str | None = None


def data_url(image: Image) -> str:
    """A picture as a server is sent it."""
    return f"data:image/png;base64,{b64encode(image.png()).decode()}"


def digest_url(image: Image) -> str:
    """What stands for a picture where a request is shown or kept."""
    return f"sha256:{image.sha256}"


def body(
    card: Card, server: Server, request: Request, url: Callable[[Image], str] = data_url
) -> dict[str, Any]:
    """The JSON of one chat completion, in one piece; `url` says where its picture is."""
    picture = request.image and {"type": "image_url", "image_url": {"url": url(request.image)}}
    asked: dict[str, Any] = {
        "model": card.weights,
        # Texts stay texts: not every server and chat template takes parts.
        "messages": [
            in_parts([message], picture)[0] if picture and "image" in message else dict(message)
            for message in request.messages
        ],
        "max_tokens": request.max_tokens,
        "temperature": request.temperature or 0,
        "seed": request.sample,
        "stream": False,
    }
    if server.kind in _PENALTY:
        asked[_PENALTY[server.kind]] = 1.0
    if request.temperature:
        asked |= {"top_p": 1, **_ALL.get(server.kind, {})}
    if card.thinking == "switch":
        asked["chat_template_kwargs"] = {"enable_thinking": request.thinking}
    if request.answer == "constrained":
        asked |= _constraint(server.kind, request)
    if request.answer == "readout":
        asked |= {"max_tokens": 1, "logprobs": True, "top_logprobs": TOP}
    return asked


def _constraint(kind: Kind, request: Request) -> dict[str, Any]:
    schema = answer_schema(request.role, request.actions, form=request.form)
    schema = {key: value for key, value in schema.items() if key not in ("$schema", "title")}
    if "evidence" in schema["properties"]:  # a constrained answer has no free text, as with local engines
        schema["properties"] = {**schema["properties"], "evidence": {"type": "string", "enum": [""]}}
    # Numbers of a JSON Schema may run on for ever, or leave 0..1, with most servers; two decimals cannot.
    if kind == "vllm":
        return {"structured_outputs": {"regex": _pattern(schema, re.escape)}}
    if kind in ("llama-server", "llama-cpp-python"):
        return {"grammar": f"root ::= {_pattern(schema, canonical_json)}"}
    wanted = {"name": "answer", "strict": True, "schema": schema}
    return {"response_format": {"type": "json_schema", "json_schema": wanted}}


def _pattern(schema: Mapping[str, Any], literal: Callable[[str], str]) -> str:
    """Compact JSON of a schema: a regular expression, or a rule of llama.cpp's grammar.

    For what an answer is made of, the two differ in nothing but how `literal` text is written.
    """
    if "enum" in schema:
        return f"({'|'.join(literal(json.dumps(value)) for value in schema['enum'])})"
    if schema["type"] == "number":
        return f"({literal('0.')}[0-9][0-9]|{literal('1.00')})"
    members = [
        literal(f"{json.dumps(name)}:") + _pattern(value, literal)
        for name, value in schema["properties"].items()
    ]
    return literal("{") + literal(",").join(members) + literal("}")


def read(payload: Any, request: Request) -> Said:
    """What a chat completion says. Anything that is none is an error, in one sentence."""
    try:
        choice = payload["choices"][0]
        message = choice["message"]
        content = message["content"]
        thought = message.get("reasoning_content", message.get("reasoning"))
        finish, usage = choice.get("finish_reason"), payload.get("usage") or {}
        tokens = _count(usage.get("prompt_tokens")), _count(usage.get("completion_tokens"))
    except (LookupError, TypeError, AttributeError):
        return Said(error="the answer is no chat completion")
    if request.answer == "readout":
        return _read_out(choice, request, *tokens)
    thought = thought if isinstance(thought, str) else None
    if not isinstance(content, str) and not (content is None and thought):
        kind = "null" if content is None else type(content).__name__
        return Said(error=f"the answer's content is no text but {kind}")
    # What a server's filter cut off is cut off.
    finish_reason: FinishReason = "length" if finish in ("length", "content_filter") else "stop"
    text = _whole(thought, content or "", finish_reason, request.thinking)
    return Said(text, finish_reason, *tokens)


def _whole(thought: str | None, content: str, finish_reason: FinishReason, asked: bool) -> str:
    """The text as the model wrote it, where the server took the thought out: the parser looks for it.

    An answer that was cut off with nothing behind the thought was cut off inside it, so it stays open.
    """
    if not thought and not (asked and thought is not None):
        return content
    if finish_reason == "length" and not content.strip():
        return f"<think>\n{thought}"
    return f"<think>\n{thought}\n</think>\n\n{content}"


def _read_out(
    choice: Mapping[str, Any], request: Request, prompt_tokens: int | None, completion_tokens: int | None
) -> Said:
    """The letters' probabilities out of the likeliest tokens.

    A letter that is not listed is no likelier than the least likely token that is, nor, with all others that
    are not listed, than what is left: it gets the most that it can have. `label_mass` is that of the listed.
    """
    try:
        listed = [(t["token"], float(t["logprob"])) for t in choice["logprobs"]["content"][0]["top_logprobs"]]
        p = [math.exp(logprob) for _, logprob in listed]
    except (LookupError, TypeError, ValueError, OverflowError):
        return Said(error="the server gives no log-probabilities")
    names = letters(request.actions)
    found = {
        letter: math.fsum(x for x, (token, _) in zip(p, listed, strict=True) if token == letter)
        for letter in names
    }
    mass = math.fsum(found.values())
    if not 0 < math.fsum(p) <= 1.001:
        return Said(error="the server's log-probabilities are none")
    if not mass:
        return Said(error=f"none of the letters {names} is among the {len(p)} likeliest tokens")
    tokens = {token for token, _ in listed}
    missing = [letter for letter in names if letter not in tokens]
    left = max(0.0, 1.0 - math.fsum(p))
    shares = [min(min(p), left / len(missing)) if x in missing else found[x] for x in names]
    return Said(stated(request.actions, shares), "stop", prompt_tokens, completion_tokens, min(1.0, mass))


def _count(value: Any) -> int | None:
    return value if type(value) is int and value >= 0 else None
