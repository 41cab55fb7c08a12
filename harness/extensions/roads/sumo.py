"""The family `sumo`: scenarios of fresh traffic, which SUMO plays on a net with routes.

Their files are found by their digest: those that were typed, and those of a dataset.
"""

import atexit
import shutil
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING, ClassVar

from harness.core.errors import UserError, printable
from harness.extensions.roads.by_digest import DIGITS, ByDigest, Folders, digest_in

if TYPE_CHECKING:
    from harness.extensions.roads.simulation import Inputs
    from harness.world.scenario import Scenario

PREFIX, NET, ROUTES, BUILDINGS = "sumo:", "sumo", "routes", "buildings"
FOLDERS = "SWARMDRIVE_SUMO"  # environment variable: folders that may hold such files
_FOLDERS = Folders(FOLDERS)


class FreshTraffic(ByDigest):
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
        _FOLDERS.remember(folder)
        name = f"{PREFIX}{name_of(stem_of(net))}@{inputs.digest[:DIGITS]}"
        return self.joined(name, [settings] if settings else [])

    def scenario(self, name: str) -> "Scenario":
        from harness.extensions.roads.fresh import scenario  # imports highway-env

        return scenario(name)

    def kept_in(self, name: str, folder: Path) -> None:
        from harness.extensions.roads.simulation import NET_FILE

        if (folder / NET_FILE).is_file():
            _FOLDERS.remember(folder.absolute())


def inputs_named(name: str) -> "Inputs":
    """Return the files of a scenario's name, from what was typed or a dataset's folder.

    Raises UserError where no such folder has those with the digest that the name has.
    """
    return _inputs(name.removeprefix(PREFIX), _FOLDERS.listed)


@lru_cache(maxsize=16)
def _inputs(name: str, folders: Sequence[str]) -> "Inputs":
    from harness.extensions.roads.simulation import kept_inputs

    digest = digest_in(name)
    for folder in folders if digest else ():
        try:
            inputs = kept_inputs(Path(folder))
        except UserError:
            continue
        if inputs.digest.startswith(digest):
            return inputs
    raise UserError(
        f"the files of sumo:{printable(name, 80)} are in no folder that is known; set that of a "
        f"dataset that has them: {FOLDERS}=FOLDER"
    )


FRESH = FreshTraffic()
