"""The `[vision]` table of a card: the size of the pictures that a model is shown,
and their tokens.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from harness.core.config import Count

WIDE, HIGH = 16, 8  # tokens along the sides of a picture whose size the checkpoint does not fix


@dataclass(frozen=True)
class Vision:
    """Describe how a model takes pictures: their size, and how many tokens they become.

    `width_px` and `height_px` are the size of the pictures that the model is shown. A token stands
    for a square of `merge` x `merge` patches, each of `patch_px` x `patch_px` pixels. A picture is
    scaled so that both sides hold whole squares and its area lies from `least_px` to `most_px`
    pixels (Qwen2-VL's `smart_resize`), or to the one size `scaled_to_px` (Idefics3); None for no
    limit.
    """

    width_px: Count  # width of the pictures that the model is shown
    height_px: Count  # their height; even, since one camera's picture is above the other's
    patch_px: Count  # side of a patch
    merge: Count  # number of patches along a side of a token's square
    least_px: Count | None = None  # least area of a picture; a smaller one is enlarged
    # greatest area; a larger one is scaled down. None if there is no limit.
    most_px: Count | None = None
    scaled_to_px: tuple[Count, Count] | None = None  # size that every picture is scaled to, if any

    def __post_init__(self) -> None:
        if self.height_px % 2:
            raise ValueError(
                f"height_px is {self.height_px}, wants an even number: two cameras share it"
            )
        if max(self.width_px, self.height_px) > 4096:
            raise ValueError(
                f"a picture of {self.width_px} x {self.height_px} pixels; allowed: 4096 a side"
            )

    @property
    def size_px(self) -> tuple[int, int]:
        return self.width_px, self.height_px

    @property
    def tokens(self) -> int:
        """Return the number of tokens that one picture becomes, without markers around it."""
        square = self.patch_px * self.merge
        width, height = self.scaled_to_px or self._whole_squares(square)
        return (width // square) * (height // square)

    def difference(self, tokens: int) -> str | None:
        """Return an error message if an image processor makes another number of tokens than this.

        `tokens` is the number that it makes of a picture; None is returned if they are equal.
        """
        if tokens == self.tokens:
            return None
        return (
            f"its processor makes {tokens} tokens of {self.width_px} x {self.height_px} pixels, "
            f"and its card says {self.tokens}; fix [vision]"
        )

    def _whole_squares(self, square: int) -> tuple[int, int]:
        sides = self.width_px, self.height_px
        width, height = (max(square, round(side / square) * square) for side in sides)
        if self.most_px is not None and width * height > self.most_px:
            shrink = math.sqrt(sides[0] * sides[1] / self.most_px)
            width, height = (
                max(square, math.floor(side / shrink / square) * square) for side in sides
            )
        elif self.least_px is not None and width * height < self.least_px:
            grow = math.sqrt(self.least_px / (sides[0] * sides[1]))
            width, height = (math.ceil(side * grow / square) * square for side in sides)
        return width, height


def read_vision(config: Mapping[str, Any], processor: Mapping[str, Any]) -> Vision | None:
    """Return how a checkpoint takes pictures, by its two config files; None if it does not.

    `config` is its config.json and `processor` its preprocessor_config.json. Pictures have `WIDE` x
    `HIGH` tokens, unless it scales them to a size of its own. Raises LookupError or TypeError if
    the model is neither Qwen's nor Idefics3's kind, or a file is malformed.
    """
    vision = config.get("vision_config")
    if vision is None:
        return None
    patch = int(vision["patch_size"])
    if "scale_factor" in config:
        side = int(vision["image_size"])
        return Vision(512, 256, patch, int(config["scale_factor"]), scaled_to_px=(side, side))
    merge, size = int(vision["spatial_merge_size"]), processor.get("size") or processor
    square = patch * merge
    least = size.get("shortest_edge", size.get("min_pixels"))
    most = size.get("longest_edge", size.get("max_pixels"))
    return Vision(WIDE * square, HIGH * square, patch, merge, least, most)
