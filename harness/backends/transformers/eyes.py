"""Pictures for a transformers model: its own image processor, and tokens that stand for what it sees.

Importing this imports torch.
"""

import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from harness.backends.vision import Vision
from harness.core.errors import UserError, printable
from harness.core.image import Image, Pixels

KEPT = 128  # pictures that prompts may hold at once: more than one call asks about


class Eyes:
    """A loaded model's image processor, with the pictures that prompts hold.

    Attributes:
        image_token: what its chat template writes for a picture.
    """

    def __init__(self, name: str, where: Path, vision: Vision, tokenizer: Any, model: Any) -> None:
        """Load the processor.

        Raises:
            UserError: there is none, or it makes other tokens of a picture than the card says.
        """
        from transformers import AutoImageProcessor

        side = vision.scaled_to_px and {"longest_edge": max(vision.scaled_to_px)}
        limits = {"shortest_edge": vision.least_px or 1, "longest_edge": vision.most_px or 1 << 30}
        self._options = (
            {"size": side, "max_image_size": side, "do_image_splitting": False} if side else {"size": limits}
        )
        try:
            # Pillow, so that pictures are scaled alike wherever torchvision is installed or not.
            self._processor = AutoImageProcessor.from_pretrained(
                where, backend="pil", local_files_only=True, trust_remote_code=False
            )
        except Exception as error:  # a broken file surfaces as any of a dozen exception types
            reason = printable(" ".join(str(error).split()), 200)
            raise UserError(
                f"model {name!r} in {where} has no image processor ({reason}); copy its "
                "preprocessor_config.json there, or leave [vision] out of its card"
            ) from error
        self._model, self._vision, self._of_size = model, vision, dict[tuple[int, ...], tuple[int, Any]]()
        self._filled: int = model.config.image_token_id
        self.image_token: str = tokenizer.convert_ids_to_tokens(self._filled)
        self._before, self._after = _markers(tokenizer, side is not None)
        self._next = -1
        self._seen = OrderedDict[str, tuple[range, Pixels]]()  # by digest, those asked for longest ago first
        blank = np.zeros((vision.height_px, vision.width_px, 3), dtype=np.uint8)
        if (tokens := self._measured(blank)[0]) != vision.tokens:
            raise UserError(
                f"model {name!r}: its processor makes {tokens} tokens of {vision.width_px} x "
                f"{vision.height_px} pixels, and its card says {vision.tokens}; mend [vision]"
            )

    def look(self, image: Image) -> list[int]:
        """What stands for a picture in a prompt; see `harness.backends.engine.Engine.look`."""
        if image.sha256 not in self._seen:
            tokens, _ = self._measured(image.pixels)
            self._seen[image.sha256] = range(self._next, self._next - tokens, -1), image.pixels
            self._next -= tokens
            while len(self._seen) > KEPT:
                self._seen.popitem(last=False)
        self._seen.move_to_end(image.sha256)
        return [*self._before, *self._seen[image.sha256][0], *self._after]

    def inputs(self, ids: torch.Tensor) -> dict[str, Any]:
        """The model's inputs for tokens (n, width): their ids, and the pictures among them in their order."""
        found = self._pictures(ids.flatten().tolist())
        pictures = self._processed(found) if found else {}
        device = self._model.device
        return {
            "input_ids": torch.where(ids < 0, self._filled, ids).to(device),
            **{key: value.to(device) for key, value in pictures.items()},
        }

    def positions(self, prompt: Sequence[int]) -> torch.Tensor | None:
        """Where a prompt's tokens stand, (3, tokens): in time, height and width; None if in one row."""
        if not hasattr(self._model.model, "get_rope_index"):
            return None
        ids = torch.tensor([list(prompt)])
        grids = [self._measured(pixels)[1] for pixels in self._pictures(list(prompt))]
        place, _ = self._model.model.get_rope_index(
            torch.where(ids < 0, self._filled, ids), mm_token_type_ids=(ids < 0).int(),
            image_grid_thw=torch.cat(grids) if grids else None,
        )  # fmt: skip
        found: torch.Tensor = place[:, 0]
        return found

    def _pictures(self, ids: list[int]) -> list[Pixels]:
        """Pixels of the pictures whose first token is among these, in order."""
        first = {tokens[0]: pixels for tokens, pixels in self._seen.values()}
        return [first[token] for token in ids if token in first]

    def _processed(self, pictures: list[Pixels]) -> Mapping[str, torch.Tensor]:
        if self._vision.scaled_to_px:  # a list for each row, of one
            rows = [[pixels] for pixels in pictures]
            found: Mapping[str, torch.Tensor] = self._processor(
                images=rows, return_tensors="pt", **self._options
            )
            return found
        found = self._processor(images=pictures, return_tensors="pt", **self._options)
        return found

    def _measured(self, pixels: Pixels) -> tuple[int, Any]:
        """Tokens of a picture of this size, and its grid of patches, where the model has one."""
        if pixels.shape not in self._of_size:
            made = self._processed([pixels])
            grid = made.get("image_grid_thw")
            config = self._model.config
            if grid is None:
                square = config.vision_config.patch_size * config.scale_factor
                patches = [side // square for side in made["pixel_values"].shape[-2:]]
            else:
                patches = [int(side) // config.vision_config.spatial_merge_size for side in grid[0, 1:]]
            self._of_size[pixels.shape] = math.prod(patches), grid
        return self._of_size[pixels.shape]


def _markers(tokenizer: Any, written: bool) -> tuple[list[int], list[int]]:
    """Tokens before and behind a picture's, which the processor of some models writes, and no template."""
    if not written:
        return [], []
    around, whole = map(tokenizer.convert_tokens_to_ids, ("<fake_token_around_image>", "<global-img>"))
    return [around, whole], [around]
