"""The answers of a run, `answers.jsonl`: one answer a line."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO

import msgspec
import numpy as np

from harness.core.arrays import ROUNDING, Floats
from harness.core.files import sha256_bytes
from harness.runs.records import ASKED, REWRITTEN, Answer, roles

_ANSWER = msgspec.json.Decoder(Answer)
MARKS = f"{ASKED}{REWRITTEN}/+"  # in keys, beside who answered


@dataclass(frozen=True)
class Answered:
    """Hold how many answers a run has, how many could not be read, and what the ego answered.

    `count` has numbers by role, who answers and to what: `ego`, `helper` or `merge` (a fusion call:
    the ego asked again, with the messages it heard). `failed` has by role the numbers of those that
    could not be read, by parse status. `ego` has the n readable answers of the ego, probabilities
    of A actions, (n, A).
    """

    count: Counter[str]  # number of answers by role
    # number of answers that could not be read, by role, and by status, such as `bad_sum`
    failed: Mapping[str, Counter[str]]
    # the intents in the n answers of the ego that could be read, probabilities of A actions, (n, A)
    ego: Floats


class Answers:
    """Hold the answers of a run in the order of their file, decoded anew at each access.

    An answer is what a model said about one scene (decision point) for one vehicle. Undecoded, they
    take the memory of the file only, a tenth of what decoded answers would.

    Attributes:
        by_scene: the answers about each scene, by the scene's id.
        errors: how many of them are an engine's error.
        sha256: hex digest of their file.
    """

    def __init__(self, lines: bytes, actions: int) -> None:
        """Check the lines of a run with so many actions. Raises ValueError for a broken one."""
        self._lines, self._count, self._actions = lines, 0, actions
        self.sha256 = sha256_bytes(lines)
        self.errors = 0
        # of lines that stand together and are of one decision point
        self._spans: list[tuple[int, int]] = []
        of_scene: dict[str, list[int]] = {}  # places in `_spans`
        keys: set[str] = set()
        scene, start, role_names = None, 0, roles()
        for line in BytesIO(lines):
            stop = start + len(line)
            for answer in _ANSWER.decode_lines(line):  # one; none in a blank line
                if answer.intent is not None and len(answer.intent) != actions:
                    raise ValueError(f"answer {answer.id} has {len(answer.intent)} probabilities")
                if answer.intent and not (
                    min(answer.intent) >= 0 and abs(sum(answer.intent) - 1) <= ROUNDING
                ):
                    raise ValueError(f"answer {answer.id} has an intent that is no distribution")
                if answer.role not in role_names:
                    raise ValueError(
                        f"answer {answer.id} has role {answer.role}; known: {', '.join(role_names)}"
                    )
                if any(mark in answer.viewer for mark in MARKS):
                    raise ValueError(f"answer {answer.id} is of a viewer that no vehicle is")
                if answer.heard and answer.role != "merge":
                    raise ValueError(f"answer {answer.id} heard messages, and is no fusion call's")
                if answer.scene != scene:
                    scene = answer.scene
                    keys = {
                        sibling.key
                        for place in of_scene.get(scene, ())
                        for sibling in self._span(place)
                    }
                    of_scene.setdefault(scene, []).append(len(self._spans))
                    self._spans.append((start, stop))
                if answer.key in keys:
                    raise ValueError("an answer is there twice")
                keys.add(answer.key)
                self._spans[-1] = self._spans[-1][0], stop
                self._count += 1
                self.errors += answer.error is not None
            start = stop
        self.by_scene: Mapping[str, list[Answer]] = _ByScene(self, of_scene)

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Answer]:
        for place in range(len(self._spans)):
            yield from self._span(place)

    def counted(self) -> Answered:
        """Read all answers once, and return how many there are, how many failed, and the ego's.

        The ego's are its probabilities of the actions.
        """
        count, failed, ego = Counter[str](), dict[str, Counter[str]](), list[tuple[float, ...]]()
        for answer in self:
            if answer.error is not None:
                continue
            count[answer.role] += 1
            if answer.verdict == "failed":
                failed.setdefault(answer.role, Counter())[answer.status] += 1
            if answer.role == "ego" and answer.intent:
                ego.append(answer.intent)
        return Answered(count, failed, np.array(ego, dtype=float).reshape(-1, self._actions))

    def _span(self, place: int) -> list[Answer]:
        start, stop = self._spans[place]
        return _ANSWER.decode_lines(self._lines[start:stop])


class _ByScene(Mapping[str, list[Answer]]):
    def __init__(self, answers: Answers, places: Mapping[str, list[int]]) -> None:
        self._answers, self._places = answers, places

    def __getitem__(self, scene: str) -> list[Answer]:
        return [answer for place in self._places[scene] for answer in self._answers._span(place)]

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)
