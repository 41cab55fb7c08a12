"""Keep what a run was made of: the folder `sources` of a run's folder, laid out as a project is.

It has the files of the prompts, the model cards, the channels and so on that the run used, and the
schemas of its answers. `run.json` has the digests of the prompts, so that a kept prompt can be
checked.
"""

import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from harness.core import resources
from harness.core.errors import UserError, printable
from harness.core.files import bytes_of, refuse_links, sha256_bytes
from harness.core.formats import SOURCES
from harness.prompts import versions
from harness.prompts.versions import FILES, OPTIONAL, Prompt
from harness.runs import fit
from harness.runs.folder import Run

PROMPTS = "prompts"


def write(out: Path, files: Mapping[str, bytes], work: Path) -> None:
    """Write the files that a run was made of to the folder `sources` in the run's folder `out`.

    `files` has their content by path within that folder. They replace what is there at once:
    written first to the folder `work`, which is then renamed.
    """
    if read(out) == files:
        return
    part = work / f".{SOURCES}.{os.getpid()}.part"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    for folder in dict.fromkeys((part / name).parent for name in files):
        folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (part / name).write_bytes(data)
    shutil.rmtree(out / SOURCES, ignore_errors=True)
    os.replace(part, out / SOURCES)


def read(out: Path) -> dict[str, bytes]:
    """Return the files that a run was made of, as its folder keeps them in `sources`.

    They are prompts, models' descriptions and the like: content by path. Raises UserError for a
    link, which could lead to any file of whoever reads a stranger's run.
    """
    kept = out / SOURCES
    refuse_links(kept)
    files = sorted(path for path in kept.rglob("*") if path.is_file())
    return {file.relative_to(kept).as_posix(): bytes_of(file, "text") for file in files}


def prompt_of(run: Run, prompt_record: Mapping[str, Any]) -> Prompt | None:
    """Return a prompt version with the digest that a run states: the installed one or its own copy.

    `prompt_record` has the keys `version` and `sha256`. None if neither has this digest. Raises
    UserError for a link in the folder of its own copies.
    """
    version, sha256 = prompt_record["version"], prompt_record["sha256"]
    if prompt := versions.as_it_was(version, sha256):
        return prompt
    refuse_links(run.path / SOURCES)
    return versions.as_it_was(version, sha256, run.path / SOURCES / PROMPTS)


def otherwise(
    files: Mapping[str, bytes], prompt_records: Iterable[Mapping[str, Any]]
) -> Iterator[str]:
    """Yield a sentence for each prompt that a run keeps with another digest than it states.

    `files` are those of its folder `sources`, by path, and `prompt_records` have the keys `version`
    and `sha256`. A run may keep none.
    """
    pairs = [(each["version"], each["sha256"]) for each in prompt_records]
    for version, sha256 in dict.fromkeys(pairs):
        folder = f"{PROMPTS}/{version}"
        names = [name for name in (*FILES, *OPTIONAL) if f"{folder}/{name}" in files]
        texts = {name: files[f"{folder}/{name}"].decode(errors="replace") for name in names}
        if texts and versions.digest(texts) != sha256:
            yield (
                f"{SOURCES}/{printable(folder, 60)} has another digest than prompt "
                f"{printable(version, 40)} in run.json"
            )


def other_files(run: Run) -> dict[tuple[str, str], Path]:
    """Return the files that a run keeps of what its conditions name, and that are others here.

    They are paths in the run's folder, by the folder of a project, such as `promises`, and the name
    in it. A file is another here if the project has none, or one that differs from the run's in
    more than words.
    """
    others = dict[tuple[str, str], Path]()
    for (folder, name), data in copies(run).items():
        here = resources.find(folder, f"{name}.toml")
        if not here.is_file() or not fit.is_alike(bytes_of(here, "text"), data):
            others[folder, name] = run.path / SOURCES / folder / f"{name}.toml"
    return others


def copies(run: Run) -> dict[tuple[str, str], bytes]:
    """Return what a run keeps of the files that its conditions name and whose digests it states.

    They are contents, by the folder of a project, such as `promises`, and the name in it.
    """
    files, contents = read(run.path), dict[tuple[str, str], bytes]()
    for folder, by_name in run.manifest.kept.items():
        for name, recorded in by_name.items():
            data = files.get(f"{folder}/{name}.toml")
            if data is not None and sha256_bytes(data) == recorded:
                contents[folder, name] = data
    return contents


def refuse_other_files(run: Run) -> None:
    """Raise UserError if what a run's conditions name is another file here, or none."""
    for (folder, name), file in other_files(run).items():
        is_here = resources.find(folder, f"{name}.toml").is_file()
        state = "has changed since" if is_here else "is not here"
        raise UserError(
            f"{printable(run.path)}: {printable(folder.removesuffix('s'))} {printable(name)} "
            f"{state}; copy {printable(file)} to {printable(folder)}/, or run again"
        )


def lacking(run: Run) -> str | None:
    """Return a sentence that names a prompt of a run which cannot be found; None if all are here.

    A prompt is found if it is installed with the digest that the run states, or stored in its
    folder.
    """
    for agent in (run.manifest.agent(0), *run.manifest.helpers):
        if prompt_of(run, agent["prompt"]) is None:
            version, sha256 = agent["prompt"]["version"], agent["prompt"]["sha256"]
            return (
                f"prompt {printable(version, 40)} with sha256 {printable(sha256, 13)} is not here"
            )
    return None
