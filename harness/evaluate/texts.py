"""Read the texts of a finished run's answers again, as its agents' answers are read.

A file can state any intent beside a text, so whoever makes something of intents reads the texts.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import msgspec

from harness.backends.base import BARE
from harness.core.errors import UserError, printable
from harness.core.versions import PARSER
from harness.parsing.parse import Parsed, parse
from harness.prompts.answer_schema import Shape
from harness.runs.contradictions import close
from harness.runs.folder import Run
from harness.runs.records import Answer, is_helper
from harness.runs.sources import lacking, prompt_of

OF_TEXTS = ("status", "verdict", "repairs", "intent", "mass", "message")  # what is read in a text


def refuse_others(run: Run, more: Iterable[Answer] = ()) -> None:
    """Raise UserError if an answer of a run, or one `more`, states what its text does not say.

    Also if a prompt of the run is neither here nor kept, so that nothing can be read again.
    """
    if gone := lacking(run):
        raise UserError(
            f"{printable(run.path)}: {gone}, so no answer can be read again; restore it, or run "
            "again"
        )
    agents = (run.manifest.agent(0), *run.manifest.helpers)
    readers = {msgspec.json.encode(agent): _Reader(run, agent) for agent in agents}
    for answer in run.answers:
        reader = readers[msgspec.json.encode(run.agent(answer))]
        if other := _other(answer, reader.read(answer)):
            raise _contradicts(run, answer, other)
    for answer in more:  # which vehicle of its scene answered only the dataset knows
        others = [_other(answer, reader.read(answer)) for reader in readers.values()]
        if all(others) and others[0]:
            raise _contradicts(run, answer, others[0])


def same(name: str, stated: Answer, here: Answer | Parsed) -> bool:
    """Return whether two readings agree in a field of `OF_TEXTS`."""
    a, b = getattr(stated, name), getattr(here, name)
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(close, a, b))
    return close(a, b)


class _Reader:
    """Reads texts as those of one agent."""

    def __init__(self, run: Run, agent: Mapping[str, Any]) -> None:
        prompt = prompt_of(run, agent["prompt"])
        assert prompt is not None  # or it would be lacking
        self._prompt, self._actions = prompt, run.actions
        self._bare = agent["answer"] in BARE
        self._options = {
            "thinking": agent.get("thinking", False),
            "divides": agent["answer"] == "constrained" or agent.get("sums") == "divide",
        }

    def read(self, answer: Answer) -> Parsed:
        """Return what an answer's text says."""
        role = "helper" if is_helper(answer.role) else "ego"
        shape = self._prompt.shape(role, self._actions)
        if self._bare:
            shape = Shape("ego", self._actions, "distribution")
        return parse(
            answer.raw,
            **shape._asdict(),
            **self._options,
            reasons_first=role in self._prompt.reasons_first,
            finish_reason=answer.finish_reason,
            error=answer.error,
        )


def _other(answer: Answer, here: Parsed) -> str | None:
    """Return the first field that an answer states otherwise than its text; None if none is."""
    return next((name for name in OF_TEXTS if not same(name, answer, here)), None)


def _contradicts(run: Run, answer: Answer, field: str) -> UserError:
    version, shown = run.manifest.versions.get("parser", "1"), printable(run.path)
    older = "" if version == str(PARSER) else f" (read by parser {printable(version)})"
    return UserError(
        f"{shown}: answer {printable(answer.id)} states another {field} than its text says{older}; "
        f"`harness eval --model replay:{shown}` reads all of its texts again"
    )
