"""Vision of a transformers model: its image processor and encoder,
and the tokens that stand for pictures.

Importing this imports torch.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from harness.backends.card import Card
from harness.backends.pictures import KEPT, Pictures, pictures_in
from harness.backends.vision import Vision
from harness.backends.weights import find_checkpoint
from harness.core.arrays import Pixels
from harness.core.errors import UserError, one_line
from harness.core.image import Image


class Processor:
    """Prepare pictures for a vision model by its checkpoint's image processor.

    `tokens` is how many tokens the model reads for one picture of the size that its model card
    (TOML file) states.
    """

    def __init__(self, name: str, where: Path, vision: Vision) -> None:
        """Load the image processor in `where`. Raises UserError if the checkpoint has none."""
        # slow, and needed for pictures alone
        from transformers import AutoConfig, AutoImageProcessor

        side = vision.scaled_to_px and {"longest_edge": max(vision.scaled_to_px)}
        limits = {"shortest_edge": vision.least_px or 1, "longest_edge": vision.most_px or 1 << 30}
        self._options = (
            {"size": side, "max_image_size": side, "do_image_splitting": False}
            if side
            else {"size": limits}
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

    def __call__(self, pictures: list[Pixels]) -> Mapping[str, torch.Tensor]:
        # A model that scales to one size takes one list of pictures for each row.
        images = (
            [[pixels] for pixels in pictures] if "max_image_size" in self._options else pictures
        )
        inputs: Mapping[str, torch.Tensor] = self._processor(
            images=images, return_tensors="pt", **self._options
        )
        return inputs

    def measured(self, pixels: Pixels) -> tuple[int, Any]:
        """Return how many tokens a picture of this shape becomes, and its grid of patches.

        `pixels` is RGB, (height, width, 3). The grid is the processor's `image_grid_thw`, `(1, 3)`:
        patches in time, height and width; None if the model has none.
        """
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


class Eyes:
    """Encode pictures by the image processor and vision encoder of a loaded transformers model.

    A picture stands as the text `image_token` in the chat template.
    """

    def __init__(self, name: str, where: Path, vision: Vision, tokenizer: Any, model: Any) -> None:
        """Load the image processor of a model, which is in memory already.

        Raises UserError if there is none, or it makes another number of tokens than the card says.
        """
        self._processor = Processor(name, where, vision)
        if difference := vision.difference(self._processor.tokens):
            raise UserError(f"model {name!r}: {difference}")
        self._model = model
        self._filled: int = model.config.image_token_id
        self.image_token: str = tokenizer.convert_ids_to_tokens(self._filled)
        self._before, self._after = _markers(tokenizer, vision.scaled_to_px is not None)
        self._pictures = Pictures(self._encode)
        self.forget = self._pictures.forget

    def look(self, image: Image) -> list[int]:
        """Return the token ids that stand for a picture, with markers around it.

        Ids of the picture itself are negative. The `Image` must stay alive until they are read.
        """
        tokens = self._pictures.add(image, self._processor.measured(image.pixels)[0])
        return [*self._before, *tokens, *self._after]

    def encode(self, tokens: Iterable[int]) -> None:
        """Encode all pictures of a prompt in one batch, and keep the results for reading them.

        `tokens` are the prompt's token ids. If they have more pictures than are kept, nothing is
        done now: each is encoded when it is read.
        """
        numbers = list(dict.fromkeys(pictures_in(tokens)))
        if len(numbers) <= KEPT:
            with torch.inference_mode():
                self._pictures.encodings(numbers)

    def inputs(self, ids: torch.Tensor) -> dict[str, Any]:
        """Return the keyword arguments by which the model reads token ids `(n, width)`.

        They are the ids, with those of pictures replaced by the model's own, and encoded pictures.
        """
        numbers = pictures_in(ids.flatten().tolist())
        token_ids = torch.where(ids < 0, self._filled, ids).to(self._model.device)
        inputs: dict[str, Any] = {"input_ids": token_ids}
        if numbers:
            first, *deeper = zip(*self._pictures.encodings(numbers), strict=True)
            features = SimpleNamespace(pooler_output=first, deepstack_features=deeper)
            inputs["mm_encoder_outputs"] = {"image": features}
        return inputs

    def positions(self, prompt: Sequence[int]) -> torch.Tensor | None:
        """Return the positions of a prompt's tokens, `(3, tokens)`.

        The rows are time, height and width. `prompt` has the token ids. None if the model numbers
        tokens consecutively.
        """
        if not hasattr(self._model.model, "get_rope_index"):
            return None
        ids = torch.tensor([list(prompt)])
        images = [self._pictures.image(number) for number in pictures_in(prompt)]
        grids = [self._processor.measured(image.pixels)[1] for image in images]
        filled = torch.where(ids < 0, self._filled, ids)
        grid = torch.cat(grids) if grids else None
        types = (ids < 0).int()
        positions: torch.Tensor
        positions, _ = self._model.model.get_rope_index(
            filled, mm_token_type_ids=types, image_grid_thw=grid
        )
        return positions[:, 0]

    def _encode(self, images: list[Image]) -> list[list[torch.Tensor]]:
        """Return each layer's inputs for some pictures."""
        processed = self._processor([image.pixels for image in images])
        inputs = {name: value.to(self._model.device) for name, value in processed.items()}
        features = self._model.model.get_image_features(**inputs, return_dict=True)
        layers = [features.pooler_output, *getattr(features, "deepstack_features", ())]
        inputs_of_images = []
        for number in range(len(images)):
            inputs_of_images.append([layer[number] for layer in layers])
        return inputs_of_images


def _markers(tokenizer: Any, written: bool) -> tuple[list[int], list[int]]:
    """Return the markers before and after a picture that some models' processors write,
    and no template.
    """
    if not written:
        return [], []
    around = tokenizer.convert_tokens_to_ids("<fake_token_around_image>")
    whole = tokenizer.convert_tokens_to_ids("<global-img>")
    return [around, whole], [around]


def count_tokens(card: Card) -> int:
    """Return how many tokens a model's image processor makes of one picture.

    `card` is its model card (TOML file), which states the picture's size. Raises ValueError if the
    card takes no pictures, UserError if there is no processor.
    """
    if card.vision is None:
        raise ValueError(f"card {card.name} takes no pictures")
    return Processor(card.name, find_checkpoint(card), card.vision).tokens
