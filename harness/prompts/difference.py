"""What differs between two prompts: their settings, and their texts word by word."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import SequenceMatcher
from typing import Any, Literal

from harness.core.errors import printable
from harness.dataset.load import Scene
from harness.prompts.densest import densest_messages
from harness.prompts.examples import Examples
from harness.prompts.versions import Prompt
from harness.world.scenario import Scenario

Kind = Literal["same", "removed", "added"]

WORD = re.compile(r"\n|[^\S\n]*\S+|[^\S\n]+")  # a word with the space before it; a line's end is a word too
CONTEXT = 8  # words that are shown before and after a change
MARKS: Mapping[Kind, tuple[str, str]] = {"same": ("", ""), "removed": ("[-", "-]"), "added": ("{+", "+}")}
SETTINGS = (
    "helper_answer", "reasons_first", "max_answer_tokens", "max_objects", "max_conflicts", "token_budget",
    "examples", "repair_turn",
)  # fmt: skip


@dataclass(frozen=True)
class Hunk:
    """A change with the words around it.

    Attributes:
        line_a: of A, from 1, in which it begins.
        line_b: of B.
        pieces: what both texts have, what only A has and what only B has, in reading order.
    """

    line_a: int
    line_b: int
    pieces: tuple[tuple[Kind, str], ...]


@dataclass(frozen=True)
class TextChange:
    """What differs between two texts.

    Attributes:
        hunks: in order; empty where the texts are the same.
        removed: how many words only A has.
        added: how many words only B has.
    """

    hunks: tuple[Hunk, ...]
    removed: int
    added: int


@dataclass(frozen=True)
class PromptChange:
    """What differs between two versions.

    Attributes:
        settings: name, A's value and B's of each that differs, but for what is said about a version.
        texts: of each template by the name of its file.
    """

    settings: tuple[tuple[str, Any, Any], ...]
    texts: Mapping[str, TextChange]

    def __bool__(self) -> bool:
        return bool(self.settings) or any(text.hunks for text in self.texts.values())


@dataclass(frozen=True)
class Sent:
    """What a model is sent of one scene, its own chat template not applied, by A's text and by B's.

    Attributes:
        viewer: id of the vehicle that is asked.
        role: `ego`, `helper`, or `fusion` for the ego with messages.
        words: A's and B's.
        tokens: A's and B's; None where nobody counts them.
        parts: what differs in the system's message, in the examples where there are any, and in the user's.
    """

    viewer: str
    role: str
    words: tuple[int, int]
    tokens: tuple[int, int] | None
    parts: Mapping[str, TextChange]


def change(a: Prompt, b: Prompt) -> PromptChange:
    """What differs from version A to B."""
    before, after = (dict(_settings(side)) for side in (a, b))
    return PromptChange(
        tuple((name, value, after[name]) for name, value in before.items() if value != after[name]),
        {f"{role}.j2": words(text, b.texts[role]) for role, text in a.texts.items()},
    )


def of_swarm(ego: Prompt, helper: Prompt) -> Prompt:
    """The ego's version with the helper's part of another."""
    mine, others = (prompt.examples or Examples("") for prompt in (ego, helper))
    both = Examples(mine.scenario or others.scenario, mine.ego, others.helper)
    return replace(
        ego,
        examples=both if both.seeds else None,
        texts={**ego.texts, "helper": helper.texts["helper"]},
        max_answer_tokens={**ego.max_answer_tokens, "helper": helper.max_answer_tokens["helper"]},
        helper_answer=helper.helper_answer,
        reasons_first=tuple(r for r, p in (("ego", ego), ("helper", helper)) if r in p.reasons_first),
    )


def _settings(prompt: Prompt) -> Iterator[tuple[str, Any]]:
    for name in SETTINGS:
        value = getattr(prompt, name)
        if isinstance(value, Examples):
            yield name, str(value)
        elif isinstance(value, Mapping):
            yield from ((f"{name}.{key}", each) for key, each in sorted(value.items()))
        else:
            yield name, value


def sent(
    a: Prompt, b: Prompt, scene: Scene, scenario: Scenario,
    count: Callable[[Iterable[Mapping[str, str]]], int] | None = None,
) -> list[Sent]:  # fmt: skip
    """What the ego and its first helper are sent, and the ego with a message of every helper.

    Args:
        a: version A.
        b: version B.
        scene: what is shown.
        scenario: whose actions and words the prompts have.
        count: counts the tokens of chat messages.
    """
    ego, *helpers = scene.viewers
    asked: list[tuple[str, str, Sequence[str]]] = [(ego, "ego", ())]
    if helpers:
        asked += [(helpers[0], "helper", ()), (ego, "fusion", helpers)]
    result = []
    for viewer, role, senders in asked:
        graph = scene.record["graphs"][viewer]
        heard = [
            {
                **message,
                "evidence": f"what {message['sender']} sees from where it stands, in twelve words or less",
            }
            for message in densest_messages(senders, scenario.actions)
        ]
        old, new = (p.render(graph, scenario.actions, heard, scenario.prompt_words) for p in (a, b))
        pairs = zip(_parts(old).items(), _parts(new).values(), strict=True)
        parts = {part: words(one, other) for (part, one), other in pairs if one or other}
        lengths = _size(old), _size(new)
        result.append(Sent(viewer, role, lengths, (count(old), count(new)) if count else None, parts))
    return result


def _parts(messages: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """The system's message, the turns of examples one after the other, and the user's."""
    system, *turns, user = (message["content"] for message in messages)
    return {"system": system, "examples": "\n".join(turns), "user": user}


def _size(messages: Iterable[Mapping[str, str]]) -> int:
    return sum(len(message["content"].split()) for message in messages)


def words(a: str, b: str) -> TextChange:
    """What differs from text A to B."""
    before, after = WORD.findall(a), WORD.findall(b)
    hunks, removed, added = [], 0, 0
    for group in SequenceMatcher(None, before, after, autojunk=False).get_grouped_opcodes(CONTEXT):
        pieces: list[tuple[Kind, str]] = []
        for tag, i, i_end, j, j_end in group:
            gone, new = before[i:i_end], after[j:j_end]
            if tag == "equal":
                pieces.append(("same", "".join(new)))
                continue
            pieces += [("removed", "".join(gone))] if gone else []
            pieces += [("added", "".join(new))] if new else []
            removed, added = removed + _count(gone), added + _count(new)
        _, i, _, j, _ = group[0]
        hunks.append(Hunk(1 + before[:i].count("\n"), 1 + after[:j].count("\n"), tuple(pieces)))
    return TextChange(tuple(hunks), removed, added)


def _count(some: Iterable[str]) -> int:
    return sum(not word.isspace() for word in some)


def marked(hunk: Hunk) -> list[tuple[Kind, str]]:
    """The pieces for people, safe to print: `[-removed-]`, `{+added+}`, and ↵ where a line's end is one."""
    pieces: list[tuple[Kind, str]] = []
    for kind, text in hunk.pieces:
        first = "" if text.isspace() else text[: len(text) - len(text.lstrip(" "))]
        lines = [printable(line, len(line) * 10) for line in text[len(first) :].split("\n")]
        end = {"same": "\n", "removed": "↵", "added": "↵\n"}[kind]
        pieces.append((kind, first + end.join(lines).join(MARKS[kind])))
    return pieces
