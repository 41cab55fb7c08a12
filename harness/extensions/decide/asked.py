"""What a client asks: one state, and typed questions about it, whatever the wire shape."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from harness.backends.base import Completion
from harness.core.depth import MOST_DEPTH, shallow
from harness.core.errors import printable
from harness.prompts.decision import Question

MOST_QUESTIONS = 64  # of one request
MOST_OPTIONS = 255  # of one question, as other servers of the class


class Refusal(Exception):
    """Signal that a client's request gets no answer, and why.

    `words` is one line for the client, `status` the HTTP status, such as 429, and `code` a short
    name of the reason for programs, such as `busy`.
    """

    def __init__(self, words: str, status: int = 400, code: str = "invalid_request") -> None:
        super().__init__(words)
        self.words, self.status, self.code = words, status, code


@dataclass(frozen=True)
class Asked:
    """Hold one question of a client's request, with its options as the client writes them.

    `question` has the state (what all is about), the instructions, and each option's meaning, as
    texts for the model. `values` has the options in their order, as the response is to name them;
    `name` is that of the question in the request, None if it has none.
    """

    name: str | None  # name of the question in the client's request, if it has one
    question: Question  # state, instructions, and each option's meaning
    values: tuple[Any, ...]  # its options as the client writes them, in their order

    @property
    def options(self) -> tuple[str, ...]:
        return tuple(self.question.meanings)

    @property
    def length(self) -> int:
        """Return how many characters the question takes: state, instructions, options and meanings.

        Questions that are too long are refused by it.
        """
        meanings = self.question.meanings
        texts = (self.question.state, self.question.instructions, *meanings, *meanings.values())
        return sum(len(text or "") for text in texts)


@dataclass(frozen=True)
class Enquiry:
    """Hold a client's request, whatever its JSON looks like: questions about one state.

    `model` is the name of the model that it asks for; None takes the one that is served. `images`
    has the data URLs of pictures that the model is shown before the state.
    """

    model: str | None  # name of the model that it asks for; None takes the served one
    # the questions with their options, each asked by itself
    questions: tuple[Asked, ...]
    images: tuple[str, ...] = ()  # URLs of the pictures before the state


class Act(NamedTuple):
    """Hold how to act on an answer: alone, carefully, or after helpers are asked.

    `choice` is the index of the option to take, also where helpers are asked and nobody is heard.
    """

    word: str  # `alone`, `careful` or `ask`
    choice: int  # index of the option to take


@dataclass(frozen=True)
class Answered:
    """Hold the answer to one question: a probability for each of its K options.

    `shares`, (K,), are in the order of the question's options, as the model states them, and None
    if it refused. `tokens` is the number of prompt tokens, None if nobody counts them. `act` says
    how to act on the answer, None where the server keeps no condition.
    """

    # the question, with its options
    asked: Asked
    # probability of each option, as the model states it; None where the model refused
    shares: tuple[float, ...] | None
    tokens: int | None  # number of prompt tokens; None if nobody counts them
    act: Act | None = None  # how to act on it; None where no condition says

    @property
    def choice(self) -> int:
        """Return the index of the option to take, the likeliest unless a condition says another."""
        assert self.shares is not None
        return self.act.choice if self.act else self.shares.index(max(self.shares))

    @property
    def acted(self) -> dict[str, str]:
        """Return how to act as a field of the response, `act`; empty where no condition says."""
        return {"act": self.act.word} if self.act else {}

    @property
    def confidence(self) -> float:
        """Return how sure the answer is: (K p - 1) / (K - 1), p the greatest of K probabilities.

        It is 0 where all options are equally likely, and 1 where one is certain.
        """
        assert self.shares is not None
        k = len(self.shares)
        return min(1.0, max(0.0, (k * max(self.shares) - 1) / (k - 1)))

    @property
    def mean_level(self) -> float:
        assert self.shares is not None
        return sum(level * share for level, share in enumerate(self.shares))


def text_of(content: Any) -> str:
    """Return content of a client's request as text for the model.

    A text stays as it is; anything else, which comes from JSON, is written as JSON. Raises Refusal
    if it is nested too deep.
    """
    try:  # each level indents all below it, so that a small request could fill the memory
        shallow(content)
    except ValueError:
        raise Refusal(
            f"data is nested more than {MOST_DEPTH} deep; give it flatter", code="depth"
        ) from None
    return (
        content if isinstance(content, str) else json.dumps(content, indent=2, ensure_ascii=False)
    )


def with_options(
    name: str | None, question: Question, options: Sequence[tuple[Any, str | None]]
) -> Asked:
    """Return a client's question with its options, as an `Asked`.

    `question` has the state and instructions. Each item of `options` is an option as the client
    writes it, and its meaning or None. `name` is the question's in the request, for messages.
    Raises Refusal if there are too few options, too many, or two with the same text.
    """
    who = "a question" if name is None else f"question {printable(name, 40)!r}"
    if not 2 <= len(options) <= MOST_OPTIONS:
        raise Refusal(f"{who} has {len(options)} options; give 2 to {MOST_OPTIONS}", code="options")
    meanings = {text_of(value): meaning for value, meaning in options}
    if len(meanings) < len(options):
        raise Refusal(f"{who} has an option twice; give each once", code="options")
    full = Question(question.state, question.instructions, meanings, question.kind)
    return Asked(name, full, tuple(value for value, _ in options))


def answered(question: Asked, completion: Completion) -> Answered:
    """Return the answer to a question, read from what the model completed.

    Raises Refusal if it does not state a probability for each option; one that the model itself
    refused to answer has none and raises nothing.
    """
    if completion.finish_reason == "refusal":
        return Answered(question, None, completion.prompt_tokens)
    try:
        distribution: Mapping[str, Any] = json.loads(completion.text)["action_distribution"]
        shares = [distribution[option] for option in question.options]
    except (ValueError, LookupError, TypeError, RecursionError):
        shares = []
    if not shares or not all(type(p) in (int, float) and 0 <= p <= 1 for p in shares):
        raise Refusal("the model stated no probability of each option", 502, "no_answer")
    return Answered(question, tuple(map(float, shares)), completion.prompt_tokens)
