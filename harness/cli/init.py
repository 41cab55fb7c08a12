"""`harness init`: a project of one's own."""

from importlib.util import find_spec
from pathlib import Path

import typer

from harness.core.errors import UserError, printable, sayable_path

PROMPT = "v3"  # what one's own prompt begins as


def command(
    folder: Path = typer.Argument(
        metavar="DIR", help="Folder to make; it may exist if it is empty."
    ),
) -> None:
    """Make a project with a prompt, a model card and settings.

    Commands that you type in this folder find prompts and cards by name.
    """
    from tempfile import TemporaryDirectory

    from harness.core import resources

    starter = Path(__file__).parent / "starter"
    sayable_path("folder", folder)
    place = folder.resolve()  # `absent/../mine` is there once `absent` is made
    try:
        if place.exists() and not place.is_dir():
            raise UserError(f"{printable(folder)} is a file; give a new folder, or an empty one")
        if place.exists() and {path.name for path in place.iterdir()} - {".git"}:
            raise UserError(f"{printable(folder)} is not empty; give a new folder, or an empty one")
        place.mkdir(parents=True, exist_ok=True)
        # so that a full disk leaves nothing half-written
        with TemporaryDirectory(dir=place) as draft:
            _copy(starter, Path(draft))
            _copy(resources.folder("prompts") / PROMPT, Path(draft, "prompts/mine"))
            _name_own(Path(draft, "prompts/mine/prompt.toml"))
            for whole in Path(draft).iterdir():
                whole.rename(place / whole.name)
    except OSError as error:
        reason = printable(error.strerror or error)
        raise UserError(
            f"{printable(folder)} cannot be made ({reason}); give another folder"
        ) from None
    command = "harness eval --model swarm-tiny --prompt mine"
    if find_spec("llama_cpp") is None:  # the engine of that model
        command = "harness eval settings.toml"
    typer.echo(f"made {printable(folder)}; next: cd there, `{command}`; README.md says more")


def _copy(folder: Path, to: Path) -> None:
    """Copy what a folder holds. Contents alone: what is installed may be read-only."""
    from shutil import copyfile

    to.mkdir(parents=True, exist_ok=True)
    for each in sorted(folder.iterdir()):
        if each.is_dir():
            _copy(each, to / each.name)
        else:
            copyfile(each, to / each.name)


def _name_own(file: Path) -> None:
    """Say of a copied prompt what it is, in place of what is said of the released one."""
    texts = {
        "description": f'description = "mine, which began as {PROMPT}"',
        "changed": f'changed = "against {PROMPT}: say here what you change, and why"',
    }
    lines = []
    for line in file.read_text().splitlines():
        key, _, _ = line.partition(" = ")
        lines.append(texts.get(key, line))
    file.write_text("\n".join(lines) + "\n")
