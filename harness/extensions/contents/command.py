"""`harness study contents`: intents, objects, both or nothing, over bits, loss,
delay and density.
"""

from pathlib import Path

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.show import finish
from harness.cli.terminal import echo_json
from harness.core.errors import printable
from harness.core.files import folder_in
from harness.runs.settings import parse_seeds

Runs = typer.Argument(
    help="Folders of finished runs of `harness eval`, or of suites. Several families of scenes are "
    "averaged.",
    metavar="RUN...",
)


def command(
    runs: list[Path] = Runs,
    condition: list[str] = typer.Option(
        [],
        help="Operating point to play every content in: 6g:encoding=etsi. Repeatable. Default: "
        "that, and "
        "mode2:encoding=etsi over density.",
    ),
    over: list[str] = typer.Option(
        [],
        help="Setting to vary in each condition, alone: loss, latency (ms), tau, max_helpers, or "
        "any other. "
        "Repeatable. Default: these, if no --condition is given.",
    ),
    grid: list[str] = typer.Option(
        [],
        help="Values to try: 0,10,20 or from:to:step. Give one --grid for each --over, in the same "
        "order.",
    ),
    seeds: options.RunSeeds = None,
    latency: options.RunLatency = "run",
    model: options.RunModel = None,
    no_model: options.NoModel = False,
    dry_run: bool = typer.Option(
        False,
        "--dry-run",
        help="Only count the questions that the runs may lack; ask and write nothing.",
    ),
    out: Path | None = typer.Option(
        None, help="Folder to write. Default: RUN/contents, in the first folder."
    ),
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
    pictures: options.Pictures = False,
) -> None:
    """Compare contents of messages: intents, objects, both.

    Each is played at every point from stored answers. The model is asked only where the runs have
    no answer. If the study is stopped, the same command continues it.
    """
    from harness.extensions.contents.page import contents_study
    from harness.extensions.contents.study import (
        asked_at_most,
        folders,
        models,
        panels_of,
        run_contents,
    )
    from harness.studies.replayed_run import ReplayedRun

    with bar("points", quiet=as_json or quiet or dry_run, grows=True) as progress:
        cards = options.cards(model)
        by_path, replayed = list[list[ReplayedRun]](), list[ReplayedRun]()
        for path in runs:
            of_path = [
                ReplayedRun(run, latency, progress, not no_model, None, cards)
                for run in folders(path)
            ]
            by_path.append(of_path)
            replayed += of_path
        panels = panels_of(replayed, condition, over, grid)
        swarms = models(by_path, panels)
        if dry_run:
            counts = {swarm.name: asked_at_most(swarm, panels) for swarm in swarms}
            if as_json:
                echo_json(counts)
            elif not quiet:
                _show_counts(counts)
            return
        draws = parse_seeds(seeds) if seeds else replayed[0].seeds
        where = out or folder_in(runs[0], "contents")
        results = run_contents(swarms, panels, draws, where, progress)
    finish(contents_study(results, draws), where, as_json, quiet, verbose, pictures)


def _show_counts(counts: dict[str, dict[str, dict[str, int]]]) -> None:
    """Print how many questions may be asked, by model, family and role."""
    for name, by_family in counts.items():
        for family, by_role in by_family.items():
            questions = ", ".join(f"{count} of {role}" for role, count in by_role.items())
            typer.echo(f"{printable(name)}, {printable(family)}: at most {questions}")
