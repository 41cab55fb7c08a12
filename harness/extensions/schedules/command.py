"""`harness study schedule`: compare whom to ask and when over stored runs; learn it from them."""

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

TrainRuns = typer.Argument(
    help="One or more folders of finished runs on train layouts (seeds 100000 to 199999).",
    metavar="RUN...",
)


def learn(
    runs: list[Path] = TrainRuns,
    tune: list[Path] = typer.Option(
        ..., help="Run on tune layouts (seeds 0 to 99999), to choose the threshold on. Repeatable."
    ),
    condition: str = typer.Option(
        "6g:max_helpers=1", help="Operating point to learn the schedule for."
    ),
    out: Path = typer.Option(
        ..., help="File to write; schedules/NAME.toml makes it usable as schedule NAME."
    ),
    model: options.RunModel = None,
    quiet: options.Quiet = False,
) -> None:
    """Learn a schedule: what asking a helper is worth.

    It learns from runs on train layouts, and chooses the threshold on tune layouts.
    """
    from harness.coordination.named_points import named_point
    from harness.extensions.schedules.learning import ROUNDS, run_learn
    from harness.studies.replayed_run import ReplayedRun

    where = options.check_new_file("--out", out, "schedules")
    point, cards = named_point(condition), options.cards(model)
    command = shlex.join(["harness", *sys.argv[1:]])
    with bar("learning", ROUNDS, quiet=quiet) as progress:
        train = [ReplayedRun(run, progress=progress, models=cards) for run in runs]
        tune_runs = [ReplayedRun(run, progress=progress, models=cards) for run in tune]
        for run in (*train, *tune_runs):
            progress.more(run.dataset.scenario.parameters.decisions)
        schedule = run_learn(train, tune_runs, point, out, command, progress)
    if not quiet:
        typer.echo(
            f"wrote {printable(out)}: threshold {schedule.threshold:g}, the best on tune layouts"
            f"{where}"
        )


def compare(
    runs: options.Runs,
    tune: list[Path] = typer.Option(
        [],
        help="Run on tune layouts (seeds 0 to 99999), to choose each schedule's settings on. Give "
        "one for "
        "each RUN, in the same order.",
    ),
    condition: str = typer.Option("6g", help="Operating point to play each schedule in."),
    budget: float = typer.Option(
        0.5,
        help="Most messages that a chosen setting may take, as a share of what the paper's "
        "schedule takes.",
    ),
    schedule: list[str] | None = typer.Option(
        None,
        help="Schedule to compare, such as entropy, margin or learnt. Repeatable. Default: all.",
    ),
    seeds: options.RunSeeds = None,
    latency: options.RunLatency = "run",
    model: options.RunModel = None,
    out: Path | None = typer.Option(
        None, help="Folder to write. Default: RUN/schedules, in the first run's folder."
    ),
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
    pictures: options.Pictures = False,
) -> None:
    """Compare schedules (whom to ask, and when) on stored answers.

    The bounds are asking nobody and an oracle, which knows how every course ends.

    The model is asked only about decision points that the run did not reach;
    the run's folder keeps those answers.
    """
    from harness.coordination.schedules import SCHEDULES
    from harness.extensions.schedules.study import in_order, run_schedules, schedule_study
    from harness.studies.replayed_run import ReplayedRun, name_apart

    names = list(dict.fromkeys(schedule or in_order(SCHEDULES.usable())))
    for name in names:
        if name not in SCHEDULES:
            raise unknown("--schedule", name, SCHEDULES)
    if not 0 < budget <= 1:
        raise UserError(f"--budget {budget:g}: give a share above 0, 1 at most")
    if tune and len(tune) != len(runs):
        raise UserError(
            f"--tune: {len(tune)} given for {len(runs)} runs; give one for each, in order, or none"
        )
    with bar("schedules", quiet=as_json or quiet, grows=True) as progress:
        cards = options.cards(model)
        replayed = [ReplayedRun(run, latency, progress, models=cards) for run in runs]
        name_apart(replayed)
        tuned = [ReplayedRun(run, latency, progress, models=cards) for run in tune]
        draws = parse_seeds(seeds) if seeds else replayed[0].seeds
        where = out or folder_in(runs[0], "schedules")
        compared = run_schedules(replayed, tuned, condition, names, draws, budget, where, progress)
    study = schedule_study(compared, [*replayed, *tuned], draws)
    finish(study, where, as_json, quiet, verbose, pictures)
