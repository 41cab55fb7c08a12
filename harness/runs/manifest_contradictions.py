"""Hold what `run.json` states against a run's answers, and against its own settings."""

from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import replace
from typing import Any

from harness.core.errors import UserError, printable
from harness.runs.answer_counts import counts
from harness.runs.answer_times import times
from harness.runs.folder import Run
from harness.runs.records import Answer, FrozenScenes
from harness.world.parameters import SCENES
from harness.world.scenario import Scenario
from harness.world.scenarios import DEFAULT, argument, get, split


def of_manifest(run: Run, answers: Sequence[Answer]) -> Iterator[str]:
    """Yield a sentence for each statement of a run's `run.json` that the run's own data contradict.

    Such is a number of episodes. `answers` are the run's.
    """
    for name, count in counts(answers).items():
        in_manifest = getattr(run.manifest, name)
        if in_manifest != count:
            yield f"run.json has {name} {in_manifest}, and answers.jsonl has {count}"
    untimed = (each for each in answers if each.seconds is None)
    timed = (each for each in untimed if (each.first_token_s, each.token_s) != (None, None))
    if (answer := next(timed, None)) is not None:
        yield f"answers.jsonl has times of tokens of {printable(answer.id)}, and none of the whole"
    yield from _of_cost(run)
    for what, recorded, named in _records(run):
        for name in sorted(recorded.keys() - named):
            yield f"run.json has {what} {printable(name)}, which no condition names"


def by_later_rules(run: Run, answers: Sequence[Answer]) -> Iterator[str]:
    """Yield what a run's `run.json` states otherwise than the rules of today for figures make.

    These are times of answers, records that it lacks, what its settings choose, and looks at what
    it had so far. A run by earlier rules may state them so. `answers` are the run's.
    """
    if run.manifest.answer_times != times(answers, run.grid.episodes, run.clusters):
        yield "run.json has another answer_times than its answers took"
    for what, recorded, named in _records(run):
        for name in sorted(named - recorded.keys()):
            yield f"run.json lacks {what} {printable(name)}, which a condition names"
    yield from _of_settings(run)
    record = run.manifest.world.interim_looks
    if record is not None and (rule := run.manifest.stopping_rule):
        yield from rule.contradictions(record, run.grid, run.episodes)


def _of_settings(run: Run) -> Iterator[str]:
    """Yield what a run's settings choose otherwise than what it states to have had.

    Those of an older run, which are not in its file, follow from what stands beside them.
    """
    if "settings" not in run.record:
        return
    manifest, world, scenes = run.manifest, run.manifest.world, run.manifest.settings.world
    choices: dict[str, tuple[Any, Any]] = {
        "engine": (manifest.settings.engine, manifest.model["engine"]),
        "letters": (manifest.settings.letters, manifest.letters),
    }
    if isinstance(world, FrozenScenes):
        choices["limit"] = getattr(scenes, "limit", None), world.limit
    elif not world.interim_looks:  # a run that was looked at may have fewer
        count = world.selection.get("of", world.episodes)
        choices["episodes"] = getattr(scenes, "episodes", None), count
    for name, (typed, there) in choices.items():
        if typed is not None and typed != there:
            yield f"run.json has {name} {printable(typed)} in its settings, and {there} beside them"
    if not isinstance(world, FrozenScenes):
        with suppress(UserError):  # whoever drives again says what is not here
            yield from _of_scenario(getattr(scenes, "scenario", None) or DEFAULT, manifest.scenario)


def _of_scenario(text: str, driven: Scenario) -> Iterator[str]:
    """Yield whether settings name another scenario, `text`, than was driven.

    Settings of the first runs do not name the parameters of `SCENES`.
    """
    named, (_, dials) = get(text), split(text)
    unnamed = [key for key in SCENES if key in driven.dials and f"{key}=" not in (dials or "")]
    scenes = {key: getattr(driven.parameters, key) for key in unnamed}
    parameters = replace(named.parameters, **scenes)
    if (named.name, parameters) != (driven.name, driven.parameters):
        yield (
            f"run.json has scenario {printable(text, 200)} in its settings, and was driven in "
            f"{printable(argument(driven), 200)}"
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
