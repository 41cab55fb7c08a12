"""Sequences that advance together through a transformers model, with cached keys and values.

Sequences of different length are padded on the left of the new tokens, so pads lie between old and
new ones. A mask hides the pads and positions skip them, so full attention gives the same result as
without padding. Other kinds of layer do not (a sliding window counts pads, a recurrent state reads
them): a model that has one reads each sequence on its own.

Prompts are read in groups that begin alike, and are joined when they advance: a batch of an ego's
and its helpers' prompts reads neither system text again, and a short prompt is not padded to the
longest of all.

Importing this imports torch.
"""

from collections.abc import Sequence
from copy import deepcopy
from inspect import signature
from typing import Any

import numpy as np
import torch
from torch.nn.functional import linear, pad
from transformers.cache_utils import Cache, DynamicCache, DynamicLayer

from harness.backends.engine import Session, check_logits, common_beginning, group_by_beginning
from harness.backends.transformers.eyes import Eyes
from harness.backends.transformers.memory import (
    LEAST_TOKENS,
    NOTHING,
    Prefix,
    Prefixes,
    join_caches,
)
from harness.core.arrays import Floats

# most tokens that a CPU reads together: what more of them need does not stay in its cache
CPU_TOKENS = 1024


class Reader:
    """Read prompts with a transformers model, and keep beginnings for later prompts.

    `together` says whether several sequences can be padded to one length and read in one batch,
    which recurrent models and sliding windows do not allow.
    """

    def __init__(self, model: Any, eyes: Eyes | None = None) -> None:
        self._model, self._eyes = model, eyes
        self._prefixes = Prefixes()
        self._failed = False
        self._positions = "position_ids" in signature(model.forward).parameters
        layers = DynamicCache(config=model.config).layers
        self._exact: list[int] = []
        head = model.get_output_embeddings()
        if head is not None and model.dtype != torch.float32:
            head.register_forward_hook(self._in_float32)
        self.together = self._positions and all(type(layer) is DynamicLayer for layer in layers)

    def begin(self, prompts: Sequence[Sequence[int]], exact: Sequence[int] = ()) -> Session:
        """Return a session that has read these prompts, none of them empty.

        Until the next call, logits of the token ids in `exact` are computed in float32.
        """
        self._exact = list(exact)
        # perhaps because memory ran out; the failed call has released its own by now
        if self._failed:
            self._prefixes.clear()
            if self._model.device.type == "cuda":
                torch.cuda.empty_cache()
        self._failed = True  # until reading has succeeded
        session = self._read([list(prompt) for prompt in prompts])
        self._failed = False
        return session

    def forget(self) -> None:
        self._prefixes.clear()

    def _in_float32(self, head: Any, inputs: tuple[Any, ...], logits: Any) -> Any:
        """Replace the exact tokens' logits:
        16 bits leave steps of .06 to .13 between likely ones.
        """
        if not self._exact:
            return logits
        tokens = torch.tensor(self._exact, device=logits.device)
        bias = None if getattr(head, "bias", None) is None else head.bias[tokens].float()
        logits = logits.float()
        logits[..., tokens] = linear(inputs[0].float(), head.weight[tokens].float(), bias)
        return logits

    def _read(self, prompts: list[list[int]]) -> Session:
        if not self.together:
            return Apart([Rows.read(self, NOTHING, [p], self.positions([p])) for p in prompts])
        # Each prompt's last token is always read, for the distribution after it.
        beginnings = [prompt[:-1] for prompt in prompts]
        if len(prompts) == 1:
            return self._read_alone(prompts[0], beginnings[0])
        positions = self.positions(prompts)
        if self._eyes:
            self._eyes.encode(token for prompt in prompts for token in prompt)
        parts = []
        for group in group_by_beginning(beginnings):
            prefix = self._prefix([beginnings[place] for place in group])
            for piece in self._pieces(group, [len(prompt) - len(prefix.ids) for prompt in prompts]):
                at = positions and [positions[place] for place in piece]
                parts.append(
                    (piece, Rows.read(self, prefix, [prompts[place] for place in piece], at))
                )
        return Rows.join(parts, positions)

    def _read_alone(self, prompt: list[int], beginning: list[int]) -> Session:
        # A prompt that is repeated alone is read again, or its time would not be an answer's time.
        if self._eyes and self._prefixes.holds(prompt):
            self._eyes.forget(prompt)
            beginning = beginning[
                : next((i for i, token in enumerate(prompt) if token < 0), len(prompt))
            ]
        prefix = self._prefixes.longest(beginning, but=prompt)
        rows = Rows.read(self, prefix, [prompt], self.positions([prompt]))
        # what the next prompt shares is not known yet
        self._prefixes.keep(Prefix(prompt, rows.layers()))
        return rows

    def _prefix(self, beginnings: list[list[int]]) -> Prefix:
        """Return what some prompts begin with;
        what is read of it is kept, unless half of it was.
        """
        shared = common_beginning(beginnings)
        prefix = self._prefixes.longest(shared)
        n_known = len(prefix.ids)
        if len(beginnings) > 1 and len(shared) - n_known >= LEAST_TOKENS:
            prefix = Prefix(
                shared, Rows.read(self, prefix, [shared], self.positions([shared])).layers()
            )
            if 2 * n_known < len(shared):
                self._prefixes.keep(prefix)
        return prefix

    def _pieces(self, group: Sequence[int], lengths: Sequence[int]) -> list[list[int]]:
        """Split a group's places into those that are read together, the longest first.

        `lengths` has the number of tokens to read of each prompt.
        """
        most = CPU_TOKENS if self._model.device.type == "cpu" else sum(lengths)
        pieces: list[list[int]] = []
        for place in sorted(group, key=lengths.__getitem__, reverse=True):
            if not pieces or (len(pieces[-1]) + 1) * lengths[pieces[-1][0]] > most:
                pieces.append([])
            pieces[-1].append(place)
        return [sorted(piece) for piece in pieces]

    def cache(self) -> Cache:
        return DynamicCache(config=self._model.config)

    def positions(self, prompts: Sequence[Sequence[int]]) -> list[Any] | None:
        """Return the positions of each prompt's tokens, one array `(3, tokens)` a prompt.

        The rows are time, height and width. None if all are consecutive, as without pictures.
        """
        if self._eyes is None or not any(token < 0 for prompt in prompts for token in prompt):
            return None
        places = [self._eyes.positions(prompt) for prompt in prompts]
        return None if places[0] is None else places

    def forward(self, cache: Cache, ids: Any, mask: Any, columns: Any, places: Any) -> Any:
        """Read tokens of n sequences; return logits after some columns, `(n, columns, vocabulary)`.

        Args:
            cache: keys and values so far, to which the new ones are added.
            ids: token ids, (n, width), on the CPU.
            mask: 1 for a token and 0 for a pad, (n, cached + width),
                or what each token sees, (n, 1, width, cached + width), on the CPU.
            columns: how many of the last columns of `ids`, or the indices of columns.
            places: positions of the tokens in their prompt, (n, width), or (3, n, width) for time,
                height and width; None if they are consecutive.
        """
        device = self._model.device
        # added to what attention weighs: not every kind of it takes truth values
        if mask.ndim == 4:
            mask = torch.where(mask, 0.0, torch.finfo(self._model.dtype).min).to(self._model.dtype)
        options = {"attention_mask": mask.to(device), "past_key_values": cache, "use_cache": True}
        if places is not None:
            options["position_ids"] = places.to(device)
        elif self._positions:
            options["position_ids"] = (
                (mask.cumsum(-1) - 1).clamp(min=0)[:, -ids.shape[1] :].to(device)
            )
        try:
            with torch.inference_mode():
                options |= self._eyes.inputs(ids) if self._eyes else {"input_ids": ids.to(device)}
                return self._model(logits_to_keep=columns, **options).logits
        except Exception:
            self._failed = True
            raise


