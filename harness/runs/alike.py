"""What two runs must have alike for their success to be compared as that of one thing."""

from collections.abc import Mapping
from typing import Any

from msgspec import structs

from harness.runs.folder import Run
from harness.world.scenario import Scenario

MEASURED = "measured"  # source of a latency that each run measures for itself


def setup(run: Run, scenario: Scenario | None = None) -> dict[str, Any]:
    """Return what a run's answers and latency are of, beside its layouts, by a name for errors.

    `scenario` is that of its scenes, None where it does not count. Measured times are each run's
    own, and count as alike.
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
        "radio": {name: (each.model, each.parameters) for name, each in manifest.channels.items()},
    }


def different(one: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Return the names under which two `setup`s differ, joined by commas; empty if none does.

    Of radios only those count that both runs have.
    """
    names = [name for name in one if name != "radio" and one[name] != other[name]]
    radios = one["radio"].keys() & other["radio"].keys()
    if any(one["radio"][name] != other["radio"][name] for name in radios):
        names.append("radio")
    return ", ".join(names)
