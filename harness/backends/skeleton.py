"""The fixed text of a constrained answer, in which the model fills in digits and choices.

The text is compact JSON that always fits the answer schema. A probability is `0.` and two digits, so 1.00
cannot be written, and the digits need not sum to 1: `harness.parsing` divides by their sum, as it does with
what a server wrote. A helper's evidence is empty, since there is no free text.

The model is never asked for fixed text. A choice is made token by token, and the model decides only where the
remaining options differ in their next token (LANE_LEFT and LANE_RIGHT share two in Qwen's vocabulary).
"""

from collections.abc import Generator, Sequence
from itertools import pairwise
from typing import NamedTuple

from harness.backends.chat import Chat
from harness.core.errors import UserError, printable
from harness.core.files import canonical_json
from harness.prompts.answer_schema import RISKS, Shape

Part = str | tuple[str, ...]
TWO_DIGITS = tuple(f"{n:02d}" for n in range(100))


def parts(shape: Shape) -> list[Part]:
    """Return the text in parts: fixed strings, and tuples of options, each between two strings.

    Parts begin and end only beside letters and digits, where tokenizers split as well.
    """
    text: list[Part] = []
    opening = "{"
    if shape.role == "helper":
        text, opening = ['{"evidence":"","risk":"', RISKS], '",'
    names = tuple(canonical_json(action) for action in shape.actions)
    if key := shape.named:
        bare = tuple(name[1:-1] for name in names)
        return [*text, f'{opening}"{key}":"', bare, '","confidence":0.', TWO_DIGITS, "}"]
    opening += '"action_distribution":{'
    for name in names:
        text += [f"{opening}{name}:0.", TWO_DIGITS]
        opening = ","
    return [*text, "}}"]


def finished(shape: Shape, chosen: Sequence[int]) -> str:
    """Return the text of an answer as it was filled in; `chosen` has the place of each choice's option."""
    places = iter(chosen)
    return "".join(p if isinstance(p, str) else p[next(places)] for p in parts(shape))


def tokens_after(chat: Chat, before: str, text: str) -> tuple[int, ...]:
    """Return the tokens of a text that follows another, since some tokenizers mark the beginning of a text.

    If a token would span both texts, the tokens are those of the text alone.
    """
    head, whole = chat.encode(before), chat.encode(before + text)
    return tuple(whole[len(head) :] if whole[: len(head)] == head else chat.encode(text))


class Ask(NamedTuple):
    """A decision that the model has to make in a skeleton.

    Attributes:
        forced: tokens to append first, among them that of the last decision.
        among: tokens to choose from, sorted.
    """

    forced: list[int]
    among: list[int]


class Skeleton:
    """The text of `parts` in a tokenizer's tokens.

    Attributes:
        most_tokens: length of its longest filling.
    """

    def __init__(self, chat: Chat, shape: Shape) -> None:
        self._literals: list[tuple[int, ...]] = []
        self._choices: list[list[tuple[int, ...]]] = []
        pieces = parts(shape)
        before = "\n"  # an answer follows a line break in every known chat template
        for piece in pieces:
            if isinstance(piece, str):
                self._literals.append(tokens_after(chat, before, piece))
                before = piece
            else:
                self._choices.append([tokens_after(chat, before, option) for option in piece])
                before = piece[0]
        for place, options in enumerate(self._choices):
            # One option may be a prefix of another (SLOW, SLOWER), so the token after it is needed to decide.
            stop = self._literals[place + 1][:1]
            self._choices[place] = ended = [option + stop for option in options]
            if any(longer[: len(short)] == short for short, longer in pairwise(sorted(ended))):
                raise UserError(
                    f"model {printable(chat.name)!r}: its tokenizer cannot tell the choices of a constrained "
                    f"answer apart; use --answer json"
                )
        longest = [max(options, key=len) for options in self._choices]
        self.most_tokens = self._count(longest)

    def _count(self, ended: Sequence[tuple[int, ...]]) -> int:
        return sum(map(len, self._literals)) + sum(len(option) - 1 for option in ended)

    def count(self, chosen: Sequence[int]) -> int:
        """Return the length of the filled-in text in tokens."""
        return self._count([options[i] for options, i in zip(self._choices, chosen, strict=True)])

    def walk(self) -> Generator[Ask, int, list[int]]:
        """Yield each decision, receive its token, and return the chosen places that `finished` takes."""
        chosen = []
        forced = list(self._literals[0])
        for options, after in zip(self._choices, self._literals[1:], strict=True):
            remaining, depth = list(range(len(options))), 0
            while len(remaining) > 1:
                among = sorted({options[i][depth] for i in remaining})
                if len(among) > 1:
                    token = yield Ask(forced, among)
                    forced = []
                    remaining = [i for i in remaining if options[i][depth] == token]
                if len(remaining) > 1:
                    forced.append(options[remaining[0]][depth])
                    depth += 1
            chosen.append(remaining[0])
            forced += [*options[remaining[0]][depth:-1], *after]
        return chosen
