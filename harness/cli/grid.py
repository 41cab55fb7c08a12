"""`harness study grid`: every combination of ego and helper agents."""

from collections.abc import Mapping
from itertools import product
from pathlib import Path

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.run import file_name, first_folder
from harness.cli.show import finish
from harness.core import extras, resources
from harness.core.errors import UserError, printable
from harness.evaluate.settings import parse_seeds

MOST_CELLS = 256


def command(
    model: str = typer.Option("proxy", help="Models of the ego, separated by commas."),
    prompt: str | None = typer.Option(
        None, help="Prompt versions of the ego, such as v2,v3. Default: the scenario's usual one."
    ),
    answer: str = typer.Option(
        "json", help="Answer modes of the ego, separated by commas: json, constrained, readout."
    ),
    helper_model: str | None = typer.Option(None, help="Models of the helpers. Default: the ego's models."),
    helper_prompt: str | None = typer.Option(
        None, help="Prompt versions of the helpers. Default: the ego's versions."
    ),
    helper_answer: str | None = typer.Option(
        None, help="Answer modes of the helpers. Default: the ego's modes."
    ),
    letters: options.Letters = None,
    dataset: options.Dataset = resources.DATASET,
    condition: options.Conditions = None,
    control: options.Controls = None,
    attack: options.Attacks = None,
    seeds: options.Seeds = "0:5",
    limit: int | None = typer.Option(None, help="Use only this many episodes, from the first. Default: all."),
    batch_size: options.BatchSize = 8,
    device: options.Device = None,
    dtype: options.Dtype = None,
    latency: options.Latency = None,
    out: Path | None = typer.Option(None, help="Folder to write. Default: reports/grid-<models>-<dataset>."),
    no_cache: options.NoCache = False,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Evaluate every combination of ego and helper agents.

    An agent is a model with a prompt version and an answer mode. Each agent is asked once in each role,
    however many combinations it is in. If the grid is stopped, the same command continues it.
    """
    from harness.backends import cards
    from harness.backends.cache import default_file
    from harness.coordination.operating_point import POINTS
    from harness.evaluate import resolve
    from harness.evaluate.agent import Agent
    from harness.evaluate.settings import FrozenSettings
    from harness.evaluate.spec import Spec
    from harness.prompts import versions

    extras.need("harness study grid", "matplotlib")
    source = resolve.frozen(FrozenSettings(limit=limit), dataset)
    frozen = source.dataset
    options.say_all(limit, [frozen])
    prompt = prompt or frozen.scenario.prompt

    def agents(choices: Mapping[str, str]) -> list[Agent]:
        each = product(*(_several(option, text) for option, text in choices.items()))
        # Agent checks the mode.
        return [
            Agent(cards.resolve(m), versions.load(p), a, letters=letters if a == "readout" else None)  # type: ignore[arg-type]
            for m, p, a in each
        ]

    egos = agents({"--model": model, "--prompt": prompt, "--answer": answer})
    with resolve.helper_options({"--answer": helper_answer}):
        helpers = agents({
            "--helper-model": helper_model or model, "--helper-prompt": helper_prompt or prompt,
            "--helper-answer": helper_answer or answer,
        })  # fmt: skip
    if letters and not any(agent.answer == "readout" for agent in (*egos, *helpers)):
        raise UserError(f"--letters {printable(letters)}: no agent reads out; add --answer readout")
    if not 1 < (cells := len(egos) * len(helpers)) <= MOST_CELLS:
        raise UserError(f"{cells} combinations: give 2 to {MOST_CELLS}, such as --model a,b")
    spec = Spec(
        ego=egos[0],
        source=source,
        points=resolve.points(condition or tuple(POINTS), control or (), attack or ()),
        seeds=parse_seeds(seeds),
        batch_size=batch_size,
        device=device,
        dtype=dtype,
        latency=latency,
        ask="all",  # combinations share answers: whom one does not ask, another does
    )
    from harness.studies.grid import run_cells
    from harness.studies.grid_study import grid_study
    from harness.studies.study import refuse_taken

    names = "-".join(dict.fromkeys(file_name(agent.card.name) for agent in (*egos, *helpers)))
    folder = out or first_folder(
        f"grid-{names}-{frozen.name}", lambda folder: not (folder / "grid.json").exists()
    )
    refuse_taken(folder, "grid")
    if (folder / "grid.json").exists():
        raise UserError(
            f"--out {printable(folder)} already holds a finished grid; choose another or delete it"
        )
    with bar(f"{cells} combinations", quiet=as_json or quiet, grows=True) as progress:
        cache = None if no_cache else default_file()
        grid = run_cells(spec, egos, helpers, folder, progress, progress.more, cache)
    finish(grid_study(grid, spec, folder), folder, as_json, quiet)


def _several(option: str, text: str) -> list[str]:
    names = [name.strip() for name in text.split(",")]
    if "" in names or len(set(names)) < len(names):
        raise UserError(f"{option} {printable(text)}: give different names, such as a,b")
    return names
