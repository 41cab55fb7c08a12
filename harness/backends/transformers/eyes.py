"""Pictures for a transformers model: its own image processor, and tokens that stand for what it sees.

Importing this imports torch.
"""

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from weakref import WeakValueDictionary

import torch

from harness.backends.engine import picture_of, picture_tokens
from harness.backends.transformers.processor import Processor
from harness.backends.vision import Vision
from harness.core.errors import UserError
from harness.core.image import Image

KEPT = 64  # pictures whose encoding is kept: those of a chunk of requests, for the ego's fusion calls


class Eyes:
    """A loaded model's image processor and vision encoder.

    Attributes:
        image_token: what its chat template writes for a picture.
    """

    def __init__(self, name: str, where: Path, vision: Vision, tokenizer: Any, model: Any) -> None:
        """Load the processor.

        Raises:
            UserError: there is none, or it makes other tokens of a picture than the card says.
        """
        self._processor = Processor(name, where, vision)
        if difference := vision.difference(self._processor.tokens):
            raise UserError(f"model {name!r}: {difference}")
        self._model = model
        self._filled: int = model.config.image_token_id
        self.image_token: str = tokenizer.convert_ids_to_tokens(self._filled)
        self._before, self._after = _markers(tokenizer, vision.scaled_to_px is not None)
        self._images: WeakValueDictionary[int, Image] = WeakValueDictionary()
        # What each layer gets of a picture; those used last are at the end.
        self._encoded: OrderedDict[int, list[torch.Tensor]] = OrderedDict()

    def look(self, image: Image) -> list[int]:
        """What stands for a picture in a prompt; it must be there until that is read."""
        tokens = picture_tokens(image, self._processor.measured(image.pixels)[0])
        self._images[picture_of(tokens[0])[0]] = image
        return [*self._before, *tokens, *self._after]

    def forget(self, prompt: Sequence[int]) -> None:
        """Encode a prompt's pictures again when they are read again."""
        for key in _pictures(prompt):
            self._encoded.pop(key, None)

    def inputs(self, ids: torch.Tensor) -> dict[str, Any]:
        """The model's inputs for tokens (n, width): their ids, and the pictures among them in their order."""
        keys = _pictures(ids.flatten().tolist())
        told: dict[str, Any] = {"input_ids": torch.where(ids < 0, self._filled, ids).to(self._model.device)}
        if keys:
            first, *deeper = zip(*self._encodings(keys), strict=True)
            seen = SimpleNamespace(pooler_output=first, deepstack_features=deeper)
            told["mm_encoder_outputs"] = {"image": seen}
        return told

    def positions(self, prompt: Sequence[int]) -> torch.Tensor | None:
        """Where a prompt's tokens stand, (3, tokens): in time, height and width; None if in one row."""
        if not hasattr(self._model.model, "get_rope_index"):
            return None
        ids = torch.tensor([list(prompt)])
        grids = [self._processor.measured(self._images[key].pixels)[1] for key in _pictures(prompt)]
        place, _ = self._model.model.get_rope_index(
            torch.where(ids < 0, self._filled, ids), mm_token_type_ids=(ids < 0).int(),
            image_grid_thw=torch.cat(grids) if grids else None,
        )  # fmt: skip
        found: torch.Tensor = place[:, 0]
        return found

    def _encodings(self, keys: Sequence[int]) -> list[list[torch.Tensor]]:
        """What each layer gets of some pictures, which are encoded together where they are not yet."""
        owed = [key for key in dict.fromkeys(keys) if key not in self._encoded]
        if owed:
            made = self._processor([self._images[key].pixels for key in owed])
            seen = self._model.model.get_image_features(
                **{name: value.to(self._model.device) for name, value in made.items()}, return_dict=True
            )
            layers = [seen.pooler_output, *getattr(seen, "deepstack_features", ())]
            self._encoded |= {key: [layer[i] for layer in layers] for i, key in enumerate(owed)}
        for key in keys:
            self._encoded.move_to_end(key)
        found = [self._encoded[key] for key in keys]
        while len(self._encoded) > KEPT:
            self._encoded.popitem(last=False)
        return found


def _pictures(tokens: Sequence[int]) -> list[int]:
    """The pictures whose first token is among these, in order."""
    found = (picture_of(token) for token in tokens if token < 0)
    return [key for key, place in found if place == 0]


def _markers(tokenizer: Any, written: bool) -> tuple[list[int], list[int]]:
    """Tokens before and behind a picture's, which the processor of some models writes, and no template."""
    if not written:
        return [], []
    around, whole = map(tokenizer.convert_tokens_to_ids, ("<fake_token_around_image>", "<global-img>"))
    return [around, whole], [around]
