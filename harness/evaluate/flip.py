"""Ask a read-out once more with the list of actions reversed: does its likeliest action change?

It measures how much the place in the list decides. It is a request of its own, so that the answer,
its tokens and its time stay those of the list as it stands.
"""

from msgspec import UNSET, structs

from harness.backends.base import Request
from harness.runs.records import Answer

# shares that differ by the last digit of a read-out's text, a millionth, are equally likely
STEP = 1.5e-6


def wanted(request: Request, answer: Answer) -> bool:
    """Return whether a read-out is to be asked again with its list of actions reversed.

    A read-out is an answer by one letter per action. That needs an answer to compare with, and a
    request that has the reversed chats (`flips`).
    """
    return bool(request.flips) and answer.intent is not None and answer.flipped is UNSET


def mirror_request(request: Request) -> Request:
    """Return the request that asks the same with the list of actions reversed.

    The request must have the reversed chats (`flips`).
    """
    messages, *orders = request.flips
    return request.alike(
        messages=messages, orders=tuple(orders), flips=(), actions=request.actions[::-1]
    )


def compared(answer: Answer, mirror: Answer) -> Answer:
    """Return `answer` with a note on whether its likeliest action differs in a reversed list.

    `mirror` is the answer to the same question with the list of actions reversed; the note is the
    field `flipped`. `answer` stays as it is if either did not parse.
    """
    if answer.intent is None or mirror.intent is None:
        return answer
    return structs.replace(
        answer, flipped=not _likeliest(answer.intent) & _likeliest(mirror.intent[::-1])
    )


def _likeliest(p: tuple[float, ...]) -> set[int]:
    return {action for action, share in enumerate(p) if share > max(p) - STEP}
