"""What others' reaction is worth: every course of two datasets, counted by walking their trees."""

from collections import Counter
from collections.abc import Callable
from itertools import product
from pathlib import Path

import pytest
from studied import trials

from harness.core.errors import UserError
from harness.dataset.load import Dataset, load
from harness.dataset.schema import End
from harness.extensions.roads.reaction.stopping import could_stop
from harness.extensions.roads.reaction.study import manifest_of, reaction

pytestmark = pytest.mark.slow
Made = Callable[[str], Dataset]


@pytest.fixture
def made(tmp_path: Path, once: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> Made:
    """Reads one of the datasets of the study's trial, by its name."""
    monkeypatch.setenv("SWARMDRIVE_RECORDINGS", "")
    trials()["reaction"].lays(tmp_path, once)
    return lambda name: load(tmp_path / name)


def end_of(dataset: Dataset, layout: int, course: tuple[str, ...]) -> End:
    """How a course ends, by its tree alone."""
    levels, place = dataset.trees[layout].levels, 0
    for level, action in zip(levels, course, strict=False):
        [edge] = [each for each in level[place].edges if action in each.actions]
        if edge.end:
            return edge.end
        place = edge.to
    raise AssertionError("no end")


def test_every_course_is_counted_in_both_worlds(made: Made) -> None:
    react, replay = made("with"), made("without")
    found = reaction(react, replay, lambda done: None)
    expected = Counter[tuple[str, str]]()
    for layout, course in product(range(2), product(react.actions, repeat=3)):
        ends = {
            "react": end_of(react, layout, course),
            "replay": end_of(replay, layout, course),
        }
        slower = str(course.count("SLOWER"))
        expected[slower, "courses"] += 1
        expected[slower, "otherwise"] += ends["react"].result != ends["replay"].result
        for world, end in ends.items():
            expected[slower, f"collisions_{world}"] += end.result == "collision"
            expected[slower, f"struck_{world}"] += end.striker == "other"
    rows = {row["slower"]: row for row in found.courses.to_dict("records")}
    for (slower, name), count in expected.items():
        of = rows[slower]["courses"] if name == "otherwise" else 1
        assert rows[slower][name] * of == pytest.approx(count)
    whole = rows["all"]
    assert (whole["courses"], whole["n"], found.scenes) == (250, 2, 1)
    assert whole["struck_replay"] > whole["struck_react"] == whole["could_stop_react"] == 0
    [recorded] = found.drivers[found.drivers.driver == "recorded"].to_dict("records")
    assert (recorded["courses"], recorded["otherwise"], recorded["collisions_replay"]) == (2, 0, 0)


def test_who_could_stop_shows_in_the_course_played_again(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    replay = made("without")
    ends = {each: end_of(replay, 0, each) for each in product(replay.actions, repeat=3)}
    course, end = next(item for item in ends.items() if item[1].striker == "other")
    assert could_stop(replay.scenario, replay.seeds[0], course, end.partner or "")
    with pytest.raises(UserError, match="unknown road user of layout 0 'v77'"):
        could_stop(replay.scenario, replay.seeds[0], course, "v77")
    monkeypatch.setattr("harness.extensions.roads.replay.HARDEST_MPS2", 1.0)
    assert not could_stop(replay.scenario, replay.seeds[0], course, end.partner or "")


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("without", "with"), "without has react=false; give first the dataset whose others react"),
        (("with", "with-first"), "with-first has react=true; give first"),
        (("with", "without-first"), "differ in layout seeds; give datasets that differ in react"),
    ],
)
def test_others_are_refused(made: Made, names: tuple[str, str], said: str) -> None:
    with pytest.raises(UserError, match=said):
        manifest_of(made(names[0]), made(names[1]))
