"""Sequences that advance together through a transformers model, with cached keys and values.

Sequences of different length are padded on the left of the new tokens, so pads lie between old and new ones.
A mask hides the pads and positions skip them, so full attention gives the same result as without padding.
Other kinds of layer do not (a sliding window counts pads, a recurrent state reads them): a model that has one
reads each sequence on its own.

Importing this imports torch.
"""

from collections.abc import Sequence
from inspect import signature
from typing import Any

import numpy as np
import torch
from transformers.cache_utils import DynamicCache, DynamicLayer

from harness.backends.engine import Session, check_logits
from harness.backends.transformers.eyes import Eyes
from harness.backends.transformers.prefixes import LEAST_TOKENS, NOTHING, Prefix, Prefixes, common
from harness.core.arrays import Floats


class Reader:
    """A model that reads prompts.

    Attributes:
        together: whether sequences can be padded, and so be read in one batch.
    """

    def __init__(self, model: Any, eyes: Eyes | None = None) -> None:
        self._model, self._eyes = model, eyes
        self._prefixes = Prefixes()
        self._failed = False
        self._positions = "position_ids" in signature(model.forward).parameters
        layers = self.cache().layers
        self.together = self._positions and all(type(layer) is DynamicLayer for layer in layers)

    def begin(self, prompts: Sequence[Sequence[int]]) -> Session:
        """Read some prompts, none of them empty."""
        if self._failed:  # perhaps because memory ran out; the failed call has released its own by now
            self._prefixes.clear()
            if self._model.device.type == "cuda":
                torch.cuda.empty_cache()
        self._failed = True  # until reading has succeeded
        session = self._read(prompts)
        self._failed = False
        return session

    def _read(self, prompts: Sequence[Sequence[int]]) -> Session:
        if not self.together:
            return Apart([Rows(self, NOTHING, [prompt]) for prompt in prompts])
        # Each prompt's last token is always read, for the distribution after it.
        shared = common([list(prompt[:-1]) for prompt in prompts])
        # A prompt that is repeated alone is read again, or its time would not be an answer's time.
        if self._eyes and len(prompts) == 1 and self._prefixes.holds(list(prompts[0])):
            self._eyes.forget(prompts[0])
        prefix = self._prefixes.longest(shared, but=prompts[0] if len(prompts) == 1 else ())
        if len(prompts) > 1 and len(shared) - len(prefix.ids) >= LEAST_TOKENS:
            prefix = Prefix(shared, Rows(self, prefix, [shared]).layers())
            self._prefixes.keep(prefix)
        rows = Rows(self, prefix, prompts)
        if len(prompts) == 1:  # its common beginning with the next prompt is not known yet
            self._prefixes.keep(Prefix(list(prompts[0]), rows.layers()))
        return rows

    def cache(self) -> DynamicCache:
        """Return an empty cache of the model's layers."""
        return DynamicCache(config=self._model.config)

    def positions(self, prompts: Sequence[Sequence[int]]) -> list[Any] | None:
        """Return the positions of each prompt's tokens, (3, tokens); None if they are consecutive."""
        if self._eyes is None or not any(token < 0 for prompt in prompts for token in prompt):
            return None
        places = [self._eyes.positions(prompt) for prompt in prompts]
        return None if places[0] is None else places

    def forward(self, cache: DynamicCache, ids: Any, mask: Any, places: Any = None) -> Any:
        """Read tokens and return the logits after the last column, (n, vocabulary).

        Args:
            cache: keys and values so far, to which the new ones are added.
            ids: tokens, (n, width), on the CPU.
            mask: 1 for a token and 0 for a pad, (n, cached + width), on the CPU.
            places: positions, (3, n, width), if they are not consecutive.
        """
        device = self._model.device
        options = {"attention_mask": mask.to(device), "past_key_values": cache, "use_cache": True}
        if places is not None:
            options["position_ids"] = places.to(device)
        elif self._positions:
            options["position_ids"] = (mask.cumsum(-1) - 1).clamp(min=0)[:, -ids.shape[1] :].to(device)
        try:
            with torch.inference_mode():
                options |= self._eyes.inputs(ids) if self._eyes else {"input_ids": ids.to(device)}
                return self._model(logits_to_keep=1, **options).logits[:, -1]
        except Exception:
            self._failed = True
            raise


