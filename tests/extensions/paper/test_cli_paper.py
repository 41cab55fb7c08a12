"""`harness study paper`, and the calibrated proxy in `harness study sweep`, as typed."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
from evaluating import run as evaluate
from evaluating import spec_of

from harness.dataset.load import Dataset

Said = tuple[int, str, str]


@pytest.fixture(scope="module")
def done(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return evaluate(spec_of(small), tmp_path_factory.mktemp("sweep") / "run").out


@pytest.mark.exhaustive
def test_without_an_axis_it_draws_the_papers_panels_beside_the_proxys(
    harness: Callable[..., Said], done: Path
) -> None:
    code, out, err = harness("study", "sweep", done, "--proxy", "--out", "swept", "--pictures")
    assert (code, "harness: " in err) == (0, False)
    assert max(map(len, out.splitlines())) <= 80
    assert out.splitlines()[-1] == "wrote swept/index.html"
    page, table = Path("swept/index.html").read_text(), pd.read_csv("swept/conditions.csv")
    tables = len(re.findall(r"(?<!<figure>\n)<h2>", page))
    assert page.count('class="headline"') == tables > 4
    assert re.search(r"over loss: balanced success [^<]+ % at loss 0; ", page)
    assert set(table.panel) == {"core", "size", "loss", "tau"}
    assert set(table[table.panel == "core"].condition) == {"single-local", "v2x", "6g"}
    assert table.source.nunique() == 2
    pictures = {f"{stem}.{kind}" for kind in ("svg", "pdf", "png")
                for stem in ("sweep", "operating-points-1", "operating-points-2")}  # fmt: skip
    assert pictures <= {p.name for p in Path("swept").iterdir()}
    lines = Path("swept/conditions.jsonl").read_text().splitlines()
    assert len(lines) == len(table)
    sizes = json.loads(Path("swept/sweep.json").read_text())["panels"]["size"]
    assert [s["vehicles"] for s in sizes] == [1, 2, 3, 4]
    assert all(s["density_coupled"] for s in sizes)
