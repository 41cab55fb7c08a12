"""The conditions that `--control` and `--attack` put beside others: their names and order."""

import pytest

from harness.core.errors import UserError
from harness.evaluate.resolve import points


@pytest.mark.parametrize(
    ("conditions", "settings", "names"),
    [
        (["single-local", "6g"], {}, "single-local 6g"),
        (["single-local", "6g"], {"control": ["shuffled-messages"]},
            "single-local 6g 6g:messages=shuffled"),
        (["6g", "6g:tau=0"], {"control": ["no-messages"]}, "6g 6g:tau=0 6g:loss=1 6g:tau=0,loss=1"),
        (["6g", "6g:loss=1"], {"control": ["no-messages"]}, "6g 6g:loss=1"),
        (["v2x", "v2x"], {"control": ["no-messages", "shuffled-messages", "no-messages"]},
            "v2x v2x:loss=1 v2x:messages=shuffled"),
        (["6g", "v2x"], {"attack": ["liar:share=1/3", "stuck"], "control": ["blind"]},
            "6g v2x 6g:messages=blind v2x:messages=blind 6g:attack=liar:share=1/3 "
            "v2x:attack=liar:share=1/3 6g:attack=stuck v2x:attack=stuck"),
    ],
)  # fmt: skip
def test_a_counterpart_stands_beside_every_condition_with_a_channel(
    conditions: list[str], settings: dict[str, list[str]], names: str
) -> None:
    assert [point.name for point in points(conditions, settings)] == names.split()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"control": ["deaf"]}, "unknown --control 'deaf'"),
        ({"attack": ["lair"]}, "unknown attack 'lair'"),
    ],
)
def test_an_unknown_counterpart_is_refused(settings: dict[str, list[str]], said: str) -> None:
    with pytest.raises(UserError, match=said):
        points(["6g"], settings)
