"""Which episodes are evaluated or driven: by number, by danger, drawn; and that a run says so."""

import json
import shlex
import shutil
from collections.abc import Callable
from html import unescape
from pathlib import Path
from typing import Any

import pytest
from evaluating import same_decisions
from former import DRIVE
from hypothesis import given
from hypothesis import strategies as st
from msgspec import to_builtins
from msgspec.structs import replace
from run_on_disk import digested, restated

from harness.core import resources
from harness.core.errors import UserError
from harness.dataset import select
from harness.dataset.load import Dataset, load
from harness.evaluate.resolve import driven, frozen
from harness.evaluate.run import _chunks_of
from harness.extensions.selection.episodes import SELECTION
from harness.runs import folder
from harness.runs.settings import DriveSettings, FrozenSettings, Settings, changed, read

Typed = Callable[..., tuple[int, str, str]]
LIVE = Settings(world=DriveSettings())


@pytest.fixture(scope="module")
def shipped() -> Dataset:
    return load(resources.folder("datasets") / resources.DATASET, 60)


def chosen(dataset: Dataset, **settings: Any) -> tuple[int, ...]:
    selection = SELECTION.opened(settings)
    assert selection
    return selection.choice(dataset.episodes, dataset).numbers


def test_numbers_ranges_and_dangers_are_joined(shipped: Dataset) -> None:
    assert SELECTION.opened({"sample_seed": 3, "doubt_above": 0.5}) is None
    assert chosen(shipped, only="59,3,10:13") == (3, 10, 11, 12, 59)
    of = {tree.episode: tree.danger.sector for tree in shipped.trees}
    left = tuple(n for n in of if of[n] == "left")
    assert left
    assert chosen(shipped, danger="left") == left
    some = chosen(shipped, danger="none", only="0:30")
    assert some == tuple(n for n in range(30) if of[n] is None)


def test_the_first_are_of_those_that_are_left(small: Dataset) -> None:
    settings = changed(Settings(), {"limit": 1, "only": "1:3", "sample": 2})
    source = frozen(settings, str(small.path))
    assert source.dataset.episodes == (1,)
    assert source.choice == select.Choice(
        (1, 2), (1, 2), {"only": "1:3", "sample": 2, "sample_seed": 0}
    )


@given(st.integers(0, 50), st.integers(1, 59))
def test_a_larger_sample_has_the_smaller_in_it(shipped: Dataset, seed: int, size: int) -> None:
    small, large = (set(chosen(shipped, sample=n, sample_seed=seed)) for n in (size, size + 1))
    assert small < large
    assert len(small) == size


def test_a_seed_draws_what_another_does_not_and_what_it_always_drew(shipped: Dataset) -> None:
    assert len({chosen(shipped, sample=10, sample_seed=seed) for seed in range(5)}) == 5
    layouts = driven(changed(LIVE, {"episodes": 60, "sample": 10, "sample_seed": 3}))
    drawn = (0, 2, 4, 10, 14, 19, 30, 32, 45, 47)
    assert tuple(layouts.numbers) == chosen(shipped, sample=10, sample_seed=3) == drawn
    record = to_builtins(layouts.record())
    assert record["selection"] == {"of": 60, "sample": 10, "sample_seed": 3}
    assert _chunks_of({"world": record, "batch_size": 8}) == [drawn]


@pytest.mark.slow
def test_a_run_says_which_and_its_command_and_file_select_them_again(harness: Typed) -> None:
    words = "--danger left --sample 2 --sample-seed 7 --condition 6g --seeds 3:4"
    code, out, _ = harness("eval", *words.split(), "--out", "a")
    assert code == 0
    assert "n = 2 episodes × 1 channel seed; of layout seeds 200000 to 200199 (report)\n" in out
    made = json.loads(Path("a/run.json").read_text())
    assert made["world"]["selection"] == {"danger": "left", "sample": 2, "sample_seed": 7}
    stated = made["settings"]["world"]
    assert list(stated)[2:7] == ["limit", "only", "danger", "sample", "sample_seed"]
    assert list(stated.values())[2:7] == [None, None, "left", 2, 7]
    again = shlex.split(made["command"])
    again[again.index("a")] = "b"
    assert harness(*again[1:])[0] == 0
    assert harness("eval", "a", "--quiet", "--out", "c") == (0, "", "")
    for run in ("b", "c"):
        assert same_decisions(Path("a"), Path(run))
    assert harness("run", "check", "a")[0] == 0
    stated["sample_seed"] = 0
    Path("a/run.json").write_text(json.dumps(made))
    code, _, error = harness("run", "check", "a")
    assert (code, error.count("\n")) == (2, 1)
    assert "its settings have world.sample_seed 0, and beside them it is 7" in error


