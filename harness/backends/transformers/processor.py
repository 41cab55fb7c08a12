"""A checkpoint's image processor, with the limits of its card: turns pictures into a model's inputs.

Importing this imports neither torch nor transformers. Creating a processor imports both, and reads no
weights.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.backends.card import Card
from harness.backends.vision import Vision
from harness.backends.weights import find_checkpoint
from harness.core.errors import UserError, one_line
from harness.core.image import Pixels

if TYPE_CHECKING:
    import torch


class Processor:
    """A checkpoint's image processor, which makes `tokens` of a picture of the card's size."""

    def __init__(self, name: str, where: Path, vision: Vision) -> None:
        """Load the processor. Raises UserError if the checkpoint has none."""
        from transformers import AutoConfig, AutoImageProcessor

        side = vision.scaled_to_px and {"longest_edge": max(vision.scaled_to_px)}
        limits = {"shortest_edge": vision.least_px or 1, "longest_edge": vision.most_px or 1 << 30}
        self._options = (
            {"size": side, "max_image_size": side, "do_image_splitting": False} if side else {"size": limits}
        )
        files = {"local_files_only": True, "trust_remote_code": False}
        try:
            # Pillow, so that pictures are scaled alike with and without torchvision.
            self._processor = AutoImageProcessor.from_pretrained(where, backend="pil", **files)
            self._config = AutoConfig.from_pretrained(where, **files)
        except Exception as error:  # a broken file surfaces as any of a dozen exception types
            raise UserError(
                f"model {name!r} in {where} has no image processor ({one_line(error)}); copy its "
                "preprocessor_config.json there, or leave [vision] out of its card"
            ) from error
        self._of_size = dict[tuple[int, ...], tuple[int, Any]]()
        blank = np.zeros((vision.height_px, vision.width_px, 3), dtype=np.uint8)
        self.tokens = self.measured(blank)[0]

    def __call__(self, pictures: list[Pixels]) -> "Mapping[str, torch.Tensor]":
        # A model that scales to one size takes one list of pictures for each row.
        images = [[pixels] for pixels in pictures] if "max_image_size" in self._options else pictures
        inputs: Mapping[str, torch.Tensor] = self._processor(
            images=images, return_tensors="pt", **self._options
        )
        return inputs

    def measured(self, pixels: Pixels) -> tuple[int, Any]:
        """Return the number of tokens of a picture of this size, and its grid of patches if it has one."""
        if pixels.shape not in self._of_size:
            inputs, config = self([pixels]), self._config.vision_config
            grid = inputs.get("image_grid_thw")
            if grid is None:
                square = config.patch_size * self._config.scale_factor
                patches = [side // square for side in inputs["pixel_values"].shape[-2:]]
            else:
                patches = [int(side) // config.spatial_merge_size for side in grid[0, 1:]]
            self._of_size[pixels.shape] = math.prod(patches), grid
        return self._of_size[pixels.shape]


def tokens(card: Card) -> int:
    """Return the number of tokens that a card's processor makes of a picture of the card's size."""
    if card.vision is None:
        raise ValueError(f"card {card.name} takes no pictures")
    return Processor(card.name, find_checkpoint(card), card.vision).tokens
