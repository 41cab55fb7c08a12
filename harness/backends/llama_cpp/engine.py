"""The llama.cpp engine: GGUF files, mostly on a CPU."""

import os
from collections.abc import Sequence
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import llama_cpp as c
import numpy as np

from harness.backends.card import Card
from harness.backends.chat import Chat
from harness.backends.engine import (
    Session,
    check_logits,
    common_beginning,
    common_length,
    group_by_beginning,
)
from harness.backends.language_model import LanguageModel
from harness.backends.llama_cpp.adapter import find_adapter_gguf
from harness.backends.llama_cpp.context import LlamaContext, Logits
from harness.backends.llama_cpp.model import LlamaModel
from harness.backends.llama_cpp.projector import Projector
from harness.backends.registry import BUILT_IN
from harness.backends.weights import hub_commit, sha256_weights
from harness.core.arrays import Floats
from harness.core.errors import UserError
from harness.core.files import sha256_bytes, sha256_file
from harness.core.image import Image

BEGINNINGS = 3  # beginnings of prompts kept between calls: one for each role, and one more
_ANSWER = 256  # tokens of an answer for which memory is allocated in advance
_PICTURES = ("<|image_pad|>", "<image>")  # tokens that chat templates write for a picture


def open_here(card: Card, file: Path, device: str | None, batch_size: int) -> LanguageModel:
    """Return the backend of a GGUF file loaded in this process, which llama.cpp may abort.

    `card` is the model card, the TOML file that describes a model, `device` is `cpu` or `gpu`, None
    for a GPU if there is one, and `batch_size` the most requests computed together. Raises
    UserError if it does not load, or the batch size is too large.
    """
    # a backtrace would start a debugger if there is one
    os.environ.setdefault("GGML_NO_BACKTRACE", "1")
    most = c.llama_max_parallel_sequences() - BEGINNINGS
    if batch_size > most:
        raise UserError(f"batch size {batch_size}; llama.cpp takes {most} at most")
    model = LlamaModel(card.name, file, device, find_adapter_gguf(card, file))
    projector = None
    if card.vision and card.projector:
        projector = Projector(card.name, file.with_name(card.projector), model, card.vision)
    return LanguageModel(LlamaEngine(card, file, model, batch_size, projector), batch_size)


class _Group(NamedTuple):
    """Prompts of a call that begin alike."""

    places: list[int]  # places of their sequences
    shared: list[int]  # what they begin with
    nearest: int  # the kept beginning that the first is forked from
    known: int  # number of tokens of it
    kept: int  # most tokens of `shared` in any kept beginning


