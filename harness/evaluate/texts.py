"""Read the texts of answers again, as their agents' answers are read.

A file can state any intent beside a text, so whoever makes something of intents reads the texts.
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import msgspec
from msgspec import UNSET

from harness.backends.base import BARE
from harness.core.errors import UserError, printable
from harness.core.versions import PARSER
from harness.evaluate.agent import Agent
from harness.parsing.parse import Parsed, parse
from harness.prompts.answer_schema import Shape
from harness.prompts.versions import Prompt
from harness.runs.contradictions import close
from harness.runs.folder import Run
from harness.runs.records import Answer, is_helper
from harness.runs.sources import lacking, prompt_of

ASKED_AGAIN = "delete that file, and its questions are asked again"
# what is read in a text; of the last two an answer may state nothing
OF_TEXTS = ("status", "verdict", "repairs", "intent", "mass", "message", "faults", "extension")


def refuse_others(run: Run) -> None:
    """Raise UserError if an answer of a run states what its raw text does not say.

    A file can state any intent beside a text. Also if a prompt of the run is neither here nor kept
    in it, so that nothing can be parsed again.
    """
    for answer, field in others(run):
        raise _contradicts(run, answer, field)


def others(run: Run) -> Iterator[tuple[Answer, str]]:
    """Yield each answer of a run that states what its raw text does not say, and in which field.

    Anybody may have written the run, so texts are parsed again. The field is the first of those
    that differ. Raises UserError if a prompt of the run is neither here nor kept in it.
    """
    if gone := lacking(run):
        raise UserError(
            f"{printable(run.path)}: {gone}, so no answer can be read again; restore it, or run "
            "again"
        )
    readers = dict[bytes, _Reader]()
    for agent in (run.manifest.agent(0), *run.manifest.helpers):
        prompt = prompt_of(run, agent["prompt"])
        assert prompt is not None  # or it would be lacking
        thinking, divides = agent.get("thinking", False), agent.get("sums") == "divide"
        reader = _Reader(prompt, run.actions, agent["answer"], thinking, divides)
        readers[msgspec.json.encode(agent)] = reader
    for answer in run.answers:
        reader = readers[msgspec.json.encode(run.agent(answer))]
        if field := _other(answer, reader.read(answer)):
            yield answer, field


def refuse_other_kept(
    file: Path, answers: Iterable[Answer], agents: Sequence[Agent], actions: tuple[str, ...]
) -> None:
    """Raise UserError if an answer in `file` states what its raw text says by no agent's parsing.

    So a run that somebody else began goes on from what its answers say. Also if an answer states a
    delay that no agent's model card, the file that describes it, declares. `agents` are those of
    the run, each a model with its prompt, and `actions` the names of the meta-actions, in order.
    """
    readers = []
    for agent in agents:
        divides = agent.sums == "divide"
        readers.append(_Reader(agent.prompt, actions, agent.answer, agent.thinking, divides))
    for answer in answers:
        fault = None
        # Which vehicle of its scene answered only the dataset knows.
        others = [_other(answer, reader.read(answer)) for reader in readers]
        if not any(answer.may_take_longer(agent.card.slow_s) for agent in agents):
            fault = f"a delay of {answer.slow_s:g} s, which no card of this run declares"
        elif all(others):
            fault = f"another {others[0]} than its text says"
        if fault:
            where = f"{printable(file)}: answer {printable(answer.id)}"
            raise UserError(f"{where} states {fault}; {ASKED_AGAIN}")


def same(name: str, stated_answer: Answer, here: Answer | Parsed) -> bool:
    """Return whether a recorded answer and the same text parsed again agree in one field.

    The field, `name`, is one of `OF_TEXTS`, those that are read in a text; numbers are compared up
    to rounding. `here` is the one that was parsed now.
    """
    a, b = getattr(stated_answer, name), getattr(here, name)
    if a is UNSET:
        return True
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(close, a, b))
    return close(a, b)


class _Reader:
    """Reads texts as those of one agent."""

    def __init__(
        self, prompt: Prompt, actions: tuple[str, ...], answer: str, thinking: bool, divides: bool
    ) -> None:
        self._prompt, self._actions = prompt, actions
        self._bare = answer in BARE
        self._thinking = thinking
        self._divides = divides or answer == "constrained"

    def read(self, answer: Answer) -> Parsed:
        """Return what an answer's text says."""
        role = "helper" if is_helper(answer.role) else "ego"
        shape = self._prompt.shape(role, self._actions)
        if self._bare:
            shape = Shape("ego", self._actions, "distribution")
        return parse(
            answer.raw,
            **shape._asdict(),
            thinking=self._thinking,
            divides=self._divides,
            reasons_first=role in self._prompt.reasons_first,
            finish_reason=answer.finish_reason,
            error=answer.error,
        )


def _other(answer: Answer, here: Parsed) -> str | None:
    """Return the first field that an answer states otherwise than its text; None if none is."""
    return next((name for name in OF_TEXTS if not same(name, answer, here)), None)


def _contradicts(run: Run, answer: Answer, field: str) -> UserError:
    version, path = run.manifest.versions.get("parser", "1"), printable(run.path)
    older = "" if version == str(PARSER) else f" (read by parser {printable(version)})"
    return UserError(
        f"{path}: answer {printable(answer.id)} states another {field} than its text says{older}; "
        f"`harness eval --model replay:{path}` reads all of its texts again"
    )
