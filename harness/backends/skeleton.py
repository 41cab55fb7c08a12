"""The fixed text of a constrained answer, in which the model fills in digits,
choices and bounded texts.

The text is compact JSON that always fits the answer's schema. A probability is `0.` and two digits,
so 1.00 cannot be written, and the digits need not sum to 1: `harness.parsing` divides by their sum,
as it does with what a server wrote. A helper's evidence is empty; the members that a prompt version
adds may have text.

The model is never asked for fixed text. A choice is made token by token, and the model decides only
where the remaining options differ in their next token (LANE_LEFT and LANE_RIGHT share two in Qwen's
vocabulary).
"""

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from typing import Any, NamedTuple

from harness.backends.chat import Chat
from harness.core.errors import UserError
from harness.core.files import canonical_json
from harness.prompts.answer_schema import Shape, constrained_schema, number_texts

TWO_DIGITS = tuple(f"{n:02d}" for n in range(100))
LONGEST_PIECE = 16  # most characters of a token in a text that the model writes
UNIT = (0, 1)  # bounds of a number that is `0.` and two digits


class Branch(NamedTuple):
    """Hold fixed text of a constrained answer, and the point after it at which the model decides.

    A constrained answer is JSON whose fixed text is given, so that the model only fills in values.
    `then` is None at its end.
    """

    text: str  # the fixed text
    then: "Point | None"  # where the model decides next; None at the end of the answer


@dataclass(frozen=True, eq=False)
class Point:
    """Describe a position in a constrained answer at which the model decides.

    A constrained answer is JSON whose fixed text is given. The model chooses one of the texts
    `options`, or, where `most` is above 0, writes a text of at most so many characters. Then one of
    `branches` (fixed text and the next point) follows. Or one of `instead` stands in its place: the
    end of a list.
    """

    options: tuple[str, ...]  # texts to choose from; one empty text where only the branch is chosen
    most: int  # most characters of a text that the model writes instead of a choice; 0 for a choice
    branches: tuple[Branch, ...]  # what may follow
    # what may stand here instead: the end of a list that has no numbers
    instead: tuple[Branch, ...] = ()


def expand(schema: Mapping[str, Any], branches: Sequence[Branch]) -> list[Branch]:
    """Return the ways to write a value of a JSON Schema in a constrained answer.

    A constrained answer is JSON whose fixed text is given, so that the model only fills in values.
    A way is a branch: fixed text, and the point after it at which the model decides. `branches` are
    the ways in which the answer goes on after the value. Fixed texts begin and end only beside
    letters and digits, where tokenizers split as well.
    """
    if "enum" in schema:
        options = [canonical_json(choice) for choice in schema["enum"]]
        if len(options) == 1:
            return _after(options[0], branches)
        texts = tuple(option[1:-1] for option in options)
        return [Branch('"', Point(texts, 0, tuple(_after('"', branches))))]
    match schema["type"]:
        case "string":
            return [Branch('"', Point(("",), schema["maxLength"], tuple(_after('"', branches))))]
        case "boolean":
            return [Branch("", Point(("false", "true"), 0, tuple(branches)))]
        case "object":
            members = [*schema["properties"].items()]
            branches = _after("}", branches)
            for place, (name, member) in reversed([*enumerate(members)]):
                branches = _after(
                    f"{',' if place else '{'}{canonical_json(name)}:", expand(member, branches)
                )
            return branches
        case "array":
            ends = further = _after("]", branches)
            for place in reversed(range(schema["maxItems"])):
                item = expand(schema["items"], further)
                enough = place and place >= schema["minItems"]
                further = _after("," if place else "[", item) + (ends if enough else [])
            if schema["minItems"]:
                return further
            if further[0].text == "[" and (point := further[0].then):  # no fixed text to choose by
                return [Branch("[", replace(point, instead=tuple(ends)))]
            return further + _after("[", ends)
    if (schema["minimum"], schema["maximum"]) == UNIT and schema["type"] == "number":
        return [Branch("0.", Point(TWO_DIGITS, 0, tuple(branches)))]
    return [Branch("", Point(number_texts(schema), 0, tuple(branches)))]


def _after(text: str, branches: Sequence[Branch]) -> list[Branch]:
    return [Branch(text + branch.text, branch.then) for branch in branches]


def start(shape: Shape) -> Point:
    """Return the point at which a constrained answer begins.

    `shape` says what the answer's JSON must look like.
    """
    return Point(("",), 0, tuple(expand(constrained_schema(shape), [Branch("", None)])))


def filled(shape: Shape, place: int) -> str:
    """Return an example of a constrained answer, as JSON text, such as to count its tokens.

    `shape` says what it must look like. Where the model would choose, the text has the option of
    the index `place`; texts that the model would write are empty.
    """
    text, point = "", Branch("", start(shape)).then
    while point:
        branch = point.branches[place]
        text, point = text + point.options[place] + branch.text, branch.then
    return text


def tokens_after(chat: Chat, before: str, text: str) -> tuple[int, ...]:
    """Return the token ids of `text` where it follows the text `before`.

    `chat` has the tokenizer. Some tokenizers mark the beginning of a text. If a token would span
    both texts, the ids are those of `text` alone.
    """
    head, whole = chat.encode(before), chat.encode(before + text)
    return tuple(whole[len(head) :] if whole[: len(head)] == head else chat.encode(text))


class Ask(NamedTuple):
    """Hold a choice that the model makes while it fills in a constrained answer.

    `forced` are the token ids of fixed text to append first, `among` the sorted ids to choose from.
    """

    forced: list[int]  # token ids of fixed text to append first
    among: Sequence[int]  # token ids to choose from, sorted


