"""A run as a record of Every Eval Ever, the shared schema of the EvalEval coalition.

A record has one result for each condition and metric. https://github.com/evaleval/every_eval_ever
"""

from collections.abc import Iterator, Mapping, Sized
from datetime import datetime
from math import inf
from pathlib import Path
from typing import Any

import msgspec

from harness.core.figures import Unit
from harness.core.files import write_whole
from harness.core.places import nameless
from harness.core.statistics import LEVEL
from harness.report.findings import FIRST, findings
from harness.runs.contradictions import refuse
from harness.runs.folder import Run
from harness.runs.metric import Metric
from harness.runs.metrics import entry
from harness.runs.records import FrozenScenes, Score

VERSION = "0.3.0"  # of the schema
LIBRARY = "swarmdrive-harness"
OVER_SEEDS = "seed means"
UNITS = {"%": "proportion", "points": "proportion"}  # of stored values, by the unit that is shown
# By an interval's kind, what it says of, and what it takes as given beside model and prompt.
EPISODES, DRAWS = "other episodes of the scenario", "the channel's seeds, and the answers"
SCOPES = {
    OVER_SEEDS: ("other seeds of the channel", "the episodes, and the answers"),
    "episodes": (EPISODES, DRAWS),
    "paired episodes": (EPISODES, DRAWS),
    "any time": (f"{EPISODES}, at every look at the run", DRAWS),
    "answers": (EPISODES, "who was asked"),
}


def write(run: Run, path: Path) -> Path:
    """Write a run as one JSON record of Every Eval Ever, and return the file.

    Raises UserError if the run's tables contradict each other.
    """
    refuse(run)
    record = msgspec.json.format(msgspec.json.encode(nameless(record_of(run))), indent=1)
    write_whole(path, record + b"\n")
    return path


def record_of(run: Run) -> dict[str, Any]:
    """Return a run as a record of Every Eval Ever: plain values of its JSON schema by name.

    Scores that could not be computed have no result there; the record names them. Equal runs give
    equal records, also those that are written later.
    """
    manifest = run.manifest
    made = datetime.fromisoformat(manifest.created)
    model, seconds = _model(run), str(int(made.timestamp()))
    unknown = [_id(score) for score in run.scores if score.value is None]
    sentences = [finding.sentence for finding in findings(run, *FIRST)]
    return {
        "schema_version": VERSION,
        "evaluation_id": f"{run.source}/{model['id']}/{seconds}",
        "evaluation_timestamp": manifest.created,
        "retrieved_timestamp": seconds,
        "source_metadata": {
            "source_name": LIBRARY,
            "source_type": "evaluation_run",
            "source_organization_name": "unknown",
            "evaluator_relationship": "other",
            "additional_details": _texts(
                {"what to know first": sentences, "scores without a value": unknown}
            ),
        },
        "eval_library": {
            "name": LIBRARY,
            "version": manifest.versions.get("harness", "unknown"),
            "additional_details": _texts(manifest.versions),
        },
        "model_info": model,
        "evaluation_results": list(_results(run)),
    }


def _model(run: Run) -> dict[str, Any]:
    """Return who answered: the ego's model; those of helpers are in each result."""
    manifest = run.manifest
    card = manifest.model
    weights = card.get("weights")
    # Only weights of a hub have a revision that the engine met.
    is_of_hub = isinstance(manifest.identity.get("revision"), str) and isinstance(weights, str)
    own_id = str(weights) if is_of_hub else f"{LIBRARY}/{card['name']}"
    facts = {name: value for name, value in card.items() if name not in ("name", "description")}
    deployment = "unknown" if card.get("server") else "self_deployed"
    hosting = {"deployment_type": deployment, "model_availability": "unknown"}
    return {
        "name": card["name"],
        "id": own_id,
        "inference_engine": {"name": card["engine"]},
        "additional_details": _texts({**facts, "identity": manifest.identity, **hosting}),
    }


def _results(run: Run) -> Iterator[dict[str, Any]]:
    """Yield the results: a score over episodes or answers, with its interval over seeds beside."""
    over_seeds = {s.key[:2]: s for s in run.scores if s.interval == OVER_SEEDS}
    over_others = {s.key[:2] for s in run.scores if s.interval != OVER_SEEDS}
    generation = {score.condition: _generation(run, score.condition) for score in run.scores}
    source = _source(run)
    for score in run.scores:
        is_beside = score.interval == OVER_SEEDS and score.key[:2] in over_others
        if score.value is None or is_beside:
            continue
        metric = entry(score.metric)
        seed_score = over_seeds.get(score.key[:2])
        yield {
            "evaluation_result_id": _id(score),
            "evaluation_name": f"{run.source} {score.condition}",
            "evaluation_timestamp": run.manifest.created,
            "source_data": source,
            "metric_config": _metric(metric),
            "score_details": _score(score, seed_score),
            "generation_config": generation[score.condition],
        }


