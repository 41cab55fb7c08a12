"""`harness dataset`: build frozen scenes, verify them, look at one,
compare them with closed loop.
"""

import time
from collections.abc import Mapping
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.scenario import ready_to_drive
from harness.cli.terminal import console, echo_json, table
from harness.core.errors import UserError, printable
from harness.core.figures import dataset_size, interval_of

if TYPE_CHECKING:
    from harness.core.statistics import Estimate
    from harness.world.scenario import Scenario


MOST_PROBLEMS = 50  # lines of a check that are printed
Dataset = Annotated[
    str, typer.Argument(help="Folder of a dataset, or the name of a shipped one.", metavar="DIR")
]


@options.of_families
def build(
    of_family: Mapping[str, str],
    name: str | None = typer.Argument(
        None,
        help="Scenario to freeze; `harness dataset scenario list` shows them.",
        show_default=False,
    ),
    episodes: int = typer.Option(200, help="Number of episodes, each on a layout of its own."),
    seed: options.FirstSeed = 0,
    workers: options.Workers = "2",
    lag: float | None = typer.Option(
        None,
        help="Seconds from the start of a decision to its action. Default: the scenario's, usually "
        "0.145.",
    ),
    audit: bool = typer.Option(
        True, help="With 100 layouts or more, audit whether the ego's view gives the danger away."
    ),
    out: Path = typer.Option(..., help="Folder to make; its name becomes the dataset's name."),
    shard: options.Shard = None,
    unreachable: options.Unreachable = False,
) -> None:
    """Build a frozen dataset of some layouts of a scenario.

    It drives every sequence of actions on each layout, and keeps every scene on the way.

    If the build is stopped, the same command continues it.
    """
    from harness.world.families import family_of

    name = options.scenario_name(name, of_family)
    family = family_of(name)
    note = family.allow(name) if family else None
    scenario, who = ready_to_drive(name, episodes, seed), options.workers_of(workers)
    if lag is not None:
        period_s = scenario.parameters.decision_period_s
        if not 0 <= lag < period_s:
            raise UserError(
                f"--lag {lag}: give seconds from 0 to below {period_s:g}, the decision period"
            )
        scenario = replace(scenario, parameters=replace(scenario.parameters, decision_lag_s=lag))
    from harness.dataset.build import build as build_dataset
    from harness.world import scenarios

    begun_s, part = time.monotonic(), options.shard_of(shard)
    mine = len(part.part(range(episodes))) if part else episodes
    with bar(f"freezing {printable(name, 30)}", mine) as progress:
        manifest = build_dataset(
            scenario, out, episodes, seed, who, progress, audit, progress.more, part, unreachable
        )
    if part:
        options.say_shard(part, out, f"{mine} of {episodes} layouts")
        return
    typer.echo(
        f"wrote {printable(out)} of {printable(scenarios.title(scenario))}: "
        f"{dataset_size(manifest['episodes'], manifest['nodes'])}, "
        f"in {time.monotonic() - begun_s:.0f} s"
    )
    if note:
        typer.echo(note)


def check(dataset: Dataset, as_json: options.Json = False) -> None:
    """Check every file and every decision point of a dataset. Exit code 1 if something is wrong.

    Where highway-env is installed, first scenes and three whole layouts are built again from their
    seeds.
    """
    from harness.dataset import load, rebuilt, verify

    path = load.find(dataset)
    with bar(f"checking {printable(path.name, 30)}", quiet=as_json):
        problems = verify.check(path) or list(rebuilt.differences(load.load(path)))
    manifest, digest = verify.read_manifest(path)
    lost = 0 if problems else load.load(path).lost
    built_again = find_spec("highway_env") is not None
    if as_json:
        result = {
            "name": manifest.name,
            "episodes": manifest.episodes,
            "nodes": manifest.nodes,
            "sha256": digest,
            "problems": problems,
            "lost_before_first_action": lost,
            "built_again": built_again,
        }
        echo_json(result)
    elif problems:
        typer.echo("\n".join(problems[:MOST_PROBLEMS]))
        if len(problems) > MOST_PROBLEMS:
            typer.echo(f"({len(problems) - MOST_PROBLEMS} more problems: --json)")
    else:
        typer.echo(
            f"{printable(dataset)} is sound: {dataset_size(manifest.episodes, manifest.nodes)}\n"
            f"manifest sha256 {digest}"
        )
        if not built_again:
            typer.echo(
                "no layout was built again from its seed, since highway-env is not installed"
            )
        if lost:
            console().print(
                f"{lost} of {manifest.episodes} episodes are lost before the ego's first action: "
                "it begins in a collision, or cannot escape one; mend the environment, or choose "
                "other seeds"
            )
    if problems:
        raise typer.Exit(1)