class Rows:
    """A `Session` of sequences in one batch."""

    def __init__(self, reader: Reader, prefix: Prefix, prompts: Sequence[Sequence[int]]) -> None:
        """Read prompts that all begin with `prefix` and are longer."""
        n, known = len(prompts), len(prefix.ids)
        self._reader = reader
        self._cache = reader.cache()
        for i, (keys, values) in enumerate(prefix.layers):
            self._cache.update(keys.expand(n, -1, -1, -1), values.expand(n, -1, -1, -1), i)
        self._mask = torch.ones(n, known, dtype=torch.long)
        self._logits: Any = None
        self._places = reader.positions(prompts)
        self.advance([prompt[known:] for prompt in prompts])

    def layers(self) -> list[tuple[Any, Any]]:
        """Return each layer's keys and values, (n, heads, tokens, dim); advancing never alters them."""
        return [(layer.keys, layer.values) for layer in self._cache.layers]

    def argmax(self, among: Sequence[Sequence[int] | None]) -> list[int]:
        check_logits(self._logits.amax(-1).tolist())
        best = []
        for row, tokens in zip(self._logits, among, strict=True):
            if tokens is None:
                best.append(row.argmax())
            else:
                ids = torch.tensor(sorted(tokens), device=row.device)
                best.append(ids[row[ids].argmax()])
        chosen: list[int] = torch.stack(best).tolist()
        return chosen

    def log_probs(self, tokens: Sequence[int] | None = None) -> Floats:
        logits = self._logits.float()
        check_logits(logits.amax(-1).tolist())
        selected = logits if tokens is None else logits[:, list(tokens)]
        log_p: Floats = (selected - logits.logsumexp(-1, keepdim=True)).double().cpu().numpy()
        return log_p

    def advance(self, chunks: Sequence[Sequence[int]]) -> None:
        width = max(map(len, chunks))
        if width == 0:
            return
        ids = torch.zeros(len(chunks), width, dtype=torch.long)  # pads stay 0 and are masked
        new = torch.zeros_like(ids)
        for row, chunk in enumerate(chunks):
            if chunk:
                ids[row, width - len(chunk) :] = torch.tensor(chunk)
                new[row, width - len(chunk) :] = 1
        self._mask = torch.cat([self._mask, new], dim=1)
        logits = self._reader.forward(self._cache, ids, self._mask, self._positions(chunks, width))
        advanced = new[:, -1:].bool().to(logits.device)
        self._logits = logits if self._logits is None else torch.where(advanced, logits, self._logits)

    def _positions(self, chunks: Sequence[Sequence[int]], width: int) -> Any:
        """Return the positions of new tokens, (3, n, width); None if they are consecutive."""
        if self._places is None:
            return None
        positions = torch.zeros(3, len(chunks), width, dtype=torch.long)
        for row, chunk in enumerate(chunks):
            if not chunk:
                continue
            end = int(self._mask[row].sum())  # number of the row's tokens, with the new ones
            place, start = self._places[row], end - len(chunk)
            if end > place.shape[1]:  # after the prompt, positions are consecutive
                more = torch.arange(1, end - place.shape[1] + 1) + place.max()
                place = self._places[row] = torch.cat([place, more.expand(3, -1)], dim=1)
            positions[:, row, -len(chunk) :] = place[:, start:end]
        return positions

    def keep(self, places: Sequence[int]) -> None:
        if self._places is not None:
            self._places = [self._places[place] for place in places]
        rows = torch.tensor(places)
        self._mask = self._mask[rows]
        self._logits = self._logits[rows.to(self._logits.device)]
        self._cache.batch_select_indices(rows.to(self._logits.device))

    def close(self) -> None:
        self._cache = self._logits = None


class Apart:
    """A `Session` of sequences that are each read on their own."""

    def __init__(self, sessions: Sequence[Session]) -> None:
        self._sessions = sessions

    def argmax(self, among: Sequence[Sequence[int] | None]) -> list[int]:
        return [s.argmax([tokens])[0] for s, tokens in zip(self._sessions, among, strict=True)]

    def log_probs(self, tokens: Sequence[int] | None = None) -> Floats:
        return np.concatenate([session.log_probs(tokens) for session in self._sessions])

    def advance(self, chunks: Sequence[Sequence[int]]) -> None:
        for session, chunk in zip(self._sessions, chunks, strict=True):
            session.advance([chunk])

    def keep(self, places: Sequence[int]) -> None:
        self._sessions = [self._sessions[place] for place in places]

    def close(self) -> None:
        for session in self._sessions:
            session.close()