def _id(score: Score) -> str:
    return f"{score.condition}/{score.metric}/{score.interval}"


def _source(run: Run) -> dict[str, Any]:
    """Return where the scenes are from: a dataset with its digest, or a scenario that is driven."""
    world = run.manifest.world
    facts = msgspec.to_builtins(world)
    name = world.name if isinstance(world, FrozenScenes) else world.title
    facts = {key: value for key, value in facts.items() if key not in ("name", "path")}
    return {"dataset_name": name, "source_type": "other", "additional_details": _texts(facts)}


def _metric(metric: Metric) -> dict[str, Any]:
    # A gain is a difference, and nothing is known of a metric that another version had.
    is_signed = metric.unit.name == "points" or not metric.meaning
    most = "Infinity" if metric.most == inf else metric.most
    lowest = "-Infinity" if most == "Infinity" else -metric.most
    return {
        "evaluation_description": metric.meaning,
        "metric_id": f"{LIBRARY}.{metric.name}",
        "metric_name": metric.label,
        "metric_unit": _unit(metric.unit),
        "lower_is_better": metric.better == "lower",
        "score_type": "continuous",
        "min_score": lowest if is_signed else 0.0,
        "max_score": most,
        "additional_details": {"better": metric.better},
    }


def _unit(unit: Unit) -> str:
    return UNITS.get(unit.name, unit.name or "1")


def _score(score: Score, over_seeds: Score | None) -> dict[str, Any]:
    _, condition = _scope(score)
    uncertainty = {"num_samples": score.n, **_interval(score)}
    facts: dict[str, Any] = {
        "n": score.n,
        "n_excluded": score.n_excluded,
        "units": score.interval,
        "conditional on": condition,
    }
    if "confidence_interval" not in uncertainty:
        facts["interval"] = "none: the data cannot bound it"
    if over_seeds:
        _, episodes = _scope(over_seeds)
        seeds = {"n": over_seeds.n, "conditional on": episodes, **_interval(over_seeds)}
        facts["interval over seeds"] = seeds
    return {"score": score.value, "uncertainty": uncertainty, "details": _texts(facts)}


def _interval(score: Score) -> dict[str, Any]:
    """Return the interval's table by its name in the schema; empty if there is no interval."""
    if score.low is None or score.high is None:
        return {}
    population, _ = _scope(score)
    ends = {"lower": score.low, "upper": score.high, "confidence_level": LEVEL}
    return {"confidence_interval": {**ends, "method": f"over {population}"}}


def _scope(score: Score) -> tuple[str, str]:
    """Return what a score's interval says of, and what it takes as given."""
    return SCOPES.get(score.interval, (score.interval, "unknown"))


def _generation(run: Run, condition: str) -> dict[str, Any]:
    """Return how answers came under a condition, a named set of settings that a run scores."""
    manifest = run.manifest
    points = [point for point in manifest.conditions if point["name"] == condition]
    arguments = {
        "temperature": manifest.temperature,
        "reasoning": manifest.thinking,
        "execution_command": nameless(manifest.command, "command"),
    }
    most_tokens = manifest.model.get("max_new_tokens")
    if most_tokens:
        arguments["max_tokens"] = most_tokens
    details = {
        "prompt": manifest.prompt,
        "answer": manifest.answer,
        "helpers": manifest.helpers,
        "condition": points,
        "channels": manifest.channels,
        "networks": manifest.networks,
        "schedules": manifest.schedules,
        "kept": manifest.kept,
        "beside": manifest.beside,
        "seeds": manifest.seeds,
        "sampling_seed": manifest.sampling_seed,
        "latency": msgspec.to_builtins(manifest.latency),
        "engine_errors": manifest.engine_errors,
    }
    return {"generation_args": arguments, "additional_details": _texts(details)}


def _texts(values: Mapping[str, Any]) -> dict[str, str]:
    """Return values as the schema has further details: texts, of tables and lists their JSON."""
    texts = {}
    for name, value in values.items():
        is_empty = value is None or (isinstance(value, Sized) and not len(value))
        if not is_empty:
            is_text = isinstance(value, str)
            texts[name] = value if is_text else msgspec.json.encode(nameless(value)).decode()
    return texts
