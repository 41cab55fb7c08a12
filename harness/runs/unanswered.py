"""Questions that got no answer, which is no answer:
what they said, and whether a run can do without them.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

from harness.core import work
from harness.core.errors import printable
from harness.runs.decisions import Decisions
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
    """Count a run's requests by role, and those that got an error instead of an answer.

    A role is who is asked, and what: `ego`, `helper` or `merge`, a fusion call.

    Attributes:
        asked: number of requests by role.
        unanswered: number of requests without an answer by role.
        words: number of times that each error message came, by its text.
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
        """Return the roles with too many unanswered requests, so that a run has no valid result.

        Any is too many for the ego and for fusion calls; of helpers' a share of `MOST_LOST`, since
        one of theirs counts as a lost message. A fusion call asks the ego's model again, with the
        messages that it heard.
        """
        lost = sum(n for role, n in self.unanswered.items() if is_helper(role))
        helper_requests = sum(n for role, n in self.asked.items() if is_helper(role))
        too_many = lost and lost >= MOST_LOST * helper_requests
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
        """Return a phrase on how many requests of each role got no answer; empty if all got one.

        A role is who is asked, such as `helper`.
        """
        roles = dict.fromkeys((*_WHO, *sorted(self.unanswered)))
        return ", ".join(
            f"{self.unanswered[role]} of {self.asked[role]} questions to "
            f"{_WHO.get(role, f'{role} helpers')}"
            for role in roles
            if self.unanswered[role]
        )


Counted = TypeVar("Counted", bound=Answer | AnswerFacts)


def of_use(answers: Iterable[Counted], decisions: Iterable[Decisions]) -> Iterator[Counted]:
    """Yield answers without those of helpers where no condition asks helpers.

    `--ask all` asks them at every decision point, and no figure depends on what is lost there.
    `decisions` are all that were made with the answers, some at a time. Where no condition asks at
    any decision point, all answers are yielded.
    """
    scenes = set[str]()
    for some in decisions:
        asks = some.flags("triggered")
        scenes |= {
            scene for scene, rows in some.scenes.items() if asks[rows.start : rows.stop].any()
        }
    for answer in answers:
        if not scenes or not is_helper(answer.role) or answer.scene in scenes:
            yield answer


def by_condition(run: Run) -> dict[str, Tally]:
    """Return how many helpers' questions got an answer where each condition asks, by its name.

    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages; one that asks seldom may lose a larger share than all together. Empty where nothing
    is lost.
    """
    if not run.answers.errors:
        return {}
    scenes: dict[str, set[str]] = {name: set() for name in run.conditions}
    for some in run.decisions.pieces():
        asks, labels = some.flags("triggered"), some.labels("condition")
        for scene, rows in some.scenes.items():
            for row in rows:
                name = labels[row]
                if asks[row] and name is not None:
                    scenes[name].add(scene)
    tallies = {name: Tally() for name in scenes}
    for answer in run.answers:
        if is_helper(answer.role):
            for name, where in scenes.items():
                if answer.scene in where:
                    tallies[name].add([answer])
    return tallies


def tally(run: Run) -> Tally:
    """Return how many requests of a finished run, by role, got an answer, and how many an error.

    A role is who is asked: `ego`, `helper` or `merge` (the ego after it heard messages). Helpers
    are left out where no condition asks any (`of_use`).
    """
    if not run.answers.errors:
        return Tally()
    if run.manifest.ask == "all":
        return Tally(of_use(run.answers, run.decisions.pieces()))
    return Tally(run.answers)


def lacking(run: Run) -> Iterator[Answer]:
    """Yield the requests without an answer because of which a finished run has no valid result.

    Each is the record of an answer with an error.
    """
    missing = tally(run).missing
    if missing:
        yield from (a for a in run.answers if a.error is not None and a.role in missing)


def why(path: Path) -> str | None:
    """Return why a run has no valid result because its model did not answer; None if it has one.

    `path` is the run's folder; the run may be finished or not.
    """
    if (path / "run.json").is_file():
        counts = tally(read(path))
        return str(counts) if counts.missing else None
    return work.unanswered(path)
