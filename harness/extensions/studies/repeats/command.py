"""`harness study repeats`: one evaluation several times, with other draws of its answers."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from harness.cli import options
from harness.cli.eval import show_counted
from harness.cli.progress import bar
from harness.cli.run import RunGroup, free_folder
from harness.cli.show import finish
from harness.cli.terminal import echo_json
from harness.core import work
from harness.core.errors import UserError, in_range, printable
from harness.runs.settings import FrozenSettings, Settings

if TYPE_CHECKING:
    from harness.evaluate.spec import Spec

MOST = 100
HELP = {"dataset": "Name of a shipped dataset, or a dataset's folder."}


@options.takes(FrozenSettings, HELP, without=("until_width", "until_decided"))
@options.of_extensions(followed=False)
def command(
    settings: Settings,
    of_command: Mapping[str, Any],
    repeats: int = typer.Option(
        5, help="Number of repeats, 2 to 100, each with the next sampling seed."
    ),
    out: Path | None = typer.Option(
        None, help="Folder to write. Default: reports/<model>-<prompt>-<dataset>-repeats."
    ),
    no_cache: options.NoCache = False,
    dry_run: options.DryRun = False,
    tokenizer: options.Tokenizer = None,
    as_json: options.Json = False,
    quiet: options.QuietOutput = False,
    verbose: options.Verbose = False,
    pictures: options.Pictures = False,
) -> None:
    """Evaluate several times, with other draws of answers.

    Each repeat is a run with the next sampling seed; give a --temperature above 0. If it is
    stopped, the same command continues it.
    """
    from harness.backends.cache import default_file
    from harness.dataset import suites
    from harness.evaluate import resolve
    from harness.evaluate.command_options import guarded
    from harness.evaluate.dry_run import count
    from harness.extensions.studies.repeats.study import (
        MARKER,
        WRITTEN,
        each,
        repeats_study,
        run_repeats,
    )

    world: Any = settings.world
    if suites.named(world.dataset):
        raise UserError(
            f"--repeats {repeats}: needs one dataset, and --dataset names a suite; give one of "
            "its datasets"
        )
    source = resolve.frozen(settings, world.dataset)
    options.say_all(world.limit, [source.dataset])
    spec = resolve.spec(settings, source)
    _check(spec, repeats)
    if dry_run:
        counts = {**count(spec, source.dataset, tokenizer), "repeats": repeats}
        if as_json:
            echo_json(counts)
        elif not quiet:
            show_counted(spec, counts, repeats)
        return
    group = RunGroup(each(spec, repeats), "finished repeats", MARKER, WRITTEN)
    folder = out or free_folder([spec], f"{source.name}-repeats", group.goes_on)
    group.check(folder)
    text = f"asking {printable(spec.ego.card.name, 30)}, {repeats} repeats"
    cache = None if no_cache else default_file()
    with (
        guarded(of_command, [spec], 1) as [spec],
        work.going_on(folder),
        bar(text, quiet=quiet or as_json, grows=True) as progress,
    ):
        done = run_repeats(spec, repeats, folder, progress, cache)
    finish(repeats_study(done), folder, as_json, quiet, verbose, pictures)


def _check(spec: "Spec", repeats: int) -> None:
    """Raise UserError unless an evaluation can be repeated.

    Its answers must be sampled, its latency must not be measured, and it must not stop early.
    """
    from harness.runs.records import MEASURED

    in_range("--repeats", repeats, 2, MOST)
    if rule := spec.stopping_rule:
        raise UserError(
            f"--repeats {repeats}: runs that stop early have other layouts each; leave "
            f"{rule.options} out"
        )
    if not spec.settings.temperature:
        raise UserError(
            f"--repeats {repeats}: greedy answers are the same every time; give a --temperature "
            "above 0, such as 0.7"
        )
    if spec.settings.latency == MEASURED:
        raise UserError(
            f"--latency {MEASURED}: it needs an idle machine, which its own first runs keep busy; "
            "measure once without --repeats, and give the seconds that its run.json has"
        )
