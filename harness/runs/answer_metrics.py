"""The metrics of answers by role: how they were read, how long they are, what read-outs hold."""

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from msgspec import UNSET

from harness.core.arrays import Floats
from harness.core.figures import PERCENT, Unit
from harness.parsing.status import Repair
from harness.runs.metric import COUNT, SCORE, Answers, Better, Metric
from harness.runs.records import Role, role_word


def _of_field(name: str) -> Callable[[Answers], Floats]:
    """Build the function of one field of answers, NaN where it is not stated."""

    def values(answers: Answers) -> Floats:
        numbers = [getattr(answer, name) for answer in answers]
        return np.array([np.nan if v is None or v is UNSET else v for v in numbers], dtype=float)

    return values


def _verdict(verdict: str) -> Callable[[Answers], Floats]:
    return lambda answers: np.array([answer.verdict == verdict for answer in answers], dtype=float)


def _divided(answers: Answers) -> Floats:
    divided = np.array([Repair.DIVIDED in answer.repairs for answer in answers], dtype=float)
    return divided if divided.any() else np.full(len(answers), np.nan)


def _valid(turns: int) -> Callable[[Answers], Floats]:
    """Build the function of the answers that are valid after so many turns,
    where any needed two.
    """

    def values(answers: Answers) -> Floats:
        if all(answer.turns == 1 for answer in answers):
            return np.full(len(answers), np.nan)
        return np.array([a.verdict != "failed" and a.turns <= turns for a in answers], dtype=float)

    return values


def _label(name: str, role: Role) -> str:
    """Return a label for people."""
    return f"{name} {role_word(role)}".replace("_", " ")


def answer_metrics(roles: Sequence[Role]) -> Iterator[Metric]:
    """Yield the metrics on models' answers themselves, such as the share that could be parsed.

    A role is who answers, and to what: `ego`, `helper`, or `merge` (the ego again, with the
    messages that it heard). Each of `roles` has metrics of its own, in the order of a summary's
    rows.
    """
    rates: tuple[tuple[tuple[str, str, Better, Callable[[Answers], Floats]], ...], ...] = (
        (
            (
                "strict_rate",
                "share of answers that fit the schema as they are",
                "higher",
                _verdict("strict"),
            ),
            (
                "recovered_rate",
                "share of answers that were read after repairs",
                "neither",
                _verdict("recovered"),
            ),
            ("failed_rate", "share of answers that could not be read", "lower", _verdict("failed")),
            (
                "divided_rate",
                "share of answers whose numbers were divided by their sum",
                "lower",
                _divided,
            ),
            (
                "flip_rate",
                "share of read-outs whose likeliest action changes with the order of the list",
                "lower",
                _of_field("flipped"),
            ),
        ),
        (
            (
                "valid_at_first_rate",
                "share of answers that could be read without a repair turn",
                "higher",
                _valid(1),
            ),
            (
                "valid_after_repair_rate",
                "share of answers that could be read after the repair turn",
                "higher",
                _valid(2),
            ),
        ),
    )
    for group in rates:
        for role in roles:
            for name, meaning, better, values in group:
                yield Metric(
                    f"{name}_{role}",
                    meaning,
                    PERCENT,
                    better,
                    "rate",
                    1.0,
                    label=_label(name, role),
                    answers=values,
                    role=role,
                )
    in_letters = "probability of the letters together, in a read-out"
    by_letter = "part of a read-out that follows the letter and not the action"
    one_letter = "share of read-outs in which one letter is the likeliest in every order"
    lengths: tuple[tuple[str, str, Unit, Better, float], ...] = (
        ("prompt_tokens", "tokens of a prompt", COUNT, "lower", math.inf),
        ("completion_tokens", "tokens of an answer", COUNT, "lower", math.inf),
        ("label_mass", in_letters, SCORE, "higher", 1.0),
        ("letter_share", by_letter, SCORE, "lower", 1.0),
        ("follows_letter", one_letter, SCORE, "lower", 1.0),
    )
    for role in roles:
        for name, meaning, unit, better, most in lengths:
            values = _of_field(name)
            label = _label(name, role)
            yield Metric(
                f"{name}_{role}",
                meaning,
                unit,
                better,
                most=most,
                label=label,
                answers=values,
                role=role,
            )
