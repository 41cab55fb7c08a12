"""Parity: one model through two engines. The same prompts, compared token by token.

transformers in float32 is the reference. llama.cpp is held to it twice: with the very same float32 weights,
exported on the spot, and with the GGUF file that the model's card names.
"""

import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from harness.backends.base import Backend, Request
from harness.backends.cards import Card
from harness.backends.language_model import LanguageModel
from harness.backends.llama_cpp import backend as llama_backend
from harness.backends.llama_cpp.backend import LlamaBackend
from harness.backends.transformers import engine as transformers_engine
from harness.backends.weights import find_checkpoint
from harness.core.arrays import Floats
from harness.core.errors import Unanswered, printable
from harness.core.files import text_of
from harness.parsing.parse import parse
from harness.training.gguf_export import export, projector_of

LEAST_TEXTS, MOST_READOUT = 0.98, 0.02
# Other formats are measured, and held to nothing. Of a picture llama.cpp rounds pixels, the weights of their
# patches and GELU to half precision in files of any format.
MOST_LOGIT = {"F32": 1e-3, "F16": 0.1}
SEEN = {"F32": 0.1, "F16": 0.1}
SHOWN = 5  # differences of a kind that are named
BATCH = 8
PASSES = 5


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
class Outputs:
    """The outputs of one engine, a prompt at a time.

    Attributes:
        tokens: token ids of the text of each json prompt.
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
        progress: called with 1 after each of `PASSES` passes over the prompts.

    Raises:
        UserError: weights that are not there or do not load; a checkpoint that no GGUF can hold.
    """
    where = find_checkpoint(reference)
    config = json.loads(text_of(where / "config.json", "record"))
    rows = int(config.get("text_config", config)["vocab_size"])  # padding included
    most_logit = SEEN if reference.vision else MOST_LOGIT
    plain = partial(transformers_engine.open, reference, device="cpu", dtype="float32")
    expected = _outputs(plain(batch_size=1), asked, letters, rows)
    progress(1)
    ids = [r.id for r in asked]
    findings: list[Finding] = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "f32.gguf"
        export(where, file, "F32")
        beside = projector_of(file).name if gguf.projector else None
        same = replace(gguf, weights=str(file), file=None, revision=None, sha256=None, projector=beside)
        exact = partial(llama_backend.open, same, device="cpu")
        shipped = partial(llama_backend.open, gguf, device="cpu")
        alone: list[tuple[str, Callable[..., Backend], list[str]]] = [("transformers", plain, expected.texts)]
        for label, engine in (("F32", exact), (gguf.quantisation or "GGUF", shipped)):
            other = _outputs(engine(batch_size=1), asked, letters, rows)
            if engine is exact:
                alone.append(("llama.cpp F32", exact, other.texts))
            logit = np.abs(expected.logits - other.logits).max(axis=1)
            readout = np.abs(expected.readouts - other.readouts).max(axis=1)
            findings += [
                _equal(f"{label}: token ids equal", 1.0, ids, expected.tokens, other.tokens),
                _near(f"{label}: largest difference of a logit", most_logit.get(label), ids, logit),
                _equal(f"{label}: greedy text equal", LEAST_TEXTS, ids, expected.texts, other.texts),
                _near(f"{label}: largest difference of a read-out", MOST_READOUT, ids, readout),
            ]
            progress(1)
        for label, opened, texts in alone:
            what = f"{label}: text equal in reversed batches of {BATCH}"
            together = _texts(opened(batch_size=BATCH), asked[::-1])[::-1]
            findings.append(_equal(what, 1.0, ids, texts, together))
            progress(1)
    return findings


def _outputs(
    backend: LanguageModel | LlamaBackend, asked: Sequence[Request], letters: Sequence[Request], rows: int
) -> Outputs:
    tokens = [backend.chat.encode(backend.chat.render(r.messages, thinking=r.thinking)) for r in asked]
    logits = np.concatenate([backend.next_log_probs([r], rows) for r in asked])
    readouts = [
        parse(text, role="ego", actions=r.actions).intent or [np.nan] * len(r.actions)
        for r, text in zip(letters, _texts(backend, letters), strict=True)
    ]
    return Outputs(tokens, logits, _texts(backend, asked), np.array(readouts))


def _texts(backend: Backend, asked: Sequence[Request]) -> list[str]:
    """Answer each question. Raises Unanswered if one gets no answer: two errors are not equal texts."""
    completions = backend.complete(asked)
    if errors := [printable(c.error, 300) for c in completions if c.error is not None]:
        raise Unanswered(f"{errors[0]}: no answer to {len(errors)} of {len(asked)} questions")
    return [completion.text for completion in completions]


def _equal(what: str, least: float, ids: Sequence[str], a: Sequence[Any], b: Sequence[Any]) -> Finding:
    unlike = [f"{i}: {x!r} / {y!r}" for i, x, y in zip(ids, a, b, strict=True) if x != y]
    share = 1 - len(unlike) / len(ids)
    return Finding(what, share, least, share >= least, len(ids), tuple(unlike[:SHOWN]))


def _near(what: str, most: float | None, ids: Sequence[str], values: Floats) -> Finding:
    worst = [i for i in np.argsort(-values)[:SHOWN] if most is not None and not values[i] <= most]
    return Finding(
        what, float(values.max()), most, most is None or bool(values.max() <= most), len(ids),
        tuple(f"{ids[i]}: {values[i]:.2g}" for i in worst),
    )  # fmt: skip
