"""`harness benchmark`: run an edition, pack its results into one file,
verify and rank such files.
"""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from os.path import realpath
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from harness.cli import options, suite
from harness.cli.eval import show_counted
from harness.cli.progress import bar
from harness.cli.run import evaluate
from harness.cli.terminal import echo_json, echo_text, table
from harness.core.at_once import at_once_of
from harness.core.errors import UserError, printable
from harness.core.figures import amount, interval_of
from harness.core.formats import SUITE, refuse_data

if TYPE_CHECKING:
    from harness.extensions.benchmark.board import Line
    from harness.extensions.benchmark.rescore import Here, Rescored

EDITION = "v2v-safety-1.1"  # taken if none is named

MadeBy = Annotated[
    str, typer.Option(help="Who made the results, in your words; it stands on a board.")
]
Files = Annotated[list[Path], typer.Argument(metavar="FILE...", help="Files of results.")]
To = Annotated[
    Path | None,
    typer.Option(help="File to write. Default: the run's folder with .zip after its name."),
]


def run(
    edition: Annotated[str, typer.Argument(help="Edition to run.")] = EDITION,
    model: options.Model = "proxy",
    engine: options.Engine = None,
    prompt: options.ScenarioPrompt = None,
    answer: options.Answer = "json",
    thinking: options.Thinking = False,
    batch_size: options.BatchSize = "8",
    server: Annotated[list[str] | None, typer.Option(help=options.HELP["server"])] = None,
    device: options.Device = None,
    dtype: options.Dtype = None,
    limit: Annotated[
        int | None,
        typer.Option(min=1, help="Try only the first layouts of each dataset; nothing is packed."),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Only count requests and tokens; write nothing."),
    ] = False,
    made_by: MadeBy = "",
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder to write the runs to. Default: reports/<model>-<prompts>-<edition>."
        ),
    ] = None,
    no_cache: options.NoCache = False,
    workers: options.RuleWorkers = None,
    quiet: options.Quiet = False,
) -> None:
    """Evaluate a model on an edition, and pack the results.

    Nothing is sent anywhere. If it is stopped, the same command continues it.
    """
    from harness.backends.cache import default_file
    from harness.dataset.suites import Suite
    from harness.evaluate import resolve
    from harness.evaluate.dry_run import count
    from harness.extensions.benchmark import edition as editions
    from harness.extensions.benchmark.rescore import Here

    of = editions.named(edition)
    if not dry_run:
        Here().check(of)
    sources = {name: of.source(name, limit) for name in of.datasets}
    agent_settings = {
        "model": model,
        "engine": engine,
        "prompt": prompt,
        "answer": answer,
        "thinking": thinking,
        "batch_size": at_once_of(batch_size),
        "server": tuple(server or ()),
        "device": device,
        "dtype": dtype,
    }
    specs = [
        resolve.spec(of.settings(name, **agent_settings), source)
        for name, source in sources.items()
    ]
    for spec in specs:
        if spec.ego.prompt.version not in of.prompts:
            listed = ", ".join(of.prompts)
            raise UserError(
                f"--prompt {spec.ego.prompt.version}: {of.name} has prompts {listed}; give one of "
                "them"
            )
    datasets = Suite(of.name, of.description, tuple(sources))
    suite.check(datasets, specs)
    cache = None if no_cache else default_file()
    evaluated = partial(
        evaluate, cache=cache, quiet=quiet, workers=options.workers_of(workers or "2")
    )
    frozen = [source.dataset for source in sources.values()]
    if dry_run:
        for spec, dataset in zip(specs, frozen, strict=True):
            show_counted(spec, count(spec, dataset, None))
        return
    again = ("benchmark", "run", of.name)
    folder = suite.evaluate(
        datasets, specs, frozen, out, evaluated, quiet, as_json=False, edition=again
    )
    if limit is None:
        pack([folder], edition, made_by, None, quiet)
    elif not quiet:
        typer.echo(
            f"a try of {amount(limit, 'layout')} of each dataset is no entry: nothing was packed"
        )


def pack(
    runs: options.Runs,
    edition: Annotated[str, typer.Option(help="Edition that they are of.")] = EDITION,
    made_by: MadeBy = "",
    out: To = None,
    quiet: options.Quiet = False,
) -> None:
    """Pack runs of an edition, or a suite's folder, into one file."""
    from harness.extensions.benchmark import edition as editions
    from harness.extensions.benchmark import results
    from harness.runs import folder
    from harness.runs import suite as suites

    of = editions.named(edition)
    if len(runs) == 1 and (runs[0] / SUITE).is_file():
        given = list(suites.read(runs[0]).runs.values())
    else:
        given = [folder.read(path) for path in runs]
    entry = of.entry(given)
    try:
        contents = results.Contents(
            format=results.FORMAT,
            edition=of.name,
            digest=of.digest,
            made_by=made_by,
            runs=tuple(entry),
        )
    except ValueError as error:
        raise UserError(f"--made-by: {error}; give a shorter text") from None
    file = out or runs[0].absolute().with_name(runs[0].absolute().name + ".zip")
    refuse_data("--out", file)
    results.pack(contents, entry, of.figures, file)
    if not quiet:
        typer.echo(f"packed {printable(of.name)}, digest {of.digest}, into {printable(file)}")


