"""Check a language model before a run: the prompt it reads, token by token,
its answers and their time.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from harness.backends.base import AnswerMode, Completion, Rendering, Request, failed
from harness.backends.card import Thinking
from harness.backends.chat import Chat
from harness.core.errors import UserError

# one question with a camera picture, a blank one, and none
Pictured = tuple[Request, Request, Request]


@dataclass(frozen=True)
class Looks:
    """Hold a model's answers to a prompt with a camera picture, with a blank one, and with none.

    `answers` (camera picture) and `blank` have an answer in each answer mode (way to answer, such
    as free text, `json`, or one letter, `readout`). `text` is the answer without a picture, in the
    last mode that worked; None if none did.
    """

    # answers to the camera picture, one in each answer mode, asked alone after a warm-up
    answers: dict[AnswerMode, Completion]
    blank: dict[AnswerMode, Completion]  # answers to a blank picture
    # answer without picture, in the last answer mode that worked; None if none did
    text: Completion | None

    @property
    def fault(self) -> str | None:
        """Return in words why the model takes no pictures; None if it does.

        It does if an answer to the camera picture differs from that to a blank one, or if its
        prompt has more tokens with a picture than without.
        """
        if self.text is None:
            [error, *_] = (
                a.error for a in (*self.answers.values(), *self.blank.values()) if a.error
            )
            return f"answers no prompt with a picture: {error}"
        pairs = [(answer, self.blank[mode]) for mode, answer in self.answers.items()]
        if any(a.text != b.text for a, b in pairs if not (a.error or b.error)):
            return None
        counts = [answer.prompt_tokens for answer, _ in pairs if answer.prompt_tokens is not None]
        text = self.text.prompt_tokens
        if text is None or not counts:
            return "ignores pictures: the same answers to a frame and to a blank one"
        if max(counts) > text:
            return None
        return (
            "ignores pictures: the same answers to a frame and to a blank one, and as many prompt "
            "tokens as without any"
        )


@dataclass(frozen=True)
class Checkup:
    """Hold what asking a language model a few questions showed: its prompt, tokens and answers.

    An answer mode is a way to answer, such as free text (`json`) or one letter (`readout`). A chat
    template is the model's own rule for writing a chat as one text.
    """

    prompt: str  # the first question as the model reads it, or as a server is sent it
    # its ids, each with its text; None if only a server knows them
    tokens: list[tuple[int, str]] | None
    bos_tokens: int | None  # BOS tokens that it begins with; more than one harms most models
    # text of the token that ends an answer by its chat template, if there is one
    turn_end: str | None
    thinking: Thinking | None  # what the model's own template can do; None for a server's
    # one answer in each answer mode, asked alone after a warm-up; the seconds are of batch size 1
    answers: dict[AnswerMode, Completion]
    identity: dict[str, Any]  # what tells the model apart, such as its weights' digest
    # answers to pictures; None if the card says that the model takes none
    looks: Looks | None = None


def check(
    backend: Rendering,
    requests: Sequence[Request],
    pictured: Sequence[Pictured] = (),
    progress: Callable[[int], None] = lambda done: None,
) -> Checkup:
    """Check a language model: ask it some questions, one in each answer mode, and show its prompt.

    An answer mode is a way to answer, such as free text (`json`) or one letter (`readout`).
    `backend` runs the model. For one that takes pictures, `pictured` has in each answer mode the
    same question three times: with a camera picture, with a blank one, and with none. `progress` is
    called with 1 after each answer. Returns the prompt as the model reads it, and its answers.
    """

    def answer(request: Request, warm: bool = False) -> Completion:
        completion = _answer(backend, request, warm)
        progress(1)
        return completion

    [prompt] = backend.rendered(requests[:1])
    chat: Chat | None = getattr(backend, "chat", None)
    ids = chat.encode(prompt) if chat else []
    turn_end = None
    if chat and chat.turn_end is not None:
        [turn_end] = chat.pieces([chat.turn_end])
    return Checkup(
        prompt=prompt,
        tokens=list(zip(ids, chat.pieces(ids), strict=True)) if chat else None,
        bos_tokens=_count_of_first(ids, chat.bos) if chat else None,
        turn_end=turn_end,
        thinking=chat.thinking if chat else None,
        answers={request.answer: answer(request) for request in requests},
        identity=backend.identity(),
        looks=_looks(answer, pictured) if pictured else None,
    )


def _count_of_first(ids: Sequence[int], token: int | None) -> int:
    """Return how many of the first ids are a token."""
    return next((n for n, each in enumerate(ids) if each != token), len(ids))


def _looks(answer: Callable[..., Completion], pictured: Sequence[Pictured]) -> Looks:
    answers = {with_picture.answer: answer(with_picture) for with_picture, _, _ in pictured}
    blanks = {blank.answer: answer(blank, warm=True) for _, blank, _ in pictured}
    answered = [
        text
        for _, _, text in pictured
        if not (answers[text.answer].error or blanks[text.answer].error)
    ]
    return Looks(answers, blanks, answer(answered[-1], warm=True) if answered else None)


def _answer(backend: Rendering, request: Request, warm: bool = False) -> Completion:
    """Ask one question alone; unless the model is `warm`, ask another one first."""
    try:
        if warm:
            return backend.complete([request])[0]
        # The first answer's time includes loading kernels and caches. As in a run, the first
        # question has the same system prompt and another scene.
        *head, last = request.messages
        message = {**last, "content": f"Another scene. {last['content']}"}
        backend.complete([replace(request, messages=(*head, message))])
        [completion] = backend.complete([request])
    except UserError as error:  # the tokenizer or the server leaves no room for this answer mode
        return failed(request, str(error))
    return completion
