"""Pictures for a transformers model: its own image processor, and tokens that stand for what it sees.

Importing this imports torch.
"""

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from harness.backends.transformers.processor import Processor
from harness.backends.vision import Vision
from harness.core.errors import UserError
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
        self._processor = Processor(name, where, vision)
        if difference := vision.difference(self._processor.tokens):
            raise UserError(f"model {name!r}: {difference}")
        self._model = model
        self._filled: int = model.config.image_token_id
        self.image_token: str = tokenizer.convert_ids_to_tokens(self._filled)
        self._before, self._after = _markers(tokenizer, vision.scaled_to_px is not None)
        self._next = -1
        self._seen = OrderedDict[str, tuple[range, Pixels]]()  # by digest, those asked for longest ago first

    def look(self, image: Image) -> list[int]:
        """What stands for a picture in a prompt; see `harness.backends.engine.Engine.look`."""
        if image.sha256 not in self._seen:
            tokens, _ = self._processor.measured(image.pixels)
            self._seen[image.sha256] = range(self._next, self._next - tokens, -1), image.pixels
            self._next -= tokens
            while len(self._seen) > KEPT:
                self._seen.popitem(last=False)
        self._seen.move_to_end(image.sha256)
        return [*self._before, *self._seen[image.sha256][0], *self._after]

    def inputs(self, ids: torch.Tensor) -> dict[str, Any]:
        """The model's inputs for tokens (n, width): their ids, and the pictures among them in their order."""
        found = self._pictures(ids.flatten().tolist())
        pictures = self._processor(found) if found else {}
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
        grids = [self._processor.measured(pixels)[1] for pixels in self._pictures(list(prompt))]
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


def _markers(tokenizer: Any, written: bool) -> tuple[list[int], list[int]]:
    """Tokens before and behind a picture's, which the processor of some models writes, and no template."""
    if not written:
        return [], []
    around, whole = map(tokenizer.convert_tokens_to_ids, ("<fake_token_around_image>", "<global-img>"))
    return [around, whole], [around]
