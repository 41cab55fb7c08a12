"""`harness study grid`: every combination of ego and helper agents."""

from collections.abc import Collection
from itertools import product
from pathlib import Path
from typing import Any

import typer

from harness.backends.base import BARE
from harness.cli import options
from harness.cli.progress import bar
from harness.cli.run import file_name, first_folder
from harness.cli.show import finish
from harness.core.errors import UserError, printable
from harness.extensions.mixed_helpers import EXTENSION
from harness.runs.settings import FrozenSettings, Settings, changed

MOST_CELLS = 256
HELP = {
    "model": "Models of the ego, separated by commas.",
    "prompt": "Prompt versions of the ego, such as v2,v3. Default: the scenario's usual one.",
    "answer": "Answer modes of the ego, separated by commas: json, constrained, readout, decision.",
    "dataset": "Name of a shipped dataset, or a dataset's folder.",
    "helper_model": "Models of the helpers. Default: the ego's models.",
    "helper_prompt": "Prompt versions of the helpers. Default: the ego's versions.",
    "helper_answer": "Answer modes of the helpers. Default: the ego's modes.",
}


@options.takes(FrozenSettings, HELP, without=("ask",))
def command(
    settings: Settings,
    out: Path | None = typer.Option(
        None, help="Folder to write. Default: reports/grid-<models>-<dataset>."
    ),
    no_cache: options.NoCache = False,
    as_json: options.Json = False,
    quiet: options.QuietOutput = False,
    verbose: options.Verbose = False,
    pictures: options.Pictures = False,
) -> None:
    """Evaluate every combination of ego and helper agents.

    An agent is a model with a prompt version and an answer mode. Each agent is asked once in each
    role, however many combinations it is in. If the grid is stopped, the same command continues it.
    """
    from harness.backends.cache import default_file
    from harness.evaluate import resolve
    from harness.extensions.mixed_helpers.agents import named
    from harness.extensions.mixed_helpers.grid.study import grid_study, run_cells
    from harness.studies.study import refuse_taken

    world: Any = settings.world
    source = resolve.frozen(settings, world.dataset)
    frozen = source.dataset
    options.say_all(world.limit, [frozen])
    # Combinations share answers: whom one does not ask, another does.
    settings = changed(
        settings, {"prompt": settings.prompt or frozen.scenario.prompt, "ask": "all"}
    )
    of_helpers = _of_helpers(settings)
    modes = {*_names("--answer", settings.answer), *_names("--helper-answer", of_helpers.answer)}
    by_ego = _combinations(settings, "--", modes)
    egos = [resolve.agents(each, frozen.scenario)[0] for each in by_ego]
    answer = settings.extensions.get("helper_answer")
    with named({"--answer": answer, "--thinking": of_helpers.thinking}):
        helpers = [
            resolve.agents(each, frozen.scenario)[0]
            for each in _combinations(of_helpers, "--helper-", modes)
        ]
    if not 1 < (cells := len(egos) * len(helpers)) <= MOST_CELLS:
        raise UserError(f"{cells} combinations: give 2 to {MOST_CELLS}, such as --model a,b")
    spec = resolve.spec(by_ego[0], source)
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
        grid = run_cells(spec, egos, helpers, folder, progress, cache)
    finish(grid_study(grid, spec, folder), folder, as_json, quiet, verbose, pictures)


def _of_helpers(settings: Settings) -> Settings:
    """Return settings whose model, prompt and modes are those of the helpers."""
    given: dict[str, Any] = {}
    for name in EXTENSION.settings:
        value = settings.extensions.get(name)
        if value is not None:
            given[name.removeprefix("helper_")] = value
    engine = {"engine": None} if given.get("model") else {}
    return changed(settings, {**given, **engine})


def _combinations(settings: Settings, flag: str, modes: Collection[str]) -> list[Settings]:
    """Return the settings of each model with each prompt and answer mode.

    A setting that concerns one answer mode is left out with others,
    if one of the grid's `modes` uses it.
    """
    lists = [
        _names(f"{flag}{name}", getattr(settings, name)) for name in ("model", "prompt", "answer")
    ]
    combinations = []
    for model, prompt, answer in product(*lists):
        given = {
            **dict.fromkeys(EXTENSION.settings),
            "model": model,
            "prompt": prompt,
            "answer": answer,
        }
        if any(mode in modes for mode in BARE) and answer not in BARE:
            given |= {"letters": None, "flip": False}
        if "json" in modes and answer != "json":
            given |= {"sums": "refuse"}
        combinations.append(changed(settings, given))
    return combinations


def _names(option: str, text: str) -> list[str]:
    names = [name.strip() for name in text.split(",")]
    if "" in names or len(set(names)) < len(names):
        raise UserError(f"{option} {printable(text)}: give different names, such as a,b")
    return names
