"""Keep the answers of unfinished work in a file of chunks,
so that a killed run resumes where it was.
"""

import math
import os
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from harness.core.errors import UserError, printable
from harness.core.files import appending, bytes_of, is_there
from harness.runs.records import Answer

MORE_FOLLOWS = b" \n"  # ends every line but the last of its chunk, so that a torn chunk can be told
SYNC_S = 1.0  # answers reach the disk this often; if power fails, those since are asked again
_DECODER, _ENCODER = msgspec.json.Decoder(Answer), msgspec.json.Encoder()


class KeptAnswers:
    """Read and append a stopped run's answers in a file, a JSON line each, in chunks.

    A chunk is what is written at once, and is read whole or not at all. Only one process at a time
    may append.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self._read_b, self._on_disk_s = 0, -math.inf  # bytes that were read or written here

    def recall(self, cut: bool = False) -> dict[str, Answer]:
        """Return the answers of a stopped run by request id; none if nothing is new since then.

        That is, since the last call. `cut` removes a chunk at the file's end that was written in
        part. Errors of the engine, which runs the model, do not count as answers. Raises UserError
        if the file is damaged, or has two different answers to a question, and OSError for a pipe
        or the like in its place.
        """
        if not is_there(self.file) or (size_b := self.file.stat().st_size) == self._read_b:
            return {}
        lines = bytes_of(self.file, "rows").splitlines(keepends=True)
        while lines and (lines[-1].endswith(MORE_FOLLOWS) or not lines[-1].endswith(b"\n")):
            lines.pop()
        try:
            answers = [_DECODER.decode(line) for line in lines]
        except (ValueError, RecursionError) as error:
            raise UserError(
                f"{printable(self.file)} is damaged ({printable(error)}); delete that file, and "
                "its questions are asked again"
            ) from None
        self._read_b = sum(map(len, lines))
        if cut and self._read_b < size_b:
            with appending(self.file) as file:  # never through a link
                file.truncate(self._read_b)
        by_id = dict[str, Answer]()
        for answer in answers:
            if answer.error is None and by_id.setdefault(answer.id, answer) != answer:
                raise UserError(
                    f"{printable(self.file)} has two answers to question {printable(answer.id)}; "
                    "delete that file, and its questions are asked again"
                )
        return by_id

    def append(self, answers: Sequence[Answer]) -> None:
        """Append answers to the file as one chunk, which later reads take whole or not at all."""
        lines = _ENCODER.encode_lines(answers)
        chunk = lines[:-1].replace(b"\n", MORE_FOLLOWS) + lines[-1:]
        with appending(self.file) as file:
            file.write(chunk)
            file.flush()
            if time.monotonic() - self._on_disk_s >= SYNC_S:
                os.fsync(file.fileno())
                self._on_disk_s = time.monotonic()
        self._read_b += len(chunk)


def read_kept(file: Path) -> dict[str, Answer]:
    """Return the answers in a file of `KeptAnswers` by request id; engine errors are left out.

    Raises UserError if the file is damaged.
    """
    return KeptAnswers(file).recall()
