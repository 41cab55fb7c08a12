"""`POST /v1/decisions`, as OpenAI has it (openai-python, types/decision_create_params.py and
decision.py).
"""

from collections.abc import Sequence
from typing import Annotated, Any

from msgspec import Meta, Struct

from harness.extensions.decide.asked import (
    MOST_QUESTIONS,
    Answered,
    Asked,
    Enquiry,
    Refusal,
    text_of,
    with_options,
)
from harness.prompts.decision import Question


class Text(Struct, tag_field="type", tag="input_text"):
    """Hold a part of a message or of instructions that is text, of type `input_text`."""

    text: str  # the text


class Json(Struct, tag_field="type", tag="input_json"):
    """Hold a part of a message or of instructions that is JSON data, of type `input_json`."""

    data: dict[str, Any] | list[Any]  # what JSON states; the model reads it as JSON


class Picture(Struct, tag_field="type", tag="input_image"):
    """Hold a part of a message that is a picture, of type `input_image`, in a data URL."""

    image_url: str  # a data URL, which holds the picture


Part = Text | Json | Picture


class Message(Struct):
    """Hold a message of a request's input: some of the state that its questions are about.

    `content` is a text, or parts of text, JSON and pictures. `role` is who says it; others than
    `user` are refused.
    """

    content: str | list[Part]  # a part of the state that the questions are about
    role: str  # who says it


class Option(Struct):
    """Hold one option of a `Choice`: its `value`, as the answer names it, and what it means."""

    value: str | bool  # the option, as the answer names it
    description: str | None = None  # its meaning


class Choice(Struct, tag_field="type", tag="choice"):
    """Ask which of several options is right; the answer names one, with all probabilities.

    `instructions` say what is asked, in text or JSON, and `choices` are the options in their order.
    The answer repeats `name`.
    """

    instructions: str | list[Part]  # what is asked; no pictures
    choices: list[Option]  # the options, in their order
    name: str | None = None  # the question's name, which the answer repeats


class Level(Struct):
    """Hold one level of a `Score`: its `label`, as the answer names it, and what it means."""

    label: str  # the level's name, as the answer states it
    description: str | None = None  # its meaning


class Score(Struct, tag_field="type", tag="score"):
    """Ask for a level on a scale; the answer is the mean of the levels, numbered from 0.

    `instructions` say what is asked, in text or JSON, and `levels` are listed from the lowest. The
    answer repeats `name`.
    """

    instructions: str | list[Part]  # what is asked; no pictures
    levels: list[Level]  # the levels, the lowest first
    name: str | None = None  # the question's name, which the answer repeats


class Predicate(Struct, tag_field="type", tag="predicate"):
    """Ask whether a statement is true; the answer is the probability that it is.

    `instructions` state it, in text or JSON. The answer repeats `name`.
    """

    instructions: str | list[Part]  # the statement; no pictures
    name: str | None = None  # the question's name, which the answer repeats


class Body(Struct):
    """Hold the JSON of a request to `/v1/decisions`; fields that are not listed are ignored.

    `input` is the state that all `questions` are about, a text or messages; each question is asked
    by itself. `model` is the name of the model that is asked; None takes the one that is served.
    """

    input: str | list[Message]  # the state that all questions are about
    # what is asked, each by itself
    questions: Annotated[
        list[Choice | Score | Predicate], Meta(min_length=1, max_length=MOST_QUESTIONS)
    ]
    model: str | None = None  # name of the model that is asked; None takes the served one


def read(body: Body) -> Enquiry:
    """Return the questions of a request to `/v1/decisions`, as texts for the model.

    Raises Refusal if it holds what is not supported, such as a message of another role than `user`.
    """
    messages = body.input
    contents = [messages] if isinstance(messages, str) else [_user(each) for each in messages]
    texts, images = list[str](), list[str]()
    for content in contents:
        text, urls = _read(content)
        texts.append(text)
        images += urls
    state = "\n".join(texts)
    questions = tuple(_question_of(question, state) for question in body.questions)
    return Enquiry(body.model, questions, tuple(images))


def _user(message: Message) -> str | list[Part]:
    """Return the content of a user's message. Raises Refusal for that of another role."""
    if message.role != "user":
        raise Refusal(
            "input has a message of another role than user; put what it says into the user's"
        )
    return message.content


def _read(content: str | list[Part]) -> tuple[str, list[str]]:
    """Return the text of some content, its parts on lines of their own, and its pictures' URLs."""
    if isinstance(content, str):
        return content, []
    texts, urls = list[str](), list[str]()
    for part in content:
        if isinstance(part, Picture):
            urls.append(part.image_url)
        else:
            texts.append(part.text if isinstance(part, Text) else text_of(part.data))
    return "\n".join(texts), urls


def _question_of(question: Choice | Score | Predicate, state: str) -> Asked:
    """Return a question of a request with its options. Raises Refusal if it has a picture."""
    instructions, images = _read(question.instructions)
    if images:
        raise Refusal("a question's instructions hold a picture; put it into the input")
    match question:
        case Choice(choices=choices):
            options = [(option.value, option.description) for option in choices]
            return with_options(question.name, Question(state, instructions, {}), options)
        case Score(levels=levels):
            options = []
            for number, level in enumerate(levels):
                description = f": {level.description}" if level.description else ""
                options.append((str(number), f"{level.label}{description}"))
            whole = with_options(question.name, Question(state, instructions, {}, "score"), options)
            return Asked(whole.name, whole.question, tuple(level.label for level in levels))
        case Predicate():
            outcomes = [(option, None) for option in ("true", "false")]
            return with_options(question.name, Question(state, instructions, {}, "noul"), outcomes)


def write(model: str, answers: Sequence[Answered]) -> dict[str, Any]:
    """Return the JSON of the response of `/v1/decisions`, as plain values.

    The answers are in the order of the questions; `model` is the served model's name. Token counts
    are 0 where nobody counts them.
    """
    read = sum(each.tokens or 0 for each in answers)
    usage = {
        "input_tokens": read,
        "input_tokens_details": {"cache_write_tokens": 0, "cached_tokens": 0},
        "output_tokens": 0,
        "output_tokens_details": {"reasoning_tokens": 0},
        "total_tokens": read,
    }
    return {"model": model, "answers": [_answer(each) for each in answers], "usage": usage}


def _answer(answer: Answered) -> dict[str, Any]:
    name = {"name": answer.asked.name}
    if answer.shares is None:
        return {"type": "refusal", **name}
    kind, values, shares = answer.asked.question.kind, answer.asked.values, answer.shares
    if kind == "noul":
        return {
            "type": "predicate",
            **name,
            "probability": shares[answer.asked.options.index("true")],
        }
    pairs = list(zip(values, shares, strict=True))
    if kind == "score":
        levels = [
            {"value": n, "label": label, "probability": p} for n, (label, p) in enumerate(pairs)
        ]
        score = {
            "score": answer.mean_level,
            "confidence": answer.confidence,
            "probabilities": levels,
        }
        return {"type": "score", **name, **score}
    listed = [{"value": value, "probability": p} for value, p in pairs]
    chosen = {"choice": values[answer.choice], "confidence": answer.confidence}
    return {"type": "choice", **name, **chosen, "probabilities": listed, **answer.acted}
