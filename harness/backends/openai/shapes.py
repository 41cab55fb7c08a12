"""Build the JSON request for an OpenAI-compatible server, and read its answer.

Servers differ in how a constrained answer is asked for. Whatever they promise, `harness.parsing.parse`
decides whether an answer is valid.
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
from harness.backends.chat_template import with_system
from harness.backends.servers import Kind, Server
from harness.core.files import canonical_json
from harness.core.image import Image
from harness.prompts.answer_schema import answer_schema
from harness.prompts.readout import letters, stated

TOP = 20  # most log-probabilities that servers give for one token
# Temperature 0 is not enough: by default some servers penalise repetition (llama_cpp.server by 1.1, vLLM by
# the checkpoint's generation_config.json), and JSON repeats itself.
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


@dataclass(frozen=True)
class Said:
    """A server's answer in the fields of a completion; if there is an `error`, the others mean nothing."""

    text: str = ""
    finish_reason: FinishReason = "error"
    prompt_tokens: int | None = None
    completion_tokens: int | None = None
    label_mass: float | None = None
    error: str | None = None


def data_url(image: Image) -> str:
    """Encode a picture as the URL that a server is sent."""
    return f"data:image/png;base64,{b64encode(image.png()).decode()}"


def digest_url(image: Image) -> str:
    """Return the short URL that stands for a picture where a request is shown or stored."""
    return f"sha256:{image.sha256}"


def body(
    card: Card, server: Server, request: Request, url: Callable[[Image], str] = data_url
) -> dict[str, Any]:
    """Build the JSON request of one chat completion, not streamed; `url` gives the URL of its picture."""
    picture = request.image and {"type": "image_url", "image_url": {"url": url(request.image)}}
    json_body: dict[str, Any] = {
        "model": card.weights,
        # Plain text is not sent as parts, since not every server and chat template takes them.
        "messages": [
            in_parts([message], picture)[0] if picture and "image" in message else dict(message)
            for message in with_system(request.messages, card.system)
        ],
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
        json_body |= _constraint(server.kind, request)
    if request.answer == "readout":
        json_body |= {"max_tokens": 1, "logprobs": True, "top_logprobs": TOP}
    return json_body


def _constraint(kind: Kind, request: Request) -> dict[str, Any]:
    schema = answer_schema(request.role, request.actions, form=request.form)
    schema = {key: value for key, value in schema.items() if key not in ("$schema", "title")}
    if "evidence" in schema["properties"]:  # as with local engines, a constrained answer has no free text
        schema["properties"] = {**schema["properties"], "evidence": {"type": "string", "enum": [""]}}
    # With a JSON Schema most servers allow numbers of any length, or outside 0..1; two decimals prevent both.
    if kind == "vllm":
        return {"structured_outputs": {"regex": _pattern(schema, re.escape)}}
    if kind in ("llama-server", "llama-cpp-python"):
        return {"grammar": f"root ::= {_pattern(schema, canonical_json)}"}
    json_schema = {"name": "answer", "strict": True, "schema": schema}
    return {"response_format": {"type": "json_schema", "json_schema": json_schema}}


def _pattern(schema: Mapping[str, Any], literal: Callable[[str], str]) -> str:
    """Write the compact JSON of a schema as a regular expression, or as a rule of llama.cpp's grammar.

    For the parts of an answer the two differ only in how `literal` text is written.
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
    """Read a chat completion. A malformed one becomes an error, in one sentence."""
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
    # An answer that a server's content filter cut off counts as cut off.
    finish_reason: FinishReason = "length" if finish in ("length", "content_filter") else "stop"
    text = _whole(thought, content or "", finish_reason, request.thinking)
    return Said(text, finish_reason, *tokens)


def _whole(thought: str | None, content: str, finish_reason: FinishReason, asked: bool) -> str:
    """Restore the text as the model wrote it, if the server took out the thought: the parser looks for it.

    An answer that was cut off with nothing after the thought was cut off inside it, so it stays open.
    """
    if not thought and not (asked and thought is not None):
        return content
    if finish_reason == "length" and not content.strip():
        return f"<think>\n{thought}"
    return f"<think>\n{thought}\n</think>\n\n{content}"


def _read_out(
    choice: Mapping[str, Any], request: Request, prompt_tokens: int | None, completion_tokens: int | None
) -> Said:
    """Read the letters' probabilities from the list of the likeliest tokens.

    A letter that is not listed is at most as likely as the least likely listed token, and all such letters
    together have at most the remaining probability; each gets the most that it can have. `label_mass` counts
    the listed letters only.
    """
    try:
        listed = [(t["token"], float(t["logprob"])) for t in choice["logprobs"]["content"][0]["top_logprobs"]]
        p = [math.exp(logprob) for _, logprob in listed]
    except (LookupError, TypeError, ValueError, OverflowError):
        return Said(error="the server gives no log-probabilities")
    names = letters(request.actions)
    listed_p = {
        letter: math.fsum(x for x, (token, _) in zip(p, listed, strict=True) if token == letter)
        for letter in names
    }
    mass = math.fsum(listed_p.values())
    if not 0 < math.fsum(p) <= 1.001:
        return Said(error="the server's log-probabilities are none")
    if not mass:
        return Said(error=f"none of the letters {names} is among the {len(p)} likeliest tokens")
    tokens = {token for token, _ in listed}
    missing = [letter for letter in names if letter not in tokens]
    rest = max(0.0, 1.0 - math.fsum(p))
    shares = [min(min(p), rest / len(missing)) if x in missing else listed_p[x] for x in names]
    return Said(stated(request.actions, shares), "stop", prompt_tokens, completion_tokens, min(1.0, mass))


def _count(value: Any) -> int | None:
    return value if type(value) is int and value >= 0 else None
