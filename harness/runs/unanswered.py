"""Questions that got no answer, which is no answer:
what they said, and whether a run can do without them.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from harness.core import work
from harness.core.errors import printable
from harness.runs.folder import Run, read
from harness.runs.records import Answer, AnswerFacts, Role

MOST_LOST = 0.05  # share of the helpers' questions without an answer that no run has
WORDS = 3  # different errors that are named
_WHO: dict[Role, str] = {
    "ego": "the ego",
    "merge": "fusion calls",
    "helper": "helpers",
    "blind": "blind helpers",
}
HELPERS: tuple[Role, ...] = ("helper", "blind")  # whose answers are messages, which may be lost


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
        lost = sum(self.unanswered[role] for role in HELPERS)
        too_many = lost and lost >= MOST_LOST * sum(self.asked[role] for role in HELPERS)
        return frozenset(
            r for r, n in self.unanswered.items() if n and (r not in HELPERS or too_many)
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
        counts = [
            (self.unanswered[r], self.asked[r], who)
            for r, who in _WHO.items()
            if self.unanswered[r]
        ]
        return ", ".join(f"{n} of {asked} questions to {who}" for n, asked, who in counts)


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
