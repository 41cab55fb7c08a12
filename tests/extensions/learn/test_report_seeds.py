"""Nothing here learns from layouts that numbers are reported of, whatever seeds they state."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from harness.core.errors import UserError
from harness.dataset.load import find, load
from harness.extensions.learn.optimize.layouts import given
from harness.extensions.learn.rewards.layouts import stored


@pytest.mark.slow
def test_no_prompt_is_searched_there(relabelled: Path) -> None:
    with pytest.raises(UserError, match="is not what layout seed"):
        given([str(relabelled)], [load(find("occluded-intersection-v2"), 1).manifest])
    with pytest.raises(
        UserError, match=r"it has a layout of relabelled, where the winner is certified"
    ):
        given([str(relabelled)], [load(relabelled).manifest])


@pytest.mark.slow
def test_an_environment_of_rewards_refuses_them(relabelled: Path) -> None:
    with pytest.raises(UserError, match="is not what layout seed"):
        stored(str(relabelled))


@pytest.mark.slow
def test_no_chats_are_written_of_them(
    relabelled: Path, run_of_it: Path, harness: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    run = shutil.copytree(run_of_it, tmp_path / "run")
    code, out, error = harness("run", "export", run, "--sft", "pairs.jsonl")
    assert (code, error.count("\n")) == (2, 1), (out, error)
    assert "is not what layout seed" in error
    assert not list(tmp_path.glob("*.jsonl"))
