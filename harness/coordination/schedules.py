"""Find schedules by name: the core's, those of extensions and packages,
and those in files `schedules/*.toml`, which an extension reads.
"""

import math
from collections.abc import Callable
from typing import Any, ClassVar

from harness.coordination.scheduling import FORMULAS, Schedule
from harness.core.errors import UserError, printable
from harness.core.extensions import owner_of_plugin, part_of
from harness.core.files import sha256_file
from harness.core.plugins import FilesAndPlugins, Shipped, one_of, tuple_of

NEEDS = ("in_time", "outlook", "lot")  # what a schedule may need to know
# By folder, such as `schedules`, what reads the files in it; only extensions that ship have one.
READERS = Shipped[Callable[[Any], Schedule]]("swarmdrive.readers", Callable, {})


def _is_threshold(value: Any) -> bool:
    number = type(value) in (int, float) and math.isfinite(value)
    return value is None or number


class Schedules(FilesAndPlugins[Schedule]):
    """Hold all schedules, rules for whom the ego asks, by name.

    They are built in, of installed packages, or in files of a folder `schedules/`. `stated` has, by
    an attribute that a package's schedule must have, the test of its value and what is allowed in
    words.
    """

    folder = "schedules"
    # what packages' schedules must have, by attribute: a test of its value, and words for what is
    # allowed
    stated: ClassVar = {
        "threshold": (_is_threshold, "a finite number, or None"),
        "needs": tuple_of(one_of(*NEEDS)),
    }

    def read(self, file: Any) -> Schedule:
        """Return the schedule, a rule for whom the ego asks, that the file at a path describes.

        Raises UserError if the file is wrong, or the extension that reads such files is not
        installed.
        """
        if self.folder not in READERS:
            owner = owner_of_plugin("readers", self.folder)
            reader = f"is {part_of(owner)}" if owner else "is gone; install the harness again"
            raise UserError(f"schedule file {printable(file)}: what reads it {reader}")
        return READERS[self.folder](file)

    def file_sha256(self, name: str) -> str | None:
        """Return the SHA-256 hex digest of the file that describes a schedule; None without one.

        A schedule is a rule for whom the ego asks, here that of this `name`. A run records the
        digest.
        """
        file = self.file(name)
        return sha256_file(file) if file else None


SCHEDULES = Schedules("swarmdrive.schedules", Schedule, FORMULAS)
