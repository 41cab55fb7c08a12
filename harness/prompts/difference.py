"""Compare two prompts: their settings, and their texts word by word."""

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

# a word with the space before it; a line break is a word too
WORD = re.compile(r"\n|[^\S\n]*\S+|[^\S\n]+")
CONTEXT = 8  # words shown before and after a change
MARKS: Mapping[Kind, tuple[str, str]] = {
    "same": ("", ""),
    "removed": ("[-", "-]"),
    "added": ("{+", "+}"),
}
SETTINGS = (
    "ego_answer",
    "helper_answer",
    "reasons_first",
    "max_answer_tokens",
    "max_objects",
    "max_conflicts",
    "token_budget",
    "examples",
    "example_sets",
    "extension",
    "repair_turn",
)


@dataclass(frozen=True)
class Hunk:
    """Describe one change between two texts A and B, with the words around it.

    It begins in line `line_a` of A and `line_b` of B, from 1; `pieces` are pairs in reading order:
    `same` (in both texts), `removed` (in A only) or `added` (in B only), and the words.
    """

    line_a: int  # line of A in which it begins, from 1
    line_b: int  # line of B
    # parts that both texts have, that only A has and that only B has, in reading order
    pieces: tuple[tuple[Kind, str], ...]


@dataclass(frozen=True)
class TextChange:
    """Hold the word-by-word differences between two texts A and B.

    `hunks` are the changes in order, none if the texts are the same; `removed` counts the words
    that only A has and `added` those that only B has.
    """

    hunks: tuple[Hunk, ...]  # changes in order; empty if the texts are the same
    removed: int  # number of words that only A has
    added: int  # number of words that only B has


@dataclass(frozen=True)
class PromptChange:
    """Hold the differences between two prompt versions A and B; true if there are any.

    A prompt version is a folder of templates and settings. `settings` has, for each setting that
    differs, its name, A's value and B's, and `texts` the change of each template by the name of its
    file.
    """

    # name, A's value and B's value of each setting that differs; descriptions are left out
    settings: tuple[tuple[str, Any, Any], ...]
    texts: Mapping[str, TextChange]  # change of each template by the name of its file

    def __bool__(self) -> bool:
        return bool(self.settings) or any(text.hunks for text in self.texts.values())


@dataclass(frozen=True)
class Sent:
    """Compare the messages about one scene that prompt versions A and B send to a model.

    `viewer` is the id of the vehicle that is asked, and `role` is `ego`, `helper`, or `fusion` for
    the ego with helpers' messages. `words` and `tokens` count A's and B's, None for tokens without
    a tokenizer; `parts` has the differences of each part, such as the system message. The
    comparison is before any chat template of a model.
    """

    viewer: str  # id of the vehicle that is asked
    role: str  # `ego`, `helper`, or `fusion` for the ego with messages
    words: tuple[int, int]  # number of words in A's and in B's
    tokens: tuple[int, int] | None  # number of tokens in A's and in B's; None without a tokenizer
    # differences in the system message, in the examples if there are any, and in the user's message
    parts: Mapping[str, TextChange]


def change(a: Prompt, b: Prompt) -> PromptChange:
    """Compare the settings and the template texts of prompt version `a` with those of `b`.

    A prompt version is a folder of templates and settings.
    """
    before, after = (dict(_settings(side)) for side in (a, b))
    return PromptChange(
        tuple((name, value, after[name]) for name, value in before.items() if value != after[name]),
        {f"{role}.j2": words(text, b.texts[role]) for role, text in a.texts.items()},
    )


def of_swarm(ego: Prompt, helper: Prompt) -> Prompt:
    """Return a prompt version with the ego's part of `ego` and the helper's part of `helper`.

    A prompt version is a folder of templates, one for each of the two roles, and settings. It is
    for a run whose ego and helpers have prompts of different versions.
    """
    of_ego, of_helper = (prompt.examples or Examples("") for prompt in (ego, helper))
    examples = Examples(of_ego.scenario or of_helper.scenario, of_ego.ego, of_helper.helper)
    return replace(
        ego,
        examples=examples if examples.seeds else None,
        texts={**ego.texts, "helper": helper.texts["helper"]},
        max_answer_tokens={**ego.max_answer_tokens, "helper": helper.max_answer_tokens["helper"]},
        helper_answer=helper.helper_answer,
        extension={
            r: p.extension[r] for r, p in (("ego", ego), ("helper", helper)) if r in p.extension
        },
        reasons_first=tuple(
            r for r, p in (("ego", ego), ("helper", helper)) if r in p.reasons_first
        ),
    )


