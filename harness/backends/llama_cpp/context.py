"""Token sequences in llama.cpp's key-value memory, which grows as needed."""

from collections.abc import Mapping, Sequence
from typing import Any

import llama_cpp as c
import numpy as np
from numpy.typing import NDArray

from harness.backends.engine import common_length
from harness.backends.llama_cpp.model import LlamaModel, last_error
from harness.backends.llama_cpp.projector import Projector, Run, text_run
from harness.core.cores import threads

Ints = NDArray[np.int32]
Logits = NDArray[np.float32]

_BATCH = 512  # most tokens of one call; more are split over several
_PAGE = 256  # llama.cpp rounds its memory up to a multiple of this many tokens
_FULL = 1  # llama_decode's code for no room left
_FIELDS = c.llama_batch._fields_


class LlamaContext:
    """Hold numbered token sequences whose keys and values llama.cpp has computed.

    Sequences have numbers from 0 to n-1; `tokens` has the token ids of each. Negative ids are a
    picture's; a sequence may be cut before or after a picture, but not inside. All have equal room
    in memory that is allocated at first need; when one has filled it, memory of twice the size is
    allocated and all are computed again. (llama.cpp can also share one memory, but then each
    sequence would attend to all the others' tokens, if only to mask them.) Keys and values have the
    number format `F32` for F32 weights, or else `F16`.
    """

    def __init__(
        self, model: LlamaModel, sequences: int, projector: Projector | None = None
    ) -> None:
        self._model = model
        self._projector = projector
        self.sequences = sequences
        self._context: int | None = None
        self._room = 0
        self.cache_type = "F32" if model.dtype == "F32" else "F16"
        self.tokens: dict[int, list[int]] = {}
        self._ends: dict[int, list[int]] = {}  # the position after each token

    def fork(self, source: int, copy: int, length: int) -> None:
        """Make a sequence a copy of another's first `length` tokens, as computed.

        `source` and `copy` are the numbers of the two sequences.
        """
        if length:  # llama.cpp can only copy a whole sequence, so the copy is cut afterwards
            c.llama_memory_seq_cp(self._memory(), source, copy, -1, -1)
            c.llama_memory_seq_rm(self._memory(), copy, self._ends[source][length - 1], -1)
        for lists in (self.tokens, self._ends):
            lists[copy] = lists[source][:length] if length else []

    def drop(self, sequence: int) -> None:
        if self.tokens.pop(sequence, None) is not None and self._context:
            c.llama_memory_seq_rm(self._memory(), sequence, -1, -1)

    def cut(self, sequence: int, length: int) -> None:
        """Cut the sequence of a number to its first `length` tokens.

        Recurrent models, which cannot go back, compute it again.
        """
        tokens = self.tokens[sequence][:length]
        if self._model.whole_state:
            self.drop(sequence)
            self.fork(sequence, sequence, 0)
            self.extend({sequence: tokens})
        else:
            c.llama_memory_seq_rm(self._memory(), sequence, self._ends[sequence][length - 1], -1)
            self.tokens[sequence], self._ends[sequence] = tokens, self._ends[sequence][:length]

    def reserve(self, room: int) -> None:
        """Allocate memory for `room` tokens of each sequence, if none is allocated yet."""
        if not self._context:
            self._make(room)

    def extend(self, chunks: Mapping[int, Sequence[int]]) -> Logits:
        """Append tokens to some sequences; return the logits after them, `(n, vocabulary)`.

        `chunks` has token ids, none empty, by the sequence's number; row i of the logits is of its
        i-th entry. Raises RuntimeError if llama.cpp fails; all sequences are lost then.
        """
        try:
            logits = self._decode(chunks)
            if logits is None:
                longest = max(len(self.tokens[s]) + len(chunk) for s, chunk in chunks.items())
                self._make(max(2 * self._room, longest))
                self._fill()
                logits = self._decode(chunks)
            if logits is None:
                raise RuntimeError(
                    f"llama.cpp finds no room in {self._room} tokens: {last_error()}"
                )
        except BaseException:
            self.free()
            raise
        return logits

    def free(self) -> None:
        if self._context:
            c.llama_free(self._context)
        self._context, self.tokens, self._ends = None, {}, {}

    def _memory(self) -> int:
        memory: int = c.llama_get_memory(self._context)
        return memory

    def _make(self, room: int) -> None:
        if self._context:  # freed before the new one is allocated, since both may not fit
            c.llama_free(self._context)
            self._context = None
        params = c.llama_context_default_params()
        self._room = -(-room // _PAGE) * _PAGE
        params.n_ctx = self._room * self.sequences
        params.n_batch = params.n_ubatch = _BATCH
        params.n_seq_max = params.n_outputs_max = self.sequences
        params.kv_unified = False
        # otherwise a beginning is lost once the sliding window has passed it
        params.swa_full = True
        if self.cache_type == "F32":
            # As exact as the weights; llama.cpp's default and its fused attention round to F16.
            params.type_k = params.type_v = c.GGML_TYPE_F32
            params.flash_attn_type = c.LLAMA_FLASH_ATTN_TYPE_DISABLED
        params.n_threads = params.n_threads_batch = threads()
        params.offload_kqv = params.op_offload = self._model.device == "gpu"
        params.no_perf = True
        last_error()
        self._context = c.llama_init_from_model(self._model.pointer, params)
        if not self._context:
            raise RuntimeError(
                f"no memory for {self.sequences} x {self._room} tokens: {last_error()}"
            )
        self._model.adapt(self._context)

    def _fill(self) -> None:
        """Compute all sequences again, sorted,
        so that each shares its longest beginning with the last.
        """
        sequences = sorted(self.tokens.items(), key=lambda item: item[1])
        before, self.tokens = sequences[0][0], {}
        for sequence, tokens in sequences:
            shared = [] if self._model.whole_state else self.tokens.get(before, [])
            self.fork(before, sequence, common_length([shared, tokens]))
            try:
                if rest := tokens[len(self.tokens[sequence]) :]:
                    self._decode({sequence: rest})
            except LookupError:  # a beginning with a picture that no longer exists
                self.drop(sequence)
            else:
                before = sequence

    def _decode(self, chunks: Mapping[int, Sequence[int]]) -> Logits | None:
        """Append chunks and return the logits after each;
        without room, append nothing and return None.
        """
        queues = {s: self._runs(chunk) for s, chunk in chunks.items()}
        ends = {s: self._ends[s][-1:] or [0] for s in chunks}
        logits = np.empty((len(chunks), self._model.vocabulary), dtype=np.float32)
        while fronts := {s: queue[0] for s, queue in queues.items() if queue}:
            texts = {s: run for s, run in fronts.items() if run.inputs.ndim == 1}
            now = texts or fronts  # one call of llama.cpp takes either texts or pictures
            rows = [
                row if len(queues[s]) == 1 else None for row, s in enumerate(chunks) if s in now
            ]
            if not self._read(now, [ends[s][-1] for s in now], logits, rows):
                return None
            for s, run in now.items():
                ends[s] += run.ends(ends[s][-1])
                del queues[s][0]
        for s, chunk in chunks.items():
            self.tokens[s] += chunk
            self._ends[s] += ends[s][1:]
        return logits

    def _runs(self, chunk: Sequence[int]) -> list[Run]:
        if self._projector is None or min(chunk) >= 0:
            return [text_run(chunk)]
        runs, start = [], 0
        while start < len(chunk):
            if chunk[start] < 0:
                runs.append(self._projector.run(chunk[start]))
            else:
                end = next((i for i in range(start, len(chunk)) if chunk[i] < 0), len(chunk))
                runs.append(text_run(chunk[start:end]))
            start += len(runs[-1].inputs)
        return runs

    def _read(
        self,
        runs: Mapping[int, Run],
        starts: Sequence[int],
        logits: Logits,
        rows: Sequence[int | None],
    ) -> bool:
        """Read a run of each of some sequences, all texts or all pictures;
        return whether there was room.

        `starts` has the position of each run's first token;
        `rows` its row of `logits`, None if not needed.
        """
        inputs = np.concatenate([run.inputs for run in runs.values()])
        places = [run.at(start) for run, start in zip(runs.values(), starts, strict=True)]
        place = np.concatenate(places, axis=1)
        lengths = [len(run.inputs) for run in runs.values()]
        owner = np.repeat(np.array(list(runs), dtype=np.int32), lengths)
        last = np.cumsum(lengths) - 1
        wanted = np.zeros(len(inputs), dtype=np.int8)
        wanted[last] = [row is not None for row in rows]
        for start in range(0, len(inputs), _BATCH):
            part = slice(start, start + _BATCH)
            code = self._call(inputs[part], place[:, part].copy(), owner[part], wanted[part])
            if code == _FULL:
                return False
            if code:
                raise RuntimeError(f"llama_decode returned {code}: {last_error()}")
            for row, i in zip(rows, last - start, strict=True):
                if row is not None and 0 <= i < _BATCH:
                    pointer = c.llama_get_logits_ith(self._context, int(i))
                    logits[row] = np.ctypeslib.as_array(pointer, (self._model.vocabulary,))
        return True

    def _call(
        self, inputs: NDArray[Any], place: Ints, owner: Ints, wanted: NDArray[np.int8]
    ) -> int:
        """Call llama_decode on arrays of one length, without a copy."""
        # One address for each token, since it belongs to one sequence.
        owners = owner.ctypes.data + owner.itemsize * np.arange(len(owner), dtype=np.uintp)
        arrays: dict[str, NDArray[Any]] = {
            "token" if inputs.ndim == 1 else "embd": inputs,
            "pos": place,
            "n_seq_id": np.ones_like(owner),
            "seq_id": owners,
            "logits": wanted,
        }
        pointers = {
            name: arrays[name].ctypes.data_as(kind) for name, kind in _FIELDS if name in arrays
        }
        code: int = c.llama_decode(self._context, c.llama_batch(n_tokens=len(inputs), **pointers))
        return code
