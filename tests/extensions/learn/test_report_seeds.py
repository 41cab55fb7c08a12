"""Nothing here learns from layouts that numbers are reported of, whatever seeds they state."""

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
    with pytest.raises(UserError, match=r"it has a layout of relabelled, where the winner is certified"):
        given([str(relabelled)], [load(relabelled).manifest])


@pytest.mark.slow
def test_an_environment_of_rewards_refuses_them(relabelled: Path) -> None:
    with pytest.raises(UserError, match="is not what layout seed"):
        stored(str(relabelled))