@pytest.mark.slow
def test_what_was_chosen_by_more_than_chance_is_said_and_passes_no_gate(
    harness: Typed, small_path: Path
) -> None:
    for name, *choice in (
        ("whole",),
        ("some", "--only", "0:3"),
        ("fewer", "--only", "0:3", "--sample", "2"),
        ("sample", "--sample", "2"),
        ("sought", "--sample", "2", "--sample-seed", "3"),
        ("first", "--limit", "2"),
    ):
        words = ("--dataset", small_path, "--seeds", "0:1", "--condition", "single-local")
        code, out, _ = harness("eval", *words, *choice, "--out", f"runs/{name}")
        said = "The episodes were chosen by --only 0:3: figures and intervals are of such alone."
        is_said = said in " ".join(out.split())
        assert (code, is_said) == (0, "--only" in choice)
        assert (said in unescape(Path(f"runs/{name}/report.html").read_text())) == is_said
    assert harness("run", "ls", "runs")[1].count("of episodes chosen by --only 0:3") == 2
    gate, by = ("--fail-if", "success_rate < -0.5"), "--only 0:3"
    for a, b, lacks, n in (
        ("whole", "some", "B", "1 episode"),
        ("some", "whole", "A", "1 episode"),
        ("whole", "fewer", "B", "2 episodes"),
        ("some", "fewer", "", ""),
        ("whole", "sample", "", ""),
        ("first", "some", "", ""),
        ("whole", "sought", "B", "2 episodes"),
    ):
        by = "--sample 2 --sample-seed 3" if b == "sought" else by
        code, out, error = harness("compare", f"runs/{a}", f"runs/{b}", *gate)
        refused = f"success_rate < -0.5': {lacks} lacks {n} of the other run by {by}, "
        assert (code, out == "", refused in error) == (
            (2, True, True) if lacks else (0, False, False)
        )
    shutil.copytree("runs/some", "runs/forged")
    record = json.loads(Path("runs/forged/run.json").read_text())
    world = {**record["world"], "selection": {}}
    Path("runs/forged/run.json").write_text(json.dumps(restated(record, {"world": world})))
    digested(Path("runs/forged"))
    code, out, error = harness("compare", "runs/whole", "runs/forged", *gate)
    assert (code, out) == (2, "")
    assert "runs/forged: episodes.csv has other episodes than run.json says" in error
    out = harness("compare", "runs/whole", "runs/some")[1]
    assert "A has 1 more episode, left out of B by --only 0:3;" in " ".join(out.split())