class Rows:
    """Advance sequences that are rows of one padded batch of a transformers model: a `Session`."""

    def __init__(self, reader: Reader, cache: Cache, mask: Any, logits: Any, places: Any) -> None:
        """Hold a batch that was read, and the logits after each sequence, `(n, vocabulary)`.

        `mask` is 1 for a token and 0 for a pad, (n, columns), on the CPU. `places` has the
        positions of each prompt's tokens; None if they are consecutive.
        """
        self._reader, self._cache, self._mask, self._logits = reader, cache, mask, logits
        self._places = places

    @classmethod
    def read(
        cls, reader: Reader, prefix: Prefix, prompts: Sequence[Sequence[int]], places: Any
    ) -> "Rows":
        """Return a session that has read prompts, which all begin with `prefix` and are longer.

        `reader` has the model, and `prompts` the token ids. `places` has the positions of each
        prompt's tokens, `(3, tokens)` for time, height and width; None if they are consecutive.
        """
        n, n_known, cache = len(prompts), len(prefix.ids), reader.cache()
        for i, (keys, values) in enumerate(prefix.layers):
            cache.update(keys.expand(n, -1, -1, -1), values.expand(n, -1, -1, -1), i)
        rows = cls(reader, cache, torch.ones(n, n_known, dtype=torch.long), None, places)
        rows.advance([prompt[n_known:] for prompt in prompts])
        return rows

    @classmethod
    def join(cls, parts: Sequence[tuple[Sequence[int], "Rows"]], positions: Any) -> "Rows":
        """Return the sequences of several sessions as one session.

        Each of `parts` is a pair: the indices of its sequences in the whole, and its session.
        `positions` has the positions of each prompt's tokens, `(3, tokens)`, in the order of the
        whole; None if they are consecutive.
        """
        if len(parts) == 1:
            return parts[0][1]
        order = torch.tensor([place for piece, _ in parts for place in piece]).argsort()
        columns = max(rows._mask.shape[1] for _, rows in parts)
        mask = torch.cat([pad(rows._mask, (0, columns - rows._mask.shape[1])) for _, rows in parts])
        logits = torch.cat([rows._logits for _, rows in parts])
        cache = join_caches([rows._cache for _, rows in parts], order)
        return cls(
            parts[0][1]._reader, cache, mask[order], logits[order.to(logits.device)], positions
        )

    def copy(self) -> "Rows":
        return Rows(self._reader, deepcopy(self._cache), self._mask, self._logits, self._places)

    def layers(self) -> list[tuple[Any, Any]]:
        """Return each layer's keys and values of the n sequences, to keep them for later.

        Each is an array `(n, heads, tokens, dim)` that stays valid.
        """
        return [(layer.keys, layer.values) for layer in self._cache.layers]

    def argmax(self, among: Sequence[Sequence[int] | None]) -> list[int]:
        check_logits(self._logits.amax(-1).tolist())
        chosen: list[int] = self._logits.argmax(-1).tolist()
        for row, tokens in enumerate(among):
            if tokens is not None:
                ids = sorted(tokens)
                chosen[row] = ids[int(self._logits[row, ids].argmax())]
        return chosen

    def log_probs(self, tokens: Sequence[int] | None = None) -> Floats:
        return _log_probs(self._logits, tokens)

    def ends(self, chunks: Sequence[Sequence[Sequence[int]]], tokens: Sequence[int]) -> Floats:
        # All chunks of a sequence stand side by side in its row, and a token sees those of its own
        # chunk alone: the sequence's keys and values are neither copied nor read again.
        n, count = len(chunks), len(chunks[0])
        width = max(len(chunk) for each in chunks for chunk in each)
        ids = torch.zeros(n, count, width, dtype=torch.long)
        is_token = torch.zeros(n, count, width, dtype=torch.bool)
        for row, each in enumerate(chunks):
            for i, chunk in enumerate(each):
                ids[row, i, width - len(chunk) :] = torch.tensor(chunk)
                is_token[row, i, width - len(chunk) :] = True
        same = torch.eye(count, dtype=torch.bool)[:, None, :, None]
        earlier = torch.ones(width, width, dtype=torch.bool).tril()[:, None]
        among = (same & earlier & is_token[:, None, None]).reshape(n, count * width, count * width)
        before = self._mask.bool()[:, None].expand(-1, count * width, -1)
        if self._places is None:
            starts = self._mask.sum(-1)
        else:  # after the prompt, positions are consecutive
            starts = torch.stack([place.max() + 1 for place in self._places])
        places = (starts[:, None, None] + (is_token.cumsum(-1) - 1).clamp(min=0)).reshape(n, -1)
        if self._places is not None:
            places = places.expand(3, -1, -1)
        mask = torch.cat([before, among], dim=-1)[:, None]
        last = torch.arange(1, count + 1) * width - 1
        logits = self._reader.forward(self._cache, ids.reshape(n, -1), mask, last, places)
        return _log_probs(logits.flatten(0, 1), tokens).reshape(n, count, -1)

    def advance(self, chunks: Sequence[Sequence[int]]) -> None:
        if not any(chunks):
            return
        logits = self._append(chunks, 1)[:, -1]
        advanced = torch.tensor([[bool(chunk)] for chunk in chunks], device=logits.device)
        self._logits = (
            logits if self._logits is None else torch.where(advanced, logits, self._logits)
        )

    def follow(
        self, chunks: Sequence[Sequence[int]], guesses: Sequence[Sequence[int]]
    ) -> list[int]:
        widest = max(map(len, guesses))
        both = [[*chunk, *guess] for chunk, guess in zip(chunks, guesses, strict=True)]
        logits = self._append(both, 1 + widest)
        counts = []
        for guess, choices in zip(guesses, logits.argmax(-1).tolist(), strict=True):
            likeliest = zip(guess, choices[widest - len(guess) :], strict=False)
            counts.append(next((i for i, (a, b) in enumerate(likeliest) if a != b), len(guess)))
        wrong = [len(guess) - count for guess, count in zip(guesses, counts, strict=True)]
        for row, tokens in enumerate(wrong):
            self._mask[row, self._mask.shape[1] - tokens :] = 0
        self._logits = logits[torch.arange(len(wrong)), widest - torch.tensor(wrong)]
        if cut := min(wrong):
            self._mask = self._mask[:, :-cut]
            self._cache.crop(-cut)
        return counts

    def _append(self, chunks: Sequence[Sequence[int]], columns: int) -> Any:
        """Read tokens and return the logits after each of the last columns,
        (n, columns, vocabulary).
        """
        width = max(map(len, chunks))
        ids = torch.tensor([[0] * (width - len(chunk)) + list(chunk) for chunk in chunks])
        new = torch.tensor([[0] * (width - len(chunk)) + [1] * len(chunk) for chunk in chunks])
        self._mask = torch.cat([self._mask, new], dim=1)
        return self._reader.forward(
            self._cache, ids, self._mask, columns, self._positions(chunks, width)
        )

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


