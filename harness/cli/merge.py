"""`harness run merge`: one run, or one dataset, of its shards."""

from pathlib import Path
from typing import Annotated

import typer

from harness.cli import drive, options
from harness.cli.progress import bar
from harness.cli.terminal import echo_json
from harness.core import work
from harness.core.errors import printable


def command(
    folders: Annotated[
        list[Path], typer.Argument(help="Folders of all shards, in any order.", metavar="FOLDER...")
    ],
    out: Path = typer.Option(..., help="Folder to write the whole to."),
    audit: bool = typer.Option(
        True, help="Audit a merged dataset of 100 layouts or more, as `harness dataset build` does."
    ),
    workers: options.Workers = "2",
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Merge the shards of a run or a dataset. The result is byte for byte what one unsplit run writes."""
    from harness.core.shards import read

    who, silent = options.workers_of(workers), as_json or quiet
    if "world" not in read(folders, work.WorkStart)[0].settings:
        from harness.dataset.build import merge as merge_dataset

        with bar("layouts", quiet=silent) as progress:
            manifest = merge_dataset(folders, out, who, progress, audit, progress.more)
        if as_json:
            echo_json(manifest)
        elif not quiet:
            typer.echo(
                f"wrote {printable(out)}: {manifest['episodes']} layouts, {manifest['nodes']} decision points"
            )
        return
    from harness.cli.report import write
    from harness.evaluate.run import merge

    done = merge(folders, out)
    with work.going_on(out):
        page = write([out], quiet=silent)
    work.tidy(out)
    drive.tell(done, as_json, quiet)
    if not silent:
        typer.echo(f"wrote {page}")
