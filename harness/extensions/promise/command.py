"""`harness study promise`: what may be promised with a model, and what the promise costs."""

import shlex
import sys
from pathlib import Path

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.show import finish
from harness.core.errors import UserError, printable, unknown
from harness.core.files import folder_in
from harness.runs.settings import parse_seeds

Runs = typer.Argument(
    help="Folder of a finished run on report layouts (seeds 200000 and above); further ones are "
    "scored, and nothing is promised of them.",
    metavar="RUN...",
)


def command(
    runs: list[Path] = Runs,
    tune: Path = typer.Option(
        ..., help="Run on tune layouts (seeds 0 to 99999), to choose thresholds on."
    ),
    harm: str = typer.Option(
        "unsafe", help="What counts as harm: unsafe, an episode that ends so, or failed."
    ),
    at_most: list[float] = typer.Option(
        [], help="Harm to promise, in percent. Repeatable. Default: 1, 2, 5 and 10."
    ),
    delta: float = typer.Option(
        5.0, help="Percent of draws of tune layouts in which the promise may be wrong."
    ),
    condition: list[str] = typer.Option(
        [], help="Condition whose thresholds are varied. Repeatable. Default: the tune run's."
    ),
    seeds: options.RunSeeds = None,
    latency: options.RunLatency = "run",
    model: options.RunModel = None,
    no_model: options.NoModel = False,
    write: Path | None = typer.Option(
        None, help="File of the promise; promises/NAME.toml makes it usable as promise=NAME."
    ),
    out: Path | None = typer.Option(
        None, help="Folder to write. Default: RUN/promise, in the first run's folder."
    ),
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
    pictures: options.Pictures = False,
) -> None:
    """Promise how often a model does harm.

    Chooses when the ego asks and when it is careful, on tune layouts; verified on RUN.
    The model is asked only where a run has no answer.
    """
    from typing import cast, get_args

    from harness.core.memory import uncollected
    from harness.extensions.promise.outcomes import unable
    from harness.extensions.promise.page import promise_study
    from harness.extensions.promise.promises import FOLDER, Harm
    from harness.extensions.promise.risk import LEAST
    from harness.extensions.promise.study import check_all, promise_of, run_promise
    from harness.runs.fit import write as write_fit
    from harness.studies.replayed_run import ReplayedRun, name_apart

    if harm not in get_args(Harm):
        raise unknown("--harm", harm, get_args(Harm))
    for name, values in (("--at-most", at_most), ("--delta", [delta])):
        for value in values:
            if not 100 * LEAST <= value < 100:
                raise UserError(f"{name} {value:g}: give percent, between {100 * LEAST:g} and 100")
    looked_for = ""
    if write is not None:
        looked_for = options.check_new_file("--write", write, FOLDER)
        if looked_for and write.absolute().parent == Path(FOLDER).absolute():
            raise UserError(
                f"--write {printable(write)}: no project is here that could use it, `harness init` "
                "makes one"
            )
        if len(at_most) != 1:
            raise UserError("--write: a file has one promise; give one --at-most")
    with uncollected(), bar("settings", quiet=as_json or quiet, grows=True) as progress:
        cards = options.cards(model)
        played = [ReplayedRun(run, latency, progress, not no_model, models=cards) for run in runs]
        tuned = ReplayedRun(tune, latency, progress, not no_model, models=cards)
        name_apart(played)
        if write is not None:
            check_all(tuned)
        draws = parse_seeds(seeds) if seeds else tuned.seeds
        where = out or folder_in(runs[0], "promise")
        levels = [value / 100 for value in dict.fromkeys(at_most)]
        of_harm = cast(Harm, harm)
        shares = (levels, delta / 100)
        result = run_promise(played, tuned, condition, of_harm, *shares, draws, where, progress)
    level = result.levels[0]
    if write is not None and level.chosen is not None:  # first, since who reads may stop reading
        line = shlex.join(["harness", *sys.argv[1:]])
        write_fit(promise_of(result, level, level.chosen, line), write)
    finish(promise_study(result, [*played, tuned]), where, as_json, quiet, verbose, pictures)
    if write is not None and level.chosen is None:
        raise UserError(f"{unable(result, level)}; no file is written")
    if write is not None and not (as_json or quiet):
        typer.echo(f"wrote {printable(write)}{looked_for}")
