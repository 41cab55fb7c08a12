"""How this extension's study is tried."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from studied import Once, Trial

from harness.core.progress import Progress
from harness.dataset.build import build
from harness.extensions.roads import family, tables
from harness.extensions.roads.fitness import choose_fit
from harness.extensions.roads.held import horizon_s
from harness.extensions.roads.scene import Lane, Scene, Track
from harness.world import scenarios

TIMES = np.arange(0.0, 16.01, 0.1)
REACTS = {"with": "react=true", "without": "react=false"}


def column() -> Scene:
    """Return a straight road on which three cars follow each other at 10 m/s."""
    ends = np.array([(0.0, 0.0), (600, 0)])
    tracks = {}
    for n in range(3):
        still = np.zeros_like(TIMES)
        poses = np.stack([100 - 25 * n + 10 * TIMES, still, still, still + 10], axis=-1)
        tracks[f"e{n}"] = Track(f"e{n}", "car", 4.6, 1.8, TIMES, poses)
    # who stands far from the road, so long that the first seconds are to tune
    tracks["q"] = Track(
        "q", "car", 4.6, 1.8, np.array([0.0, 40.0]), np.array([[0, 900, 0, 0.0]] * 2)
    )
    lanes = {"a": Lane("a", ends, 3.5, 14.0, (), None, None)}
    return Scene("s", "s.xml", "0" * 64, False, tracks, lanes, ())


def choose(folder: Path) -> None:
    """Give a recording the moments that its rule chooses."""
    recording = tables.read(folder)
    until_s = horizon_s(recording.facts)
    choice = choose_fit(recording, recording.scenes(), until_s, Progress())
    facts = {**choice.record, "horizon_s": until_s}
    tables.chosen(recording, recording.speeds_mps, choice.moments, facts)


def recorded(out: Path) -> None:
    """Make datasets of a recording in which others react, and do not, of two layouts and one."""
    out.mkdir()
    (out / "column").mkdir()
    texts = ("column", "made by hand", "CC0-1.0")
    tables.write(out / "column", *texts, 80.0, [column()], (), {})
    choose(out / "column")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(family.FOLDERS, "")
        name = family.RECORDINGS.named({"recording": str(out / "column")})
        for title, setting in REACTS.items():
            scenario = scenarios.get(family.RECORDINGS.joined(name, [setting]))
            build(scenario, out / title, 2, 0, 1, lambda done: None)
            build(scenario, out / f"{title}-first", 1, 0, 1, lambda done: None)


def lays(here: Path, once: Once) -> None:
    made = once("recorded", recorded)
    for name in REACTS:
        shutil.copytree(made / name, here / name)
        shutil.copytree(made / f"{name}-first", here / f"{name}-first")


TRIALS = {
    "reaction": Trial(
        "study reaction", "with without", "with-first without-first",
        "out holds another reaction, with other sources; name another folder",
        {
            "data data": 
                "data is of occluded-intersection, which is no "
                "recording; give two datasets of one recording",
            "data nowhere": "unknown dataset 'nowhere'",
        },
        "conditional on the moments of this recording", lays=lays,
    ),
}  # fmt: skip
