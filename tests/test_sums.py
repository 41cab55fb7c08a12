"""`--sums divide`: an answer whose only fault is its sum is divided by it, and counted apart."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from served import completion, serving

from harness.backends import cards
from harness.backends.base import Completion, Sums
from harness.core import resources
from harness.core.errors import UserError
from harness.evaluate.agent import Agent
from harness.evaluate.answers import answer_of
from harness.evaluate.lifecycle import finished_with
from harness.prompts import versions
from harness.report.caveats import divided
from harness.runs import folder

ACTIONS = ("SLOWER", "IDLE", "FASTER")
CARD = """engine = "openai"
description = "Says every time that braking is a tenth less likely than it means."
weights = "m"
[server]
base_url = "{url}"
key_env = "NO_KEY"
[latency]
source = "paper"
basis = "none: made up"
"""


def text(*p: float) -> str:
    numbers = ", ".join(f'"{a}": {x}' for a, x in zip(ACTIONS, p, strict=True))
    return f'{{"action_distribution": {{{numbers}}}}}'


@pytest.mark.parametrize(
    ("said", "refused", "divided"),
    [
        (text(0.6, 0.2, 0.1), "bad_sum", ("divided",)),
        (text(0.9, 0.9, 0.9), "bad_sum", ("divided",)),
        (f"So: {text(0.6, 0.2, 0.1)}", "bad_sum", ("prose_around", "divided")),
        (text(0, 0, 0), "bad_sum", None),  # nothing to divide
        (text(0.6, 0.2, 1.2), "out_of_range", None),  # another fault beside the sum
        (text(0.7, 0.2, 0.1), "strict", ()),
    ],
)
def test_only_a_sum_that_is_off_is_divided_and_only_where_that_was_declared(
    said: str, refused: str, divided: tuple[str, ...] | None
) -> None:
    def answered(sums: Sums) -> Any:
        agent = Agent(cards.resolve("proxy"), versions.load("v2"), sums=sums)
        request = agent.blank("ego", ACTIONS)
        return answer_of(request, Completion(request.id, said, None, None, "stop", None, 1))

    assert answered("refuse").status == refused
    answer = answered("divide")
    if divided is None:
        assert answer.verdict == "failed"
        assert answer.status == refused
    else:
        assert answer.repairs == divided
        assert sum(answer.intent) == pytest.approx(1)
        first = float(said.partition('"SLOWER": ')[2].partition(",")[0])
        assert answer.intent[0] == pytest.approx(first / answer.mass)


def test_where_sums_need_no_declaration_it_is_refused() -> None:
    with pytest.raises(
        UserError, match="--sums divide: swarm-tiny answers in constrained, whose sums"
    ):
        Agent(cards.resolve("swarm-tiny"), versions.load("v2"), "constrained", sums="divide")
    with pytest.raises(UserError, match="unknown sums 'halve'; known: divide, refuse"):
        Agent(cards.resolve("proxy"), versions.load("v2"), sums="halve")  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_run_says_how_many_were_divided_and_is_no_run_that_refuses_them(
    harness: Callable[..., tuple[int, str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    (tmp_path / resources.MARKER).touch()
    (tmp_path / "models").mkdir()
    command = ("eval", "--model", "mine", "--prompt", "v2", "--limit", "1", "--seeds", "0:1",
               "--condition", "single-local", "--out", "run")  # fmt: skip
    with serving(lambda asked: asked.reply(completion(text(0.6, 0.2, 0.1)))) as there:
        (tmp_path / "models/mine.toml").write_text(CARD.format(url=there.url))
        code, out, err = harness(*command, "--sums", "divide", "--verbose")
        assert code == 0, err
        run = folder.read(tmp_path / "run")
        n = sum(answer.role == "ego" for answer in run.answers)
        assert f"ego answers divided by their sum: 100.0 % of {n}" in out
        assert run.score("all", "divided_rate_ego").value == 1
        assert (
            f"{n} of the ego's {n} answers did not sum to 1 and were divided by their sum"
            in "".join(divided(run))
        )
        assert run.manifest.sums == run.manifest.agent(0)["sums"] == "divide"
        assert "--sums divide" in run.manifest.command
        with pytest.raises(UserError, match="sums"):
            finished_with({"sums": "refuse"}, tmp_path / "run")
        assert harness(*command[:-1], "other")[0] == 0
    refused = folder.read(tmp_path / "other")
    assert {a.status for a in refused.answers} == {"bad_sum"}
    assert refused.score("all", "divided_rate_ego") is None
    stored = msgspec.json.decode((tmp_path / "other/run.json").read_bytes())
    assert stored.pop("sums") == "refuse"
    (tmp_path / "other/run.json").write_bytes(msgspec.json.encode(stored))
    finished_with({"sums": "refuse"}, tmp_path / "other")  # as every run before the setting
