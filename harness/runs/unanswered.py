"""Questions that got no answer, which is no answer:
what they said, and whether a run can do without them.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from harness.core import work
from harness.core.errors import printable
from harness.runs.folder import Run, read
from harness.runs.records import Answer, AnswerFacts, Role, is_helper

MOST_LOST = 0.05  # share of the helpers' questions without an answer that no run has
WORDS = 3  # different errors that are named
_WHO: dict[Role, str] = {
    "ego": "the ego",
    "merge": "fusion calls",
    "helper": "helpers",
}


class Tally:
    """How many questions were asked in each role, and how many of them got which error.

    Attributes:
        asked: questions by role.
        unanswered: questions without an answer by role.
        words: how often each error came, as its server or engine says it.
    """

    def __init__(self, answers: Iterable[Answer | AnswerFacts] = ()) -> None:
        self.asked: Counter[Role] = Counter()
        self.unanswered: Counter[Role] = Counter()
        self.words: Counter[str] = Counter()
        self.add(answers)

    def add(self, answers: Iterable[Answer | AnswerFacts]) -> None:
        for answer in answers:
            self.asked[answer.role] += 1
            if answer.error is not None:
                self.unanswered[answer.role] += 1
                self.words[answer.error] += 1

    @property
    def missing(self) -> frozenset[Role]:
        """The roles whose questions without an answer are more than lost messages."""
        lost = sum(n for role, n in self.unanswered.items() if is_helper(role))
        asked = sum(n for role, n in self.asked.items() if is_helper(role))
        too_many = lost and lost >= MOST_LOST * asked
        return frozenset(
            role for role, n in self.unanswered.items() if n and (too_many or not is_helper(role))
        )

    def __str__(self) -> str:
        """In one line: the words of the server or engine, then how many questions got no answer."""
        words = [
            printable(text, 300) + (f" ({n} times)" if n > 1 else "")
            for text, n in self.words.most_common(WORDS)
        ]
        if len(self.words) > WORDS:
            words.append(f"{len(self.words) - WORDS} other errors")
        return f"{'; '.join(words)}: no answer to {self.counts()}"

    def counts(self) -> str:
        """Return how many questions got no answer, by role; empty if all did."""
        roles = dict.fromkeys((*_WHO, *sorted(self.unanswered)))
        return ", ".join(
            f"{self.unanswered[role]} of {self.asked[role]} questions to "
            f"{_WHO.get(role, f'{role} helpers')}"
            for role in roles
            if self.unanswered[role]
        )


def tally(run: Run) -> Tally:
    """Count a finished run's questions;
    none where its manifest has no errors, and no answer is read.
    """
    return Tally(run.answers if run.manifest.engine_errors else ())


def lacking(run: Run) -> Iterator[Answer]:
    """Yield the questions without an answer that a finished run cannot do without."""
    missing = tally(run).missing
    if missing:
        yield from (a for a in run.answers if a.error is not None and a.role in missing)


def why(path: Path) -> str | None:
    """Return why the results of a run are none, be it finished or not:
    its model could not be asked.
    """
    if (path / "run.json").is_file():
        counts = tally(read(path))
        return str(counts) if counts.missing else None
    return work.unanswered(path)
