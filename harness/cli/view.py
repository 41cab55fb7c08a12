"""`harness view`: the runs in a folder, in a browser."""

from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.core.errors import UserError, in_range, printable


def command(
    folder: options.Reports = Path("reports"),
    port: int = typer.Option(7654, help="Port on 127.0.0.1; 0 picks a free one."),
    open_browser: bool = typer.Option(False, "--open", help="Also open the page in the browser."),
    export: Path | None = typer.Option(
        None, help="Serve nothing; write the list and all pages to this new folder."
    ),
) -> None:
    """List, open and compare runs and studies in a browser.

    Only this machine is served, and only to who has the token in the printed address, until Ctrl-C.
    """
    from harness.report.view.serve import serve
    from harness.runs.listing import runs

    def listening(url: str) -> None:
        typer.echo(f"{url} shows them until Ctrl-C")
        if open_browser:
            import webbrowser

            Thread(target=webbrowser.open, args=[_leading_to(url, Path(private))], daemon=True).start()

    in_range("--port", port, 0, 65535)
    listed = runs(folder)  # says what is wrong with the folder
    if export:
        if open_browser:
            raise UserError("--export and --open: give one of them")
        _export(folder, export, len(listed))
        return
    with TemporaryDirectory(prefix="harness-view-") as private:  # which only this user can read
        try:
            serve(folder, port, listening)
        except KeyboardInterrupt:
            return


def _export(folder: Path, out: Path, count: int) -> None:
    from harness.report.view.export import INDEX, export

    with bar("drawing pages", count) as progress:
        left = export(folder, out, progress)
    for line in left:
        typer.echo(f"left out {line}", err=True)
    typer.echo(f"wrote {printable(out / INDEX)}")


def _leading_to(url: str, folder: Path) -> str:
    """Write a page that leads to a URL, and return its address.

    A browser is given its address as an argument, which every user of the machine can see.
    """
    page = folder / "open.html"
    page.write_text(f'<!doctype html><title>Runs</title><meta http-equiv="refresh" content="0; url={url}">')
    return page.as_uri()