def show(
    dataset: Dataset,
    scene: str = typer.Argument(help="Scene id, such as 00003-0."),
    out: Path = typer.Option(..., help="Picture to write: .svg or .png; with --camera .png."),
    viewer: str | None = typer.Option(
        None, help="Vehicle whose view to draw, such as v2. Default: the ego."
    ),
    camera: bool = typer.Option(
        False, "--camera", help="Draw what its cameras see, front above rear."
    ),
) -> None:
    """Draw a scene from above, or as a vehicle's cameras see it."""
    from io import BytesIO

    from harness.core.files import write_whole
    from harness.dataset import load

    kinds = (".png",) if camera else (".svg", ".png")
    if out.suffix not in kinds:
        raise UserError(
            f"--out {printable(out)} is no picture that can be written; end it in "
            f"{' or '.join(kinds)}"
        )
    data = load.load(load.find(dataset))
    drawn = data.scene(scene)
    viewer = drawn.viewer(viewer)
    picture = BytesIO()
    if camera:
        from harness.world.perception.camera import frame

        picture.write(frame(drawn.seat or data.scenario, drawn.state, viewer).png())
    else:
        from harness.report.drawing.scene import draw

        draw(drawn, picture, "png" if out.suffix == ".png" else "svg", viewer)
    try:
        write_whole(out, picture.getvalue())
    except OSError as error:
        raise UserError(
            f"--out {printable(out)} cannot be written ({error.strerror}); give another path"
        ) from None
    typer.echo(f"wrote {printable(out)}")


def export(
    dataset: Annotated[
        str,
        typer.Argument(
            help="Name of a shipped dataset, a dataset's folder, or suite:NAME.", metavar="DATASET"
        ),
    ],
    out: Path = typer.Option(..., help="Folder to make."),
    prompt: options.ScenarioPrompt = None,
) -> None:
    """Write a dataset as Parquet that other programs load.

    A card and a Croissant file describe it. A row is a decision point, with what the ego is asked
    and how safe each action is. Each dataset of a suite is a table.
    """
    from harness.dataset import load, suites
    from harness.dataset.publish import Chat, publish
    from harness.evaluate.chats import Asking

    def ask(scenario: "Scenario") -> "tuple[str, Chat]":
        asking = Asking.of(scenario, prompt, "json")
        return asking.prompt.version, asking.chat

    suite = suites.named(dataset)
    folders = [load.find(name) for name in suites.datasets(dataset)]
    try:
        with bar(f"exporting {printable(dataset, 30)}") as progress:
            tables = publish(folders, out, ask, progress, suite.name if suite else None)
    except OSError as error:
        raise UserError(
            f"--out {printable(out)} cannot be written ({error.strerror}); give another folder"
        ) from None
    rows, size = sum(each.rows for each in tables), sum(each.bytes for each in tables)
    typer.echo(f"wrote {printable(out)}: {rows} decision points, {size / 1e6:.1f} MB of Parquet")


def rank_drivers(
    dataset: Dataset, workers: options.Workers = "2", as_json: options.Json = False
) -> None:
    """Compare the reference drivers, frozen and in closed loop.

    Both are on the same episodes.
    """
    from harness.dataset import load

    who = options.workers_of(workers)
    data = load.load(load.find(dataset))
    from harness.studies.both_worlds import rank

    episodes = data.manifest.episodes
    with bar(f"driving {printable(data.name, 30)}", episodes) as progress:
        standings = rank(data, who, progress)
    if as_json:
        drivers = {driver: _as_mapping(standing) for driver, standing in standings.items()}
        echo_json({"dataset": data.name, "episodes": episodes, "drivers": drivers})
    else:
        _table(episodes, standings)


def _as_mapping(standing: dict[str, "Estimate"]) -> dict[str, "Estimate"]:
    points = {end: 100 * getattr(standing["difference"], end) for end in ("value", "low", "high")}
    return {
        "frozen": standing["frozen"],
        "live": standing["closed"],
        "difference_points": replace(standing["difference"], **points),
        "agreement": standing["agreement"],
    }


def _table(episodes: int, standings: dict[str, dict[str, "Estimate"]]) -> None:
    heads = ("driver", "frozen % [95 % CI]", "closed loop % [95 % CI]", "difference, pts", "same %")
    rows = []
    for driver, standing in standings.items():
        estimates = (standing["frozen"], standing["closed"], standing["difference"])
        same = f"{100 * standing['agreement'].value:.0f}"
        rows.append((driver, *(interval_of(estimate) for estimate in estimates), same))
    table(heads, rows)
    text = console()
    text.print(
        f"n = {episodes} episodes; same: share of them that end alike, frozen and in closed loop"
    )
    text.print(
        "these few drivers give no rank correlation: compare runs of models with `harness study "
        "fidelity`"
    )
