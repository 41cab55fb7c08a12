"""The family `sumo`: scenarios of fresh traffic, which SUMO plays on a net with routes.

Their files are found by their digest: those that were typed, and those of a dataset.
"""

import atexit
import os
import shutil
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING, ClassVar

from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from harness.extensions.roads.simulation import Inputs
    from harness.world.scenario import Scenario

PREFIX, NET, ROUTES, BUILDINGS = "sumo:", "sumo", "routes", "buildings"
DIGITS = 12  # of the files' digest, in their scenario's name
FOLDERS = "SWARMDRIVE_SUMO"  # environment variable: folders that may hold such files


class FreshTraffic:
    """Make scenarios of fresh traffic, by names such as `sumo:crossing@0123456789ab`.

    A name has the digest of the files, as SUMO is given them, so they are the same wherever they
    lie. `options` are those of commands that take a scenario, by name, with their help. Methods are
    those of `Family`.
    """

    heading = "Fresh traffic of SUMO"
    options: ClassVar[Mapping[str, str]] = {
        NET: "Net of SUMO on which fresh traffic is played instead of a scenario; needs --routes. "
        "Settings may follow, as in my.net.xml:decisions=2.",
        ROUTES: "With --sumo: file of SUMO with the vehicles that set off.",
        BUILDINGS: "With --sumo: file of SUMO with polygons of type building, which block sight.",
    }

    def named(self, typed: Mapping[str, str]) -> str:
        from harness.extensions.roads.simulation import inputs_of
        from harness.extensions.roads.sources import name_of, stem_of

        if NET not in typed or ROUTES not in typed:
            raise UserError("fresh traffic needs a net and routes; give --sumo NET --routes ROUTES")
        path, settings = self.split(typed[NET])
        net = Path(path)
        buildings = Path(typed[BUILDINGS]) if BUILDINGS in typed else None
        inputs = inputs_of(net, Path(typed[ROUTES]), buildings)
        folder = Path(mkdtemp(prefix="harness-sumo-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        for name, content in inputs.files.items():
            (folder / name).write_bytes(content)
        _remember(folder)
        name = f"{PREFIX}{name_of(stem_of(net))}@{inputs.digest[:DIGITS]}"
        return self.joined(name, [settings] if settings else [])

    def scenario(self, name: str) -> "Scenario":
        from harness.extensions.roads.fresh import scenario  # imports highway-env

        return scenario(name)

    def split(self, text: str) -> tuple[str, str | None]:
        name, _, settings = text.rpartition(":")
        return (name, settings) if "=" in settings else (text, None)

    def joined(self, name: str, settings: Sequence[str]) -> str:
        return ":".join([name, *([",".join(settings)] if settings else [])])

    def allow(self, name: str) -> str | None:
        return None  # a dataset has the files of its scenario

    def kept_in(self, name: str, folder: Path) -> None:
        from harness.extensions.roads.simulation import NET_FILE

        if (folder / NET_FILE).is_file():
            _remember(folder.absolute())


def _remember(folder: Path) -> None:
    """Look for files of SUMO in a folder, too, here and in worker processes."""
    folders = _folders()
    if str(folder) not in folders:
        os.environ[FOLDERS] = os.pathsep.join([*folders, str(folder)])


def _folders() -> list[str]:
    return [folder for folder in os.environ.get(FOLDERS, "").split(os.pathsep) if folder]


def inputs_named(name: str) -> "Inputs":
    """Return the files of a scenario's name, from what was typed or a dataset's folder.

    Raises UserError where no such folder has those with the digest that the name has.
    """
    return _inputs(name.removeprefix(PREFIX), tuple(_folders()))


@lru_cache(maxsize=16)
def _inputs(name: str, folders: Sequence[str]) -> "Inputs":
    from harness.extensions.roads.simulation import kept_inputs

    _, at, digest = name.partition("@")
    for folder in folders if at and len(digest) == DIGITS else ():
        try:
            inputs = kept_inputs(Path(folder))
        except UserError:
            continue
        if inputs.digest.startswith(digest):
            return inputs
    raise UserError(
        f"the files of sumo:{printable(name, 80)} are in no folder that is known; type them: "
        f"--{NET} NET --{ROUTES} ROUTES, or set {FOLDERS}=FOLDER of a dataset"
    )


FRESH = FreshTraffic()
