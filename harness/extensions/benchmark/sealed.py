"""Layout seeds that nobody knew before a commit was made."""

import hashlib
import re

from harness.core.errors import UserError, printable

SEALED = 1_000_000_000  # the first of as many layout seeds from which sealed layouts are taken


def sealed(commit: str, scenario: str) -> int:
    """Return the first layout seed of a test set that nobody can have seen, from a commit's id.

    A layout seed draws a start situation of a scenario; the test set has the seeds from this one
    on. The seed is 10^9 plus the SHA-256 of "COMMIT SCENARIO", read as a number, modulo 10^9.
    `commit` is the hex id of a Git commit, which nobody knows before it is made, and `scenario` the
    scenario's name. Raises UserError if `commit` is not a whole hex id.
    """
    if not re.fullmatch("[0-9a-f]{40}|[0-9a-f]{64}", commit):
        raise UserError(
            f"commit {printable(commit, 70)}: give a whole id, 40 hex digits, as `git rev-parse` "
            "prints it"
        )
    number = int(hashlib.sha256(f"{commit} {scenario}".encode()).hexdigest(), 16)
    return SEALED + number % SEALED
