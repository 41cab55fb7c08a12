"""The picture of an image prompt: the model that it is drawn for, its tokens,
its looks in a terminal.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.cli.terminal import console
from harness.core.errors import UserError, printable
from harness.core.files import write_whole

if TYPE_CHECKING:
    from rich.text import Text

    from harness.backends.card import Card
    from harness.backends.vision import Vision
    from harness.core.arrays import Pixels
    from harness.core.image import Image
    from harness.prompts.versions import Prompt

MODEL = "swarm-tiny-vl"  # unasked
COLUMNS = 64  # of a picture in a terminal


@dataclass(frozen=True)
class PictureModel:
    """Describe the model with vision that a prompt's pictures are drawn for, and their size.

    `card` is its model card, the file that describes it, and `vision` how it takes pictures.
    `processor_tokens` is the number of tokens of a picture by its own image processor; None if not
    asked.
    """

    card: "Card"  # the model's
    vision: "Vision"  # how it takes pictures
    # what its own image processor makes of one; None where that is not here
    processor_tokens: int | None = None

    @property
    def picture(self) -> str:
        """Return a line for people on how large the model's pictures are, in pixels and tokens."""
        name, (width, height) = printable(self.card.name), self.vision.size_px
        return (
            f"{width} x {height} pixels, front above rear; {self.vision.tokens} tokens with {name}"
        )

    @property
    def checked(self) -> bool:
        """Return whether the model's own image processor was asked for its number of tokens."""
        return self.processor_tokens is not None

    @property
    def difference(self) -> str | None:
        """Return a sentence if the image processor's number of tokens is not that on the card.

        The card is the file that describes the model. None if the numbers are equal, or the
        processor was not asked.
        """
        n = self.processor_tokens
        difference = None if n is None else self.vision.difference(n)
        return difference and f"model {printable(self.card.name)!r}: {difference}"

    def as_mapping(self) -> dict[str, Any]:
        """Return the model's name and its pictures' size in pixels and tokens, as plain values."""
        width, height = self.vision.size_px
        return {
            "model": self.card.name,
            "width_px": width,
            "height_px": height,
            "tokens": self.vision.tokens,
        }


def picture_model(
    prompt: "Prompt", model: str | None, checked: bool = False
) -> PictureModel | None:
    """Return the model that a prompt's pictures are drawn for; None if the prompt shows none.

    Args:
        prompt: the prompt version.
        model: name or path of the model; None for the default one.
        checked: whether to ask the model's own image processor, if it is installed.

    Raises:
        UserError: the model reads text alone.
    """
    from harness.backends.cards import resolve
    from harness.backends.registry import processor_tokens

    if prompt.image is None:
        return None
    card = resolve(model or MODEL)
    if card.vision is None:
        raise UserError(
            f"--model {printable(card.name)}: prompt {prompt.version} shows a picture, and this "
            f"model reads texts alone (its card has no [vision]); give another, such as {MODEL}"
        )
    return PictureModel(card, card.vision, processor_tokens(card) if checked else None)


def write(image: "Image", file: Path) -> str:
    """Write an image as a PNG file, with its folder; return the line to print.

    Raises UserError if it cannot be written.
    """
    try:
        write_whole(file, image.png())
    except OSError as error:
        raise UserError(
            f"--out {printable(file.parent)} cannot be written ({error.strerror}); give another "
            "folder"
        ) from None
    return f"wrote {printable(file)}"


def draw(image: "Image") -> bool:
    """Draw an image in the terminal; return whether it was drawn, which takes one with colours."""
    screen = console()
    if not screen.is_terminal or screen.color_system in (None, "standard"):
        return False
    screen.print(half_blocks(image.pixels))
    return True


def half_blocks(pixels: "Pixels") -> "Text":
    """Return pixels (height, width, 3) as text of half-block characters.

    Pixels are red, green and blue, 0 to 255. Each character has the colours of two, one above the
    other.
    """
    from rich.color import Color
    from rich.style import Style
    from rich.text import Text

    height, width, _ = pixels.shape
    columns = min(COLUMNS, width)
    lines = max(1, min(round(columns * height / width / 2), height // 2))
    small = _shrunk(_shrunk(pixels, 2 * lines, 0), columns, 1).round().astype(int).tolist()
    rows = []
    for above, below in zip(small[::2], small[1::2], strict=True):
        blocks = []
        for upper, lower in zip(above, below, strict=True):
            style = Style(color=Color.from_rgb(*upper), bgcolor=Color.from_rgb(*lower))
            blocks.append(("▀", style))
        rows.append(Text.assemble(*blocks))
    return Text("\n").join(rows)


def _shrunk(pixels: Any, n: int, axis: int) -> Any:
    """Return the means of n parts of an axis, each as long as another or longer by a pixel."""
    import numpy as np

    return np.stack([part.mean(axis) for part in np.array_split(pixels, n, axis)], axis)
