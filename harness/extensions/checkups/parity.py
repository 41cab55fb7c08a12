"""Parity: one model through two engines. The same prompts, compared token by token.

transformers in float32 is the reference. llama.cpp is held to it twice: with the very same float32
weights, exported on the spot where the architecture can be, and with the GGUF file that the model's
card names.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from harness.backends.base import Backend, Request
from harness.backends.card import Card
from harness.backends.gguf_export import export, projector_of
from harness.backends.language_model import LanguageModel
from harness.backends.llama_cpp import backend as llama_backend
from harness.backends.llama_cpp.backend import LlamaBackend
from harness.backends.transformers import engine as transformers_engine
from harness.backends.transformers.engine import TransformersEngine
from harness.core.arrays import Floats
from harness.core.errors import Unanswered, UserError, printable
from harness.parsing.parse import parse

LEAST_TEXTS, MOST_READOUT = 0.98, 0.02
# Other formats are measured, and have no limit. Of a picture llama.cpp rounds pixels, the weights
# of their patches and GELU to half precision in files of any format.
MOST_LOGIT = {"F32": 1e-3, "F16": 0.1}
SEEN = {"F32": 0.1, "F16": 0.1}
SHOWN = 5  # differences of a kind that are named
BATCH = 8
PASSES = 5


@dataclass(frozen=True)
class Finding:
    """Hold one comparison of what an engine (code that runs a model) makes of n prompts.

    Its outputs are compared with another engine's, or with its own when prompts come in batches.
    `measured` is the share of equal outputs, 0 to 1, or the largest difference of log-probabilities
    or probabilities, as `what` says in words.
    """

    what: str  # what was compared
    measured: float  # the figure
    allowed: float | None  # its limit; None where there is none
    holds: bool  # whether the figure is within the limit
    n: int  # number of prompts
    differences: tuple[str, ...] = ()  # the first prompts that differ, and how


@dataclass(frozen=True)
class Comparison:
    """Hold how far one model on the engine llama.cpp differs from itself on transformers.

    `findings` are the comparisons. `left_out` says why llama.cpp was not also compared with the
    very same float32 weights; None if it was.
    """

    findings: tuple[Finding, ...]  # everything compared
    left_out: str | None  # why llama.cpp was not held to the same float32 weights; None if it was


@dataclass(frozen=True)
class Outputs:
    """Hold the outputs of one engine, code that runs a model, for prompts of two kinds.

    `tokens` has each prompt's token ids, of n prompts that ask for JSON and then of r that ask for
    a letter. `logits`, (n, V), are the log-probabilities of all V tokens of the vocabulary after
    each of the n, and `texts` the likeliest answers to these. `readouts`, (r, A), are the
    probabilities of A actions that follow from those of one letter each.
    """

    tokens: list[list[int]]  # token ids of the text of each prompt, of those for JSON first
    logits: Floats  # log-probabilities of the whole vocabulary after each json prompt, (n, V)
    texts: list[str]  # greedy answers to the json prompts
    readouts: Floats  # distributions over actions from the read-out prompts, (n, A)


def compare(
    reference: Card,
    gguf: Card,
    json_requests: Sequence[Request],
    letters: Sequence[Request],
    progress: Callable[[int], None],
) -> Comparison:
    """Compare a model on llama.cpp with the same model on transformers, token by token.

    Args:
        reference: the card (description) of the model on transformers: of a checkpoint, or of a
            GGUF file, which is unpacked.
        gguf: its card on llama.cpp.
        json_requests: questions that ask for JSON, perhaps none.
        letters: questions that ask for one letter.
        progress: called with 1 after each of `PASSES` passes over the prompts, or with the number
            of those that are left out.

    Raises UserError if weights are missing or do not load, and Unanswered if a question gets no
    answer.
    """
    most_logit = SEEN if reference.vision else MOST_LOGIT
    plain = partial(transformers_engine.open, reference, device="cpu", dtype="float32")
    first = plain(batch_size=1)
    model = cast(TransformersEngine, first.engine).model
    rows = model.get_input_embeddings().num_embeddings  # padding included
    expected = _outputs(first, json_requests, letters, rows)
    progress(1)
    json_ids, letter_ids = [r.id for r in json_requests], [r.id for r in letters]
    findings: list[Finding] = []
    with tempfile.TemporaryDirectory() as folder:
        file, left_out, exact = Path(folder) / "f32.gguf", None, None
        engines = [(gguf.quantisation or "GGUF", partial(llama_backend.open, gguf, device="cpu"))]
        try:
            export(transformers_engine.checkpoint(reference), file, "F32")
        except UserError as error:
            left_out = str(error)
        else:
            beside = projector_of(file).name if gguf.projector else None
            same = replace(
                gguf, weights=str(file), file=None, revision=None, sha256=None, projector=beside
            )
            exact = partial(llama_backend.open, same, device="cpu")
            engines.insert(0, ("F32", exact))
        alone: list[tuple[str, Callable[..., Backend], list[str]]] = [
            ("transformers", plain, expected.texts)
        ]
        for label, engine in engines:
            trial = _outputs(engine(batch_size=1), json_requests, letters, rows)
            if engine is exact:
                alone.append(("llama.cpp F32", engine, trial.texts))
            ids = json_ids + letter_ids
            findings.append(
                _equal(f"{label}: token ids equal", 1.0, ids, expected.tokens, trial.tokens)
            )
            if json_requests:
                logit = np.abs(expected.logits - trial.logits).max(axis=1)
                most = most_logit.get(label)
                findings += [
                    _near(f"{label}: largest difference of a logit", most, json_ids, logit),
                    _equal(
                        f"{label}: greedy text equal",
                        LEAST_TEXTS,
                        json_ids,
                        expected.texts,
                        trial.texts,
                    ),
                ]
            readout = np.abs(expected.readouts - trial.readouts).max(axis=1)
            what = f"{label}: largest difference of a read-out"
            findings.append(_near(what, MOST_READOUT, letter_ids, readout))
            progress(1)
        for label, opened, texts in alone if json_requests else ():
            what = f"{label}: text equal in reversed batches of {BATCH}"
            together = _texts(opened(batch_size=BATCH), json_requests[::-1])[::-1]
            findings.append(_equal(what, 1.0, json_ids, texts, together))
            progress(1)
    if spared := PASSES - 1 - len(engines) - (len(alone) if json_requests else 0):
        progress(spared)
    return Comparison(tuple(findings), left_out)


def _outputs(
    backend: LanguageModel | LlamaBackend,
    json_requests: Sequence[Request],
    letters: Sequence[Request],
    rows: int,
) -> Outputs:
    """Return what an engine makes of some questions: tokens, logits, texts and read-outs."""
    tokens = []
    for request in (*json_requests, *letters):
        prompt = backend.chat.render(request.messages, thinking=request.thinking)
        tokens.append(backend.chat.encode(prompt))
    logits = np.empty((0, rows))
    if json_requests:
        logits = np.concatenate(
            [backend.next_log_probs([request], rows) for request in json_requests]
        )
    readouts = []
    for request, text in zip(letters, _texts(backend, letters), strict=True):
        intent = parse(text, role="ego", actions=request.actions).intent
        readouts.append(intent or [np.nan] * len(request.actions))
    return Outputs(tokens, logits, _texts(backend, json_requests), np.array(readouts))


def _texts(backend: Backend, requests: Sequence[Request]) -> list[str]:
    """Answer each question. Raises Unanswered if one gets no answer:
    two errors are not equal texts.
    """
    completions = backend.complete(requests)
    if errors := [printable(c.error, 300) for c in completions if c.error is not None]:
        raise Unanswered(f"{errors[0]}: no answer to {len(errors)} of {len(requests)} questions")
    return [completion.text for completion in completions]


def _equal(
    what: str, least: float, ids: Sequence[str], a: Sequence[Any], b: Sequence[Any]
) -> Finding:
    unlike = [f"{i}: {x!r} / {y!r}" for i, x, y in zip(ids, a, b, strict=True) if x != y]
    share = 1 - len(unlike) / len(ids)
    return Finding(what, share, least, share >= least, len(ids), tuple(unlike[:SHOWN]))


def _near(what: str, most: float | None, ids: Sequence[str], values: Floats) -> Finding:
    worst = [i for i in np.argsort(-values)[:SHOWN] if most is not None and not values[i] <= most]
    holds = most is None or bool(values.max() <= most)
    differences = tuple(f"{ids[i]}: {values[i]:.2g}" for i in worst)
    return Finding(what, float(values.max()), most, holds, len(ids), differences)
