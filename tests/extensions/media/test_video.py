"""A driven episode, played again and drawn."""

import shutil
import sys
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from evaluating import live_spec_of, run
from former import DRIVE
from PIL import Image, ImageSequence
from run_on_disk import made_up
from typer.testing import CliRunner

from harness.cli import app, main
from harness.coordination.named_points import named_point
from harness.core import extras
from harness.core.errors import UserError
from harness.evaluate.live_world import LiveSource
from harness.extensions.media.stills import find, stills
from harness.extensions.media.video import write_video
from harness.runs import folder

RECORDS = Path(__file__).parents[2] / "records"
FROM_LEFT = 6  # a layout seed with a danger


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("driven") / "run"
    run(live_spec_of("cruise", episodes=3, first_seed=FROM_LEFT), folder)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.exhaustive), 7])
def test_an_episode_played_again_ends_as_it_did(out, every):
    """Every seventh row is of another layout and condition."""
    row: Any
    for row in pd.read_csv(out / "episodes.csv", keep_default_na=False)[::every].itertuples():
        seen = list(stills(find(out, row.episode, row.condition, row.seed)))
        assert seen[-1].state.time_s == row.time_s
        # Who clears it, late or not, clears it in the played world.
        how = "cleared" if row.failure in ("", "late") else row.failure
        assert seen[-1].outcome.startswith(how.replace("_", " "))
        assert [s.outcome for s in seen[:-1]] == [""] * (len(seen) - 1)


def test_thinking_is_seen_frame_by_frame_and_the_rest_ten_times_a_second(out):
    seen = list(stills(find(out, 0, "single-local", 0)))
    times = [s.state.time_s for s in seen if 1.0 <= s.state.time_s < 2.0]
    assert times[:9] == pytest.approx([1.0 + 0.02 * n for n in range(9)])  # 145 ms are 8 frames
    assert max(b - a for a, b in pairwise(times)) == pytest.approx(0.1)
    assert [next(iter(s.turns.values())).open for s in seen[:9]] == [True] * 8 + [False]


def typed(monkeypatch, capsys, *words):
    """A command line: its exit code, stdout and stderr."""
    monkeypatch.setattr(sys, "argv", ["harness", *map(str, words)])
    with pytest.raises(SystemExit) as end:
        main()
    return end.value.code or 0, *capsys.readouterr()


@pytest.fixture(scope="module")
def short(out, tmp_path_factory):
    """The run, as if the time had been up after a decision: a dozen stills an episode."""
    copy = shutil.copytree(out, tmp_path_factory.mktemp("short") / "run")
    file = copy / "run.json"
    file.write_text(file.read_text().replace('"time_limit_s": 10.0', '"time_limit_s": 0.4'))
    assert 8 < len(list(stills(find(copy, 0, None, None)))) < 16
    return copy


@pytest.fixture(scope="module")
def drawn(short, tmp_path_factory):
    """A GIF of its first episode by the command, and what that said."""
    return gif_of(short, tmp_path_factory.mktemp("drawn") / "episode.gif")


def gif_of(run, picture):
    done = CliRunner().invoke(app, ["run", "video", str(run), "0", "--out", str(picture)])
    return picture, (done.exit_code, done.stdout, done.stderr)


@pytest.mark.slow
def test_an_episode_is_drawn_as_a_gif_in_which_things_move(short, drawn):
    things_move(short, *drawn)


@pytest.mark.exhaustive
def test_an_episode_is_drawn_to_its_end(out, tmp_path):
    things_move(out, *gif_of(out, tmp_path / "episode.gif"))


def things_move(run, picture, said):
    assert said[:2] == (0, f"wrote {picture}\n")
    seen = list(stills(find(run, 0, None, None)))
    with Image.open(picture) as image:
        frames = [frame.convert("RGB").tobytes() for frame in ImageSequence.Iterator(image)]
    assert len(frames) == len(seen)
    assert sum(a != b for a, b in pairwise(frames)) == len(frames) - 1


@pytest.mark.slow
def test_an_episode_is_drawn_as_an_mp4_that_lasts_as_long(short, tmp_path, monkeypatch, capsys):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs the video extra")
    film = tmp_path / "episode.mp4"
    assert typed(monkeypatch, capsys, "run", "video", short, 0, "--out", film)[:2] == (
        0,
        f"wrote {film}\n",
    )
    assert film.read_bytes()[4:8] == b"ftyp"
    expected = 0.1 * len(list(stills(find(short, 0, None, None)))) + 2.4  # the last still stays
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(film))
    assert (frames, seconds) == (round(10 * expected), pytest.approx(expected, abs=0.11))
    assert [p.name for p in tmp_path.iterdir()] == ["episode.mp4"]


@pytest.mark.exhaustive
def test_the_same_episode_gives_the_same_gif(short, drawn, tmp_path):
    write_video(find(short, 0, None, None), tmp_path / "again.gif", lambda done: None)
    assert (tmp_path / "again.gif").read_bytes() == drawn[0].read_bytes()


