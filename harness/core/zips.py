"""Read ZIP archives that somebody else may have made, with a bound on all that is unpacked."""

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from lzma import LZMAError
from pathlib import Path
from typing import BinaryIO
from zipfile import BadZipFile, ZipFile, ZipInfo

from harness.core.files import LARGEST, Kind, opened

# What taking a ZIP archive apart raises where it is broken or forged, whatever it is packed by.
BROKEN_ZIP = (
    BadZipFile,
    zlib.error,
    LZMAError,
    EOFError,
    NotImplementedError,
    RuntimeError,
    ValueError,
)
END, END_64 = b"PK\5\6", b"PK\6\7"  # how the two records begin that stand after the list of files
LOCAL, LOCAL_BYTES = b"PK\3\4", 30  # how the record before a file begins, and its length
ZSTANDARD = 93  # the method by which a file is packed, which Python reads from 3.14 on


@contextmanager
def bounded_archive(file: Path, kind: Kind, longest_list: int) -> Iterator[ZipFile]:
    """Enter a context that yields a ZIP archive, open to be read by `piece`.

    `kind`, a key of `LARGEST`, says how large the archive may be, and `longest_list` how many bytes
    its list of files may have. Raises OSError, and one of `BROKEN_ZIP` where it is no such archive.
    """
    with opened(file, kind) as data:
        _refuse_long_list(data, kind, longest_list)
        with ZipFile(data) as archive:
            yield archive


def _refuse_long_list(whole: BinaryIO, kind: Kind, longest: int) -> None:
    """Raise ValueError for a list of files that would fill memory before one of them is looked
    at.
    """
    end = whole.seek(0, 2)
    whole.seek(max(0, end - 42))
    tail = whole.read()
    if len(tail) < 22 or tail[-22:-18] != END or tail[:4] == END_64:
        raise ValueError(f"it does not end as a zip file of at most {LARGEST[kind] >> 20} MB does")
    if int.from_bytes(tail[-10:-6], "little") > longest:
        raise ValueError("its list of files is too long")


def piece(archive: ZipFile, name: str, most: int) -> bytes:
    """Return the content of a file in an archive; never more than `most` bytes are unpacked.

    Raises KeyError if there is no such file, and one of `BROKEN_ZIP` or an OSError for one that is
    larger, or broken.
    """
    member = archive.getinfo(name)
    refuse_larger(name, member.file_size, most)
    if member.compress_type == ZSTANDARD:
        return _of_zstandard(archive, member, most)
    with archive.open(member) as packed:
        data = packed.read(most + 1)
    refuse_larger(name, len(data), most)
    return data


def refuse_larger(name: str, size: int, most: int) -> None:
    """Raise ValueError if a file, here called `name`, has more than `most` bytes."""
    if size > most:
        raise ValueError(f"{name} is larger than {most >> 20} MB")


def _of_zstandard(archive: ZipFile, member: ZipInfo, most: int) -> bytes:
    import pyarrow as pa  # imported here, since few archives need it

    whole = archive.fp
    assert whole is not None
    refuse_larger(member.filename, member.compress_size, most)
    whole.seek(member.header_offset)
    record = whole.read(LOCAL_BYTES)
    if len(record) < LOCAL_BYTES or not record.startswith(LOCAL):
        raise BadZipFile(f"{member.filename} is not where the list says")
    further = int.from_bytes(record[26:28], "little") + int.from_bytes(record[28:30], "little")
    whole.seek(further, 1)
    packed = whole.read(member.compress_size)
    with pa.input_stream(pa.BufferReader(packed), compression="zstd") as stream:
        data: bytes = stream.read(member.file_size + 1)
    if len(data) != member.file_size or zlib.crc32(data) != member.CRC:
        raise BadZipFile(f"{member.filename} is not what the list says")
    return data
