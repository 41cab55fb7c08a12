"""A look at a language model before any run: what it reads, token by token, and how fast it answers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from harness.backends.base import AnswerMode, Completion, Rendering, Request
from harness.backends.cards import Thinking
from harness.backends.chat import Chat
from harness.core.errors import UserError

Pictured = tuple[Request, Request, Request]  # with what the cameras see, with a blank picture, with none


@dataclass(frozen=True)
class Looks:
    """What a model does with the picture of an image prompt.

    Attributes:
        answers: one answer an answer mode, to what the cameras see.
        blank: the same to a blank picture in its place.
        text: an answer to the text alone, in the last answer mode that it answered in.
    """

    answers: dict[AnswerMode, Completion]
    blank: dict[AnswerMode, Completion]
    text: Completion | None

    @property
    def fault(self) -> str | None:
        """Why it takes no pictures; None if it does.

        One that answers all pictures alike still reads them if they are tokens in its prompt.
        """
        if self.text is None:
            [error, *_] = (a.error for a in (*self.answers.values(), *self.blank.values()) if a.error)
            return f"answers no prompt with a picture: {error}"
        both = [(answer, self.blank[way]) for way, answer in self.answers.items()]
        if any(a.text != b.text for a, b in both if not (a.error or b.error)):
            return None
        counts = [answer.prompt_tokens for answer, _ in both if answer.prompt_tokens is not None]
        text = self.text.prompt_tokens
        if text is None or not counts:
            return "ignores pictures: the same answers to a frame and to a blank one"
        if max(counts) > text:
            return None
        return (
            "ignores pictures: the same answers to a frame and to a blank one, and as many prompt tokens as "
            "without any"
        )


@dataclass(frozen=True)
class Checkup:
    """What a look at a model shows.

    Attributes:
        prompt: the first question, just as the model reads it; as a server is sent it.
        tokens: its token ids, each with its text; None where only a server knows them.
        bos_tokens: how many of them begin a sequence; more than one harms most models.
        thinking: what the model's own template can do, whatever its card says; None where a server has it.
        answers: one answer an answer mode, asked alone after a warm-up; its seconds are batch-1 seconds.
        identity: as in a run's manifest.
        looks: what it does with pictures; None if its card says that it takes none.
    """

    prompt: str
    tokens: list[tuple[int, str]] | None
    bos_tokens: int | None
    thinking: Thinking | None
    answers: dict[AnswerMode, Completion]
    identity: dict[str, Any]
    looks: Looks | None = None


def check(backend: Rendering, asked: Sequence[Request], shown: Sequence[Pictured] = ()) -> Checkup:
    """Look at a model by some questions, one an answer mode.

    Args:
        backend: the model.
        asked: the questions.
        shown: those of an image prompt; none for a model of texts.
    """
    [prompt] = backend.rendered(asked[:1])
    chat: Chat | None = getattr(backend, "chat", None)
    ids = chat.encode(prompt) if chat else []
    return Checkup(
        prompt=prompt,
        tokens=list(zip(ids, chat.pieces(ids), strict=True)) if chat else None,
        bos_tokens=ids.count(chat.bos) if chat and chat.bos is not None else (0 if chat else None),
        thinking=chat.thinking if chat else None,
        answers={request.answer: _answer(backend, request) for request in asked},
        identity=backend.identity(),
        looks=_looks(backend, shown) if shown else None,
    )


def _looks(backend: Rendering, shown: Sequence[Pictured]) -> Looks:
    answers = {own.answer: _answer(backend, own) for own, _, _ in shown}
    others = {blank.answer: _answer(backend, blank, warm=True) for _, blank, _ in shown}
    answered = [text for _, _, text in shown if not (answers[text.answer].error or others[text.answer].error)]
    return Looks(answers, others, _answer(backend, answered[-1], warm=True) if answered else None)


def _answer(backend: Rendering, request: Request, warm: bool = False) -> Completion:
    """The answer to a question, asked alone, behind another one where the model is not `warm` yet."""
    try:
        if warm:
            return backend.complete([request])[0]
        # The first answer pays for kernels and caches. As in a run, its system prompt is the same and its
        # scene is another.
        *head, last = request.messages
        other = {**last, "content": f"Another scene. {last['content']}"}
        backend.complete([replace(request, messages=(*head, other))])
        [completion] = backend.complete([request])
    except UserError as error:  # the tokenizer or the server leaves no room for this answer mode
        return Completion(request.id, "", None, None, "error", None, 1, str(error))
    return completion
