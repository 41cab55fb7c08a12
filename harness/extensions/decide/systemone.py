"""`POST /v1/systemone`, as TypeSafe's API and llama.cpp have it (llama.cpp,
tools/server/README.md).
"""

from collections.abc import Sequence
from typing import Annotated, Any

from msgspec import Meta, Struct

from harness.extensions.decide.asked import (
    MOST_QUESTIONS,
    Answered,
    Asked,
    Enquiry,
    text_of,
    with_options,
)
from harness.prompts.decision import Question

Content = str | dict[str, Any] | list[Any]


class Choice(Struct, tag_field="type", tag="choice"):
    """Ask which of several options is right; the answer names one, with all probabilities.

    `criteria` has the meaning of each option, by the option's text, None where nothing is said;
    `instructions` say what is asked. Both may be texts or JSON.
    """

    criteria: dict[str, Content | None]  # the meaning of each option, by the option
    instructions: Content | None = None  # what is asked


class Score(Struct, tag_field="type", tag="score"):
    """Ask for a level on a scale; the answer is the mean of the levels, numbered from 0.

    `criteria` has the meaning of each level, the lowest first; `instructions` say what is asked.
    Both may be texts or JSON.
    """

    # the meaning of each level, the lowest first
    criteria: Annotated[list[Content], Meta(min_length=2, max_length=10)]
    instructions: Content | None = None  # what is asked


class Noul(Struct, tag_field="type", tag="noul"):
    """Ask whether something is true; the answer is the probability that it is.

    `instructions` say what; `criteria` has what `true` and `false` mean, by these names. Both may
    be texts or JSON.
    """

    instructions: Content | None = None  # what is to be true
    criteria: dict[str, Content | None] | None = None  # what `true` and `false` mean


class Body(Struct):
    """Hold the JSON of a request to `/v1/systemone`; fields that are not listed are ignored.

    All `questions`, by their names, are about `state`, a text or JSON; each is asked by itself.
    `model` is the name of the model that is asked, None for the one that is served. `files`, then
    `images`, have data URLs of pictures that the model is shown before the state.
    """

    state: Content  # what all questions are about, a text or JSON
    # what is asked, each by itself, by the question's name
    questions: Annotated[
        dict[str, Choice | Score | Noul], Meta(min_length=1, max_length=MOST_QUESTIONS)
    ]
    model: str | None = None  # name of the model that is asked; None takes the served one
    images: list[str] = []  # data URLs of pictures, which stand before the state
    files: list[str] = []  # more of these; they come first


def read(body: Body) -> Enquiry:
    """Return the questions of a request to `/v1/systemone`, as texts for the model.

    Raises Refusal if it holds what is not supported, such as a question with one option.
    """
    state = text_of(body.state)
    questions = tuple(_question_of(name, each, state) for name, each in body.questions.items())
    return Enquiry(body.model, questions, (*body.files, *body.images))


def _question_of(name: str, question: Choice | Score | Noul, state: str) -> Asked:
    instructions = "" if question.instructions is None else text_of(question.instructions)
    match question:
        case Choice(criteria=criteria):
            options = [(option, _meaning(content)) for option, content in criteria.items()]
            return with_options(name, Question(state, instructions, {}), options)
        case Score(criteria=levels):
            options = [(str(level), text_of(content)) for level, content in enumerate(levels)]
            return with_options(name, Question(state, instructions, {}, "score"), options)
        case Noul(criteria=outcomes):
            options = [
                (option, _meaning((outcomes or {}).get(option))) for option in ("true", "false")
            ]
            return with_options(name, Question(state, instructions, {}, "noul"), options)


def _meaning(content: Content | None) -> str | None:
    return None if content is None else text_of(content)


def write(model: str, answers: Sequence[Answered]) -> dict[str, Any]:
    """Return the JSON of the response of `/v1/systemone`, as plain values.

    Each answer stands under its question's name; `model` is the served model's name. `input_tokens`
    is 0 where nobody counts them.
    """
    written = {each.asked.name: _answer(each) for each in answers}
    usage = {"input_tokens": sum(each.tokens or 0 for each in answers), "output_tokens": 0}
    return {"model": model, "answers": written, "usage": usage}


def _answer(answer: Answered) -> dict[str, Any]:
    if answer.shares is None:  # which these servers' documents do not know
        return {"type": "refusal"}
    kind, options = answer.asked.question.kind, answer.asked.options
    if kind == "noul":
        return {"type": kind, "noul": answer.shares[options.index("true")]}
    spread = {
        "probabilities": dict(zip(options, answer.shares, strict=True)),
        "confidence": answer.confidence,
    }
    if kind == "score":
        legend = dict(answer.asked.question.meanings)
        return {"type": kind, "score": answer.mean_level, "legend": legend, **spread}
    return {"type": kind, "choice": options[answer.choice], **spread, **answer.acted}
