"""`harness run`: list and check finished runs, merge shards."""

import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from harness.cli import drive, options
from harness.cli.progress import bar
from harness.cli.terminal import WIDTH, echo_json, echo_text
from harness.core import extras, work
from harness.core.errors import UserError, printable
from harness.core.figures import PERCENT, amount, dataset_size
from harness.core.formats import SUITE
from harness.runs.headline import BALANCED

if TYPE_CHECKING:
    from harness.runs.listing import Listed


def ls(folder: options.Reports = Path("reports"), as_json: options.Json = False) -> None:
    """List runs and studies, newest first.

    Each has the success of its best condition that no warning of its page is about,
    balanced over danger and none where that leads.
    """
    from harness.runs.listing import UNREAD, runs

    listed = runs(folder)
    if as_json:
        echo_json([{**asdict(run), "date": run.date.isoformat()} for run in listed])
        return
    for run in listed:
        name, date = printable(run.name, WIDTH - 17), f"{run.date.astimezone():%Y-%m-%d %H:%M}"
        typer.echo(f"{name:<{WIDTH - 17}} {date}")
        outcome = _outcome(run)
        kind = f"{run.kind:<5} "
        left = WIDTH - 3 - len(kind) - len(outcome)
        parts = " · ".join(part for part in (run.model, run.prompt, run.answer) if part is not None)
        typer.echo(f"  {kind}{printable(parts, left):<{left}} {outcome}".rstrip())
        if run.unread is not None and run.unread >= UNREAD:
            share = "none" if run.unread == 1 else f"only {100 * (1 - run.unread):.1f} %"
            typer.echo(
                f"{'':8}{share} of the ego's answers could be read: it drives by the fallback"
            )
        if run.pick:
            chosen = printable(f"of episodes chosen by {run.pick}", WIDTH - 8)
            typer.echo(f"{'':8}{chosen}")
        if run.tags:
            typer.echo(f"{'':8}{printable('tags: ' + ', '.join(run.tags), WIDTH - 8)}")
    if not listed:
        typer.echo(f"no runs in {printable(folder)}; `harness eval` makes one")


def _outcome(run: "Listed") -> str:
    if run.why is not None:
        return f"{run.state}: {run.why}"
    if run.success is None:
        return ""
    what = " balanced" if run.metric == BALANCED else ""
    return (
        f"{printable(run.condition, 24)}{what} {PERCENT.interval(run.success, run.low, run.high)} %"
    )


def check(
    runs: options.Runs,
    dataset: options.RunsDataset = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Compute runs again from their own answers; compare each number.

    No model is asked; rule-based drivers are. A driven run is driven again with its answers. Exit
    code 1 means that a number differs.
    """
    silent = as_json or quiet
    lines = [_checked(run, dataset, silent) for run in _runs_in(runs)]
    lines += [_checked_means(run, silent) for run in runs if (run / SUITE).is_file()]
    if as_json:
        echo_json(lines)
    if not all(line["equal"] for line in lines):
        raise typer.Exit(1)


def _runs_in(folders: list[Path]) -> list[Path]:
    """Return the folders of runs, those of a suite in its place."""
    from harness.runs import suite

    runs = list[Path]()
    for folder in folders:
        is_suite = (folder / SUITE).is_file()
        runs += [run.path for run in suite.read(folder).runs.values()] if is_suite else [folder]
    return runs


def _checked(path: Path, dataset: Path | None, silent: bool) -> dict[str, object]:
    """Check a run, print the result, and return it."""
    from harness.evaluate.recompute import differences, texts_otherwise
    from harness.evaluate.stated_times import unchecked_times
    from harness.runs.contradictions import contradictions, unchecked
    from harness.runs.folder import read
    from harness.runs.run_dataset import dataset_of
    from harness.runs.settings import otherwise

    run = read(path)
    open_points = [*unchecked(run), *unchecked_times(run)]
    frozen = run.world == "frozen"
    try:
        if not frozen:
            extras.need("to drive again", "highway_env")
    except UserError as error:
        wrong = [*contradictions(run), *texts_otherwise(run)]
        open_points.append(f"It was not driven again: {error}.")
        how = "whose tables were held against each other"
    else:
        reading = bar(f"reading {printable(path.name, 30)}", quiet=silent, grows=True)
        scenes = dataset_of(run, dataset) if frozen else None
        with tempfile.TemporaryDirectory(prefix="harness-") as folder, reading as progress:
            wrong, lacking = differences(run, scenes, Path(folder) / "run", progress)
        open_points += lacking
        how = "computed again from its answers" if frozen else "driven again with its answers"
    if mistake := otherwise(path, run.manifest.settings):
        wrong.append(mistake)
    if not silent:
        rows = f"{amount(len(run.scores), 'figure')} and {amount(len(run.decisions), 'decision')}"
        equal = "equal where it can be checked" if open_points else "equal"
        typer.echo(f"{printable(path)}: {'not equal' if wrong else equal}: {rows}, {how}")
        for line in (*wrong, *open_points):
            echo_text(f"  {line}")
    return {
        "run": str(path),
        "world": run.world,
        "equal": not wrong,
        "figures": len(run.scores),
        "decisions": len(run.decisions),
        "differences": wrong,
        "unchecked": open_points,
    }


def _checked_means(path: Path, silent: bool) -> dict[str, object]:
    """Check the means of a suite over its runs, print the result, and return it."""
    from harness.runs.contradictions import of_suite, unchecked_of_suite
    from harness.runs.suite import read

    suite = read(path)
    wrong, open_points = list(of_suite(suite)), list(unchecked_of_suite(suite))
    if not silent:
        means = amount(len(suite.stated_scores), "mean")
        equal = "equal where it can be checked" if open_points else "equal"
        result = "not equal" if wrong else equal
        typer.echo(f"{printable(path)}: {result}: {means}, computed again from its runs")
        for line in (*wrong, *open_points):
            echo_text(f"  {line}")
    return {
        "suite": str(path),
        "equal": not wrong,
        "figures": len(suite.stated_scores),
        "differences": wrong,
        "unchecked": open_points,
    }


def merge(
    folders: list[Path] = typer.Argument(
        help="Folders of all shards, in any order.", metavar="FOLDER..."
    ),
    out: Path = typer.Option(..., help="Folder to write the whole to."),
    audit: bool = typer.Option(
        True, help="Audit a merged dataset of 100 layouts or more, as `harness dataset build` does."
    ),
    unreachable: options.Unreachable = False,
    workers: options.Workers = "2",
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Merge the shards of a run or a dataset.
    The result is byte for byte what one unsplit run writes.
    """
    from harness.core.shards import read

    who, silent = options.workers_of(workers), as_json or quiet
    if "world" not in read(folders, work.WorkStart)[0].settings:
        from harness.dataset.build import merge as merge_dataset

        with bar("layouts", quiet=silent) as progress:
            manifest = merge_dataset(folders, out, who, progress, audit, progress.more, unreachable)
        if as_json:
            echo_json(manifest)
        elif not quiet:
            typer.echo(
                f"wrote {printable(out)}: {dataset_size(manifest['episodes'], manifest['nodes'])}"
            )
        return
    from harness.cli.report import write
    from harness.evaluate.run import merge
    from harness.runs import folder

    done = merge(folders, out)
    with work.going_on(out):
        page = write([out], quiet=silent)
    work.tidy(out)
    drive.tell(done, folder.read(out), as_json, quiet)
    if not silent:
        typer.echo(f"wrote {printable(page)}")
