"""Sequences that advance together through a graph of OpenVINO, which has their keys and values.

These lie in blocks of tokens (paged attention): a sequence is a list of blocks, so that several
begin with the same ones, none is padded, and what is dropped is overwritten. Importing this imports
openvino.
"""

from collections.abc import Sequence
from itertools import chain

import numpy as np

from harness.backends.engine import (
    Session,
    check_logits,
    common_beginning,
    common_length,
    group_by_beginning,
)
from harness.core.arrays import Floats
from harness.extensions.openvino.model import BLOCK, Logits, OpenVinoModel, Part

MOST_KEPT = 2048  # tokens of earlier prompts whose keys and values are kept
MOST_READ = 1024  # tokens read together: what more of them need does not stay in a CPU's cache


class Blocks:
    """Count who uses each block of keys and values: sequences, and beginnings that are kept."""

    def __init__(self) -> None:
        self._users: list[int] = []

    @property
    def number(self) -> int:
        return len(self._users)

    def take(self) -> int:
        """Return the number of a block that nobody uses, which is used once now."""
        if 0 not in self._users:
            self._users.append(0)
        block = self._users.index(0)
        self._users[block] = 1
        return block

    def share(self, blocks: Sequence[int]) -> list[int]:
        for block in blocks:
            self._users[block] += 1
        return list(blocks)

    def release(self, blocks: Sequence[int]) -> None:
        for block in blocks:
            self._users[block] -= 1


