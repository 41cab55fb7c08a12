"""What `run.json` counts of a run's answers."""

from collections.abc import Iterable

from harness.runs.records import Answer, AnswerFacts


def counts(answers: Iterable[Answer | AnswerFacts]) -> dict[str, int]:
    """Return by field of `run.json` how many answers came from the cache, and how many are errors.

    `retries` is the number of attempts that failed before an answer came, over all of them.
    """
    answers = list(answers)
    return {
        "cached_answers": sum(answer.cached for answer in answers),
        "engine_errors": sum(answer.error is not None for answer in answers),
        "retries": sum(answer.retries for answer in answers),
    }
