"""What the tests of promises share: a promise of the proxy, by hand."""

from pathlib import Path
from typing import Any

import pytest
from msgspec import to_builtins

from harness.coordination.named_points import named_point
from harness.core.resources import MARKER
from harness.dataset.load import Dataset
from harness.extensions.promise.promises import (
    Promise,
    opened_of,
    parameters_of,
    settings_of,
    times_of,
)
from harness.runs import folder
from harness.runs.fit import question_of, write


def promise_of(run: Path, dataset: Dataset, **changes: Any) -> Promise:
    """A promise for the model of a run: it asks above .3 nats and is careful from .9."""
    manifest = folder.read(run).manifest
    fields: dict[str, Any] = {
        "command": "by hand",
        "fitted_on": "nothing",
        "first_seed": 0,
        "last_seed": 99,
        "scenario": dataset.scenario.name,
        "actions": tuple(dataset.actions),
        "question": question_of({**manifest.agent(0), "model": manifest.answerers.model}),
        "harm": "unsafe",
        "at_most": 0.05,
        "delta": 0.05,
        "settings": settings_of(named_point("6g")),
        "parameters": parameters_of(dataset.scenario),
        "setup": {
            "ties": "drawn",
            "temperature": "0.0",
            "flip": "False",
            "latency": times_of({"latency": to_builtins(manifest.latency)}),
        },
        "opened": opened_of(named_point("6g")),
        "tau_nats": 0.3,
        "careful_nats": 0.9,
        "units": 100,
        "mean_harm": 0.0,
        "channel_seeds": (0,),
        "dataset_sha256": "0" * 64,
    }
    return Promise(**{**fields, **changes})


@pytest.fixture
def project(
    proxy_run: Path, small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A project, the current directory, with the promises `p` and `never`, of no careful action."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / MARKER).touch()
    (tmp_path / "promises").mkdir()
    write(promise_of(proxy_run, small), tmp_path / "promises/p.toml")
    write(promise_of(proxy_run, small, careful_nats=None), tmp_path / "promises/never.toml")
    return tmp_path