class Reader:
    """Read prompts with a model, and keep beginnings for later prompts."""

    def __init__(self, model: OpenVinoModel) -> None:
        self.model, self.blocks = model, Blocks()
        # token ids and blocks of beginnings, in whole blocks; the least recently used comes first
        self._kept: list[tuple[list[int], list[int]]] = []

    def begin(self, prompts: Sequence[list[int]], exact: bool) -> "Rows":
        """Return a session that has read prompts, none empty; `exact` wants float32 logits."""
        rows = Rows(self, exact)
        try:
            self._read(rows, prompts)
        except BaseException:  # perhaps memory ran out
            rows.close()
            self.forget()
            raise
        return rows

    def _read(self, rows: "Rows", prompts: Sequence[list[int]]) -> None:
        heads = [prompt[:-1] for prompt in prompts]  # the last token is read for its logits
        alone = len(prompts) == 1
        lengths = [0] * len(prompts)  # of what a prompt's sequence has
        starts: list[list[int]] = [[] for _ in prompts]
        for places in group_by_beginning(heads):
            shared = common_beginning([heads[place] for place in places])
            shared = shared[: len(shared) // BLOCK * BLOCK]
            # a prompt that is repeated alone is read again, or its time would not be an answer's
            blocks = self._nearest(shared, prompts[0] if alone else None)
            if len(places) > 1 and len(blocks) * BLOCK < len(shared):
                rows.start([blocks])
                rows.advance([shared[len(blocks) * BLOCK :]])
                blocks = self._keep(shared, rows.taken(0))
                rows.close()
            for place in places:
                starts[place], lengths[place] = blocks, len(blocks) * BLOCK
        rows.start(starts)
        rows.advance([prompt[length:] for prompt, length in zip(prompts, lengths, strict=True)])
        if alone:  # what the next prompt shares is not known yet
            self._keep(prompts[0], rows.taken(0))

    def forget(self) -> None:
        for _, blocks in self._kept:
            self.blocks.release(blocks)
        self._kept.clear()

    def _nearest(self, shared: list[int], but: list[int] | None) -> list[int]:
        """Return the blocks of the longest kept beginning of some tokens, of no prompt `but`."""
        most: list[int] = []
        for ids, blocks in self._kept:
            count = 0 if ids == but else common_length([ids, shared]) // BLOCK
            if count > len(most):
                most, nearest = blocks[:count], (ids, blocks)
        if most:  # it was used most recently
            self._kept.remove(nearest)
            self._kept.append(nearest)
        return most

    def _keep(self, ids: list[int], blocks: Sequence[int]) -> list[int]:
        """Keep a beginning in its whole blocks, and return these."""
        whole = self.blocks.share(blocks[: len(ids) // BLOCK])
        self._kept.append((ids, whole))
        while len(self._kept) > 1 and sum(len(each) for _, each in self._kept) * BLOCK > MOST_KEPT:
            self.blocks.release(self._kept.pop(0)[1])
        return whole


class Rows(Session):
    """Advance n sequences of one batch, each in blocks of its own and in common ones."""

    def __init__(self, reader: Reader, exact: bool) -> None:
        self._reader, self._exact = reader, exact
        self._blocks: list[list[int]] = []  # of each sequence
        self._lengths: list[int] = []  # of each sequence, in tokens
        self._logits: Logits = np.zeros((0, 0), dtype=np.float32)  # (n, vocabulary)

    def start(self, beginnings: Sequence[Sequence[int]]) -> None:
        """Begin sequences with blocks that are full."""
        self._blocks = [self._reader.blocks.share(blocks) for blocks in beginnings]
        self._lengths = [len(blocks) * BLOCK for blocks in beginnings]
        self._logits = np.zeros((len(beginnings), self._reader.model.vocabulary), np.float32)

    def taken(self, row: int) -> list[int]:
        """Return the blocks of a sequence."""
        return self._blocks[row]

    def argmax(self, among: Sequence[Sequence[int] | None]) -> list[int]:
        check_logits(self._logits.max(axis=1).tolist())
        chosen = self._logits.argmax(axis=1).tolist()
        for row, allowed in enumerate(among):
            if allowed is not None:
                tokens = np.unique(allowed)
                chosen[row] = int(tokens[self._logits[row, tokens].argmax()])
        return [int(token) for token in chosen]

    def log_probs(self, tokens: Sequence[int] | None = None) -> Floats:
        largest = self._logits.max(axis=1, keepdims=True).astype(np.float64)
        check_logits(largest.ravel().tolist())
        reduced = self._logits - largest
        total = np.log(np.exp(reduced).sum(axis=1, keepdims=True))
        log_p: Floats = (reduced if tokens is None else reduced[:, list(tokens)]) - total
        return log_p

    def advance(self, chunks: Sequence[Sequence[int]]) -> None:
        reads = [row for row, chunk in enumerate(chunks) if chunk]
        while reads:
            count = 1
            while count < len(reads) and _total(chunks, reads[: count + 1]) <= MOST_READ:
                count += 1
            now, reads = reads[:count], reads[count:]
            ends = np.cumsum([len(chunks[row]) for row in now])
            self._logits[now] = self._append(now, [chunks[row] for row in now], ends - 1)

    def follow(
        self, chunks: Sequence[Sequence[int]], guesses: Sequence[Sequence[int]]
    ) -> list[int]:
        both = [[*chunk, *guess] for chunk, guess in zip(chunks, guesses, strict=True)]
        columns, start = list[int](), 0
        for chunk, ids in zip(chunks, both, strict=True):
            columns += range(start + len(chunk) - 1, start + len(ids))
            start += len(ids)
        logits = self._append(range(len(both)), both, np.array(columns))
        likeliest, start, counts = logits.argmax(axis=1).tolist(), 0, list[int]()
        for row, guess in enumerate(guesses):
            count = common_length([list(guess), likeliest[start : start + len(guess)]])
            self._logits[row] = logits[start + count]
            self._lengths[row] -= len(guess) - count
            counts.append(count)
            start += len(guess) + 1
        return counts

    def ends(self, chunks: Sequence[Sequence[Sequence[int]]], tokens: Sequence[int]) -> Floats:
        lengths, readings = list(self._lengths), []
        for turn in zip(*chunks, strict=True):
            self.advance(turn)
            readings.append(self.log_probs(tokens))
            self._lengths = list(lengths)
        return np.stack(readings, axis=1)

    def keep(self, places: Sequence[int]) -> None:
        for row, blocks in enumerate(self._blocks):
            if row not in places:
                self._reader.blocks.release(blocks)
        self._blocks = [self._blocks[place] for place in places]
        self._lengths = [self._lengths[place] for place in places]
        self._logits = self._logits[list(places)]

    def close(self) -> None:
        for blocks in self._blocks:
            self._reader.blocks.release(blocks)
        self._blocks = []

    def _append(
        self, rows: Sequence[int], chunks: Sequence[Sequence[int]], columns: np.ndarray
    ) -> Logits:
        """Append token ids to some sequences; return the logits (K, vocabulary) of K of them.

        `columns` has the places of these among all token ids, one chunk after another.
        """
        parts = []
        for row, chunk in zip(rows, chunks, strict=True):
            length = self._lengths[row] + len(chunk)
            while len(self._blocks[row]) * BLOCK < length:
                self._blocks[row].append(self._reader.blocks.take())
            parts.append(Part(list(chunk), self._lengths[row], self._blocks[row]))
            self._lengths[row] = length
        return self._reader.model.run(parts, columns, self._reader.blocks.number, self._exact)


def _total(chunks: Sequence[Sequence[int]], rows: Sequence[int]) -> int:
    return len(list(chain.from_iterable(chunks[row] for row in rows)))