def _settings(prompt: Prompt) -> Iterator[tuple[str, Any]]:
    for name in SETTINGS:
        value = getattr(prompt, name)
        if isinstance(value, Examples):
            yield name, str(value)
        elif isinstance(value, Mapping):
            yield from ((f"{name}.{key}", item) for key, item in sorted(value.items()))
        else:
            yield name, value


def sent(
    a: Prompt,
    b: Prompt,
    scene: Scene,
    scenario: Scenario,
    count: Callable[[Iterable[Mapping[str, str]]], int] | None = None,
) -> list[Sent]:
    """Render what two prompt versions ask about a scene, and compare it question by question.

    `a` and `b` are prompt versions, folders of templates and settings. The questions are that to
    the ego, that to its first helper, and that to the ego with a message of every helper.
    `scenario` gives the actions and words of the prompts. `count` returns the number of tokens of
    chat messages; None leaves them uncounted.
    """
    ego, *helpers = scene.viewers
    questions: list[tuple[str, str, Sequence[str]]] = [(ego, "ego", ())]
    if helpers:
        questions += [(helpers[0], "helper", ()), (ego, "fusion", helpers)]
    result = []
    for viewer, role, senders in questions:
        graph = scene.graphs[viewer]
        received = [
            {
                **message,
                "evidence": f"what {message['sender']} sees from where "
                "it stands, in twelve words or less",
            }
            for message in densest_messages(senders, scenario.actions)
        ]
        old, new = (
            p.render(graph, scenario.actions, received, scenario.prompt_words) for p in (a, b)
        )
        pairs = zip(_parts(old).items(), _parts(new).values(), strict=True)
        parts = {part: words(before, after) for (part, before), after in pairs if before or after}
        lengths = _size(old), _size(new)
        result.append(
            Sent(viewer, role, lengths, (count(old), count(new)) if count else None, parts)
        )
    return result


def _parts(messages: Sequence[Mapping[str, str]]) -> dict[str, str]:
    system, *turns, user = (message["content"] for message in messages)
    return {"system": system, "examples": "\n".join(turns), "user": user}


def _size(messages: Iterable[Mapping[str, str]]) -> int:
    return sum(len(message["content"].split()) for message in messages)


def words(a: str, b: str) -> TextChange:
    """Compare text `a` with `b` word by word; return the changes with the words around them."""
    before, after = WORD.findall(a), WORD.findall(b)
    hunks, removed, added = [], 0, 0
    for group in SequenceMatcher(None, before, after, autojunk=False).get_grouped_opcodes(CONTEXT):
        pieces: list[tuple[Kind, str]] = []
        for tag, i, i_end, j, j_end in group:
            old, new = before[i:i_end], after[j:j_end]
            if tag == "equal":
                pieces.append(("same", "".join(new)))
                continue
            pieces += [("removed", "".join(old))] if old else []
            pieces += [("added", "".join(new))] if new else []
            removed, added = removed + _count(old), added + _count(new)
        _, i, _, j, _ = group[0]
        hunks.append(Hunk(1 + before[:i].count("\n"), 1 + after[:j].count("\n"), tuple(pieces)))
    return TextChange(tuple(hunks), removed, added)


def _count(tokens: Iterable[str]) -> int:
    return sum(not token.isspace() for token in tokens)


def marked(hunk: Hunk) -> list[tuple[Kind, str]]:
    """Return the pieces of a change, `hunk`, as they are printed, with marks around what differs.

    Each is a pair: `same`, `removed` or `added`, and the words. Marks are `[-removed-]` and
    `{+added+}`. A line break in a change is shown as ↵.
    """
    pieces: list[tuple[Kind, str]] = []
    for kind, text in hunk.pieces:
        first = "" if text.isspace() else text[: len(text) - len(text.lstrip(" "))]
        lines = [printable(line, len(line) * 10) for line in text[len(first) :].split("\n")]
        end = {"same": "\n", "removed": "↵", "added": "↵\n"}[kind]
        pieces.append((kind, first + end.join(lines).join(MARKS[kind])))
    return pieces
