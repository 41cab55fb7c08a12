"""`harness study sweep` as typed."""

import json
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
from evaluating import run as evaluate
from evaluating import spec_of

from harness.dataset.load import Dataset

pytestmark = pytest.mark.usefixtures("svg_alone")

Said = tuple[int, str, str]


@pytest.fixture(scope="module")
def done(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return evaluate(spec_of(small), tmp_path_factory.mktemp("sweep") / "run").out


@pytest.mark.slow
def test_conditions_stand_side_by_side_and_times_may_be_the_papers(
    harness: Callable[..., Said], done: Path
) -> None:
    """On demand the helpers' 145 ms come after the ego's; serial replies of 25 ms each follow."""
    options = (
        "--over",
        "window",
        "--grid",
        "400",
        "--condition",
        "v2x",
        "--condition",
        "v2x:on_demand=true",
    )
    code, out, err = harness("study", "sweep", done, *options, "--latency", "paper", "--json")
    assert (code, err) == (0, "")
    table = pd.DataFrame(json.loads(out))
    p99 = table[table.metric == "latency_p99_ms"].set_index("condition")["mean"]
    assert p99["v2x"] == pytest.approx(220, abs=3)
    assert p99["v2x:on_demand=true"] == pytest.approx(365, abs=3)


def test_a_proxy_that_no_extension_has_is_one_line(
    harness: Callable[..., Said], done: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("harness.studies.play.SOURCES", {})
    code, out, err = harness("study", "sweep", done, "--proxy", "--out", "swept")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "--proxy: no extension that is installed has the calibrated proxy" in err
    assert not Path("swept").exists()
