"""The backend of a file of answers that another program wrote, found by what was asked.

A question's id is the digest of all that is asked, so that no answer is taken for another question.
What the file states of an answer's tokens and seconds is bounded, and never timed or counted here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from harness.backends.base import Completion, Request, Text, failed
from harness.backends.card import Card, Sha256
from harness.backends.registry import BUILT_IN, capabilities
from harness.backends.token_counts import MOST_TOKENS, too_few
from harness.core.config import Seconds
from harness.core.errors import UserError, printable
from harness.core.files import bytes_of, digest, sha256_bytes
from harness.prompts.answer_schema import Shape, answer_schema

Why = Annotated[str, Meta(min_length=1, max_length=300)]
Tokens = Annotated[int, Meta(ge=0, le=MOST_TOKENS)]


class AnswerLine(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Hold one line of a file of answers: the text that answers a question, or why there is none.

    `id` is the question's. `tokens` are those of the text, and `seconds` how long it took; nobody
    here counted or timed them.
    """

    id: Sha256  # of the question
    text: Text | None = None  # the answer; None if there is none
    error: Why | None = None  # why there is none
    tokens: Tokens | None = None  # that the text has; None if nobody counted
    seconds: Seconds | None = None  # that it took; None if nobody timed it

    def __post_init__(self) -> None:
        if (self.text is None) == (self.error is None):
            raise ValueError("give a text or an error")


@dataclass(frozen=True)
class Question:
    """Hold a question as another program is asked it: a JSON object, and the id that it goes by.

    `content` has `role`, `messages`, `schema`, `max_tokens` and `thinking`; `id` is its digest.
    """

    id: str  # the digest of `content`
    content: Mapping[str, Any]  # all that is asked, as JSON values by name

    @classmethod
    def of(cls, request: Request) -> "Question":
        """Return the question of a request, whose id stays the same in every scene and run."""
        content = {
            "role": request.role,
            "messages": [dict(message) for message in request.messages],
            "schema": _schema(request.shape),
            "max_tokens": request.max_tokens,
            "thinking": request.thinking,
        }
        return cls(digest(content), content)

    def line(self) -> bytes:
        """Return the question as a line of JSON, its id first."""
        return msgspec.json.encode({"id": self.id, **self.content}) + b"\n"


@lru_cache
def _schema(shape: Shape) -> Mapping[str, Any]:
    return answer_schema(**shape._asdict())


def open(card: Card, **_: Any) -> "AnswersFile":
    """Return the backend that answers from the file which a card names; other options are ignored.

    Raises UserError if the file cannot be read, or a line of it is no answer or the second to a
    question.
    """
    return AnswersFile(Path(card.weights or ""))


class AnswersFile:
    """Answer requests from a file, and note what it was asked and what it lacks.

    `complete` raises UserError for an answer that states fewer tokens than its text can have.

    Attributes:
        path: the file.
        answers: its lines, by the question's id.
        asked: the ids of the questions that were asked.
        left: the questions that the ego or a fusion call needs an answer to, and helpers' that the
            file does not name, by id; a fusion call asks the ego again, with messages.
        refused: helpers' questions to which the file has an error, by id.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            content = bytes_of(path, "record")
        except OSError as error:
            reason = printable(error.strerror)
            raise UserError(
                f"--answers {printable(path)} cannot be read ({reason}); give the file of answers, "
                "a JSON line each"
            ) from None
        self._sha256 = sha256_bytes(content)
        self.answers = _lines(path, content)
        self.asked = set[str]()
        self.left, self.refused = dict[str, Question](), dict[str, Question]()

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        return [self._completion(request) for request in requests]

    def _completion(self, request: Request) -> Completion:
        question = Question.of(request)
        self.asked.add(question.id)
        line = self.answers.get(question.id)
        if line is None or line.text is None:
            is_needed = line is None or request.role == "ego"
            (self.left if is_needed else self.refused)[question.id] = question
            reason = line.error if line else None
            return failed(request, reason or f"{self.path.name} has no answer")
        can = capabilities("answers-file")
        if few := too_few(request, can, line.text, None, line.tokens):
            raise UserError(
                f"--answers {printable(self.path)}: answer {line.id} states {few}, too few; give "
                "their number, or leave it out"
            )
        return Completion(request.id, line.text, None, line.tokens, "stop", line.seconds, 1)

    def identity(self) -> dict[str, Any]:
        return {
            "engine": "answers-file",
            "answers": BUILT_IN["answers-file"].answers,
            "answers_sha256": self._sha256,
        }


def _lines(path: Path, content: bytes) -> dict[str, AnswerLine]:
    """Return the lines of a file of answers by id."""
    decoder = msgspec.json.Decoder(AnswerLine)
    answers: dict[str, AnswerLine] = {}
    for number, line in enumerate(content.splitlines(), 1):
        where = f"--answers {printable(path)}, line {number}"
        try:
            answer = decoder.decode(line)
        except (ValueError, RecursionError) as error:
            raise UserError(
                f"{where} is no answer ({printable(error)}); give an object with id and text, or "
                "id and error"
            ) from None
        if answer.id in answers:
            raise UserError(f"{where} answers {answer.id} once more; give one answer to each id")
        answers[answer.id] = answer
    return answers
