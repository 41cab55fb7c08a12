"""Hold what `run.json` states against a run's answers, and against its own settings."""

from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import suppress
from typing import Any

from harness.core.errors import UserError, printable
from harness.runs.answer_counts import counts
from harness.runs.answer_times import times
from harness.runs.folder import Run
from harness.runs.records import Answer, ClosedLoop
from harness.world import scenarios


def of_manifest(run: Run, answers: Sequence[Answer]) -> Iterator[str]:
    """Yield a sentence for each statement of a run's `run.json` that the run's own data contradict.

    Such is a number of episodes. `answers` are the run's.
    """
    for name, count in counts(answers).items():
        in_manifest = getattr(run.manifest, name)
        if in_manifest != count:
            yield f"run.json has {name} {in_manifest}, and answers.jsonl has {count}"
    yield from _of_cost(run)
    for what, recorded, named in _records(run):
        for name in sorted(recorded.keys() - named):
            yield f"run.json has {what} {printable(name)}, which no condition names"


def by_later_rules(run: Run, answers: Sequence[Answer]) -> Iterator[str]:
    """Yield what a run's `run.json` states otherwise than the rules of today for figures make.

    These are times of answers, records that it lacks, the scenario that its settings name, and
    looks at what it had so far. A run by earlier rules may state them so. `answers` are the run's.
    """
    if run.manifest.answer_times != times(answers, run.grid.episodes, run.clusters):
        yield "run.json has another answer_times than its answers took"
    for what, recorded, named in _records(run):
        for name in sorted(named - recorded.keys()):
            yield f"run.json lacks {what} {printable(name)}, which a condition names"
    yield from _of_scenario(run)
    record = run.manifest.world.interim_looks
    if record is not None and (rule := run.manifest.stopping_rule):
        yield from rule.contradictions(record, run.grid, run.episodes)


def _of_scenario(run: Run) -> Iterator[str]:
    """Yield whether a driven run's settings name another scenario than was driven."""
    text = getattr(run.manifest.settings.world, "scenario", None)
    if not isinstance(run.manifest.world, ClosedLoop) or text is None:
        return
    with suppress(UserError):  # whoever drives again says what is not here
        named, driven = scenarios.get(text), run.manifest.scenario
        if (named.name, named.parameters) != (driven.name, driven.parameters):
            yield (
                f"run.json has settings of scenario {printable(text, 200)}, and it was driven in "
                f"{printable(scenarios.argument(driven), 200)}"
            )


def _of_cost(run: Run) -> Iterator[str]:
    """Yield which costs are of no model of the run that has a price in their currency."""
    models = [run.manifest.model, *(helper["model"] for helper in run.manifest.helpers)]
    currency = {}
    for model in models:
        price = model.get("price")
        currency[model["name"]] = price.get("currency") if isinstance(price, Mapping) else None
    for name, cost in (run.manifest.cost or {}).items():
        if currency.get(name) != cost.currency:
            yield (
                f"run.json has a cost of {printable(name)} in {printable(cost.currency)}, and no "
                "model of it has such a price"
            )


def _records(run: Run) -> Iterator[tuple[str, Mapping[str, Any], Set[str]]]:
    """Yield channel profiles and networks: what they are, those recorded, and those named."""
    manifest = run.manifest
    recorded_by_setting: dict[str, tuple[str, Mapping[str, Any]]] = {
        "profile": ("channel profile", manifest.channels),
        "round_trip": ("network", manifest.networks),
    }
    for setting, (what, recorded) in recorded_by_setting.items():
        named = {str(point[setting]) for point in manifest.conditions if point.get(setting)}
        yield what, recorded, named
