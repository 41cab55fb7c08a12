"""`harness study trust`: what consensus rules make of helpers that lie or fail."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from harness.cli import options
from harness.cli.progress import bar
from harness.cli.run import file_name
from harness.cli.show import finish
from harness.core import resources, work
from harness.core.errors import UserError
from harness.core.files import folder_in
from harness.runs.settings import parse_seeds

if TYPE_CHECKING:
    from harness.evaluate.spec import Spec


def command(
    run: Path | None = typer.Argument(
        None,
        help="Folder of a finished run of `harness eval`. Give this or --model.",
        metavar="[RUN]",
    ),
    model: str | None = typer.Option(
        None,
        help="Model to evaluate first, on the default dataset, instead of RUN. With RUN: the run's "
        "model, "
        "where it is none of your cards.",
    ),
    prompt: options.ScenarioPrompt = None,
    attacks: str = typer.Option(
        "all",
        help="Attacks, separated by commas: liar, stuck, stale, "
        "replay, spoof, sybil, flood, brake, "
        "silent, "
        "overconfident, random, injection, jump or absent; on objects ghost, hide or shift. + "
        "combines some, "
        "and a colon changes a setting: liar+spoof,stale:decisions=2. all: the usual "
        "ones that the condition allows.",
    ),
    rules: str = typer.Option(
        "all",
        help="Consensus rules, separated by commas: linear, log-pool, median, trimmed-mean, "
        "trimmed-heads, "
        "geometric-median, centred-clipping, bayes or trust; linear:weight_cap=0.3 changes a "
        "setting. Against ego-prompt the strongest messages alone are looked for.",
    ),
    share: str = typer.Option(
        "0,1/3,2/3", help="Shares of the helpers that attack, 0 to 1; 0 is always played as well."
    ),
    condition: str = typer.Option(
        "6g", help="Operating point to attack, or one with changed settings: 6g:max_helpers=1."
    ),
    seeds: str | None = typer.Option(
        None, help="Channel seeds, such as 0:5 or 3,7,9. Default: the run's, or 0:5 with --model."
    ),
    no_model: options.NoModel = False,
    out: Path | None = typer.Option(
        None,
        help="Folder to write. Default: RUN/trust, or reports/trust-<model>-<prompt>-<dataset>.",
    ),
    as_json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
    pictures: options.Pictures = False,
) -> None:
    """Play every attack against every consensus rule.

    The model is asked only where the run has no answer.
    If the study is stopped, the same command continues it.
    """
    from harness.backends.cache import default_file
    from harness.backends.registry import open_backend
    from harness.coordination.contents import INTENTS
    from harness.coordination.rules import EGO_PROMPT, RULES, reads
    from harness.evaluate.run import read_or_evaluate
    from harness.extensions.trust.attacks import ATTACKS
    from harness.extensions.trust.page import trust_study
    from harness.extensions.trust.study import names_of, run_bench, shares_of
    from harness.studies.replayed_run import ReplayedRun

    attack_names = names_of("--attacks", attacks, tuple(ATTACKS))
    rule_names, shares = (
        names_of(
            "--rules", rules, (*(rule for rule in RULES if INTENTS in reads(rule)), EGO_PROMPT)
        ),
        shares_of(share),
    )
    if (run is None and model is None) or (run and prompt):
        raise UserError(
            "give either RUN, the folder of a finished run, or --model, with its --prompt"
        )
    with bar("rules under attack", quiet=as_json or quiet, grows=True) as progress:
        if run is None:
            assert model is not None
            spec = _spec(model, prompt, condition, seeds)
            name = f"trust-{file_name(model)}-{spec.ego.prompt.version}-{spec.source.name}"
            out = out or Path("reports") / name
            cache = default_file()
            run = read_or_evaluate(spec, out / "run", progress, cache, open_backend).path
        cards = options.cards([model] if model else None)
        replayed = ReplayedRun(run, progress=progress, asks=not no_model, models=cards)
        draws = parse_seeds(seeds) if seeds else replayed.seeds
        where = out or folder_in(run, "trust")
        with work.going_on(where):
            bench = run_bench(
                replayed, condition, rule_names, attack_names, shares, draws, where, progress
            )
    finish(trust_study(bench), where, as_json, quiet, verbose, pictures)


def _spec(model: str, prompt: str | None, condition: str, seeds: str | None) -> "Spec":
    """Return the evaluation whose answers are walked."""
    from harness.evaluate import resolve
    from harness.runs.settings import Settings

    settings = Settings(
        model=model,
        prompt=prompt,
        condition=(condition,),
        seeds=seeds or "0:5",
        ask="all",  # attacks use what every helper intends
    )
    return resolve.spec(settings, resolve.frozen(settings, resources.DATASET))