@pytest.mark.exhaustive
def test_a_sample_is_of_the_layouts_that_eval_draws_and_its_run_is_read_as_any(
    harness: Typed, small_path: Path
) -> None:
    draw = ["--sample", "2", "--sample-seed", "3", "--seeds", "0:1", "--condition", "6g"]
    layouts = json.loads((small_path / "manifest.json").read_text())
    of = ("--episodes", str(layouts["episodes"]), "--first-seed", str(layouts["seed"]))
    code, out, err = harness(*DRIVE, *draw, *of, "--workers", "1", "--out", "run")
    assert (code, err) == (0, "")
    assert f"n = 2 episodes × 1 channel seed; of layout seeds {layouts['seed']} to" in out
    assert harness("eval", "--dataset", small_path, *draw, "--out", "frozen")[0] == 0
    live, walked = (folder.read(Path(path)) for path in ("run", "frozen"))
    assert live.grid.episodes == walked.grid.episodes
    assert [e.layout_seed for e in live.episodes] == [e.layout_seed for e in walked.episodes]
    assert " --sample 2 --sample-seed 3 " in live.manifest.command
    assert harness("study", "fidelity", "run", "frozen", "--out", "fidelity")[0] == 0
    code, _, err = harness("drive", *draw, *of, "--sample-seed", "4", "--out", "run")
    assert (code, "already holds a finished run" in err) == (2, True)


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("eval --danger up", "unknown --danger 'up'; known: left, none, oncoming, right"),
        ("eval --only 3:9999", "--only 3:9999: give episodes from 0 to 3, such as 3,10:20"),
        ("eval --sample 201", "--sample 201: give 1 to 4 episodes"),
        ("eval --sample 0", "--sample 0: give 1 to 4 episodes"),
        ("eval --only 0 --danger none", "--only 0, --danger none: no episode of small matches; "),
        ("eval --sample 1 --sample-seed -1", "--sample-seed -1 is out of range; give 0 to 2147483"),
        ("drive --sample-seed 2147483648", "--sample-seed 2147483648 is out of range; give 0 to 2"),
        ("drive --episodes 3 --sample 4", "--sample 4: give 1 to 3 episodes"),
        ("drive --sample 0", "give 1 to 200 episodes"),
        ("drive --scenario parking-exit --sample 0", "give 1 to 100 episodes"),
        ("drive --until-width 4 --sample 3", "--sample 3: a run that stops takes layouts"),
        ("drive --danger left", "No such option: --danger"),
        ("drive stated.toml", "settings stated.toml: only is no setting of `harness drive`; leave"),
    ],
)
def test_bad_input_is_one_line(harness: Typed, typed: str, said: str, small_path: Path) -> None:
    Path("stated.toml").write_text('[world]\nonly = "3"\n')
    command, *words = typed.split()
    of = ("--dataset", small_path) if command == "eval" else ()
    code, out, error = harness(command, *of, *words)
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert said in error


def test_what_a_run_states_is_held_to_its_types() -> None:
    """As a stranger may have written it."""
    for stated, said in (
        ({"sample": "two"}, "selection of episodes: sample = 'two'; allowed: a whole number"),
        ({"of": 9}, "a run says that its episodes were selected by of, as nothing does"),
    ):
        with pytest.raises(UserError, match=f"^{said}"):
            select.recorded(stated)
    with pytest.raises(UserError, match=r"^--danger left: where a layout's danger comes from"):
        driven(replace(LIVE, extensions={"danger": "left"}))


def test_a_file_may_select_in_both_worlds(tmp_path: Path) -> None:
    file = tmp_path / "stated.toml"
    file.write_text("[world]\nsample = 2\nsample_seed = 0\n")
    for world in (FrozenSettings, DriveSettings):
        settings = read(file, world, {})
        assert (settings.world, settings.extensions) == (world(), {"sample": 2})
    assert read(file, FrozenSettings, {"sample": 3}).extensions == {"sample": 3}
    file.write_text("[world]\nsample_seed = 5\n")
    assert read(file, FrozenSettings, {"sample_seed": 0}).extensions == {}
    file.write_text("sample-seed = 2")
    with pytest.raises(
        UserError,
        match=r"sample-seed stands in a table; write sample_seed below a line \[world\] instead$",
    ):
        read(file, FrozenSettings, {})


@pytest.mark.slow
@pytest.mark.parametrize(
    "selection", [{"only": "1:3"}, {"sample": 2, "sample_seed": 1}, {"danger": "left"}]
)
def test_nothing_is_learnt_from_a_run_whose_episodes_are_others_than_it_states(
    selection: dict[str, Any], proxy_run: Path, small_path: Path, harness: Typed, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(proxy_run, tmp_path / "run"))
    record = json.loads((run / "run.json").read_text())
    world = {**record["world"], "selection": selection}
    (run / "run.json").write_text(json.dumps(restated(record, {"world": world})))
    digested(run)
    said = "run: episodes.csv has other episodes than run.json says that were selected; make"
    for typed in (
        "study promise run --tune run --condition 6g --at-most 50",
        f"model calibrate run --dataset {small_path} --out c.toml",
        f"run export run --sft sft.jsonl --dataset {small_path}",
    ):
        code, _, error = harness(*typed.split())
        assert (code, error.count("\n"), said in error) == (2, 1, True), error