class Filled(NamedTuple):
    """Hold a finished constrained answer: JSON with fixed text, whose values a model chose.

    `tokens` counts those of the whole `text`.
    """

    text: str  # the answer's JSON
    tokens: int  # number of its tokens, those of the fixed text included


class Leg(NamedTuple):
    """Pair an option that the model may choose in a constrained answer with the text after it.

    `text` is the option with the fixed text that follows, `tokens` are the token ids of both, and
    `branch` is that fixed text with the next point at which the model decides.
    """

    text: str  # the option and the branch's fixed text
    tokens: tuple[int, ...]  # ids of the tokens of `text`
    branch: Branch  # what follows the option


class Skeleton:
    """Hold the tokens of all constrained answers that a `Shape` allows, for one tokenizer.

    A constrained answer is JSON whose fixed text is given, so that the model only fills in values.
    Answers follow a line break, as in every chat template. Raises UserError if the tokenizer cannot
    tell choices apart.
    """

    def __init__(self, chat: Chat, shape: Shape) -> None:
        self._chat = chat
        self._start = start(shape)
        self._legs: dict[tuple[Point, str], list[Leg]] = {}
        self._tokens = cache(partial(tokens_after, chat))
        self._sizes: list[tuple[int, int]] = []
        self._allowed: dict[tuple[int, frozenset[int]], list[int]] = {}
        self.most_tokens = self._most()  # of the longest answer

    def _legs_of(self, point: Point, before: str) -> list[Leg]:
        """Return what may be chosen at a point that follows a fixed text."""
        if (point, before) not in self._legs:
            # Only the first option stands before a branch: those of one kind end alike.
            first = point.options[0] or before
            ends = [self._tokens(first, branch.text) for branch in point.branches]
            legs: list[Leg] = []
            for option in point.options:
                for branch, end in zip(point.branches, ends, strict=True):
                    tokens = self._tokens(before, option) + end
                    legs.append(Leg(option + branch.text, tokens, branch))
            for branch in point.instead:
                legs.append(Leg(branch.text, self._tokens(before, branch.text), branch))
            self._legs[point, before] = legs
            # One option may be a prefix of another (SLOW, SLOWER), so the tokens after it decide.
            by_tokens = sorted(leg.tokens for leg in legs)
            if any(longer[: len(tokens)] == tokens for tokens, longer in pairwise(by_tokens)):
                raise UserError(
                    f"{self._chat.subject}: its tokenizer cannot tell the choices of a "
                    "constrained answer apart; use --answer json"
                )
        return self._legs[point, before]

    def _most(self) -> int:
        longest: dict[Point | None, int] = {None: 0}
        pending = [Branch("\n", self._start)]
        while pending:
            before, point = pending[-1]
            if point is None or point in longest:
                pending.pop()
            elif later := [
                branch for branch in point.branches + point.instead if branch.then not in longest
            ]:
                pending += later
            else:
                legs = self._legs_of(point, before)
                longest[point] = point.most + max(
                    len(leg.tokens) + longest[leg.branch.then] for leg in legs
                )
        return longest[self._start]

    def walk(self) -> Generator[Ask, int, Filled]:
        """Go through one constrained answer: yield each choice of the model, return the answer.

        It is a generator: it wants the chosen token id sent for each choice that it yields.
        """
        text, count, before = "", 0, "\n"
        forced: list[int] = []
        point: Point | None = self._start
        while point:
            legs, depth = self._legs_of(point, before), 0
            if point.most:
                written, tokens, legs = yield from self._write(point, before, legs, forced)
                text, count = text + written, count + tokens
            while len(legs) > 1:
                among = sorted({leg.tokens[depth] for leg in legs})
                if len(among) > 1:
                    token = yield Ask(forced, among)
                    forced = []
                    legs = [leg for leg in legs if leg.tokens[depth] == token]
                if len(legs) > 1:
                    forced.append(legs[0].tokens[depth])
                    depth += 1
            [leg] = legs
            forced += leg.tokens[depth:]
            text, count = text + leg.text, count + len(leg.tokens)
            before, point = leg.branch
        return Filled(text, count)

    def _write(
        self, point: Point, before: str, legs: list[Leg], forced: list[int]
    ) -> Generator[Ask, int, tuple[str, int, list[Leg]]]:
        """Let the model write a text; return it, its tokens, and what may follow.
        `forced` is used up.
        """
        ids: list[int] = []
        head = self._chat.encode(before)
        left, ends = point.most, frozenset(leg.tokens[0] for leg in legs)
        while left > 0:
            token = yield Ask(forced.copy(), self._among(left, ends))
            forced.clear()
            if token in ends:
                legs = [leg for leg in legs if leg.tokens[0] == token]
                break
            ids.append(token)
            forced.append(token)
            left = point.most - len(self._text(head, ids))
        return self._text(head, ids), len(ids), legs

    def _text(self, head: list[int], ids: list[int]) -> str:
        return self._chat.decode([*head, *ids])[len(self._chat.decode(head)) :]

    def _among(self, left: int, ends: frozenset[int]) -> list[int]:
        """Return the tokens that end a text,
        and those of plain text of up to so many characters, sorted.
        """
        if not self._sizes:
            head = self._chat.encode('"')
            texts = ((i, self._text(head, [i])) for i in range(self._chat.vocabulary))
            self._sizes = [(i, len(text)) for i, text in texts if _is_plain(text)]
        key = min(left, LONGEST_PIECE), ends
        if key not in self._allowed:
            self._allowed[key] = sorted(ends.union(i for i, size in self._sizes if size <= key[0]))
        return self._allowed[key]


def _is_plain(text: str) -> bool:
    return bool(text) and text.isprintable() and not {'"', "\\", "\ufffd"} & set(text)
