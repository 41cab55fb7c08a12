"""`harness study reaction`: recorded others that react against others that only replay."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.show import finish

Reacting = Annotated[
    str, Argument(metavar="WITH", help="Dataset of a recording, whose others react.")
]
Replaying = Annotated[
    str, Argument(metavar="WITHOUT", help="The same layouts, built with react=false.")
]


def command(
    with_reaction: Reacting,
    without_reaction: Replaying,
    out: Annotated[Path, Option(help="Folder to write.")] = Path("reports/reaction"),
    as_json: options.Json = False,
    verbose: options.Verbose = False,
    pictures: options.Pictures = False,
) -> None:
    """Compare courses where others react and where they replay.

    Give two datasets of one recording that differ in react alone.
    """
    from harness.dataset.load import find, load
    from harness.extensions.roads.reaction.study import manifest_of, reaction, reaction_study
    from harness.studies.study import refuse_other

    react, replay = load(find(with_reaction)), load(find(without_reaction))
    manifest = manifest_of(react, replay)
    refuse_other(out, "reaction", {"sources": manifest["sources"]})
    with bar("following courses", len(react.episodes), quiet=as_json) as progress:
        study = reaction_study(reaction(react, replay, progress), manifest)
    finish(study, out, as_json, verbose=verbose, pictures=pictures)
