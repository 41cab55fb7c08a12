"""What two runs must have alike for their success to be compared as that of one thing."""

from collections.abc import Iterable, Mapping
from typing import Any

from msgspec import structs

from harness.core.errors import UserError, printable
from harness.runs import formats
from harness.runs.folder import Run
from harness.runs.records import MEASURED
from harness.world.scenario import Scenario

# what conditions open: a run with other conditions opens others
OPENED = ("radio", "network", "schedule", "file")


def setup(run: Run, scenario: Scenario | None = None) -> dict[str, Any]:
    """Return what two runs must have alike for their success to be compared as one thing's.

    Its keys are names for error messages: `scenario` with its parameters, `model` and `prompt` of
    all that answer, `temperature` with the sampling seed, `ties`, `latency` (the seconds of
    answers) and `radio` by profile; `different` compares two of these. `scenario` is that of the
    run's scenes, None where it does not count. Measured times are each run's own, and count as
    alike.
    """
    manifest = run.manifest
    agents = (manifest.agent(0), *manifest.helpers)
    times = structs.replace(manifest.latency, basis="", sample={})
    return {
        "scenario": scenario and (scenario.name, scenario.parameters),
        "model": [{**agent, "prompt": {}} for agent in agents],
        "prompt": [agent["prompt"] for agent in agents],
        "temperature": (manifest.temperature, manifest.sampling_seed),
        "ties": manifest.ties,
        "latency": MEASURED if times.source == MEASURED else times,
        "weights": formats.identity(manifest.identity),
        **opened(run),
    }


def opened(run: Run) -> dict[str, Mapping[str, Any]]:
    """Return what a run's conditions open, by a word of `OPENED` and by name.

    Such is what a radio does, as the run recorded it.
    """
    manifest = run.manifest
    radios = {name: (each.model, each.parameters) for name, each in manifest.channels.items()}
    kept = {}
    for folder, by_name in manifest.kept.items():
        for name, record in by_name.items():
            kept[f"{folder} {name}"] = record
    return {
        "radio": radios,
        "network": manifest.networks,
        "schedule": manifest.schedules,
        "file": kept,
    }


def different(one: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Return the names under which two `setup`s differ, joined by commas; empty if none does.

    Of what conditions open, only what both runs have counts.
    """
    names = []
    for name, value in one.items():
        there = other[name]
        if name in OPENED:
            common = value.keys() & there.keys()
            value = {key: value[key] for key in common}
            there = {key: there[key] for key in common}
        if value != there:
            names.append(name)
    return ", ".join(names)


def refuse_two_of_a_name(runs: Iterable[Run]) -> None:
    """Raise UserError if a model of one name has other weights in one run than in another.

    Work that was stopped may go on with a model that was trained or updated in the meantime.
    """
    by_name: dict[str, tuple[Run, Any]] = {}
    for run in runs:
        manifest = run.manifest
        of_ego = formats.identity(manifest.identity)
        identities = [of_ego, *of_ego.pop("helpers", [])]
        agents = [manifest.agent(0), *manifest.helpers]
        for agent, identity in zip(agents, identities, strict=False):
            name = str(agent["model"]["name"])
            first, known_identity = by_name.setdefault(name, (run, identity))
            if identity != known_identity:
                raise UserError(
                    f"model {printable(name)} has other weights, or another engine, in "
                    f"{printable(run.path)} than in {printable(first.path)}; delete both, with "
                    "what was made of their answers, and type the command again"
                )
