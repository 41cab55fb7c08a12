"""`harness study fidelity`: frozen against closed-loop."""

from pathlib import Path

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.show import finish


def command(
    runs: options.Runs,
    out: Path = typer.Option(Path("reports/fidelity"), help="Folder to write."),
    as_json: options.Json = False,
    verbose: options.Verbose = False,
    pictures: options.Pictures = False,
) -> None:
    """Compare frozen with closed-loop success, paired by episode.

    Give at least one run of `harness eval` and one of `harness drive`,
    with the same models and layouts.
    """
    from harness.extensions.studies.fidelity.study import fidelity, fidelity_study
    from harness.studies.study import refuse_other

    with bar("comparing frozen with closed loop", quiet=as_json):
        study = fidelity_study(fidelity(runs), runs)
        refuse_other(out, study.kind, {"sources": study.manifest["sources"]})
    finish(study, out, as_json, verbose=verbose, pictures=pictures)
