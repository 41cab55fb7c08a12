"""How a model takes pictures: the size that they are made in for it, and the tokens that one becomes."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from harness.core.config import Count

WIDE, HIGH = 16, 8  # tokens of a picture whose size nothing fixes


@dataclass(frozen=True)
class Vision:
    """Numbers of a model's image processor.

    A token stands for a square of `merge` x `merge` patches. A picture is scaled so that both sides hold
    whole squares and its area lies within the limits (Qwen2-VL's `smart_resize`), or to one size (Idefics3).

    Attributes:
        width_px: of the pictures that it is shown.
        height_px: of them; even, since one camera's picture stands above the other's.
        patch_px: side of a patch.
        merge: patches along a side of a token's square.
        least_px: least area of a picture; a smaller one is enlarged. None if none.
        most_px: greatest area; a larger one is made smaller. None if none.
        scaled_to_px: width and height that every picture is scaled to; None if they keep theirs.
    """

    width_px: Count
    height_px: Count
    patch_px: Count
    merge: Count
    least_px: Count | None = None
    most_px: Count | None = None
    scaled_to_px: tuple[Count, Count] | None = None

    def __post_init__(self) -> None:
        if self.height_px % 2:
            raise ValueError(f"height_px is {self.height_px}, wants an even number: two cameras share it")
        if max(self.width_px, self.height_px) > 4096:
            raise ValueError(f"a picture of {self.width_px} x {self.height_px} pixels; allowed: 4096 a side")

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the pictures that it is shown."""
        return self.width_px, self.height_px

    @property
    def tokens(self) -> int:
        """Tokens that one picture becomes, markers around it left out."""
        square = self.patch_px * self.merge
        width, height = self.scaled_to_px or self._whole_squares(square)
        return (width // square) * (height // square)

    def difference(self, tokens: int) -> str | None:
        """What to say of a model that makes this many tokens of such a picture; None if as stated here."""
        if tokens == self.tokens:
            return None
        return (
            f"its processor makes {tokens} tokens of {self.width_px} x {self.height_px} pixels, and its card "
            f"says {self.tokens}; fix [vision]"
        )

    def _whole_squares(self, square: int) -> tuple[int, int]:
        sides = self.width_px, self.height_px
        width, height = (max(square, round(side / square) * square) for side in sides)
        if self.most_px is not None and width * height > self.most_px:
            less = math.sqrt(sides[0] * sides[1] / self.most_px)
            width, height = (max(square, math.floor(side / less / square) * square) for side in sides)
        elif self.least_px is not None and width * height < self.least_px:
            more = math.sqrt(self.least_px / (sides[0] * sides[1]))
            width, height = (math.ceil(side * more / square) * square for side in sides)
        return width, height


def of_checkpoint(config: Mapping[str, Any], processor: Mapping[str, Any]) -> Vision | None:
    """What a checkpoint's config.json and preprocessor_config.json say; None of a model of texts alone.

    Its pictures have `WIDE` x `HIGH` tokens, unless it scales them to a size of its own.

    Raises:
        LookupError, TypeError: a model of another kind than Qwen's and Idefics3's, or a file that is none.
    """
    eyes = config.get("vision_config")
    if eyes is None:
        return None
    patch = int(eyes["patch_size"])
    if "scale_factor" in config:
        side = int(eyes["image_size"])
        return Vision(512, 256, patch, int(config["scale_factor"]), scaled_to_px=(side, side))
    merge, size = int(eyes["spatial_merge_size"]), processor.get("size") or processor
    square = patch * merge
    least = size.get("shortest_edge", size.get("min_pixels"))
    most = size.get("longest_edge", size.get("max_pixels"))
    return Vision(WIDE * square, HIGH * square, patch, merge, least, most)
