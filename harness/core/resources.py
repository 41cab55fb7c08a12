"""Where prompts, models, channels, devices, networks and datasets lie: in a project, and what ships beside.

What ships lies at the checkout's top level, or inside the wheel. A folder with a file `swarmdrive.toml` is a
project; its own `prompts/`, `models/`, `channels/`, `devices/`, `networks/`, `schedules/` and `datasets/`
count where it is the current directory.
"""

import os
from pathlib import Path

from harness.core.errors import UserError, printable

DATASET = "occluded-intersection-v2"  # the one that ships
MARKER = "swarmdrive.toml"

_PACKAGE = Path(__file__).resolve().parent.parent


def root() -> Path:
    """Folder that holds what ships, such as `prompts/` and `datasets/`."""
    checkout = _PACKAGE.parent
    return checkout if (checkout / "pyproject.toml").is_file() else _PACKAGE / "_data"


def folder(kind: str) -> Path:
    """Folder of one kind of resource that ships, such as `prompts` or `channels`."""
    return root() / kind


def entries(kind: str, pattern: str) -> list[Path]:
    """What there is of one kind, shipped and the project's, by a pattern below its folder."""
    return sorted(path for where in _folders(kind) for path in where.glob(pattern))


def names(kind: str) -> list[str]:
    """Names of the TOML files of one kind, sorted."""
    return sorted({path.stem for path in entries(kind, "*.toml")})


def find(kind: str, name: str) -> Path:
    """Where a resource lies; if nowhere, where it would lie among those that ship.

    Raises:
        UserError: the project and the harness both have one of that name, which would then mean two things.
    """
    found = list(dict.fromkeys(where / name for where in _folders(kind)))  # one, if `name` is absolute
    there = [path for path in found if os.path.lexists(path)]
    if len(there) > 1:
        raise UserError(
            f"{kind}/{printable(name)} is in this project and ships with the harness; give yours another name"
        )
    return there[0] if there else found[0]


def _folders(kind: str) -> list[Path]:
    project = Path.cwd()
    return [folder(kind), *([project / kind] if (project / MARKER).is_file() else [])]
