"""`harness study twins`: metamorphic tests of a prompt."""

from pathlib import Path

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.run import free_folder
from harness.cli.show import finish
from harness.core import resources, work
from harness.core.at_once import at_once_of
from harness.core.errors import in_range, printable, unknown
from harness.core.seeds import LAST_SEED

# that are drawn where nothing is said; with fewer, intervals near 90 % are too narrow
EPISODES = 40


def command(
    model: options.Model = "proxy",
    engine: options.Engine = None,
    prompt: options.ScenarioPrompt = None,
    dataset: options.Dataset = resources.DATASET,
    twin: list[str] | None = typer.Option(
        None, help="Twin to ask, such as mirrored or paraphrase. Repeatable. Default: all."
    ),
    limit: int | None = typer.Option(None, help="Use only this many episodes, from the first."),
    sample: int | None = typer.Option(
        None,
        help=f"Number of episodes to draw at random. Default: {EPISODES}, or all if there are "
        "fewer.",
    ),
    sample_seed: int = typer.Option(
        0, help="Seed of this draw, and of that of their decision points."
    ),
    thinking: options.Thinking = False,
    answer: options.Answer = "json",
    batch_size: options.BatchSize = "8",
    workers: options.ModelWorkers = "2",
    device: options.Device = None,
    dtype: options.Dtype = None,
    fail_if: list[str] | None = typer.Option(
        None,
        help="Gate: '[TWIN:]METRIC[.low|.high] OP NUMBER'. It "
        "fails where that is true in any role: "
        "'mirrored:invariance_rate < 0.9'. METRIC is invariance_rate, tv_distance or failed_rate, "
        "each from "
        "0 to 1; .low and .high are the ends of the 95 % interval. Repeatable. Exit code 1 if a "
        "gate fails.",
    ),
    out: Path | None = typer.Option(
        None, help="Folder to write. Default: reports/<model>-<prompt>-twins-<dataset>."
    ),
    no_cache: options.NoCache = False,
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
    pictures: options.Pictures = False,
) -> None:
    """Test whether answers to a question and its twin agree.

    A twin is the same question put otherwise: mirrored, in other units, in other words. So what
    must hold of both answers is known without knowing the right one. If the study is stopped, the
    same command continues it.
    """
    from harness.backends import cards
    from harness.backends.cache import default_file
    from harness.dataset import load
    from harness.dataset.select import Choice, drawn
    from harness.evaluate.agent import Agent
    from harness.evaluate.frozen_world import FrozenSource
    from harness.evaluate.spec import Spec
    from harness.extensions.studies.twins import asking, scoring
    from harness.extensions.studies.twins.declared import TWINS
    from harness.extensions.studies.twins.study import twins_study, write_pairs
    from harness.prompts import versions
    from harness.report.compare.gate import gate
    from harness.runs.settings import Settings

    who = options.workers_of(workers)
    for name in twin or ():
        if name not in TWINS:
            raise unknown("--twin", name, TWINS)
    example = "mirrored:invariance_rate < 0.9"
    form = (scoring.METRICS, "TWIN", example, scoring.SCALE)
    gates = [gate(typed, *form) for typed in fail_if or ()]
    whole = load.load(load.find(dataset), None if sample else limit)
    options.say_all(limit, [whole])
    if limit is None and sample is None:
        sample = min(EPISODES, len(whole.episodes))
    choice, numbers = None, whole.episodes
    in_range("--sample-seed", sample_seed, 0, LAST_SEED)
    if sample is not None:
        numbers = tuple(drawn(numbers, sample, sample_seed, max(numbers) + 1))
        given = {"sample": sample, "sample_seed": sample_seed}
        choice = Choice(numbers, whole.episodes, given)
    source = FrozenSource(whole.of_episodes(frozenset(numbers[:limit])), limit, choice)
    version = versions.load(prompt or source.scenario.prompt)
    spec = Spec(
        Agent(cards.resolve(model, engine), version, answer, thinking),
        source,
        points=(),
        seeds=(0,),
        # Every viewer has a twin.
        settings=Settings(batch_size=at_once_of(batch_size), device=device, dtype=dtype, ask="all"),
    )
    questions = asking.Questions(spec, tuple(dict.fromkeys(twin or TWINS)), sample_seed)
    able = [name for name in questions.twins if asking.lack(spec, TWINS[name]) is None]
    for each in gates:
        if each.condition not in (None, *able):
            raise unknown(f"twin of --fail-if {printable(each.text)!r}", str(each.condition), able)
    where = out or free_folder([spec], f"twins-{source.name}", questions.goes_on)
    label = f"asking {printable(spec.ego.card.name, 30)}, episodes"
    with bar(label, len(questions.points()), as_json or quiet) as progress:
        pairs, unanswered = asking.ask(
            questions, where, progress, None if no_cache else default_file(), who
        )
    with work.going_on(where):
        data = source.dataset
        twins = [TWINS[name] for name in questions.twins]
        rows = scoring.rows(pairs, twins, data.episodes, data.clusters)
        verdicts = [scoring.judge(each, rows) for each in gates]
        write_pairs(pairs, where)
        study = twins_study(questions, rows, verdicts, unanswered)
        finish(study, where, as_json, quiet, verbose, pictures)
    work.tidy(where)
    raise typer.Exit(1 if any(verdict.failed for verdict in verdicts) else 0)
