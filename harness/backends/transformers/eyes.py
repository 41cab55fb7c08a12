"""Vision of a transformers model: its image processor and encoder, and the tokens that stand for pictures.

Importing this imports torch.
"""

from collections import OrderedDict
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from weakref import WeakValueDictionary

import torch

from harness.backends.engine import locate_picture, picture_tokens
from harness.backends.transformers.processor import Processor
from harness.backends.vision import Vision
from harness.core.errors import UserError
from harness.core.image import Image

KEPT = 64  # pictures whose encoding is kept: those of a chunk of requests, for the ego's fusion calls


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
        self._images: WeakValueDictionary[int, Image] = WeakValueDictionary()
        # Each layer's inputs for a picture; the most recently used are at the end.
        self._encoded: OrderedDict[int, list[torch.Tensor]] = OrderedDict()

    def look(self, image: Image) -> list[int]:
        """Return the tokens that stand for a picture; the `Image` must stay alive until they are read."""
        tokens = picture_tokens(image, self._processor.measured(image.pixels)[0])
        self._images[locate_picture(tokens[0])[0]] = image
        return [*self._before, *tokens, *self._after]

    def forget(self, prompt: Sequence[int]) -> None:
        """Drop the encodings of a prompt's pictures, so that they are encoded again."""
        for key in _pictures(prompt):
            self._encoded.pop(key, None)

    def encode(self, tokens: Iterable[int]) -> None:
        """Encode the pictures among some tokens together, unless they are too many to be kept."""
        keys = list(dict.fromkeys(_pictures(tokens)))
        if 0 < len(keys) <= KEPT:
            with torch.inference_mode():
                self._encodings(keys)

    def inputs(self, ids: torch.Tensor) -> dict[str, Any]:
        """Return the model's inputs for tokens (n, width): their ids, and their pictures in order."""
        keys = _pictures(ids.flatten().tolist())
        token_ids = torch.where(ids < 0, self._filled, ids).to(self._model.device)
        inputs: dict[str, Any] = {"input_ids": token_ids}
        if keys:
            first, *deeper = zip(*self._encodings(keys), strict=True)
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
        grids = [self._processor.measured(self._images[key].pixels)[1] for key in _pictures(prompt)]
        place, _ = self._model.model.get_rope_index(
            torch.where(ids < 0, self._filled, ids), mm_token_type_ids=(ids < 0).int(),
            image_grid_thw=torch.cat(grids) if grids else None,
        )  # fmt: skip
        positions: torch.Tensor = place[:, 0]
        return positions

    def _encodings(self, keys: Sequence[int]) -> list[list[torch.Tensor]]:
        """Return each layer's inputs for some pictures; those not yet encoded are encoded together."""
        new = [key for key in dict.fromkeys(keys) if key not in self._encoded]
        if new:
            inputs = self._processor([self._images[key].pixels for key in new])
            features = self._model.model.get_image_features(
                **{name: value.to(self._model.device) for name, value in inputs.items()}, return_dict=True
            )
            layers = [features.pooler_output, *getattr(features, "deepstack_features", ())]
            self._encoded |= {key: [layer[i] for layer in layers] for i, key in enumerate(new)}
        for key in keys:
            self._encoded.move_to_end(key)
        encodings = [self._encoded[key] for key in keys]
        while len(self._encoded) > KEPT:
            self._encoded.popitem(last=False)
        return encodings


def _pictures(tokens: Iterable[int]) -> list[int]:
    """Return the pictures whose first token is among these, in order."""
    pictures = (locate_picture(token) for token in tokens if token < 0)
    return [key for key, place in pictures if place == 0]


def _markers(tokenizer: Any, written: bool) -> tuple[list[int], list[int]]:
    """Return the markers before and after a picture that some models' processors write, and no template."""
    if not written:
        return [], []
    around, whole = map(tokenizer.convert_tokens_to_ids, ("<fake_token_around_image>", "<global-img>"))
    return [around, whole], [around]
