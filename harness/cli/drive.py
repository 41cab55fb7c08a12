"""`harness drive`: a model with a prompt drives in the simulator."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast, runtime_checkable

import typer

from harness.cli import brief, options
from harness.cli.next_command import after_run
from harness.cli.progress import bar
from harness.cli.run import Column, as_mapping, default_out, evaluate, show
from harness.cli.terminal import echo_json
from harness.core.errors import UserError, in_range, printable
from harness.core.figures import crossed
from harness.core.formats import WORK
from harness.core.plugins import Plugins
from harness.core.seeds import seeds_text
from harness.runs.settings import OUTPUT, DriveSettings, Settings, changed

if TYPE_CHECKING:
    from harness.evaluate.lifecycle import Evaluated
    from harness.runs.folder import Run
    from harness.runs.records import ClosedLoop

ALL = "all"
SHARE = "agent_share"
LATE = Column("late", "late_rate")
TIME_OUT = Column("time-out", "time_out_rate")  # where several decide, since nobody is late there
COLUMNS = (
    Column("success % [95 % CI]", "success_rate", interval=True),
    Column("crash", "collision_rate"),
    LATE,
    Column("latency", "latency_proxy_ms"),
    Column("missed", "deadline_miss_rate"),
    Column("gap", "least_gap_m"),
    Column("clear", "time_to_clear_s"),
)


@runtime_checkable
class Videos(Protocol):
    """Describe what an extension offers to draw videos of a closed-loop run's episodes."""

    def ready(self) -> None:
        """Raise UserError if a package that drawing needs is not installed."""
        ...

    def write(self, run: Path, most: int, quiet: bool) -> list[Path]:
        """Draw up to `most` episodes that failed under the run's last condition; return the files.

        A condition is an operating point by its name. `run` is the folder of a closed-loop run;
        `quiet` shows no progress.
        """
        ...


VIDEOS = Plugins[Videos]("swarmdrive.videos", Videos, {})  # those that extensions add


@options.takes(DriveSettings)
@options.of_families
@options.of_extensions(followed=True)
def command(
    settings: Settings,
    of_family: Mapping[str, str],
    of_command: Mapping[str, Any],
    agents: options.Agents = None,
    workers: options.ModelWorkers = "2",
    out: Path | None = typer.Option(
        None, help="Folder to write the run to. Default: reports/<model>-<prompt>-drive."
    ),
    shard: options.Shard = None,
    save_video: int = typer.Option(
        0,
        help="Number of failed episodes of the last condition to draw as videos.",
        rich_help_panel=OUTPUT,
    ),
    no_cache: options.NoCache = False,
    full: options.OldFullPage = False,
    as_json: options.Json = False,
    quiet: options.QuietOutput = False,
    verbose: options.Verbose = False,
) -> None:
    """Drive episodes in closed loop, in highway-env.

    If the run is stopped, the same command continues it.
    """
    from harness.backends.cache import default_file
    from harness.evaluate import command_options, resolve
    from harness.evaluate.costs import Spending
    from harness.evaluate.run import evaluate_shard
    from harness.runs.folder import read
    from harness.world.scenarios import DEFAULT

    world: Any = settings.world
    if ALL in settings.condition:
        if len(settings.condition) > 1:
            raise UserError(
                f"--condition {ALL} stands for every operating point; leave the others out"
            )
        settings = changed(settings, {"condition": ()})
    name = options.scenario_name(
        world.scenario if world.scenario or of_family else DEFAULT, of_family
    )
    name = name if agents is None else deciding(name, agents)
    who, part = options.workers_of(workers), options.shard_of(shard)
    if part and (out is None or save_video):
        raise UserError(
            f"--shard {part}: give --out with a folder for this shard alone, and leave "
            "--save-video out"
        )
    if save_video:
        for drawer in VIDEOS:
            VIDEOS.ask(drawer, lambda videos: videos.ready())
    source = resolve.driven(settings, name)
    driven = len(source.numbers)
    in_range("--save-video", save_video, 0, driven)
    if save_video and not VIDEOS:
        raise UserError("--save-video: no extension that is installed draws videos; leave it out")
    spec = resolve.spec(settings, source)
    silent = as_json or quiet
    follows = command_options.follows(of_command, "shards" if part else "")
    with command_options.guarded(of_command, [spec], who) as [spec]:
        if part and out:
            with bar(f"driving {printable(spec.ego.card.name, 30)}", quiet=silent) as progress:
                progress.spent = Spending(spec.record(), out / WORK)
                mine = evaluate_shard(spec, out, part, progress, who)
            if not silent:
                options.say_shard(part, out, f"{mine} of {driven} episodes")
            return
        where = out or default_out(spec)
        videos: list[Path] = []

        def draw() -> None:
            for drawer in VIDEOS if save_video else ():
                videos.extend(
                    VIDEOS.ask(drawer, lambda drawer: drawer.write(where, save_video, silent))
                )

        done, page = evaluate(
            spec,
            where,
            cache=None if no_cache else default_file(),
            quiet=silent,
            workers=who,
            full=full,
            then=draw,
            follows=follows,
        )
    run = read(where)
    tell(done, run, as_json, quiet, verbose)
    if silent:
        return
    if videos:
        typer.echo(
            f"wrote {printable(where / 'videos')}: {', '.join(video.name for video in videos)}"
        )
    elif save_video:
        typer.echo(f"no episode failed under {printable(spec.points[-1].name)}: no video")
    typer.echo(f"wrote {printable(page)}")
    after_run(run)


