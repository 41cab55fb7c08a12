"""`harness prompt optimize`: search the wording of a prompt on tune seeds,
certify it on report seeds.
"""

import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import typer
from msgspec import structs, to_builtins

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.show import finish
from harness.cli.terminal import echo_json, echo_prompt_tokens
from harness.core import extras, resources, work
from harness.core.errors import UserError, in_range, printable
from harness.core.formats import WORK
from harness.core.seeds import FIRST, LAST_EPISODE
from harness.runs.formats import settings_as_file
from harness.runs.settings import OUTPUT, FrozenSettings, Settings
from harness.runs.stopping import STOPPING_RULES

if TYPE_CHECKING:
    from harness.evaluate.frozen_world import FrozenSource
    from harness.evaluate.spec import Spec
    from harness.extensions.learn.optimize.engines import Engine
    from harness.prompts.versions import Prompt
    from harness.world.scenario import Scenario

CONDITION = "single-local"
SAMPLE = 4  # layouts of a family that a dry run counts on
HELP = {
    "prompt": "Prompt version to start from. Default: the scenario's usual one.",
    "dataset": "Dataset of report layouts to certify on, or "
    "suite:NAME for several families at once.",
    "condition": "Operating point to search under, one. Default: single-local.",
}


@options.takes(FrozenSettings, help=HELP)
def command(
    settings: Settings,
    budget: int = typer.Option(..., help="Most questions that the search may ask on tune layouts."),
    out: str = typer.Option(..., help="Name of the version to make, in the project's prompts/."),
    layouts: int = typer.Option(24, help="Number of tune layouts of each scenario."),
    first_seed: int = typer.Option(
        FIRST["tune"], help="Layout seed of the first tune layout; tune seeds are 0 to 99999."
    ),
    tune: list[str] | None = typer.Option(
        None, help="Dataset of tune layouts to use instead, one for each of --dataset. Repeatable."
    ),
    reflect: str | None = typer.Option(
        None,
        help="Model that rewrites the system text by what went wrong (GEPA), such as a served one. "
        "Default: "
        "the search chooses among the alternatives that the prompt marks.",
    ),
    folder: Path | None = typer.Option(
        None, help="Folder to write the search to. Default: reports/NAME."
    ),
    workers: options.Workers = "2",
    no_cache: options.NoCache = False,
    dry_run: bool = typer.Option(
        False,
        "--dry-run",
        help="Only count requests and tokens; ask no model, and write nothing.",
        rich_help_panel=OUTPUT,
    ),
    tokenizer: options.Tokenizer = None,
    as_json: options.Json = False,
    quiet: options.QuietOutput = False,
    verbose: options.Verbose = False,
) -> None:
    """Search the wording of a prompt, and certify the winner.

    It searches on tune seeds, and asks once on report seeds whether the winner is better than what
    it came from. If the search is stopped, the same command continues it.
    """
    from harness.backends.cache import default_file
    from harness.backends.registry import open_backend
    from harness.dataset import load, suites
    from harness.dataset.verify import read_manifest, scenario_of
    from harness.evaluate import resolve
    from harness.extensions.learn.optimize import engines
    from harness.extensions.learn.optimize.layouts import built, counted, given, only_for
    from harness.extensions.learn.optimize.search import Search, choices, search
    from harness.prompts import versions as prompts

    extras.need("harness prompt optimize", *(() if tune else ("highway_env",)))
    extras.need("--reflect", *(("gepa",) if reflect else ()))
    settings = structs.replace(settings, condition=settings.condition or (CONDITION,))
    names = suites.datasets(settings.world.dataset)  # type: ignore[union-attr]
    manifests = [read_manifest(load.find(name)) for name in names]  # their layouts stay unread
    scenarios = [scenario_of(manifest) for manifest, _ in manifests]
    for name, (manifest, _) in zip(names, manifests, strict=True):
        only_for("report", "--dataset", name, manifest.seed, manifest.episodes)
    base = _base(settings, scenarios, budget, out)
    settings = structs.replace(settings, prompt=base.version)
    # What may stop a run is for those that certify: the search says how many tune layouts it asks.
    others = STOPPING_RULES.without(settings.extensions)
    tune_settings = structs.replace(settings, extensions=others)
    sizes = {} if reflect else choices(base)
    given_layouts = given(tune, [manifest for manifest, _ in manifests]) if tune else []
    in_range("--layouts", layouts, 2, FIRST["train"])
    if (limit := settings.world.limit) is not None:  # type: ignore[union-attr]
        in_range("--limit", limit, 1, LAST_EPISODE + 1)
    only_for("tune", "--first-seed", str(first_seed), first_seed, layouts)
    silent, who = as_json or quiet, options.workers_of(workers)
    engine_name = f"GEPA with {reflect}" if reflect else "alternatives"
    if dry_run:
        with (
            TemporaryDirectory() as place,
            bar("freezing a few tune layouts", quiet=silent) as progress,
        ):
            few = given_layouts or built(
                scenarios, Path(place), min(SAMPLE, layouts), first_seed, who, progress
            )
            specs = [resolve.spec(tune_settings, source) for source in few]
            episodes = [
                min(manifest.episodes, settings.world.limit or manifest.episodes)  # type: ignore[union-attr]
                for manifest, _ in manifests
            ]
            asks = counted(
                specs, sizes, budget, 0 if given_layouts else layouts, episodes, tokenizer
            )
        if as_json:
            echo_json(asks)
        elif not quiet:
            _show_counted(asks, engine_name)
        return
    where = folder or Path("reports", out)
    _check_name(out, (where / WORK).is_dir())
    begins = work.WorkStart(
        settings={
            "version": out,
            "budget": budget,
            "engine": engine_name,
            "prompt_sha256": base.sha256,
            "tune": [source.dataset.sha256 for source in given_layouts] or [layouts, first_seed],
            "report": [sha256 for _, sha256 in manifests],
            "evaluation": settings_as_file(to_builtins(settings)),
        }
    )
    if start := work.start_of(where, work.WorkStart):
        work.same(where, begins.settings, start.settings)
    cache, label = None if no_cache else default_file(), f"asking {printable(settings.model, 30)}"
    with (
        work.working(where, start or begins) as place,
        bar(label, quiet=silent, grows=True) as progress,
    ):
        sources = given_layouts or built(scenarios, place, layouts, first_seed, who, progress)
        specs = [resolve.spec(tune_settings, source) for source in sources]
        plan = Search(
            base,
            specs,
            partial(_report, settings, names, sources),
            budget,
            out,
            Path("prompts"),
            engine_name,
            shlex.join(["harness", *sys.argv[1:]]),
        )
        engine = (
            _reflecting(reflect, specs[0], place, begins.settings)
            if reflect
            else engines.alternatives
        )
        study = search(plan, engine, where, place, open_backend, progress, cache)
    finish(study, where, as_json, quiet, verbose)
    if not silent and Path("prompts", out).is_dir():
        typer.echo(f"wrote prompts/{printable(out)}, sha256 {prompts.load(out).sha256}; a draft")
    work.tidy(where)


