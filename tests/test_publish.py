"""A published dataset: what stands in its tables is what the trees say,
and other programs load it.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from msgspec import structs

from harness.core.files import sha256_file
from harness.core.progress import Progress
from harness.dataset.card import SIMULATED, Table, hub_size, readme
from harness.dataset.columns import COLUMNS
from harness.dataset.load import Dataset
from harness.dataset.publish import publish
from harness.evaluate.chats import Asking
from harness.world.scenario import Scenario

Harness = Callable[..., tuple[int, str, str]]


def ask(scenario: Scenario) -> tuple[str, Any]:
    asking = Asking.of(scenario, None, "json")
    return asking.prompt.version, asking.chat


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def published(once: Callable[..., Path], small_path: Path) -> Path:
    return once("published", lambda out: publish([small_path], out, ask, Progress()))


@pytest.fixture(scope="module")
def rows(published: Path) -> list[dict[str, Any]]:
    return pq.read_table(published / "data/small.parquet").to_pylist()


def test_a_row_has_what_the_trees_say_of_its_decision_point(
    rows: list[dict[str, Any]], small: Dataset
) -> None:
    forest = small.forest
    assert [row["scene"] for row in rows] == list(forest.ids)
    for name, table in (
        ("safe", forest.safe),
        ("avoids_harm", forest.avoids_harm),
        ("value", forest.worth),
    ):
        np.testing.assert_array_equal([row[name] for row in rows], table)
    delays_s = np.array([row["delay_s"] for row in rows], dtype=float)  # null becomes NaN
    np.testing.assert_array_equal(delays_s, forest.delay_s)
    assert all(d is None or d == d for row in rows for d in row["delay_s"])
    assert {row["layout_seed"] - row["episode"] for row in rows} == {small.manifest.seed}
    assert {tuple(row["actions"]) for row in rows} == {small.actions}


def test_an_episode_can_be_played_from_the_table_alone(
    rows: list[dict[str, Any]], small: Dataset
) -> None:
    points = {row["scene"]: row for row in rows}
    for driver in small.forest.drivers:
        successes = []
        for row in (row for row in rows if row["step"] == 0):
            while True:
                action = row["actions"].index(json.loads(row["drivers"])[driver])
                assert (row["next_scene"][action] is None) != (row["result"][action] is None)
                if row["next_scene"][action] is None:
                    break
                row = points[row["next_scene"][action]]
            successes.append(row["safe"][action])
        assert successes == small.forest.driver_success(driver).tolist()


def test_a_row_shows_what_the_ego_is_asked_and_what_each_viewer_knows(
    rows: list[dict[str, Any]], small: Dataset
) -> None:
    row = rows[-1]
    scene = small.scene(row["scene"])
    ego, *helpers = scene.viewers
    assert row["viewers"] == [ego, *helpers]
    assert [json.loads(graph)["viewer"] for graph in row["scene_graphs"]] == row["viewers"]
    assert json.loads(row["scene_graphs"][0]) == scene.graphs[ego].plain()
    assert row["range_m"] == [None, *(scene.record.range_m[helper] for helper in helpers)]
    _, chat = ask(small.scenario)
    assert row["prompt"] == chat(scene.graphs[ego])
    assert len(json.loads(row["state"])["vehicles"]) == len(scene.state.vehicles)


def test_the_card_and_the_croissant_file_name_every_table_and_column(
    published: Path, small: Dataset
) -> None:
    [_, head, text] = (published / "README.md").read_text().split("---\n", 2)
    [config] = yaml.safe_load(head)["configs"]
    [part] = config["data_files"]
    assert (config["config_name"], part["split"]) == ("small", "validation")  # tune seeds
    assert (yaml.safe_load(head)["license"], yaml.safe_load(head)["size_categories"]) == (
        "unknown",
        ["n<1K"],
    )
    assert "quote no result" in text
    assert small.sha256 in text
    document = json.loads((published / "croissant.json").read_text())
    [file], [table] = document["distribution"], document["recordSet"]
    assert file["contentUrl"] == part["path"]
    assert file["sha256"] == sha256_file(published / part["path"])
    assert [field["name"] for field in table["field"]] == [column.name for column in COLUMNS]
    assert all(f"| `{column.name}` |" in text for column in COLUMNS)
    assert "license" not in document  # nobody has stated it


@pytest.mark.parametrize(
    ("licences", "word"),
    [
        (["CC-BY-4.0"], "cc-by-4.0"),
        (["Apache-2.0", "apache-2.0"], "apache-2.0"),
        (["CC-BY-4.0", "CC0-1.0"], "other"),
        (["terms of highD"], "other"),
        (["unknown"], "unknown"),
        (["CC-BY-4.0", None], "unknown"),
        ([""], "unknown"),
    ],
)
def test_the_front_matter_says_of_terms_what_the_page_says(
    licences: list[str | None], word: str, small: Dataset
) -> None:
    tables = []
    for n, licence in enumerate(licences):
        manifest = structs.replace(small.manifest, name=f"set-{n}", licence=licence)
        tables.append(Table(manifest, "0" * 64, "", 0.1, False, "v", 9, "0" * 64, 9, {}))
    [_, head, text] = readme("sets", tables).split("---\n", 2)
    assert yaml.safe_load(head)["license"] == word
    terms = [f"- `set-{n}`: `{each}`" for n, each in enumerate(licences) if each]
    assert "\n".join(terms) in text


@pytest.mark.parametrize(
    ("tables", "lines"),
    [
        ([("", True)], [f"The scenes {SIMULATED}"]),
        ([("A8", False)], ["- Traffic of `set-0`: `A8`"]),
        (
            [("", False), ("", True)],
            ["- Traffic of `set-0`: not stated", f"- Scenes of `set-1` {SIMULATED}"],
        ),
    ],
)
def test_only_scenes_that_the_harness_draws_are_called_simulated(
    tables: list[tuple[str, bool]], lines: list[str], small: Dataset
) -> None:
    described = []
    for n, (source, simulated) in enumerate(tables):
        manifest = structs.replace(small.manifest, name=f"set-{n}", source=source)
        table = Table(manifest, "0" * 64, "", 0.1, False, "v", 9, "0" * 64, 9, {}, None, simulated)
        described.append(table)
    text = readme("sets", described)
    assert "\n\n" + "\n".join(lines) + "\n\n" in text
    assert text.count("simulated: no recording") == sum(simulated for _, simulated in tables)
    assert text.count("- Consequences are of one simulator") == (tables[0] != ("", True))


@pytest.mark.parametrize(
    ("rows", "word"),
    [
        (1, "n<1K"),
        (1000, "1K<n<10K"),
        (22_761, "10K<n<100K"),
        (10**6, "1M<n<10M"),
        (10**9, "n>100M"),
    ],
)
def test_the_size_of_a_dataset_is_the_hubs_word(rows: int, word: str) -> None:
    assert hub_size(rows) == word


def test_a_second_export_has_the_same_bytes_and_needs_another_folder(
    harness: Harness, published: Path, small_path: Path, tmp_path: Path
) -> None:
    (tmp_path / ".again.99998.part/data").mkdir(parents=True)  # of an export that was killed
    code, out, _ = harness("dataset", "export", small_path, "--out", "again")
    assert (code, "decision points" in out) == (0, True)
    before = files(tmp_path / "again")
    assert before == files(published)
    code, _, err = harness("dataset", "export", small_path, "--out", "again")
    assert (code, err.count("\n"), "--out again is there already" in err) == (2, 1, True)
    assert files(tmp_path / "again") == before
    assert [path.name for path in tmp_path.iterdir()] == ["again"]


def test_a_damaged_dataset_leaves_nothing_behind(
    harness: Harness, small_path: Path, tmp_path: Path, two_path: Path
) -> None:
    shutil.copytree(small_path, tmp_path / "small")
    shutil.copy(two_path / "layouts.zip", tmp_path / "small/layouts.zip")
    code, _, err = harness("dataset", "export", "small", "--out", "new")
    assert (code, err.count("\n")) == (2, 1)
    assert [path.name for path in tmp_path.iterdir()] == ["small"]


@pytest.mark.slow
def test_a_suite_is_a_table_for_each_dataset_under_names_that_are_checked(
    harness: Harness, small_path: Path, two_path: Path, tmp_path: Path
) -> None:
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "datasets").mkdir()
    for path, name in ((small_path, "first"), (two_path, "second"), (two_path, "third")):
        (tmp_path / "datasets" / name).symlink_to(path)
    (tmp_path / "datasets/suites.toml").write_text(
        '[both]\ndescription = "x"\ndatasets = ["first", "second"]\n'
        '[twice]\ndescription = "x"\ndatasets = ["second", "third"]\n'
        '["../\\u001b[31m"]\ndescription = "x"\ndatasets = ["second"]\n'
    )
    assert harness("dataset", "export", "suite:both", "--out", "both")[0] == 0
    head = yaml.safe_load((tmp_path / "both/README.md").read_text().split("---\n")[1])
    assert [config["config_name"] for config in head["configs"]] == ["small", "two"]
    assert {path.name for path in (tmp_path / "both/data").iterdir()} == {
        "small.parquet",
        "two.parquet",
    }
    for suite, says in (("twice", "two datasets are named two"), ("../\x1b[31m", "cannot name")):
        code, _, err = harness("dataset", "export", f"suite:{suite}", "--out", "new")
        assert (code, err.count("\n"), says in err, "\x1b" in err) == (2, 1, True, False)
    assert not (tmp_path / "new").exists()


def test_a_folder_that_cannot_be_written_is_one_line(
    harness: Harness, two_path: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    code, _, err = harness("dataset", "export", two_path, "--out", "file/new")
    assert (code, err.count("\n"), "cannot be written" in err) == (2, 1, True)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of others
def test_the_tools_of_others_read_the_folder(
    published: Path, small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    datasets = pytest.importorskip("datasets")
    if not hasattr(datasets, "load_dataset"):
        pytest.skip("needs the package; the folder of that name here is none")
    hub = pytest.importorskip("huggingface_hub")
    assert hub.DatasetCard.load(published / "README.md").data.pretty_name == "small"
    loaded = datasets.load_dataset(
        str(published), "small", split="validation", cache_dir=str(tmp_path)
    )
    assert loaded.num_rows == small.nodes
    assert loaded[0]["safe"] == small.forest.safe[0].tolist()
    assert loaded[0]["prompt"][0]["role"] == "system"


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of others
def test_mlcroissant_accepts_the_file_and_reads_every_record(
    published: Path, small: Dataset
) -> None:
    croissant = pytest.importorskip("mlcroissant")
    data = croissant.Dataset(published / "croissant.json")
    assert not data.metadata.ctx.issues.errors
    records = list(data.records("small"))
    assert [record["small/scene"].decode() for record in records] == list(small.forest.ids)
    assert list(records[0]["small/safe"]) == small.forest.safe[0].tolist()
