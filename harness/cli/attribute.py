"""`harness study attribute`: what moved a run's answers and decisions."""

from pathlib import Path
from textwrap import fill

import typer

from harness.cli import options
from harness.cli.estimates import WIDTH, echo_json, table
from harness.cli.progress import bar
from harness.core.errors import printable
from harness.core.figures import Unit, as_mapping, shown

MOST = 100_000
USUAL = "6g"
HEADS = ("left out", "of", "shift [95 %]", "flips % [95 %]", "fail%", "n")


def command(
    run: Path = typer.Argument(help="Folder of a finished run of `harness eval`.", metavar="RUN"),
    sample: int = typer.Option(40, help="Number of decision points to draw at random, at most."),
    sample_seed: int = typer.Option(0, help="Seed of this draw."),
    condition: str | None = typer.Option(
        None, help="Condition to draw decision points from. Default: 6g, or the run's last if it has no 6g."
    ),
    dataset: options.RunsDataset = None,
    model: options.RunModel = None,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Show which objects and messages moved the answers.

    Each is left out of the prompt, or of the fusion, in turn.

    The run's model is asked the questions that the run has no answer for, each once. `harness report` then
    shows the result at each decision.
    """
    from harness.studies.attribution import attribute, headline, rows, rule, write
    from harness.studies.replayed_run import ReplayedRun

    options.in_range("--sample", sample, 1, MOST)
    with bar("asking without", quiet=as_json or quiet, grows=True) as progress:
        own = options.cards(model)
        stored = ReplayedRun(
            run, more=progress.more, done=progress, dataset=dataset, models=own, say=progress.say
        )
        chosen = condition or (USUAL if USUAL in stored.points else stored.run.conditions[-1])
        found = attribute(stored, chosen, sample, sample_seed)
    made, file = rows(found), write(found, run)
    if as_json:
        names = ("shift", "flips", "failed")
        echo_json({
            "run": str(run), "condition": found.condition, "decision_points": found.decision_points,
            "of": found.of, "sample_seed": found.sample_seed,
            "rows": [
                {"role": row.role, "kind": row.kind, **{n: as_mapping(getattr(row, n)) for n in names}}
                for row in made
            ],
        })  # fmt: skip
    elif not quiet:
        typer.echo(f"{printable(stored.name)} · {printable(stored.run.source)}")
        typer.echo(fill(headline(made), WIDTH))
        cells = (
            (
                r.kind,
                r.role,
                shown(r.shift, Unit(decimals=2)),
                shown(r.flips),
                f"{100 * r.failed.value:.1f}",
                str(r.shift.n),
            )
            for r in made
        )
        table(HEADS, cells)
        if stored.lost:
            typer.echo(fill(stored.lost, WIDTH))
        typer.echo(fill(f"{rule(found)}; intervals over episodes", WIDTH))
        typer.echo(
            "of: the prompt it is left out of; fusion: a message that came in time; shift:\n"
            "total variation distance of the answers or policies; flips: another action is\n"
            "most probable; fail%: the answer without it could not be read"
        )
        typer.echo(f"wrote {printable(file)}")
