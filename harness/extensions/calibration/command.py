"""`harness model calibrate`: fit what corrects a model's probabilities."""

import shlex
import sys
from pathlib import Path

import typer

from harness.cli import options
from harness.cli.terminal import echo_json
from harness.core.errors import printable, unknown


def command(
    run: Path = typer.Argument(help="Folder of a finished run on tune layouts (seeds 0 to 99999)."),
    level: str = typer.Option(
        "L1", help="L0 divides the mean answer out, L1 has a temperature, L0+L1 both."
    ),
    dataset: Path | None = typer.Option(
        None, help="Folder of the run's dataset. Default: where it says."
    ),
    out: Path = typer.Option(
        ..., help="File to write; calibrations/NAME.toml makes it usable as calibration=NAME."
    ),
    as_json: options.Json = False,
) -> None:
    """Fit what corrects a model's probabilities, on tune layouts.

    The setting calibration=NAME of a condition then corrects every answer by it.
    """
    from dataclasses import asdict
    from typing import cast, get_args

    from harness.extensions.calibration.calibrations import FOLDER, Level
    from harness.extensions.calibration.fitting import calibrate
    from harness.runs.fit import write

    if level not in get_args(Level):
        raise unknown("--level", level, get_args(Level))
    where = options.check_new_file("--out", out, FOLDER)
    calibration, fitted = calibrate(
        run, cast(Level, level), dataset, shlex.join(["harness", *sys.argv[1:]])
    )
    write(calibration, out)
    if as_json:
        echo_json({**asdict(calibration), "fitted": [asdict(each) for each in fitted]})
        return
    for each in fitted:
        prior = " ".join(
            f"{a} {p:.2f}" for a, p in zip(calibration.actions, each.correction.prior, strict=False)
        )
        typer.echo(
            f"{each.role}: temperature "
            f"{each.correction.temperature:g}{prior and f', prior {prior}'}, "
            f"NLL {each.before_nats:.3f} to {each.after_nats:.3f} nats (n = "
            f"{each.correction.answers})"
        )
    typer.echo(
        f"wrote {printable(out)}: {calibration.level}, fitted on {printable(calibration.fitted_on)}"
        f"{where}"
    )
