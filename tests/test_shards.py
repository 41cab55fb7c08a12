"""Shards: the bytes of a work that was not split, and what is refused;
driven episodes and frozen layouts.
"""

import json
import re
import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest
from evaluating import FILES
from hypothesis import given
from hypothesis import strategies as st
from run_on_disk import change

from harness.core.errors import UserError
from harness.core.files import alone
from harness.core.shards import Shard, shard_of
from harness.runs.sources import read as read_sources

Typed = Callable[..., tuple[int, str, str]]
DRIVE = (
    "drive",
    "--model",
    "cruise",
    "--condition",
    "6g",
    "--episodes",
    "6",
    "--seeds",
    "0",
    "--workers",
    "1",
    "--quiet",
)
BUILD = ("dataset", "build", "parking-exit", "--episodes", "2", "--seed", "100", "--workers", "1")
TIMES = ("name", "created", "command")


@given(st.integers(1, 50), st.lists(st.integers(), max_size=60))
def test_shards_are_all_of_it_in_order_and_of_about_one_size(of: int, items: list[int]) -> None:
    if of > len(items):
        with pytest.raises(UserError, match=rf"give {len(items)} shards? or fewer$"):
            Shard(1, of).part(items)
        return
    parts = [Shard(n, of).part(items) for n in range(1, of + 1)]
    assert [item for part in parts for item in part] == items
    assert {len(part) for part in parts} <= {len(items) // of, -(-len(items) // of)}


@pytest.mark.parametrize(
    ("text", "environment", "shard"),
    [
        ("1/1", {}, Shard(1, 1)),
        ("3/16", {"SLURM_ARRAY_TASK_ID": "7"}, Shard(3, 16)),
        ("auto/16", {"SLURM_ARRAY_TASK_ID": "7", "SLURM_ARRAY_TASK_COUNT": "1"}, Shard(7, 16)),
        ("auto/16", {"JOB_COMPLETION_INDEX": "0"}, Shard(1, 16)),
        ("auto/16", {"JOB_COMPLETION_INDEX": "15"}, Shard(16, 16)),
    ],
)
def test_a_shard_is_typed_or_is_that_of_a_jobs_task(
    text: str, environment: Mapping[str, str], shard: Shard
) -> None:
    assert shard_of(text, environment) == shard


@pytest.mark.parametrize(
    ("text", "environment", "said"),
    [
        ("0/2", {}, "--shard 0/2: give 1/N to N/N"),
        ("3/2", {}, "give 1/N to N/N"),
        ("1", {}, "give 1/N to N/N"),
        ("-1/2", {}, "give 1/N to N/N"),
        ("1/2/3", {}, "give 1/N to N/N"),
        ("1/\x1b", {}, "give 1/N to N/N"),
        ("1/" + "9" * 5000, {}, "give 1/N to N/N"),
        ("auto", {"SLURM_ARRAY_TASK_ID": "1"}, "give 1/N to N/N"),
        ("auto/4", {}, "neither SLURM_ARRAY_TASK_ID nor JOB_COMPLETION_INDEX is set"),
        (
            "auto/4",
            {"SLURM_ARRAY_TASK_ID": "0"},
            r"--shard 0/4 \(SLURM_ARRAY_TASK_ID is 0\): give 1/N to N/N",
        ),
        ("auto/4", {"JOB_COMPLETION_INDEX": "4"}, r"--shard 5/4 \(JOB_COMPLETION_INDEX is 4\)"),
        ("auto/4", {"SLURM_ARRAY_TASK_ID": "x\x1b["}, "give 1/N to N/N"),
    ],
)
def test_what_is_no_shard_is_one_line(text: str, environment: Mapping[str, str], said: str) -> None:
    with pytest.raises(UserError, match=said) as raised:
        shard_of(text, environment)
    assert str(raised.value).isprintable()


@pytest.fixture(scope="module", autouse=True)
def _two_at_once() -> Iterator[None]:
    """Six episodes are three parts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("harness.evaluate.run.EPISODES_AT_ONCE", 2)
        yield


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a whole run, and the same in three shards."""
    from typer.main import get_command

    from harness.cli import app

    place = tmp_path_factory.mktemp("split")
    program = get_command(app)
    program([*DRIVE, "--out", str(place / "whole")], standalone_mode=False)
    for n in (1, 2, 3):
        program([*DRIVE, "--shard", f"{n}/3", "--out", str(place / str(n))], standalone_mode=False)
    return place


def copied(split: Path, to: Path, *names: str) -> list[Path]:
    for name in names:
        shutil.copytree(split / name, to / name)
    return [to / name for name in names]


@pytest.mark.slow
def test_merged_shards_are_the_run_that_was_not_split(
    split: Path, harness: Typed, tmp_path: Path
) -> None:
    shards = copied(split, tmp_path, "2", "3", "1")
    assert harness("run", "merge", *shards, "--out", "merged", "--quiet") == (0, "", "")
    whole, merged = split / "whole", tmp_path / "merged"
    for name in FILES:
        assert (merged / name).read_bytes() == (whole / name).read_bytes(), name
    ours, theirs = (json.loads((run / "run.json").read_text()) for run in (merged, whole))
    assert {k: v for k, v in ours.items() if k not in TIMES} == {
        k: v for k, v in theirs.items() if k not in TIMES
    }
    assert shlex.split(ours["command"])[:-1] == shlex.split(theirs["command"])[:-1]
    written = {*FILES, "run.json", "run.toml", "report.html", "sources"}
    assert {path.name for path in merged.iterdir()} == written
    assert read_sources(merged) == read_sources(whole) != {}
    code, _, said = harness("run", "merge", *shards, "--out", "merged")
    assert (code, "already holds a finished run" in said) == (2, True)
    (merged / ".work").mkdir()  # killed while it tidied up, or somebody else's
    change(merged, decision=lambda row: row.update(latency_ms=1.0))
    assert harness("run", "merge", *shards, "--out", "merged", "--quiet") == (0, "", "")
    assert not (merged / ".work").exists()
    for name in FILES:
        assert (merged / name).read_bytes() == (whole / name).read_bytes(), name


def test_a_shard_says_what_to_do_with_it_and_goes_on(
    split: Path, harness: Typed, tmp_path: Path
) -> None:
    [shard] = copied(split, tmp_path, "2")
    code, out, _ = harness(*DRIVE[:-1], "--shard", "2/3", "--out", shard)
    assert code == 0
    assert out == (
        f"wrote {shard}: 2 of 6 episodes, shard 2/3; merge all 3 shards with "
        "`harness run merge FOLDER... --out FOLDER`\n"
    )
    for typed in (("report", shard), ("compare", shard, shard), ("run", "check", shard)):
        code, out, said = harness(*typed)
        assert (code, out) == (2, "")
        assert "is a shard of a run; `harness run merge` makes one of all its shards" in said
    for other in (["--shard", "1/3"], []):
        code, _, said = harness(*DRIVE, *other, "--out", shard)
        assert (code, "was begun with another shard;" in said) == (2, True)


def refused(harness: Typed, shards: list[Path]) -> str:
    """What is said where these are merged: one line, and nothing is made."""
    code, out, said = harness("run", "merge", *shards, "--out", "refused")
    assert (code, out, said.count("\n")) == (2, "", 1)
    assert not Path("refused").exists()
    return said


def test_gaps_are_refused(split: Path, harness: Typed, tmp_path: Path) -> None:
    shards = copied(split, tmp_path, "1", "2", "3")
    assert "shards 2/3 are missing; give the folders of all 3" in refused(
        harness, [shards[0], shards[2]]
    )
    shutil.rmtree(next((shards[1] / ".work").glob("episodes-*")))
    said = refused(harness, shards)
    assert re.search(r"/2, shard 2/3, lacks episodes 2 to 3; type its command again", said)
    config = shards[1] / ".work/config.json"  # as if it were to be all of the run
    config.write_text(json.dumps({**json.loads(config.read_text()), "shard": "1/1"}))
    assert "/2, shard 1/1, lacks episodes 0 to 1 and 2 parts more; type" in refused(
        harness, shards[1:2]
    )


@pytest.mark.slow
def test_a_broken_shard_is_named_by_its_own_folder_and_mended(
    split: Path, harness: Typed, tmp_path: Path
) -> None:
    shards = copied(split, tmp_path, "1", "2", "3")
    file = next((shards[1] / ".work").glob("episodes-*")) / "episodes.csv"
    text = file.read_text()
    file.write_text("x\0y")
    typed = ("run", "merge", *shards, "--out", "merged", "--quiet")
    code, _, said = harness(*typed)
    assert (code, said.count("\n")) == (2, 1)
    assert said.startswith(
        f"harness: {shards[1]}/.work/episodes-000002-000003 is broken (CSV parse"
    )
    file.write_text(text)
    assert harness(*typed) == (0, "", "")
    assert (tmp_path / "merged/episodes.csv").read_bytes() == (
        split / "whole/episodes.csv"
    ).read_bytes()


@pytest.mark.slow
def test_the_same_shard_twice_is_taken_where_its_bytes_agree(
    split: Path, harness: Typed, tmp_path: Path
) -> None:
    shards = copied(split, tmp_path, "1", "2", "3")
    shutil.copytree(shards[1], tmp_path / "again")
    file = tmp_path / "again/.work/episodes-000002-000003/episodes.csv"
    text = file.read_text()
    file.write_text(text.replace("collision", "time_out"))
    assert re.search(
        r"episodes 2 to 3 came out differently in \S*/again than in \S*/2; find out which is right",
        refused(harness, [*shards, tmp_path / "again"]),
    )
    file.write_text(text)
    assert (
        harness("run", "merge", *shards, tmp_path / "again", "--out", "merged", "--quiet")[0] == 0
    )
    assert (tmp_path / "merged/answers.jsonl").read_bytes() == (
        split / "whole/answers.jsonl"
    ).read_bytes()


def test_shards_of_other_runs_are_refused(split: Path, harness: Typed, tmp_path: Path) -> None:
    shards = copied(split, tmp_path, "1", "2", "3")
    config = shards[2] / ".work/config.json"
    stated = json.loads(config.read_text())

    def said(**changed: object) -> str:
        config.write_text(json.dumps({**stated, **changed}))
        return refused(harness, shards)

    assert "differ in seeds; give shards of one run" in said(
        settings={**stated["settings"], "seeds": [1]}
    )
    assert "differ in model;" in said(identity={"engine": "another"})
    assert "differ in version of numpy;" in said(versions={**stated["versions"], "numpy": "1.0"})
    assert "shards of 3 and of 4" in said(shard="4/4")
    assert "--shard 9/3" in said(shard="9/3")
    assert "is no shard; give folders made with --shard" in said(shard="")
    config.write_text("{")
    assert "is no shard" in refused(harness, shards)
    assert "is no shard" in refused(harness, [split / "whole"])
    assert "is no folder; give those of all shards" in refused(harness, [split / "nowhere"])


@pytest.mark.slow
def test_shards_that_are_forged_alike_are_refused_in_one_line_and_nothing_is_made(
    split: Path, harness: Typed, tmp_path: Path
) -> None:
    shards = copied(split, tmp_path, "1", "2", "3")
    configs = [shard / ".work/config.json" for shard in shards]
    stated = [json.loads(config.read_text()) for config in configs]
    for forged in (
        {"conditions": 5}, {"model": None}, {"seeds": "zork"}, {"world": []}, {"letters": 5},
        {"actions": []}, {"batch_size": {}}, {"seeds": [5]},
    ):  # fmt: skip
        for config, each in zip(configs, stated, strict=True):
            settings = {**each["settings"], **forged}
            config.write_text(json.dumps({**each, "settings": settings}))
        said = refused(harness, shards)
        assert "hold no parts of one whole (" in said or "is no shard; give folders" in said
    for config, each in zip(configs, stated, strict=True):
        world = each["settings"]["world"]
        parameters = {**world["scenario"]["parameters"], "zork": 1}
        scenario = {**world["scenario"], "parameters": parameters}
        settings = {**each["settings"], "world": {**world, "scenario": scenario}}
        config.write_text(json.dumps({**each, "settings": settings}))
    assert "has other parameters here (not zork)" in refused(harness, shards)
    for config, each in zip(configs, stated, strict=True):
        config.write_text(json.dumps(each))
    part, other = (next((shard / ".work").glob("episodes-*")) for shard in shards[:2])
    for file in ("answers.jsonl", "episodes.csv", "decisions.parquet"):
        own = (part / file).read_bytes()
        shutil.copy(other / file, part / file)
        assert "hold no parts of one whole (" in refused(harness, shards)
        (part / file).write_bytes(own)


@pytest.mark.parametrize(
    "place", [".work", ".work/sources", ".work/sources/prompts", ".work/episodes-000002-000003"]
)
def test_no_link_in_a_shard_is_followed(
    place: str, split: Path, harness: Typed, tmp_path: Path
) -> None:
    shards = copied(split, tmp_path, "1", "2", "3")
    (shards[1] / place).rename(tmp_path / "secret")
    (shards[1] / place).symlink_to(tmp_path / "secret")
    assert f"/2/{place} is a link; put the file itself there, or delete it" in refused(
        harness, shards
    )


@pytest.mark.slow
def test_a_merged_run_has_the_command_of_its_settings(
    split: Path, harness: Typed, tmp_path: Path
) -> None:
    shards = copied(split, tmp_path, "1", "2", "3")
    config = shards[0] / ".work/config.json"
    stated = json.loads(config.read_text())
    config.write_text(json.dumps({**stated, "command": ["harness", "drive", "--model", "brake"]}))
    assert harness("run", "merge", *shards, "--out", "merged", "--quiet")[0] == 0
    command = json.loads((tmp_path / "merged/run.json").read_text())["command"]
    assert shlex.split(command)[:-2] == stated["command"]
    assert (tmp_path / "merged/run.toml").read_text() == (split / "whole/run.toml").read_text()


def test_a_shard_with_another_text_of_its_prompt_is_named(
    split: Path, harness: Typed, tmp_path: Path
) -> None:
    shards = copied(split, tmp_path, "1", "2", "3")
    [file] = (shards[1] / ".work/sources/prompts").glob("*/ego.j2")
    file.write_text(file.read_text() + " Always go.")
    said = f"/2: sources/prompts/{file.parent.name} has another digest than prompt "
    assert said in refused(harness, shards)


def test_who_is_still_writing_is_waited_for(split: Path, harness: Typed, tmp_path: Path) -> None:
    shards = copied(split, tmp_path, "1", "2", "3")
    with alone(shards[0] / ".work/lock"):
        assert "/1 is being written by another process; wait for it" in refused(harness, shards)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--shard", "1/4", "--out", "shard"), "the work has 3 parts; give 3 shards or fewer, or --episodes 7 or more, 2 of which"),
        (("--shard", "1/3"), "--shard 1/3: give --out with a folder for this shard alone"),
        (("--shard", "1/3", "--out", "shard", "--latency", "measured", "--model", "swarm-tiny"),
         "--latency measured is of one machine"),
    ],
)  # fmt: skip
def test_what_no_shard_can_be(options: tuple[str, ...], said: str, harness: Typed) -> None:
    code, _, err = harness(*DRIVE, *options)
    assert (code, said in err, err.count("\n")) == (2, True, 1)
    assert not Path("shard").exists()


