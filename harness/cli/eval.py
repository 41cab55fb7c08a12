"""`harness eval`: a model with a prompt on a dataset."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import typer

from harness.cli import brief, options, suite
from harness.cli.next_command import after_run
from harness.cli.run import Column, as_mapping, default_out, evaluate, show, walked
from harness.cli.terminal import echo_cost, echo_json, echo_prompt_tokens
from harness.core.errors import UserError, printable
from harness.core.figures import amount, crossed
from harness.core.seeds import seeds_text
from harness.runs import headline
from harness.runs.settings import FrozenSettings, Settings

if TYPE_CHECKING:
    from harness.backends.answers_file import Question
    from harness.core.parallel import Workers
    from harness.dataset.load import Dataset
    from harness.evaluate.lifecycle import Evaluated
    from harness.evaluate.spec import Spec
    from harness.runs.folder import Run

SUCCESS = Column("success % [95 % CI]", headline.SUCCESS, interval=True)
GAINS = {  # by headline metric
    headline.SUCCESS: Column("gain, points", "success_gain_over_single-local", interval=True),
    headline.BALANCED: Column(
        "balanced gain, in points", "balanced_success_gain_over_single-local", interval=True
    ),
}
COLUMNS = (
    Column("latency", "latency_proxy_ms"),
    Column("trigger", "trigger_rate"),
    Column("msgs", "messages_per_episode"),
)


@options.takes(FrozenSettings)
@options.of_extensions(followed=True)
def command(
    settings: Settings,
    of_command: Mapping[str, Any],
    workers: options.RuleWorkers = None,
    out: Path | None = typer.Option(
        None, help="Folder to write the run to. Default: reports/<model>-<prompt>-<dataset>."
    ),
    no_cache: options.NoCache = False,
    dry_run: options.DryRun = False,
    tokenizer: options.Tokenizer = None,
    full: options.OldFullPage = False,
    as_json: options.Json = False,
    quiet: options.QuietOutput = False,
    verbose: options.Verbose = False,
) -> None:
    """Evaluate a model with a prompt on frozen scenes.

    If the run is stopped, the same command continues it.
    """
    from harness.backends.cache import default_file
    from harness.dataset import suites
    from harness.evaluate import command_options, resolve
    from harness.runs.folder import read

    world, silent = cast("Any", settings.world), as_json or quiet
    named_suite = suites.named(world.dataset)
    sources = [resolve.frozen(settings, name) for name in suites.datasets(world.dataset)]
    datasets = [source.dataset for source in sources]
    options.say_all(world.limit, datasets)
    specs = [resolve.spec(settings, source) for source in sources]
    if named_suite:
        suite.check(named_suite, specs)
    if named_suite and (rule := specs[0].stopping_rule):
        raise UserError(
            f"suite {named_suite.name}: runs that stop early have other layouts each; leave "
            f"{rule.options} out"
        )
    if dry_run:
        from harness.evaluate import questions
        from harness.evaluate.dry_run import count

        pairs = list(zip(specs, datasets, strict=True))
        by_id: dict[str, Question] = {}
        for pair in pairs if out else ():
            by_id |= questions.first(*pair)
        counts = [count(spec, dataset, tokenizer) for spec, dataset in pairs]
        if as_json:
            echo_json(counts if named_suite else counts[0])
        elif not quiet:
            for spec, counted in zip(specs, counts, strict=True):
                show_counted(spec, counted)
        if out:
            file = questions.write(by_id.values(), out)
            if not silent:
                typer.echo(f"wrote {amount(len(by_id), 'question')} to {printable(file)}")
        return
    follows = command_options.follows(of_command)
    at_servers = any(agent.card.server for spec in specs for agent in spec.agents)
    who = options.workers_of(workers or ("1" if at_servers else "2"))
    if workers is not None:
        _refuse_language_models(specs, who, workers)
    with command_options.guarded(of_command, specs, who) as specs:
        cache = None if no_cache else default_file()
        evaluated = partial(
            evaluate, cache=cache, quiet=silent, workers=who, full=full, follows=follows
        )
        if named_suite:
            suite.evaluate(named_suite, specs, datasets, out, evaluated, quiet, as_json, verbose)
            return
        done, page = evaluated(specs[0], out or default_out(specs[0]))
    run = read(done.out)
    if as_json:
        echo_json(as_mapping(run))
    if not silent:
        selected = sources[0].choice is not None
        _show(done, run, walked(datasets[0], done), len(specs[0].seeds), selected, verbose)
        typer.echo(f"wrote {printable(page)}")
        after_run(run)


def _show(
    done: "Evaluated", run: "Run", dataset: "Dataset", seeds: int, selected: bool, verbose: bool
) -> None:
    """Print a run's result beside the references that need no model, in few lines or all.

    `done` is the run as it was just evaluated, and `run` as it was read again; `selected` is
    whether its episodes are some of the dataset's.
    """
    from harness.report.references import BESIDE, in_trees, label, meaning

    episodes = dataset.manifest.episodes if selected else len(dataset.episodes)
    layout_seeds = seeds_text(dataset.manifest.seed, episodes)
    n = f"{crossed(len(dataset.episodes), seeds)}; {'of ' * selected}{layout_seeds}"
    every_reference = in_trees(dataset)
    if not verbose:
        brief.show(run, dataset.name, n, every_reference)
        return
    references = {name: every_reference[name] for name in BESIDE if name in every_reference}
    gain = GAINS[headline.headline_of(done)]
    has_gain = any(score.metric == gain.metric for score in done.scores)
    columns = (SUCCESS, gain, *COLUMNS) if has_gain else (SUCCESS, *COLUMNS)
    notes = [
        f"n = {n};",
        "95 % intervals over episodes; msgs: per episode"
        + "; gain: over single-local, paired" * has_gain,
        *(meaning(name) for name in references),
    ]
    rows = {label(name, dataset.scenario): scores for name, scores in references.items()}
    show(done, run, dataset.name, columns, notes, rows)


def _refuse_language_models(specs: "Sequence[Spec]", who: "Workers", workers: str) -> None:
    from harness.core.parallel import Ray

    agents = [agent for spec in specs for agent in spec.agents]
    for agent in agents:
        if not agent.can.language_model:
            continue
        if not agent.card.server:
            raise UserError(
                f"--workers {printable(workers)}: rules and servers answer to several processes, "
                f"and {printable(agent.card.name)} is a language model of one; give --batch-size"
            )
        if isinstance(who, Ray):
            raise UserError(
                f"--workers {printable(workers)}: {printable(agent.card.name)} is asked at "
                "servers, by processes of this machine; give their number"
            )


def show_counted(spec: "Spec", counted: dict[str, Any], times: int = 1) -> None:
    """Print what an evaluation would take, as a dry run counted it: requests, tokens and cost.

    `spec` is the evaluation, and `counted` the dict that `evaluate.dry_run.count` made of it. The
    cost is that of `times` such evaluations, since repeats ask as often.
    """
    repeated = f" × {times} repeats" if times > 1 else ""
    by_role, requests = counted["requests_by_role"], f"{counted['requests']} requests"
    if "helper" in by_role and not spec.asks_all:
        requests = (
            f"{by_role['ego']} requests to the ego and at most {by_role['helper']} to helpers"
        )
    elif "fusion" in by_role:
        requests = f"{counted['requests'] - by_role['fusion']} requests"
    if "fusion" in by_role:
        requests += f", at most {by_role['fusion']} fusion calls"
    typer.echo(
        f"{spec.source.name}: {requests}{repeated} for the {counted['scenes']} scenes on the "
        f"reference drivers' courses; would score {len(spec.points)} conditions × "
        f"{len(spec.seeds)} channel seeds; no model was called"
    )
    for name, count in counted.get("streamed", {}).items():
        typer.echo(f"of these with what helpers send unasked under {printable(name)}: {count}")
    echo_prompt_tokens(counted["prompt_tokens"])
    echo_cost(counted.get("cost", {}), times)
