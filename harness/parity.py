"""Parity: one model through two engines. The same prompts, held against each other token by token.

transformers in float32 is the reference. llama.cpp is held to it twice: with the very same float32 weights,
exported on the spot, and with the GGUF file that the model's card names.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from harness.arrays import Floats
from harness.backends import checkpoint
from harness.backends.base import Request
from harness.backends.language_model import LanguageModel
from harness.backends.registry import open_backend
from harness.cards import Card
from harness.gguf_export import export
from harness.parse import parse

LEAST_TEXTS, MOST_READOUT = 0.98, 0.02
MOST_LOGIT = {"F32": 1e-3, "F16": 0.1}  # other formats are measured, and held to nothing
SHOWN = 5  # differences of a kind that are named


@dataclass(frozen=True)
class Finding:
    """One thing compared.

    Attributes:
        what: what was compared.
        measured: the figure.
        allowed: its limit; None where there is none.
        holds: whether it is within.
        n: prompts.
        differences: the first prompts that differ, and how.
    """

    what: str
    measured: float
    allowed: float | None
    holds: bool
    n: int
    differences: tuple[str, ...] = ()


@dataclass(frozen=True)
class Heard:
    """What one engine made of the prompts.

    Attributes:
        tokens: token ids of each json prompt.
        logits: log-probabilities of the whole vocabulary after each, (n, V).
        texts: greedy answers.
        readouts: distributions read out, (n, A).
    """

    tokens: list[list[int]]
    logits: Floats
    texts: list[str]
    readouts: Floats


def compare(
    reference: Card, gguf: Card, asked: Sequence[Request], letters: Sequence[Request],
    progress: Callable[[int], None],
) -> list[Finding]:  # fmt: skip
    """Hold a GGUF card's model against a checkpoint card's.

    Args:
        reference: a card on transformers.
        gguf: a card on llama-cpp.
        asked: requests for JSON.
        letters: requests for a read-out.
        progress: called with how many of five passes over the prompts are done.

    Raises:
        UserError: weights that are not there or do not load; a checkpoint that no GGUF can hold.
    """
    where = checkpoint.find(reference)
    rows = checkpoint.vocabulary(where)
    known = _hear(reference, "float32", 1, asked, letters, rows)
    progress(1)
    found = []
    with tempfile.TemporaryDirectory() as folder:
        exact = Path(folder) / f"{where.name}-f32.gguf"
        export(where, exact, "F32")
        same = replace(gguf, weights=str(exact), file=None, revision=None, sha256=None)
        for label, card in (("F32", same), ("card", gguf)):
            heard = _hear(card, None, 1, asked, letters, rows)
            found += _findings(label if label == "F32" else (gguf.quantisation or "GGUF"), asked, known, heard)
            progress(1)
        for name, card, dtype in (("transformers", reference, "float32"), ("llama-cpp F32", same, None)):
            found.append(_company(name, card, dtype, asked))
            progress(1)
    return found


def _hear(
    card: Card, dtype: str | None, batch_size: int, asked: Sequence[Request], letters: Sequence[Request], rows: int
) -> Heard:
    backend = open_backend(card, device="cpu", dtype=dtype, batch_size=batch_size)
    tokens = [backend.chat.encode(backend.chat.render(r.messages, thinking=r.thinking)) for r in asked]
    logits = np.concatenate([backend.next_log_probs([ids], rows) for ids in tokens])
    texts = [c.text if c.error is None else f"error: {c.error}" for c in backend.complete(asked)]
    read = [parse(c.text, role="ego", actions=r.actions) for r, c in zip(letters, backend.complete(letters), strict=True)]
    nothing = [np.nan] * len(asked[0].actions)
    return Heard(tokens, logits, texts, np.array([p.intent or nothing for p in read]))


def _findings(label: str, asked: Sequence[Request], one: Heard, other: Heard) -> list[Finding]:
    n = len(asked)
    ids = [r.id for r in asked]
    tokens = [i for i, a, b in zip(ids, one.tokens, other.tokens, strict=True) if a != b]
    texts = [
        f"{i}: {a!r} / {b!r}" for i, a, b in zip(ids, one.texts, other.texts, strict=True) if a != b
    ]
    logit = np.abs(one.logits - other.logits).max(axis=1)
    read = np.abs(one.readouts - other.readouts).max(axis=1)
    most = MOST_LOGIT.get(label)
    return [
        Finding(f"{label}: token ids equal", 1 - len(tokens) / n, 1.0, not tokens, n, tuple(tokens[:SHOWN])),
        Finding(f"{label}: largest difference of a logit", float(logit.max()), most,
                most is None or bool(logit.max() <= most), n, _worst(ids, logit, most)),
        Finding(f"{label}: greedy text equal", 1 - len(texts) / n, LEAST_TEXTS,
                len(texts) <= (1 - LEAST_TEXTS) * n, n, tuple(texts[:SHOWN])),
        Finding(f"{label}: largest difference of a read-out", float(read.max()), MOST_READOUT,
                bool(read.max() <= MOST_READOUT), n, _worst(ids, read, MOST_READOUT)),
    ]  # fmt: skip


def _worst(ids: Sequence[str], values: Floats, most: float | None) -> tuple[str, ...]:
    order = np.argsort(-values)[:SHOWN]
    return tuple(f"{ids[i]}: {values[i]:.2g}" for i in order if most is not None and not values[i] <= most)


def _company(name: str, card: Card, dtype: str | None, asked: Sequence[Request]) -> Finding:
    """Batches in another order, against one at a time."""
    alone = open_backend(card, device="cpu", dtype=dtype, batch_size=1).complete(asked)
    together = open_backend(card, device="cpu", dtype=dtype, batch_size=8).complete(asked[::-1])[::-1]
    other = [f"{a.request_id}: {a.text!r} / {b.text!r}" for a, b in zip(alone, together, strict=True) if a.text != b.text]
    return Finding(
        f"{name}: text the same alone and in batches of 8 in reverse order",
        1 - len(other) / len(asked), 1.0, not other, len(asked), tuple(other[:SHOWN]),
    )  # fmt: skip