class LlamaEngine:
    """Read tokens and give distributions of next ones by a GGUF file that llama.cpp has loaded.

    It has memory for `batch_size` sequences, and also keeps some beginnings of prompts, so that
    later prompts read only the rest.
    """

    def __init__(
        self,
        card: Card,
        file: Path,
        model: LlamaModel,
        batch_size: int,
        projector: Projector | None = None,
    ) -> None:
        picture_tokens = [text for text in _PICTURES if projector and text in model.template]
        if projector and not picture_tokens:
            raise UserError(
                f"{card.shown}: its chat template has none of {_PICTURES} for a picture"
            )
        self.chat = Chat(
            card.name, model, picture_tokens[0] if picture_tokens else None, card.system
        )
        self.context_tokens = card.context_tokens or model.trained_tokens
        self.stops: Sequence[int] = sorted({*model.stops, *self.chat.ends})
        self._card, self._file, self._model = card, file, model
        self._projector = projector
        self.context = LlamaContext(model, batch_size + BEGINNINGS, projector)
        self._set_places()

    def look(self, image: Image) -> list[int]:
        if self._projector is None:
            raise ValueError(f"{self._card.shown} takes no pictures")
        return self._projector.tokens(image)

    def begin(self, prompts: Sequence[Sequence[int]], exact: Sequence[int] = ()) -> "LlamaSession":
        """Return a session that has read these prompts; all logits are float32, `exact` or not.

        A beginning is kept for later calls, unless half of it is part of one that is kept already.
        """
        if len(prompts) > len(self._free):
            raise ValueError(f"{len(prompts)} prompts for {len(self._free)} free places")
        places = [self._free.pop() for _ in prompts]
        try:
            logits = self._read(dict(zip(places, map(list, prompts), strict=True)))
        except BaseException:
            self.release(places)
            raise
        return LlamaSession(self, places, logits)

    def _read(self, prompts: dict[int, list[int]]) -> Logits:
        places = list(prompts)
        self.context.reserve(max(map(len, prompts.values())) + _ANSWER)
        # The last token of each prompt is always read, for its logits.
        heads = [[] if self._model.whole_state else prompt[:-1] for prompt in prompts.values()]
        groups = []
        for members in group_by_beginning(heads):
            shared = common_beginning([heads[i] for i in members])
            nearest, n_known = self._nearest(shared)
            groups.append(_Group([places[i] for i in members], shared, nearest, n_known, n_known))
        if len(prompts) == 1:
            groups = [self._read_again(groups[0])]
        for group in groups:
            self.context.fork(group.nearest, group.places[0], group.known)
        firsts = {g.places[0]: g.shared[g.known :] for g in groups if len(g.places) > 1}
        if unread := {place: tokens for place, tokens in firsts.items() if tokens}:
            self.context.extend(unread)
        for group in groups:
            for place in group.places[1:]:
                self.context.fork(group.places[0], place, len(group.shared))
        logits = self.context.extend(
            {p: ids[len(self.context.tokens[p]) :] for p, ids in prompts.items()}
        )
        for group in groups:
            if group.known:
                self._used(group.nearest)
        for group in groups:
            if len(group.shared) > 2 * group.kept and (len(group.places) > 1 or len(prompts) == 1):
                oldest = self._beginnings[0]
                self.context.drop(oldest)
                self.context.fork(group.places[0], oldest, len(group.shared))
                self._used(oldest)
        return logits

    def _nearest(self, shared: list[int], but: int | None = None) -> tuple[int, int]:
        """Return the kept beginning with most of some tokens, and how many: not `but` of them."""
        kept = {
            b: common_length([self.context.tokens.get(b, []), shared]) for b in self._beginnings
        }
        kept = {b: 0 if n == but else n for b, n in kept.items()}
        nearest = max(self._beginnings, key=kept.__getitem__)
        return nearest, kept[nearest]

    def _read_again(self, group: _Group) -> _Group:
        """Leave what is kept of a whole prompt:
        if repeated alone, its time would not be an answer's time.
        """
        if self._projector and group.known == len(group.shared):
            self._projector.forget(group.shared)
        nearest, n_known = self._nearest(group.shared, but=len(group.shared))
        return group._replace(nearest=nearest, known=n_known)

    def _used(self, beginning: int) -> None:
        self._beginnings.remove(beginning)
        self._beginnings.append(beginning)

    def peek(self, chunks: dict[int, Sequence[int]]) -> Logits:
        """Return the logits that some sequences would have after further tokens, which are dropped.

        `chunks` has the token ids by the sequence's number; the logits are `(n, vocabulary)`, in
        that order.
        """
        lengths = {place: len(self.context.tokens[place]) for place in chunks}
        logits = self.context.extend(chunks)
        for place, length in lengths.items():
            self.context.cut(place, length)
        return logits

    def forget(self) -> None:
        """Drop kept beginnings of prompts and free the memory.

        Where sequences lie in memory moves logits by rounding.
        """
        self.context.free()
        self._set_places()

    def _set_places(self) -> None:
        sequences = self.context.sequences
        self._free = list(range(sequences - BEGINNINGS))
        # The least recently used comes first.
        self._beginnings = list(range(sequences - BEGINNINGS, sequences))

    def release(self, places: Sequence[int]) -> None:
        for place in places:
            self.context.drop(place)
        self._free += places

    def identity(self) -> dict[str, Any]:
        """Return what decides the answers, by name: llama.cpp's build, the file, and settings.

        The file is named by its commit on the hub, or else by its SHA-256 digest.
        """
        commit = hub_commit(self._file.parent)
        identity: dict[str, Any] = {
            "engine": "llama-cpp",
            "answers": BUILT_IN["llama-cpp"].answers,
            # Its version and the features of the CPU move an answer's last digits.
            "llama_cpp_python": version("llama-cpp-python"),
            "system": c.llama_print_system_info().decode().strip(" |"),
            "weights": self._card.weights,
            "file": self._card.file,
            "revision": commit,
            "file_sha256": None if commit else self._sha256,
            **self._projector_identity,
            "dtype": self._model.dtype,
            "kv_cache": self.context.cache_type,
            "device": self._model.device,
            "chat_template_sha256": sha256_bytes(self.chat.template.encode()),
        }
        if self.chat.system:
            identity["system_text"] = self.chat.system
        if self._model.adapter_file:
            identity["adapter_sha256"] = sha256_file(self._model.adapter_file)
        return identity

    @cached_property
    def _sha256(self) -> str:
        return sha256_weights(self._file)

    @cached_property
    def _projector_identity(self) -> dict[str, Any]:
        name = self._projector and self._card.projector
        digest = name and sha256_file(self._file.with_name(name))
        return {"projector": name, "projector_sha256": digest} if name else {}


class LlamaSession(Session):
    """Advance the sequences of one batch in a `LlamaEngine`."""

    def __init__(self, engine: LlamaEngine, places: list[int], logits: Logits) -> None:
        self._engine = engine
        self._places = places
        self._logits = logits

    def argmax(self, among: Sequence[Sequence[int] | None]) -> list[int]:
        check_logits(self._logits.max(axis=1).tolist())
        best = []
        for row, allowed in zip(self._logits, among, strict=True):
            if allowed is None:
                best.append(int(row.argmax()))
            else:
                tokens = np.unique(allowed)
                best.append(int(tokens[row[tokens].argmax()]))
        return best

    def log_probs(self, tokens: Sequence[int] | None = None) -> Floats:
        return _log_probs(self._logits, tokens)

    def ends(self, chunks: Sequence[Sequence[Sequence[int]]], tokens: Sequence[int]) -> Floats:
        turns = [dict(zip(self._places, each, strict=True)) for each in zip(*chunks, strict=True)]
        return np.stack([_log_probs(self._engine.peek(turn), tokens) for turn in turns], axis=1)

    def advance(self, chunks: Sequence[Sequence[int]]) -> None:
        rows = [row for row, chunk in enumerate(chunks) if chunk]
        if rows:
            self._logits[rows] = self._engine.context.extend(
                {self._places[row]: chunks[row] for row in rows}
            )

    def keep(self, places: Sequence[int]) -> None:
        kept = [self._places[place] for place in places]
        self._engine.release([place for place in self._places if place not in kept])
        self._places, self._logits = kept, self._logits[list(places)]

    def close(self) -> None:
        self._engine.release(self._places)
        self._places = []


def _log_probs(logits: Logits, tokens: Sequence[int] | None) -> Floats:
    largest = logits.max(axis=1, keepdims=True).astype(np.float64)
    check_logits(largest.ravel().tolist())
    reduced = logits - largest
    total = np.log(np.exp(reduced).sum(axis=1, keepdims=True))
    log_p: Floats = (reduced if tokens is None else reduced[:, list(tokens)]) - total
    return log_p