def deciding(scenario: str, agents: str) -> str:
    """Return a scenario's name with a setting of which of its vehicles decide for themselves.

    `scenario` is its name without, and `agents` is `ego`, `all` or a share of the other vehicles,
    such as 0.5. Raises UserError for any other text, or a scenario in which only the ego has a
    goal.
    """
    from harness.world import scenarios

    share = {"ego": "0", ALL: "1"}.get(agents, agents)
    if not re.fullmatch(r"[01]|0?\.\d+|[01]\.0*", share):
        raise UserError(
            f"--agents is {printable(agents)!r}; give ego, all, or a share from 0 to 1, written as "
            "0.5"
        )
    if SHARE in scenario:
        raise UserError(
            f"--agents {agents}: {printable(scenario)} states {SHARE} already; give one of them"
        )
    if share != "0" and SHARE not in scenarios.get(scenario).dials:
        able = [name for name in scenarios.names() if SHARE in scenarios.get(name).dials]
        raise UserError(
            f"--agents {agents}: in {printable(scenario)} only the ego has a goal; use "
            f"{', '.join(able)}"
        )
    if share == "0":
        return scenario
    return f"{scenario}{',' if ':' in scenario else ':'}{SHARE}={share}"


def tell(done: "Evaluated", run: "Run", as_json: bool, quiet: bool, verbose: bool = False) -> None:
    """Print a driven run's results in few lines, or as JSON if `as_json`; nothing if `quiet`.

    `done` is the run, as it was just evaluated in the simulator, and `run` as it was read again;
    `verbose` prints all tables.
    """
    if as_json:
        echo_json(as_mapping(run))
    if as_json or quiet:
        return
    world = cast("ClosedLoop", done.manifest.world)
    drawn_from = world.selection.get("of")
    n = (
        f"{crossed(world.episodes, len(done.manifest.seeds))}; {'of ' if drawn_from else ''}"
        f"{seeds_text(world.first_seed, drawn_from or world.episodes)}"
    )
    scenes = f"closed loop · {world.title}"
    if not verbose:
        brief.show(run, scenes, n)
        return
    notes = (
        f"n = {n};\n"
        "95 % intervals over episodes; missed: decisions longer than the decision window;\n"
        "gap: smallest distance to a vehicle; clear: time until the ego had cleared, if\n"
        "it did; both are means over episodes",
    )
    several = any(score.metric == "arrived_rate" for score in done.scores)
    columns = tuple(TIME_OUT if several and each == LATE else each for each in COLUMNS)
    show(done, run, scenes, columns, notes)
