"""The pictures that tokens of prompts stand for, and the encodings of those that were used last.

A picture's tokens are negative numbers, the same in every engine and process: digits of its digest,
then bits of the token's place in it. It is encoded when they are first read, as part of an answer's
time.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from typing import Generic, TypeVar
from weakref import WeakValueDictionary

from harness.core.image import Image

T = TypeVar("T")
# encodings that are kept: those of a chunk of requests, for repair turns and fusion calls
KEPT = 64
_PLACE_BITS, _DIGITS = 16, 10


def locate_picture(token: int) -> tuple[int, int]:
    """Return which picture a negative token id is of, and the token's index in that picture.

    A picture is named by a number, the same in every engine and process.
    """
    return divmod(-1 - token, 1 << _PLACE_BITS)


def pictures_in(tokens: Iterable[int]) -> list[int]:
    """Return the numbers of the pictures that begin among some token ids, in order.

    Negative ids stand for pictures. `tokens` are the ids of a prompt or a piece of it. A picture's
    number is the one that `locate_picture` reads in its ids.
    """
    located = (locate_picture(token) for token in tokens if token < 0)
    return [number for number, place in located if place == 0]


class Pictures(Generic[T]):
    """Keep pictures by number, and the encodings of those that were used last.

    The number is taken from the picture's digest. `encode` turns a list of pictures into what an
    engine's model reads (`T`), one for each.
    """

    def __init__(self, encode: Callable[[list[Image]], list[T]]) -> None:
        self._encode = encode
        self._images: WeakValueDictionary[int, Image] = WeakValueDictionary()
        self._encoded: OrderedDict[int, T] = OrderedDict()  # the least recently used come first

    def add(self, image: Image, count: int) -> list[int]:
        """Return the negative token ids that stand for a picture in a prompt, `count` of them.

        The `Image` is not kept: the caller must hold it until it is encoded.
        """
        number = int(image.sha256[:_DIGITS], 16)
        self._images[number] = image
        return [-1 - ((number << _PLACE_BITS) | place) for place in range(count)]

    def image(self, number: int) -> Image:
        """Return the picture of a number, as `locate_picture` finds it in a token id.

        Raises LookupError if it is no longer alive: pictures are not kept.
        """
        if (image := self._images.get(number)) is None:
            raise LookupError(
                "a picture is gone that a prompt's tokens stand for; look at it again"
            )
        return image

    def encodings(self, numbers: Sequence[int]) -> list[T]:
        """Return the encodings of the pictures of these numbers, in order.

        Those that are not kept are computed in one batch. Raises LookupError if such a picture is
        no longer alive.
        """
        if new := [number for number in dict.fromkeys(numbers) if number not in self._encoded]:
            self._encoded |= zip(
                new, self._encode([self.image(number) for number in new]), strict=True
            )
        for number in numbers:
            self._encoded.move_to_end(number)
        encodings = [self._encoded[number] for number in numbers]
        while len(self._encoded) > KEPT:
            self._encoded.popitem(last=False)
        return encodings

    def forget(self, tokens: Iterable[int]) -> None:
        """Drop the encodings of pictures that some token ids stand for, after a prompt was read.

        `tokens` are the ids; those of a picture are negative.
        """
        for number in {locate_picture(token)[0] for token in tokens if token < 0}:
            self._encoded.pop(number, None)
