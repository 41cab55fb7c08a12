"""`harness study paper` and `harness study closed-loop`: whole studies."""

from pathlib import Path

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.run import file_name
from harness.cli.show import finish
from harness.core.at_once import at_once_of
from harness.core.errors import UserError, in_range, printable
from harness.core.seeds import FIRST
from harness.runs.settings import HELP, parse_seeds

MOST_EPISODES = 1_000_000


def paper(
    out: Path = typer.Option(Path("reports/paper"), help="Folder to write."),
    episodes: int = typer.Option(1500, help="Episodes per seed to compare the operating points."),
    sweep_episodes: int = typer.Option(
        300, help="Episodes per seed at each grid point of a sweep."
    ),
    seeds: str = typer.Option(
        "0:5", help="Seeds of the episodes and the channel: 0:5 means 0 to 4; 3,7,9 is a list."
    ),
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
    pictures: options.Pictures = False,
) -> None:
    """Compare the calibrated proxy with the paper's numbers.

    It plays the paper's study, and writes a page with both numbers.
    With --pictures, it writes Figures A and B as files, too.
    """
    from harness.extensions.paper.panels import panels, run_paper
    from harness.studies.study import refuse_other

    in_range("--episodes", episodes, 10, MOST_EPISODES)
    in_range("--sweep-episodes", sweep_episodes, 10, MOST_EPISODES)
    draws = parse_seeds(seeds)
    if len(set(draws)) < len(draws):
        raise UserError(f"--seeds {printable(seeds)}: give different whole numbers, such as 0:5")
    settings = panels(episodes, sweep_episodes)
    sizes = {panel.name: panel.episodes for panel in settings}
    refuse_other(out, "study", {"seeds": list(draws), "episodes_per_seed": sizes})
    with bar(
        "grid points", sum(len(panel.settings) for panel in settings), as_json or quiet
    ) as progress:
        study = run_paper(settings, draws, progress)
    finish(study, out, as_json, quiet, verbose, pictures)


def closed_loop(
    model: options.Model = "swarm-tiny",
    prompt: options.Prompt = "v2",
    answer: options.Answer = "json",
    scenario: str | None = typer.Option(None, help=HELP["scenario"]),
    episodes: int = typer.Option(
        300, help="Number of layouts; each is driven at every grid point with every seed."
    ),
    first_seed: int = typer.Option(
        FIRST["report"], help="Layout seed of the first layout; the others follow."
    ),
    seeds: options.Seeds = "0:5",
    workers: options.ModelWorkers = "2",
    batch_size: options.BatchSize = "8",
    latency: options.Latency = None,
    out: Path | None = typer.Option(
        None,
        help="Folder to write; a study that was stopped there continues. Default: "
        "reports/closed-loop-<model>-<prompt>.",
    ),
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
    pictures: options.Pictures = False,
) -> None:
    """Run the paper's panels with a model in closed loop.

    With --pictures, it writes Figures A and B as files, too.
    """
    from harness.backends import cards
    from harness.backends.cache import default_file
    from harness.evaluate import resolve
    from harness.evaluate.agent import Agent
    from harness.evaluate.spec import Spec
    from harness.extensions.paper.closed_loop import panels, run_closed_loop
    from harness.prompts import versions
    from harness.runs.settings import DriveSettings, Settings
    from harness.studies.study import refuse_taken

    named = scenario and options.typed_scenario(scenario)
    world = DriveSettings(episodes=episodes, first_seed=first_seed)
    source = resolve.driven(Settings(world=world), named)
    who = options.workers_of(workers)
    points = {s.point.name: s.point for panel in panels().values() for s in panel}
    spec = Spec(
        Agent(cards.resolve(model), versions.load(prompt), answer),
        source,
        tuple(points.values()),
        parse_seeds(seeds),
        settings=Settings(batch_size=at_once_of(batch_size), latency=latency),
    )
    where = out or Path("reports") / f"closed-loop-{file_name(spec.ego.card.name)}-{prompt}"
    refuse_taken(where, "closed-loop")
    with bar("layouts", episodes, as_json or quiet) as progress:
        study = run_closed_loop(spec, where, who, progress, default_file())
    finish(study, where, as_json, quiet, verbose, pictures)