@pytest.mark.exhaustive
def test_a_dataset_of_shards_is_the_one_that_was_not_split(harness: Typed, tmp_path: Path) -> None:
    assert harness(*BUILD, "--out", "whole/small")[0] == 0
    for n in ("1", "2"):
        code, out, _ = harness(*BUILD, "--shard", f"{n}/2", "--out", f"shard-{n}")
        assert (code, out.startswith(f"wrote shard-{n}: 1 of 2 layouts, shard {n}/2;")) == (0, True)
    assert "shards 2/2 are missing" in refused(harness, [Path("shard-1")])
    assert "differ in " in refused(harness, [Path("shard-1"), *_of_another_seed(tmp_path)])
    code, out, _ = harness("run", "merge", "shard-2", "shard-1", "--out", "merged/small")
    assert (code, out.startswith("wrote merged/small: 2 layouts, ")) == (0, True)
    whole, merged = tmp_path / "whole/small", tmp_path / "merged/small"
    assert {path.name for path in merged.iterdir()} == {path.name for path in whole.iterdir()}
    for file in whole.iterdir():
        assert (merged / file.name).read_bytes() == file.read_bytes(), file.name


def _of_another_seed(tmp_path: Path) -> list[Path]:
    other = tmp_path / "other"
    shutil.copytree(tmp_path / "shard-2", other)
    config = other / ".work/config.json"
    stated = json.loads(config.read_text())
    config.write_text(json.dumps({**stated, "settings": {**stated["settings"], "seed": 7}}))
    return [other]
