"""Unpack an answer that comes compressed, as some proxies send it whatever was asked for."""

import zlib

from harness.core.errors import printable

_ZLIB = ("gzip", "x-gzip", "deflate")
_EITHER = zlib.MAX_WBITS | 32  # of gzip and of deflate, by the first bytes


class Packed(Exception):
    """Report a compressed reply that cannot be unpacked; its message says why."""


class Unpacker:
    """Unpack the bytes of one compressed HTTP reply as they come."""

    def __init__(self, coding: str) -> None:
        """Prepare for a Content-Encoding, empty for none. Raises Packed for an unknown one."""
        self._coding = coding.strip().casefold()
        self._zlib = zlib.decompressobj(_EITHER) if self._coding in _ZLIB else None
        if self._zlib is None and self._coding not in ("", "identity"):
            raise Packed(
                f"the answer is compressed (Content-Encoding: {printable(coding, 40)}), though it "
                "was asked for as it is; have the server, or the proxy before it, leave it so"
            )

    def take(self, data: bytes, most: int) -> bytes:
        """Unpack further bytes of a compressed reply, and return what they hold.

        `data` are the bytes as they came; at most `most` bytes are returned. Raises Packed if they
        are damaged.
        """
        if self._zlib is None:
            return data
        try:
            return self._zlib.decompress(data, most)
        except zlib.error:
            raise Packed(
                f"the answer is no {self._coding}, though its Content-Encoding says so"
            ) from None
