"""Vision of a transformers model: its image processor and encoder, and the tokens that stand for pictures.

Importing this imports torch.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from harness.backends.pictures import KEPT, Pictures, pictures_in
from harness.backends.transformers.processor import Processor
from harness.backends.vision import Vision
from harness.core.errors import UserError
from harness.core.image import Image


class Eyes:
    """A loaded model's image processor and vision encoder; a picture is `image_token` in its template."""

    def __init__(self, name: str, where: Path, vision: Vision, tokenizer: Any, model: Any) -> None:
        """Load the processor. Raises UserError if there is none, or it makes more or fewer tokens."""
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
        """Return the tokens that stand for a picture; the `Image` must stay alive until they are read."""
        tokens = self._pictures.add(image, self._processor.measured(image.pixels)[0])
        return [*self._before, *tokens, *self._after]

    def encode(self, tokens: Iterable[int]) -> None:
        """Encode the pictures among some tokens together, unless they are too many to be kept."""
        numbers = list(dict.fromkeys(pictures_in(tokens)))
        if len(numbers) <= KEPT:
            with torch.inference_mode():
                self._pictures.encodings(numbers)

    def inputs(self, ids: torch.Tensor) -> dict[str, Any]:
        """Return the model's inputs for tokens (n, width): their ids, and their pictures in order."""
        numbers = pictures_in(ids.flatten().tolist())
        token_ids = torch.where(ids < 0, self._filled, ids).to(self._model.device)
        inputs: dict[str, Any] = {"input_ids": token_ids}
        if numbers:
            first, *deeper = zip(*self._pictures.encodings(numbers), strict=True)
            features = SimpleNamespace(pooler_output=first, deepstack_features=deeper)
            inputs["mm_encoder_outputs"] = {"image": features}
        return inputs

    def positions(self, prompt: Sequence[int]) -> torch.Tensor | None:
        """Return the positions of a prompt's tokens in time, height and width, (3, tokens).

        None if the model numbers tokens consecutively.
        """
        if not hasattr(self._model.model, "get_rope_index"):
            return None
        ids = torch.tensor([list(prompt)])
        images = [self._pictures.image(number) for number in pictures_in(prompt)]
        grids = [self._processor.measured(image.pixels)[1] for image in images]
        filled, grid = torch.where(ids < 0, self._filled, ids), torch.cat(grids) if grids else None
        types = (ids < 0).int()
        place, _ = self._model.model.get_rope_index(filled, mm_token_type_ids=types, image_grid_thw=grid)
        positions: torch.Tensor = place[:, 0]
        return positions

    def _encode(self, images: list[Image]) -> list[list[torch.Tensor]]:
        """Return each layer's inputs for some pictures."""
        inputs = self._processor([image.pixels for image in images])
        features = self._model.model.get_image_features(
            **{name: value.to(self._model.device) for name, value in inputs.items()}, return_dict=True
        )
        layers = [features.pooler_output, *getattr(features, "deepstack_features", ())]
        return [[layer[i] for layer in layers] for i in range(len(images))]


def _markers(tokenizer: Any, written: bool) -> tuple[list[int], list[int]]:
    """Return the markers before and after a picture that some models' processors write, and no template."""
    if not written:
        return [], []
    around, whole = map(tokenizer.convert_tokens_to_ids, ("<fake_token_around_image>", "<global-img>"))
    return [around, whole], [around]
