"""Hold what `run.json` states against a run's answers, and against its own settings."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from harness.core.errors import printable
from harness.runs.answer_counts import counts
from harness.runs.answer_times import times
from harness.runs.folder import Run
from harness.runs.records import Answer


def of_manifest(run: Run, answers: Iterable[Answer], *, current: bool) -> Iterator[str]:
    """Yield a sentence for each statement of a run's `run.json` that the run's own data contradict.

    Such is a number of episodes. `answers` are the run's. A run that is not `current`, by earlier
    rules for figures, may lack records, and its times of answers are not compared.
    """
    answers = list(answers)
    for name, count in counts(answers).items():
        in_manifest = getattr(run.manifest, name)
        if in_manifest != count:
            yield f"run.json has {name} {in_manifest}, and answers.jsonl has {count}"
    if current and run.manifest.answer_times != times(answers):
        yield "run.json has another answer_times than its answers took"
    yield from _of_cost(run)
    yield from _of_records(run, current)


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


def _of_records(run: Run, current: bool) -> Iterator[str]:
    """Yield which channel profiles and networks are recorded and not named, or the reverse."""
    manifest = run.manifest
    recorded_by_setting: dict[str, tuple[str, Mapping[str, Any]]] = {
        "profile": ("channel profile", manifest.channels),
        "round_trip": ("network", manifest.networks),
    }
    for setting, (what, recorded) in recorded_by_setting.items():
        named = {str(point[setting]) for point in manifest.conditions if point.get(setting)}
        for name in sorted(recorded.keys() - named):
            yield f"run.json has {what} {printable(name)}, which no condition names"
        for name in sorted(named - recorded.keys() if current else ()):
            yield f"run.json lacks {what} {printable(name)}, which a condition names"