def verify(
    files: Files,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Compute results again from their answers; compare each figure.

    No model is asked, and nothing in the file is run or believed.
    Exit code 1 means that a figure differs.
    """
    from harness.extensions.benchmark.rescore import Here

    here, lines = Here(), list[dict[str, Any]]()
    for file in files:
        with _rescored(file, here, as_json or quiet) as done:
            lines.append(_mapping(file, done))
            if not (as_json or quiet):
                _show(file, done)
    if as_json:
        echo_json(lines)
    if not all(line["equal"] for line in lines):
        raise typer.Exit(1)


@contextmanager
def _rescored(file: Path, here: "Here", silent: bool) -> "Iterator[Rescored]":
    from harness.extensions.benchmark.rescore import rescored

    with tempfile.TemporaryDirectory(prefix="harness-") as folder:
        with bar(f"reading {printable(file.name, 30)}", quiet=silent, grows=True) as done:
            computed = rescored(file, Path(folder), done, here)
        yield computed


def _mapping(file: Path, done: "Rescored") -> dict[str, Any]:
    return {
        "file": str(file),
        "edition": done.edition.name,
        "digest": done.edition.digest,
        "made_by": done.contents.made_by,
        "agents": str(done.suite.variant),
        "figures": done.compared,
        "differing": done.differences,
        "equal": not any(done.differences.values()),
    }


def _show(file: Path, done: "Rescored") -> None:
    from harness.extensions.benchmark.rescore import DIGITS

    by = f", made by {printable(done.contents.made_by)}" if done.contents.made_by else ""
    typer.echo(f"{printable(file)}: {printable(done.suite.variant)}{by}")
    typer.echo(f"{printable(done.edition.name)}, digest {done.edition.digest}, as it is here")
    wrong = {name: figures for name, figures in done.differences.items() if figures}
    for name, figures in wrong.items():
        echo_text(f"{name}: {len(figures)} differ: {', '.join(figures)}")
    layouts = sum(len(run.grid.episodes) for run in done.suite.runs.values())
    of = f"{done.compared} figures of {layouts} layouts in {len(done.suite.runs)} families"
    typer.echo(f"{'not ' * bool(wrong)}equal to {DIGITS} digits: {of}")


def seeds(
    commit: Annotated[str, typer.Argument(help="Id of a commit, 40 hex digits.")],
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[SCENARIO]...", help="Scenarios. Default: those of the edition."),
    ] = None,
    edition: Annotated[str, typer.Option(help="Edition whose scenarios are sealed.")] = EDITION,
    as_json: options.Json = False,
) -> None:
    """Print how to build sealed layouts.

    Their seeds follow from a commit. Nobody knew its id before it was made, so nobody,
    the makers included, had looked at these layouts.
    """
    from harness.dataset import load
    from harness.extensions.benchmark import edition as editions
    from harness.extensions.benchmark.sealed import sealed
    from harness.world import scenarios

    if names:
        typed = [scenarios.get(options.typed_scenario(name)) for name in names]
    else:
        datasets = editions.named(edition).datasets
        typed = [load.load(load.find(name), 1).scenario for name in datasets]
    lines: list[dict[str, Any]] = []
    for scenario in typed:
        first_seed = sealed(commit, scenario.name.partition(":")[0])
        lines.append({"scenario": scenarios.argument(scenario), "first_seed": first_seed})
    if as_json:
        echo_json(lines)
        return
    for line in lines:
        typer.echo("harness dataset build \\")
        typer.echo(f"  {printable(line['scenario'])} \\")
        typer.echo(f"  --seed {line['first_seed']} --episodes 100 --out FOLDER")


def board(
    files: Files,
    out: Annotated[Path, typer.Option(help="Page to write.")] = Path("board.html"),
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Rank files of results on a page, each computed again.

    Entries share a rank where the layouts do not tell them apart. The page works offline.
    Exit code 1 means that a file was left out, and 2 that all were.
    """
    from harness.extensions.benchmark import board as boards
    from harness.extensions.benchmark.rescore import Here
    from harness.report.page import refuse_other

    if realpath(out) in map(realpath, files):
        raise UserError(f"--out {printable(out)} is one of the files to rank; name another file")
    if out.is_dir():
        raise UserError(f"--out {printable(out)} is a folder; name a file in it")
    refuse_other("--out", out)
    here, entries, left_out = Here(), list["Rescored"](), list[str]()
    with ExitStack() as stack:
        for file in dict.fromkeys(files):
            try:
                entry = stack.enter_context(_rescored(file, here, as_json or quiet))
                if entry.golden:
                    raise UserError(f"{printable(file)} pins {entry.edition.name} and is no entry")
                entries.append(entry)
            except UserError as error:
                typer.echo(f"harness: left out: {error}", err=True)
                left_out.append(str(error))
        if not entries:
            raise typer.Exit(2)
        lines = boards.lines(entries)
        page = boards.write(lines, left_out, out)
        if as_json:
            echo_json([_line_json(line) for line in lines])
        elif not quiet:
            _show_board(lines)
            typer.echo(f"wrote {printable(page)}")
    if left_out:
        raise typer.Exit(1)


def _line_json(line: "Line") -> dict[str, Any]:
    """Return a line of a board as `--json` prints it."""
    return {
        "rank": line.rank,
        "agents": line.name,
        "gain": line.gain,
        "made_by": line.entry.contents.made_by,
        "success": line.success,
        "equal": not any(line.entry.differences.values()),
    }


def _show_board(lines: "Sequence[Line]") -> None:
    """Print the lines of a board as a table."""
    from harness.runs.metric_names import BASELINE

    by = next(iter(lines[0].success))
    rows = []
    for line in lines:
        scores = (line.success[by], line.gain)
        rank = "-" if line.rank is None else str(line.rank)
        cells = ("-" if score is None else interval_of(score) for score in scores)
        rows.append((printable(line.name, 40), rank, *cells))
    table(("entry", "rank", by, f"gain over {BASELINE}"), rows)
    typer.echo("success in % [95 % CI], balanced where dangers are known; means over families")
