"""Which server gave each answer of a run, in a file beside its tables that no comparison reads.

Who answers depends on who was free, so that it stands in no row (decision 0051).
"""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import msgspec

from harness.backends.base import Served
from harness.core.files import appending, bytes_of, write_whole

FILE = "servers.jsonl"


def lines(served: Iterable[Served]) -> bytes:
    """Return, as lines of JSON, which server gave each answer: bytes to append to a file."""
    return msgspec.json.Encoder().encode_lines(list(served))


def keep(work: Path, served: Iterable[Served] | bytes) -> None:
    """Append which server gave each answer to a file in a working folder.

    `served` has these facts, or lines of JSON with them; `work` is the folder.
    """
    if data := served if isinstance(served, bytes) else lines(served):
        with appending(work / FILE) as file:
            file.write(data)


def write(out: Path, works: Iterable[Path]) -> None:
    """Write which server gave each answer to a run's folder, from its working folders.

    No file is written if no answer came from a server. An answer that was asked for twice has the
    server that gave it last.
    """
    last: dict[str, Served] = {}
    for work in works:
        for line in bytes_of(work / FILE, "rows").splitlines() if (work / FILE).is_file() else ():
            with suppress(msgspec.MsgspecError):  # torn, if the run was killed
                read = msgspec.json.decode(line, type=Served)
                last[read.id] = read
    if last:
        write_whole(out / FILE, lines(last[name] for name in sorted(last)))
