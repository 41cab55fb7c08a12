"""A content of messages: the helper's words alone. The ego acts on its answer to them."""

from typing import TYPE_CHECKING

from harness.coordination.contents import WORDS, Call, Content
from harness.coordination.encodings import words_bits
from harness.coordination.intents import Intents
from harness.core.arrays import Floats, Ints

if TYPE_CHECKING:
    from harness.coordination.operating_point import OperatingPoint


class SaysWords(Call):
    """Ask the ego's model again, with each helper's words in a line of the prompt.

    The helpers' intents, their probabilities of actions, are left out. It is a `Call`, a second
    question that shows the ego's model what it has heard.
    """

    name = "text"
    in_words = True


class OfText(Content):
    """Describe a message that holds a helper's words without its probabilities of actions.

    A helper that has no words sends nothing. The ego's model is asked again (`call`) with these
    words, and the ego acts on that answer.
    """

    holds = frozenset((WORDS,))
    call = SaysWords()

    def able(self, point: "OperatingPoint", intents: Intents, senders: Ints | None) -> Intents:
        return intents.with_words()

    def bits(self, encoding: str, intents: Intents, headers: bool) -> Floats:
        return words_bits(encoding, intents, headers)


TEXT = OfText()
