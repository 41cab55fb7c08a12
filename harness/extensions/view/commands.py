"""`harness view` and `harness run history`: the runs in a folder, in a browser, and by date."""

from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import TYPE_CHECKING, Any

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.terminal import WIDTH, echo_json, echo_wrong
from harness.core.errors import UserError, in_range, printable
from harness.core.figures import DASH

if TYPE_CHECKING:
    from harness.extensions.view.history import Line

VARIANT = 32  # columns of model, prompt and answer mode


def view(
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
    from harness.extensions.view.serve import serve
    from harness.runs.listing import runs

    def listening(url: str) -> None:
        typer.echo(f"{url} shows them until Ctrl-C")
        if open_browser:
            import webbrowser

            Thread(
                target=webbrowser.open, args=[_leading_to(url, Path(private))], daemon=True
            ).start()

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
    from harness.extensions.view.export import INDEX, export

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
    page.write_text(
        f'<!doctype html><title>Runs</title><meta http-equiv="refresh" content="0; url={url}">'
    )
    return page.as_uri()


def history(
    folder: options.Reports = Path("reports"),
    metric: str | None = typer.Option(
        None, help="Metric to show, by its name in summary.csv. Default: the success that leads."
    ),
    condition: str | None = typer.Option(
        None, help="Condition to show. Default: the last of those that most runs have."
    ),
    dataset: str | None = typer.Option(
        None, help="Show only runs on this dataset, or driven in this scenario."
    ),
    html: Path | None = typer.Option(None, help="Also write a page to this file."),
    as_json: options.Json = False,
) -> None:
    """Show a metric over runs, by date, prompt version and model.

    Runs on the same scenes are grouped, since only those compare.
    """
    from harness.extensions.view.history import history as history_of
    from harness.extensions.view.history import write
    from harness.runs.estimates import written
    from harness.runs.metrics import entry

    wrong: dict[str, UserError] = {}
    groups = history_of(folder, metric, condition, dataset, wrong.__setitem__)
    if html:
        write(groups, html)
    if as_json:
        records: list[dict[str, Any]] = []
        for group in groups:
            record = {"scenes": group.of, "condition": group.condition, "metric": group.metric}
            records.append({**record, "runs": [_mapping(line) for line in group.lines]})
        for name, error in wrong.items():
            records.append({"run": name, "error": str(error)})
        echo_json(records)
        return
    names = {g.metric: f"{g.metric}{' %' * (entry(g.metric).unit.name == '%')}" for g in groups}
    typer.echo(f"{' or '.join(names.values())} with its 95 % interval")
    for group in groups:
        of = f": {names[group.metric]}" if len(names) > 1 else ""
        typer.echo(f"\n{printable(f'{group.of}, {group.condition}', WIDTH - len(of))}{of}")
        variants = Counter(line.run.manifest.variant for line in group.lines)
        for line in group.lines:
            value = n = DASH
            if score := line.score:
                value, n = written(score), str(score.n)
            who = printable(line.run.manifest.variant, VARIANT)
            typer.echo(
                f"{line.date.astimezone():%Y-%m-%d %H:%M} {who:<{VARIANT}} {value:<22} n {n:>4}"
            )
            if variants[line.run.manifest.variant] > 1:
                typer.echo(f"{'':17}{printable(line.name, WIDTH - 17)}")
    for name, error in wrong.items():
        typer.echo()
        echo_wrong(name, error)
    if len(groups) > 1:
        typer.echo("\nruns on different scenes do not compare, so each group has its own table")


def _mapping(line: "Line") -> dict[str, object]:
    variant, score = line.run.manifest.variant, line.score
    numbers = {
        key: getattr(score, key, None) for key in ("value", "low", "high", "n", "n_excluded")
    }
    return {
        "run": line.name,
        "date": line.date.isoformat(),
        "model": variant.model,
        "prompt": variant.prompt,
        "answer": variant.answer,
        "tags": line.run.manifest.tags,
        **numbers,
    }