def _report(
    settings: Settings, names: Sequence[str], tune: "Sequence[FrozenSource]"
) -> "list[Spec]":
    """Return what certifies. Raises UserError if it has a layout that was tuned on,
    under other seeds.
    """
    from harness.dataset import rebuilt
    from harness.evaluate import resolve

    sources = [resolve.frozen(settings, name) for name in names]
    for tuned, source in zip(tune, sources, strict=True):
        rebuilt.refuse_reported(tuned.dataset, [source.dataset])
    return [resolve.spec(settings, source) for source in sources]


def _base(
    settings: Settings, scenarios: "Sequence[Scenario]", budget: int, version: str
) -> "Prompt":
    """Return the version to start from.
    Raises UserError for what can be told to be wrong before any work.
    """
    from harness.coordination.parts_of_packages import obstacle
    from harness.evaluate import resolve
    from harness.evaluate.facts import Facts
    from harness.prompts.versions import unfit
    from harness.runs.records import MEASURED

    if budget < 1:
        raise UserError(
            f"--budget {budget}: give the most questions that the search may ask, 1 or more"
        )
    if len(points := resolve.points(settings.condition, settings.extensions)) != 1:
        names = " ".join(point.name for point in points)
        raise UserError(f"--condition {printable(names)}: a prompt is searched under one; give one")
    if settings.latency == MEASURED:
        raise UserError(f"--latency {MEASURED}: a search keeps the machine busy; give seconds")
    ego, _ = resolve.agents(settings, scenarios[0])
    if not ego.can.language_model:
        raise UserError(
            f"--model {printable(ego.card.name)}: it reads the scene and no prompt, so that no "
            "wording changes what it does; give a language model (`harness model list`)"
        )
    for scenario in scenarios:
        if reason := unfit(ego.prompt, scenario):
            raise UserError(f"--prompt {ego.prompt.version} {reason}; give one for every scenario")
    [point] = points
    winner = replace(ego, prompt=replace(ego.prompt, version=version))
    for part, scenario in product(point.more, scenarios):
        if reason := obstacle(part, point, Facts((winner,), scenario, frozen=True)):
            raise UserError(f"--condition {printable(point.name)}: {reason}")
    return ego.prompt


def _check_name(name: str, goes_on: bool) -> None:
    from harness.prompts import versions as prompts

    if not Path(resources.MARKER).is_file():
        raise UserError(f"--out {printable(name)}: no project is here, `harness init` makes one")
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,60}", name):
        raise UserError(
            f"--out {printable(name)} cannot name a prompt; give letters, digits, '.', '_' or '-', "
            "a letter or digit first"
        )
    if not goes_on and (name in prompts.names() or Path("prompts", name).exists()):
        raise UserError(f"--out {name}: a prompt of that name is there already; give a new name")


def _reflecting(model: str, first: "Spec", place: Path, settings: Mapping[str, Any]) -> "Engine":
    from harness.backends.cards import resolve
    from harness.backends.registry import open_backend
    from harness.extensions.learn.optimize.engines import Reflecting, asked_of
    from harness.prompts.versions import ROLES

    backend = open_backend(resolve(model), **{**first.opening, "batch_size": 1})
    roles = ROLES if first.points[0].asks and not first.ego_alone else ROLES[:1]
    return Reflecting(asked_of(backend), place / "reflections.jsonl", settings, roles)


def _show_counted(counted: dict[str, Any], engine: str) -> None:
    if counted["choices"]:
        marks = ", ".join(f"{name} ({n})" for name, n in counted["choices"].items())
        typer.echo(
            f"{marks}: {counted['wordings']} wordings, {counted['wordings_in_a_round']} of them in "
            "a round of the search"
        )
    typer.echo(
        f"search ({printable(engine)}): at most {counted['budget']} questions; a wording takes up "
        f"to {counted['questions_a_wording']} on the tune layouts"
    )
    typer.echo(
        f"certificate: up to {counted['certificate_questions']} questions on report layouts, both "
        "prompts"
    )
    for each in counted["prompt_tokens"]:
        echo_prompt_tokens(each)
    typer.echo("no model was called, and no report layout was read")