def test_a_file_that_cannot_be_written_is_refused_before_anything_is_drawn(
    out, tmp_path, monkeypatch, capsys
):
    (tmp_path / "folder.gif").mkdir()
    for name, says in (
        ("x.avi", "end it in .gif or .mp4"),
        ("folder.gif", "is a folder; name a file in it"),
        (
            "x.mp4",
            ".mp4 needs imageio-ffmpeg, which is not installed; run `pip install "
            "'swarmdrive-harness[",
        ),
    ):
        if name == "x.mp4":
            monkeypatch.setattr(extras, "find_spec", lambda name: None)
        code, said, error = typed(
            monkeypatch, capsys, "run", "video", out, 0, "--out", tmp_path / name
        )
        assert (code, said, error.count("\n")) == (2, "", 1)
        assert says in error
    assert [p.name for p in tmp_path.iterdir()] == ["folder.gif"]


@pytest.mark.slow
def test_a_run_ends_with_videos_of_its_first_failures(tmp_path, monkeypatch, capsys):
    pytest.importorskip("imageio_ffmpeg", reason="needs the video extra")
    # How each is drawn to its end is tested apart.
    monkeypatch.setattr(
        "harness.extensions.media.video.stills", lambda played: islice(stills(played), 2)
    )
    words = ("--model", "cruise", "--condition", "single-local", "--seeds", "0,1", "--workers", 1)
    layouts = ("--episodes", 4, "--first-seed", FROM_LEFT - 1)
    out = tmp_path / "run"
    code, said, _ = typed(
        monkeypatch, capsys, *DRIVE, *words, *layouts, "--save-video", 1, "--out", out
    )
    table = pd.read_csv(out / "episodes.csv")
    first = table[~table.success].episode.min()
    name = f"{first:05d}-seed0.mp4"
    assert code == 0
    wrote = [line for line in said.splitlines() if line.startswith("wrote ")]
    assert wrote == [f"wrote {out / 'videos'}: {name}", f"wrote {out / 'report.html'}"]
    assert [p.name for p in (out / "videos").iterdir()] == [name]


def test_what_is_not_there_is_told_in_one_line(out, tmp_path):
    for arguments, says in (
        ((out, 3, None, None), "episode 3 is not in .*; give one of 0, 1, 2$"),
        ((out, 0, "5g", None), "unknown condition '5g'"),
        ((out, 0, None, 9), "unknown seed '9'"),
        ((tmp_path, 0, None, None), "is no finished run.* or `harness drive`"),
    ):
        with pytest.raises(UserError, match=says):
            find(*arguments)
    with pytest.raises(
        UserError, match=r"was made by `harness eval`; give a folder made by `harness drive`"
    ):
        find(made_up(tmp_path / "frozen"), 0, None, None)


@pytest.mark.slow
@pytest.mark.parametrize(
    "commit", [path.name for path in RECORDS.glob("*") if (path / "drive").is_dir()]
)
def test_an_old_episode_played_again_ends_as_it_did(commit):
    """Its record lacks the parameters that came later."""
    there = folder.read(RECORDS / commit / "drive")
    *_, last = stills(find(there.path, 0, "single-local", 0))
    [row] = [
        e for e in there.episodes if (e.episode, e.condition, e.seed) == (0, "single-local", 0)
    ]
    assert last.outcome.startswith(f"{row.failure or 'cleared'} at {row.time_s:.1f} s")


@pytest.mark.exhaustive
def test_an_episode_of_agents_played_again_ends_as_it_did(tmp_path):
    spec = live_spec_of(
        prompt="v4",
        points=(named_point("single-local"),),
        seeds=(0,),
        latency="ego=1.3,helper=1.3,fusion=0",
    )
    source = LiveSource(50_000, 2, "all-way-crossing:agent_share=1")
    there = folder.read(run(replace(spec, source=source), tmp_path / "run").out)
    for e in there.episodes:
        *_, last = stills(find(there.path, e.episode, e.condition, e.seed))
        ended = {agent: turn.outcome for agent, turn in last.turns.items()}
        assert sum(said.startswith("cleared") for said in ended.values()) == e.arrived
        if not e.success:
            how, partner = e.failure.replace("_", " "), f" with {e.partner}" if e.partner else ""
            [worst] = {said for agent, said in ended.items() if last.outcome == f"{agent}: {said}"}
            assert worst == f"{how} at {e.time_s:.1f} s{partner}"


@pytest.mark.exhaustive
def test_an_old_run_is_drawn(harness):
    code, _, error = harness("run", "video", RECORDS / "356ad2b/drive", "0", "--out", "episode.gif")
    assert code == 0, error


@pytest.mark.parametrize("commit", sorted(path.parent.name for path in RECORDS.glob("*/proxy")))
def test_a_run_of_frozen_scenes_is_no_film(commit, harness):
    code, _, error = harness("run", "video", RECORDS / commit / "proxy", "0")
    assert (code, error.count("\n")) == (2, 1)
    assert "give a folder made by `harness drive`" in error


def test_more_videos_than_episodes_are_refused(harness, tmp_path):
    code, out, error = harness(
        "drive", "--episodes", 3, "--save-video", 4, "--out", tmp_path / "run"
    )
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert "--save-video 4 is out of range; give 0 to 3" in error
    assert not (tmp_path / "run").exists()


def test_without_what_draws_them_no_videos_are_promised(harness, tmp_path, monkeypatch):
    monkeypatch.setattr("harness.cli.drive.VIDEOS", {})
    code, out, error = harness(
        "drive", "--episodes", 3, "--save-video", 1, "--out", tmp_path / "run"
    )
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert "--save-video: no extension that is installed draws videos" in error
    assert not (tmp_path / "run").exists()
