"""The family `recording`: scenarios that are recordings, found in folders by their digest."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from harness.core.errors import UserError, printable
from harness.extensions.roads.by_digest import DIGITS, ByDigest, Folders, digest_in

if TYPE_CHECKING:
    from harness.extensions.roads.tables import Recording
    from harness.world.scenario import Scenario

PREFIX, OPTION = "recording:", "recording"
FOLDERS = "SWARMDRIVE_RECORDINGS"  # environment variable: folders that may hold recordings
REPLAYED = (
    "The others do not react (react=false): they drive as they were recorded to, and strike an ego "
    "that is slower than the recorded driver was."
)
_FOLDERS = Folders(FOLDERS)


class Recordings(ByDigest):
    """Make scenarios of recordings, by names such as `recording:crossing@0123456789ab`.

    A name has the digest of the recording, so its content is the same wherever it lies. `options`
    are those of commands that take a scenario, by name, with their help. Methods are those of
    `Family`.
    """

    heading = "Recordings"
    options: ClassVar[Mapping[str, str]] = {
        OPTION: "Folder of a recording to use instead of a scenario; `harness dataset import` "
        "writes one.",
    }

    def named(self, typed: Mapping[str, str]) -> str:
        from harness.extensions.roads.tables import read

        text, settings = self.split(typed[OPTION])
        folder = Path(text).absolute()
        recording = read(folder)
        _FOLDERS.remember(folder)
        return self.joined(name_of(recording), [settings] if settings else [])

    def typed(self, text: str, folder: str) -> list[str]:
        _, settings = self.split(text)
        return [f"--{OPTION}", self.joined(folder, [settings] if settings else [])]

    def scenario(self, name: str) -> "Scenario":
        from harness.extensions.roads.world import scenario  # imports highway-env

        return scenario(name)

    def kept_in(self, name: str, folder: Path) -> None:
        from harness.extensions.roads.tables import FACTS

        if (folder / FACTS).is_file():
            _FOLDERS.remember(folder.absolute(), is_first=True)  # what is beside a dataset


_IN_MEMORY: dict[str, "Recording"] = {}


@contextmanager
def in_memory(recording: "Recording") -> Iterator[str]:
    """Enter a context in which a recording that is in no folder makes a scenario; yield its name.

    It holds in this process alone.
    """
    name = name_of(recording)
    _IN_MEMORY[name] = recording
    try:
        yield name
    finally:
        del _IN_MEMORY[name]


def name_of(recording: "Recording") -> str:
    """Return the name of the scenario that a recording is."""
    return f"{PREFIX}{recording.name}@{recording.digest[:DIGITS]}"


def recording_of(name: str) -> "Recording":
    """Return the recording of a scenario's name, from a folder that was typed or of a dataset.

    Raises UserError where no such folder has one with the digest that the name has.
    """
    if name in _IN_MEMORY:
        return _IN_MEMORY[name]
    return _recording(name.removeprefix(PREFIX), _FOLDERS.listed)


@lru_cache(maxsize=16)
def _recording(name: str, folders: Sequence[str]) -> "Recording":
    from harness.core.files import bytes_of, sha256_bytes
    from harness.extensions.roads.tables import FACTS

    digest = digest_in(name)
    for folder in folders if digest else ():
        try:
            whole = sha256_bytes(bytes_of(Path(folder) / FACTS, "record"))
        except (OSError, ValueError):
            continue
        if whole.startswith(digest):
            recording = _kept(folder, whole)
            if name_of(recording) != PREFIX + name:
                raise UserError(
                    f"the recording of {printable(name, 80)} has another name; type "
                    f"{name_of(recording)}"
                )
            return recording
    raise UserError(
        f"recording {printable(name, 80)} is in no folder that is known; set its folder: "
        f"{FOLDERS}=FOLDER"
    )


@lru_cache(maxsize=16)
def _kept(folder: str, digest: str) -> "Recording":
    """Return the recording in a folder, the same object as long as its digest is the same."""
    from harness.extensions.roads import held
    from harness.extensions.roads.tables import read

    recording = read(Path(folder))
    if recording.digest != digest:
        raise UserError(f"recording {printable(folder)} changes; read it when it is written")
    held.hold(recording)
    return recording


RECORDINGS = Recordings()
