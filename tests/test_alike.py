"""What runs must have alike to be one thing."""

from pathlib import Path

import msgspec
import pytest
from run_on_disk import made_up

from harness.core.errors import UserError
from harness.runs.alike import different, refuse_two_of_a_name, setup
from harness.runs.folder import read


def test_a_model_of_one_name_has_the_same_weights_in_all_runs(tmp_path: Path) -> None:
    weights = {"engine": "llama-cpp", "file_sha256": "1" * 64}
    one = read(made_up(tmp_path / "one", identity=weights))
    same = read(made_up(tmp_path / "same", identity={**weights, "helpers": [weights]}))
    refuse_two_of_a_name([one, same, one])
    other = read(made_up(tmp_path / "other", identity={**weights, "file_sha256": "2" * 64}))
    with pytest.raises(UserError, match=r"model made-up has other weights.*other than in .*one;"):
        refuse_two_of_a_name([one, same, other])


def test_what_differs_is_named_and_what_only_one_run_opens_is_not(tmp_path: Path) -> None:
    one = read(made_up(tmp_path / "one"))
    assert different(setup(one), setup(one)) == ""
    radio = one.manifest.channels["6g"]
    slow = {**radio.parameters, "latency_s": 0.5}
    opened = {
        "channels": {"6g": {**msgspec.structs.asdict(radio), "parameters": slow}},
        "schedules": {"a": "1"},
    }
    other = read(made_up(tmp_path / "other", temperature=0.5, **opened))
    assert different(setup(one), setup(other)) == "temperature, radio"
