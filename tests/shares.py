"""The shares of the exhaustive tests."""

import zlib

SHARES = 10  # `.ci/run` takes one of them at a commit


def share_of(test: str) -> int:
    """Return the share of a test by its name:
    the same for all its parameters, whatever other tests exist.
    """
    return zlib.crc32(test.split("[")[0].encode()) % SHARES
