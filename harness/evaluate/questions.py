"""Write an evaluation's questions for another program, and see that all have got their answers.

What is asked depends on what was answered: an action leads to the next scene, and a fusion call
shows the messages. So the questions leave in rounds, until the file of answers lacks none.
"""

import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, cast

from harness.backends.answers_file import AnswersFile, Question
from harness.backends.base import Request
from harness.backends.registry import open_backend
from harness.core.errors import Unanswered, UserError, printable
from harness.core.figures import amount
from harness.core.files import replacing
from harness.core.formats import QUESTIONS
from harness.dataset.load import TREES_AT_ONCE, Dataset
from harness.evaluate import latency as latencies
from harness.evaluate.asking import Asker
from harness.evaluate.dry_run import planned
from harness.evaluate.frozen_world import FrozenWorld
from harness.evaluate.spec import Spec
from harness.evaluate.walk import walk
from harness.runs.records import Answer, Latency
from harness.runs.unanswered import Tally

if TYPE_CHECKING:
    from harness.evaluate.frozen_world import FrozenSource

SEEDS_AT_ONCE = 8  # channel seeds that are walked together


class _LacksAnswers(Unanswered):
    """Says that a walk cannot go on before questions are answered."""


class _Collector(Asker):
    """Ask a file of answers, and stop where it lacks some."""

    def ask(self, requests: Sequence[Request]) -> None:
        missing = [request for request in requests if request.id not in self.answers]
        file = cast("AnswersFile", self._backend())
        new_answers = self._answered(file, missing)
        if file.left:
            raise _LacksAnswers
        self.tally.add(new_answers.values())
        self.answers |= new_answers


def settle(spec: Spec, out: Path) -> None:
    """Return if a file of answers answers all that an evaluation asks, walked from the beginning.

    `spec` is the evaluation, of frozen scenes, and `out` the run's folder. If not, the questions
    that are left are written to `questions.jsonl` there and Unanswered is raised; else that file is
    deleted. A line on stderr says which answers are to questions that are never asked.
    """
    file = cast("AnswersFile", open_backend(spec.ego.card))
    dataset = cast("FrozenSource", spec.source).dataset
    left, tally = _walked(spec, dataset, file)
    _say_unknown(spec, dataset, file)
    if tally.missing:  # too many of the helpers so far have no answer; later ones may make up
        if not left:
            raise _too_many_refused(file, out)
        left = {**file.refused, **left}
    if not left:
        (out / QUESTIONS).unlink(missing_ok=True)
        return
    write(left.values(), out)
    name, first = printable(file.path), next(iter(left))
    errors = sum(question in file.answers for question in left)
    lines = f"correct the {amount(errors, 'line')} there that say error, " if errors else ""
    raise Unanswered(
        f"{name} has no answer to {amount(len(left), 'question')}, the first {first}: they are in "
        f"{printable(out / QUESTIONS)}; {lines}add a line to {name} for each that has none, and "
        "type the same command"
    )


def _too_many_refused(file: AnswersFile, out: Path) -> Unanswered:
    """Write the questions that have an error for an answer; return the error that names them."""
    write(file.refused.values(), out)
    return Unanswered(
        f"{printable(file.path)} has an error in place of "
        f"{amount(len(file.refused), 'answer')} of helpers, the first {next(iter(file.refused))}: "
        "too many for a result; put answers in their place, and type the same command"
    )


def write(questions: Iterable[Question], out: Path) -> Path:
    """Write questions to `questions.jsonl` in a folder, a JSON line each, and return the file.

    Raises UserError if `out` is a file.
    """
    if out.exists() and not out.is_dir():
        raise UserError(f"--out {printable(out)} is no folder; give another name")
    file = out / QUESTIONS
    with replacing(file) as part, part.open("wb") as lines:
        lines.writelines(question.line() for question in questions)
    return file


def first(spec: Spec, dataset: Dataset) -> dict[str, Question]:
    """Return the questions of an evaluation on the reference drivers' courses, by id.

    They are those that a dry run counts. Which others follow depends on the answers. Raises
    UserError if a prompt shows a picture, which no line of text can hold.
    """
    for agent in spec.agents:
        if agent.prompt.image and agent.image != "none":
            raise UserError(
                f"--out: prompt {agent.prompt.version} shows a picture, and questions are written "
                "as text; leave --out out, or give another prompt, or --image none"
            )
    return {question.id: question for question in _planned(spec, dataset)}


def _planned(spec: Spec, dataset: Dataset) -> Iterator[Question]:
    return map(Question.of, planned(spec, dataset.scenes(dataset.courses())))


def _walked(spec: Spec, dataset: Dataset, file: AnswersFile) -> tuple[dict[str, Question], Tally]:
    """Walk all episodes as far as there are answers; return the questions left, and the count."""
    left, tally = dict[str, Question](), Tally()
    for start in range(0, len(dataset.episodes), TREES_AT_ONCE):
        numbers = dataset.episodes[start : start + TREES_AT_ONCE]
        episodes, answers = dataset.of_episodes(frozenset(numbers)), dict[str, Answer]()
        for n in range(0, len(spec.seeds), SEEDS_AT_ONCE):
            world = FrozenWorld(episodes, spec.points, spec.seeds[n : n + SEEDS_AT_ONCE])
            asker = _Collector(spec, lambda: file, _latency(spec, file), answers=answers)
            asker.tally, file.left = tally, {}
            with suppress(_LacksAnswers):
                for _ in walk(world, spec.points, asker, spec.ties):
                    pass
            left |= file.left
            answers = asker.asked_answers()
    return left, tally


def _latency(spec: Spec, file: AnswersFile) -> Latency:
    if spec.timer:
        return spec.timer.latency(spec.agents)
    declared = latencies.chosen_latency(spec.settings.latency, spec.agents, [file])
    return cast("Latency", declared)  # a file's answers are never timed here


def _say_unknown(spec: Spec, dataset: Dataset, file: AnswersFile) -> None:
    """Say on stderr which answers are to no question of the evaluation, so that nothing uses them.

    They may be to questions that other answers led to.
    """
    unknown = file.answers.keys() - file.asked
    if unknown:
        unknown -= {question.id for question in _planned(spec, dataset)}
    names = [name for name in file.answers if name in unknown]
    if names:
        print(
            f"harness: {printable(file.path)} has {amount(len(names), 'answer')} to what is not "
            f"asked here, by this prompt in these scenes, the first {names[0]}; nothing uses them",
            file=sys.stderr,
        )