def _log_probs(logits: Any, tokens: Sequence[int] | None) -> Floats:
    logits = logits.float()
    check_logits(logits.amax(-1).tolist())
    selected = logits if tokens is None else logits[:, list(tokens)]
    log_p: Floats = (selected - logits.logsumexp(-1, keepdim=True)).double().cpu().numpy()
    return log_p


class Apart(Session):
    """Advance sequences of a transformers model that are each read on their own: a `Session`.

    It is for models with a sliding window or a recurrent state, which padding would change.
    """

    def __init__(self, sessions: Sequence[Rows]) -> None:
        self._sessions = sessions

    def argmax(self, among: Sequence[Sequence[int] | None]) -> list[int]:
        return [s.argmax([tokens])[0] for s, tokens in zip(self._sessions, among, strict=True)]

    def log_probs(self, tokens: Sequence[int] | None = None) -> Floats:
        return np.concatenate([session.log_probs(tokens) for session in self._sessions])

    def advance(self, chunks: Sequence[Sequence[int]]) -> None:
        for session, chunk in zip(self._sessions, chunks, strict=True):
            session.advance([chunk])

    def ends(self, chunks: Sequence[Sequence[Sequence[int]]], tokens: Sequence[int]) -> Floats:
        rows = []
        for session, each in zip(self._sessions, chunks, strict=True):
            forks = [session.copy() for _ in each]
            for fork, chunk in zip(forks, each, strict=True):
                fork.advance([chunk])
            rows.append(np.concatenate([fork.log_probs(tokens) for fork in forks]))
        return np.stack(rows)

    def keep(self, places: Sequence[int]) -> None:
        self._sessions = [self._sessions[place] for place in places]

    def close(self) -> None:
        for session in self._sessions:
            session.close()
