"""A driven episode, played again and drawn."""

import json
import sys
from itertools import pairwise

import pandas as pd
import pytest
from driving import FROM_LEFT, spec
from PIL import Image

from harness.cli import main
from harness.drive.replay import find, stills
from harness.drive.run import run
from harness.errors import UserError


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("driven") / "run"
    run(spec(episodes=3, first_seed=FROM_LEFT), folder, False, 1, lambda done: None)
    return folder


def test_an_episode_played_again_ends_as_it_did(out):
    for row in pd.read_csv(out / "episodes.csv", keep_default_na=False).itertuples():
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
    assert [s.open for s in seen[:9]] == [True] * 8 + [False]


@pytest.mark.slow
def test_an_episode_is_drawn_as_a_gif(tmp_path, monkeypatch, capsys):
    run(spec("cruise", seeds=(0,), first_seed=FROM_LEFT), tmp_path / "run", False, 1, lambda done: None)
    picture = tmp_path / "episode.gif"
    monkeypatch.setattr(sys, "argv", ["harness", "video", str(tmp_path / "run"), "0", "--out", str(picture)])
    with pytest.raises(SystemExit) as end:
        main()
    assert not end.value.code
    assert capsys.readouterr().out == f"wrote {picture}\n"
    with Image.open(picture) as image:
        assert image.n_frames == len(list(stills(find(tmp_path / "run", 0, None, None))))


def test_what_is_not_there_is_told_in_one_line(out, tmp_path):
    for arguments, says in (
        ((out, 3, None, None), "give 0 to 2"),
        ((out, 0, "5g", None), "unknown condition '5g'"),
        ((out, 0, None, 9), "unknown seed '9'"),
        ((tmp_path, 0, None, None), "is no run.* made by `harness drive`"),
    ):
        with pytest.raises(UserError, match=says):
            find(*arguments)
    frozen = tmp_path / "frozen"
    frozen.mkdir()
    (frozen / "run.json").write_text(json.dumps({"format": "swarmdrive-run/1"}))
    with pytest.raises(UserError, match=r"has format 'swarmdrive-run/1'.* made by `harness drive`"):
        find(frozen, 0, None, None)
