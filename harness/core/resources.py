"""Locate prompts, models, channels, devices, networks, schedules, datasets and the like.

They ship with the harness, at the checkout's top level or inside the wheel. A folder with a file
`swarmdrive.toml` is a project: if it is the current directory, its own `prompts/`, `models/`,
`channels/`, `devices/`, `networks/`, `schedules/` and `datasets/` are searched as well, and so is
what extensions keep so.
"""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from harness.core.errors import UserError, printable, sayable

T = TypeVar("T")
DATASET = "occluded-intersection-v3"  # taken if none is named
MARKER = "swarmdrive.toml"

_PACKAGE = Path(__file__).resolve().parent.parent


def root() -> Path:
    """Return the folder of the files that ship: `prompts/`, `datasets/` and others lie in it."""
    checkout = _PACKAGE.parent
    return checkout if (checkout / "pyproject.toml").is_file() else _PACKAGE / "_data"


def folder(kind: str) -> Path:
    """Return the folder of the files of one kind that ship, such as `prompts` or `channels`."""
    return root() / kind


def entries(kind: str, pattern: str) -> list[Path]:
    """List the paths of one kind of resource that match a glob pattern, sorted.

    A resource is a file that the harness reads by name, such as a prompt version or a model card; a
    kind is the name of its folder, such as `prompts` or `channels`. It is searched where the
    harness ships it and in the user's project.
    """
    return sorted(path for where in _folders(kind) for path in where.glob(pattern))


def names(kind: str) -> list[str]:
    """Return the sorted names (file stems) of the TOML files of one kind, such as `channels`.

    They are those that ship and those of the user's project.
    """
    return sorted({path.stem for path in entries(kind, "*.toml")})


def each(names: Iterable[str], load: Callable[[str], T]) -> dict[str, T | UserError]:
    """Load every name with `load`, such as for a list, and keep errors beside what could be loaded.

    The result has, by name, what `load` returned or the UserError that it raised.
    """
    loaded: dict[str, T | UserError] = {}
    for name in names:
        try:
            loaded[name] = load(name)
        except UserError as error:
            loaded[name] = error
    return loaded


def find(kind: str, name: str) -> Path:
    """Return the path of the file or folder of one kind with this name, such as `prompts`, `v4`.

    It is looked for in the user's project and among what ships. If neither has it, the path where
    it would ship is returned, which does not exist. Raises UserError if both have it, or the name
    has characters that terminals cannot show.
    """
    # one, if `name` is absolute
    candidates = list(dict.fromkeys(where / name for where in _folders(kind)))
    existing = [path for path in candidates if os.path.lexists(path)]
    if len(existing) > 1:
        raise UserError(
            f"{kind}/{printable(name)} is in this project and ships with the harness; give yours "
            "another name"
        )
    if existing and "/" not in name:
        sayable(f"file of {kind}", name)
    return existing[0] if existing else candidates[0]


def finds(kind: str, path: Path) -> bool:
    """Return whether a file at this path is found by its name, as one of a kind like `channels`."""
    return path.absolute().parent in _folders(kind)


def card_to_copy(model: str) -> str | None:
    """Return a sentence on where to copy a model card from that no longer ships; None for others.

    A model card is a TOML file that describes a model. `model` is what was typed, a name with
    options behind `:`.
    """
    name, _, _ = model.partition(":")
    cards = {path.stem: path for path in (root() / "docs" / "cards").glob("*.toml")}
    if name not in cards:
        return None
    return (
        f"model {name!r} no longer ships; copy its card {printable(cards[name], 1000)} to "
        f"models/{name}.toml in your project's folder, which `harness init` makes, and it runs "
        "again"
    )


def _folders(kind: str) -> list[Path]:
    project = Path.cwd()
    return [folder(kind), *([project / kind] if (project / MARKER).is_file() else [])]
