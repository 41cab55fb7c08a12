"""`harness prompt examples`: earlier turns of a chat, drawn from train layouts."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from harness.core.errors import printable
from harness.core.seeds import purpose
from harness.evaluate.agent import example_actions
from harness.prompts import versions as prompts
from harness.prompts.examples import EXAMPLES
from harness.world import scenarios

Harness = Callable[..., tuple[int, str, str]]
CROSSING = scenarios.get(scenarios.DEFAULT)


@pytest.fixture
def project(harness: Harness, monkeypatch: pytest.MonkeyPatch) -> Path:
    harness("init", "project")
    monkeypatch.chdir("project")
    return Path("prompts/mine")


@pytest.fixture(
    params=[
        pytest.param("few", marks=pytest.mark.slow),
        pytest.param("as many as are drawn", marks=pytest.mark.exhaustive),
    ]
)
def _points(request: pytest.FixtureRequest, once: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The decision points of a layout from which examples are taken: few are drawn once."""
    pytest.importorskip("highway_env", reason="needs the sim extra")
    from teaching import drawn_by

    if request.param == "few":
        monkeypatch.setattr(
            "harness.extensions.learn.training.prompt_examples.decision_points", drawn_by(once)
        )


@pytest.mark.usefixtures("_points")
def test_the_command_draws_them_from_train_layouts(project: Path, harness: Harness) -> None:
    drawing = ("prompt", "examples", "mine", "--scenario", scenarios.DEFAULT)
    code, out, _ = harness(*drawing)
    mine = prompts.load("mine")
    written = f"{printable((project / EXAMPLES).absolute())} of {scenarios.title(CROSSING)}"
    assert (code, out) == (0, f"wrote {written}: {mine.examples}\n")
    assert [len(mine.examples.of(role)) for role in prompts.ROLES] == [2, 2]
    assert all(purpose(seed, 1) == "train" for seed in mine.examples.seeds)
    for role in prompts.ROLES:
        best = example_actions(mine, role, CROSSING.actions)
        assert len(set(best)) == 2, "each shows another action than the one before"
        assert best[0] == "SLOWER", "the most careful first"
    code, _, err = harness(*drawing)
    assert (code, err.count("\n")) == (2, 1)
    assert "is there already; delete it to draw others" in err
    (project / EXAMPLES).unlink()
    harness(*drawing)
    assert prompts.load("mine").sha256 == mine.sha256, "the same draw"


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (
            ("v2", "--scenario", scenarios.DEFAULT),
            "prompt v2 is released; copy it to a new version",
        ),
        (("mine", "--scenario", "nowhere"), "unknown scenario 'nowhere'"),
        (("mine", "--scenario", scenarios.DEFAULT, "--count", "0"), "--count 0"),
        (
            ("mine", "--scenario", scenarios.DEFAULT, "--first-seed", "200000"),
            "is no train seed; give",
        ),
    ],
)
def test_what_cannot_be_drawn_is_one_line(
    project: Path, harness: Harness, args: tuple[str, ...], said: str
) -> None:
    pytest.importorskip("highway_env", reason="needs the sim extra")
    code, _, err = harness("prompt", "examples", *args)
    assert (code, err.count("\n")) == (2, 1)
    assert said in err
    assert not (project / EXAMPLES).exists()
