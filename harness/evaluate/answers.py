"""Make the answer that a model's completion of a request gives: its text parsed, with its facts."""

from typing import TypeVar

import msgspec
from msgspec import UNSET, UnsetType

from harness.backends.base import Completion, Request
from harness.core.files import sha256_bytes
from harness.parsing.parse import parse
from harness.runs.records import ASKED, Answer, Role

T = TypeVar("T")
_TEXTS = msgspec.json.Encoder(order="sorted")  # as `canonical_bytes`, where there is no number


def answer_of(request: Request, completion: Completion) -> Answer:
    """Parse a model's completion of a request, and return the answer as a run records it.

    It has the completion's facts, too, such as its tokens, its time in s and why it ended. If the
    text cannot be parsed, the status says why.
    """
    raw = completion.text
    scene, _, viewers = request.id.partition("/")
    key, *heard = viewers.split("+")
    viewer, _, question = key.partition(ASKED)
    role: Role = "merge" if heard else question or request.role
    parsed = parse(
        raw,
        **request.shape._asdict(),
        thinking=request.thinking,
        reasons_first=request.reasons_first,
        divides=request.divides,
        finish_reason=completion.finish_reason,
        error=completion.error,
    )
    prompt_sha256, image_sha256 = digests(request)
    return Answer(
        scene=scene,
        viewer=viewer,
        heard=tuple(heard),
        role=role,
        raw=raw,
        finish_reason=completion.finish_reason,
        error=completion.error,
        prompt_tokens=completion.prompt_tokens,
        completion_tokens=completion.completion_tokens,
        seconds=completion.seconds,
        batch_size=completion.batch_size,
        label_mass=completion.label_mass,
        retries=completion.retries,
        cached=completion.cached,
        slow_s=completion.slow_s,
        first_token_s=completion.first_token_s,
        token_s=completion.token_s,
        letter_share=_or_unset(completion.letter_share),
        follows_letter=_or_unset(completion.follows_letter),
        flipped=_or_unset(completion.flipped),
        prompt_sha256=prompt_sha256,
        image_sha256=image_sha256,
        status=str(parsed.status),
        verdict=parsed.verdict,
        repairs=tuple(map(str, parsed.repairs)),
        intent=parsed.intent,
        mass=parsed.mass,
        message=parsed.message,
        detail=parsed.detail,
        faults=tuple(map(str, parsed.faults)) if len(parsed.faults) > 1 else UNSET,
        extension=_or_unset(parsed.extension),
    )


def digests(request: Request) -> tuple[str, str | UnsetType]:
    """Return SHA-256 digests, in hex, of a request's chat and picture; unset without one."""
    return sha256_bytes(_TEXTS.encode(request.messages)), request.image_sha256 or UNSET


def _or_unset(value: T | None) -> T | UnsetType:
    return UNSET if value is None else value
