"""What taking a ZIP archive apart raises where it is broken or forged, whatever it is packed by."""

import zlib
from lzma import LZMAError
from zipfile import BadZipFile

BROKEN_ZIP = (
    BadZipFile,
    zlib.error,
    LZMAError,
    EOFError,
    NotImplementedError,
    RuntimeError,
    ValueError,
)
