"""What a recording states is what its tables give, whoever edited it."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.core.errors import UserError
from harness.core.files import sha256_file
from harness.extensions.roads import family, tables
from harness.extensions.roads.by_digest import DIGITS
from harness.extensions.roads.scene import Lane, Scene, Track
from harness.extensions.roads.tables import Moment

Edit = Callable[[dict[str, Any]], object]


def column() -> Scene:
    """Return two cars that follow each other at 10 m/s for 16 s, and one that stands for 40 s."""
    times_s = np.arange(0.0, 16.01, 0.1)
    still = np.zeros_like(times_s)
    stands = np.array([[0.0, 90.0, 0.0, 0.0]] * 2)
    tracks = {"q": Track("q", "car", 4.6, 1.8, np.array([0.0, 40.0]), stands)}
    for n in range(2):
        poses = np.stack([100 - 25 * n + 10 * times_s, still, still, still + 10], axis=-1)
        tracks[f"e{n}"] = Track(f"e{n}", "car", 4.6, 1.8, times_s, poses)
    lane = Lane("a", np.array([[0.0, 0.0], [600.0, 0.0]]), 3.5, 14.0, (), None, None)
    return Scene("s", "s.xml", "0" * 64, False, tracks, {"a": lane})


def of_moment(**values: Any) -> Edit:
    """Return an edit of the first moment."""
    return lambda facts: facts["moments"][0].update(values)


EDITS: dict[str, Edit | None] = {
    "": None,
    "e1 at 1 s for report; its tables give tune": of_moment(purpose="report"),
    "e1 at 9 s for tune; its tables give none": of_moment(time_s=9.0),
    "moment s e1 2 s is there twice": of_moment(time_s=2.0),
    "moment s e1 1.37 s begins at no whole second": of_moment(time_s=1.37),
    "e1 at 14 s and until 19 s; that vehicle is there 0 to 16 s": of_moment(time_s=14.0),
    "no\\x1bbody at 1 s, and nobody there is called so": of_moment(vehicle="no\x1bbody"),
    "e1 at 1 s; its hidden road user is not there": of_moment(hidden="e1", conflict_s=1.0),
    "e1 at 1 s; its hidden road user is beyond 80 m": of_moment(hidden="q", conflict_s=1.0),
    "e1 at 1 s with e0 hidden and in conflict after 1 s; its tables give nobody": of_moment(
        hidden="e0", conflict_s=1.0
    ),
    "one of hidden and conflict_s": of_moment(hidden="e0"),
    "decisions 4, and moments of another number": lambda facts: facts.update(
        decisions=4, choice={"horizon_s": 5.0}
    ),
    "other speeds_mps than its tables give: 0, 5, 10": lambda facts: facts.update(
        speeds_mps=[9.9, 10, 10.1]
    ),
    "source has 3000 characters; allowed: 1000": lambda facts: facts.update(source="s" * 3000),
    "licence has 8 characters": lambda facts: facts.update(licence="MIT\n\n# x"),
    "import these again": lambda facts: facts.update(format=tables.FORMER),
    "that scene is s again": of_moment(scene="t"),
    "recording:column@": lambda facts: None,
}


@pytest.mark.parametrize("words", EDITS)
def test_what_a_recording_states_is_held(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(family.FOLDERS, str(tmp_path))
    moments = [Moment("s", "e1", time_s, None, None, "tune") for time_s in (1.0, 2.0)]
    scenes = [column(), replace(column(), name="t", sha256="1" * 64)]
    tables.write(tmp_path, "column", "", "", 80.0, scenes, moments, {})
    facts = json.loads((tmp_path / "recording.json").read_text())
    if edit := EDITS[words]:
        edit(facts)
    (tmp_path / "recording.json").write_text(json.dumps(facts))
    digest = sha256_file(tmp_path / "recording.json")[:DIGITS]
    called = "other\x1b" if words.startswith("recording:") else "column"
    if not words:
        assert family.recording_of(f"recording:column@{digest}").name == "column"
        return
    with pytest.raises(UserError) as refusal:
        family.recording_of(f"recording:{called}@{digest}")
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert str(refusal.value).isprintable()
