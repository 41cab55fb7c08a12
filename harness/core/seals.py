"""Tell what this user wrote on this machine from what anybody may have written.

A seal is a digest of the content that only a holder of the user's key can make (HMAC-SHA256,
RFC 2104). The key lies in the cache folder and never leaves it.
"""

import hmac
import os
import secrets
from collections.abc import Mapping
from contextlib import suppress

from harness.core import kept
from harness.core.files import canonical_bytes, sha256_bytes

KEY, KEY_BYTES = "seal.key", 32


def seal(content: Mapping[str, bytes], place: str) -> str | None:
    """Return the seal of files by name, which belong to `place`; None if there is no key.

    A seal of the same files at another place is another one. There is no key where the cache folder
    cannot be written.
    """
    key = _key()
    if key is None:
        return None
    digests = {name: sha256_bytes(data) for name, data in content.items()}
    return hmac.new(key, canonical_bytes([place, digests]), "sha256").hexdigest()


def _key() -> bytes | None:
    if kept.recall(KEY) is None:
        file = kept.folder() / KEY
        with suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(file, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
            with open(descriptor, "wb") as opened:
                opened.write(secrets.token_bytes(KEY_BYTES))
    key = kept.recall(KEY)
    return key if key and len(key) == KEY_BYTES else None
