"""A limit on what answers cost stops a command before it asks more."""

import itertools
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from misbehaving import Asked, Server, completion
from priced import EACH, cost_of, priced, typed_eval

from harness.backends.base import Completion, Request
from harness.core.image import Image
from harness.extensions.budget.limit import TURN, most_tokens

CHAT = ({"role": "user", "content": "Glä"},)
PICTURE = np.zeros((3, 11, 3), dtype=np.uint8)  # 33 pixels
Typed = Callable[..., tuple[int, str, str]]


@pytest.fixture
def there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    with priced(tmp_path, monkeypatch) as server:
        yield server


@pytest.mark.slow
def test_a_limit_stops_before_more_is_asked_and_the_same_command_goes_on(
    there: Server, small_path: Path, harness: Typed
) -> None:
    typed = (*typed_eval(small_path, "--no-cache"), "--max-cost", f"{80 * EACH:.6f}")
    code, _, said = harness(*typed)
    first = len(there.asked)
    assert code == 3
    assert re.search(
        r"harness: [\d.]+ EUR of --max-cost 4.16 are spent; all answers are kept, and the same",
        said,
    )
    # Chunks of 64 are asked whole, and those on their way when it is spent still come.
    assert 80 <= first <= 80 + 3 * 64
    assert not Path("run/run.json").exists()
    for _ in range(8):
        if harness(*typed)[0] == 0:
            break
    ids = [json.loads(line) for line in Path("run/answers.jsonl").read_text().splitlines()]
    assert len(ids) == len(there.asked) > first, "no question was asked twice"
    assert cost_of("run")["mine"]["asked"] == len(there.asked)


@pytest.mark.slow
def test_a_limit_that_no_tokens_could_reach_stops_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_path: Path, harness: Typed
) -> None:
    """A server that states no `usage` would be asked without end."""

    def mute(asked: Asked) -> None:
        asked.reply({key: value for key, value in completion().items() if key != "usage"})

    with priced(tmp_path, monkeypatch, mute) as server:
        typed = typed_eval(small_path, "--no-cache")
        code, _, said = harness(*typed, "--max-cost", "1")
        first = len(server.asked)
        assert (code, said.count("\n")) == (3, 2), (
            "none of its answers can be read, which is said, too"
        )
        assert (
            "mine does not say how many tokens its answers take, so --max-cost cannot hold" in said
        )
        assert 0 < first <= 3 * 64
        assert harness(*typed)[0] == 0
        assert len(server.asked) > first
    cost = cost_of("run")["mine"]
    assert cost["asked"] == cost["uncounted"] == len(server.asked), "no question was asked twice"


@pytest.mark.slow
def test_an_answer_without_its_tokens_counts_as_the_most_that_it_can_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_path: Path, harness: Typed
) -> None:
    """A server that states its usage in one answer of sixteen would be asked for little."""
    count = itertools.count()

    def seldom(asked: Asked) -> None:
        reply = completion()
        if next(count) % 16:
            del reply["usage"]
        asked.reply(reply)

    with priced(tmp_path, monkeypatch, seldom) as server:
        code, _, said = harness(*typed_eval(small_path, "--no-cache"), "--max-cost", f"{80 * EACH}")
    assert code == 3
    assert "mine does not say how many tokens some of its answers take; these count as the" in said
    assert re.search(r"[\d.]+ EUR of --max-cost 4.16 are spent", said)
    assert len(server.asked) <= 3 * 64


@pytest.mark.parametrize(
    ("stated", "options", "most"),
    [
        ((12, 20), {}, (12, 20)),
        ((None, 20), {}, (TURN + 4, 20)),  # of which each token has a byte
        ((12, None), {}, (12, TURN + 3)),
        ((None, None), {"thinking": True}, (TURN + 4, 512)),
        ((None, None), {"max_tokens": 2}, (TURN + 4, 2)),
        ((None, 1), {"orders": (CHAT, CHAT), "image": Image(PICTURE)}, (3 * (TURN + 4 + 2), 1)),
    ],
)
def test_what_a_token_can_be_at_the_most(
    stated: tuple[int | None, int | None], options: dict[str, Any], most: tuple[int, int]
) -> None:
    request = Request("s/v1", "ego", CHAT, ("IDLE",), **{"max_tokens": 512, **options})
    answer = Completion("s/v1", "abc", *stated, "stop", None, 1)
    assert most_tokens(request, answer) == most
    failed = replace(answer, text="", error="no answer")
    assert most_tokens(request, failed) == tuple(tokens or 0 for tokens in stated)


@pytest.mark.slow
def test_a_limit_says_whose_answers_it_does_not_count(
    there: Server, tmp_path: Path, two_path: Path, harness: Typed
) -> None:
    priced = (tmp_path / "models" / "mine.toml").read_text()
    (tmp_path / "models" / "other.toml").write_text(re.sub(r"\[price\]\n(.+\n)+", "", priced))
    typed = typed_eval(two_path, "--limit", "1", "--max-cost", "99", "--no-cache", "--quiet")
    says = "harness: --max-cost 99: other has no price and is not counted\n"
    assert harness(*typed, "--helper-model", "other") == (0, "", says)
    assert harness(*typed, "--helper-model", "proxy", "--out", "rule") == (0, "", ""), (
        "a rule costs nothing"
    )


@pytest.mark.parametrize(
    ("model", "amount", "words"),
    [
        ("proxy", "2", 
            "--max-cost 2: proxy has no price; give its "
            "card a [price] with input, output and"),
        ("mine", "0", 
            "--max-cost 0: give an amount above 0, in "
            "the currency of the card's [price]"),
        ("mine", "nan", "--max-cost nan: give an amount above 0"),
    ],
)  # fmt: skip
def test_a_limit_that_limits_nothing_is_refused(
    model: str, amount: str, words: str, there: Server, two_path: Path, harness: Typed
) -> None:
    code, _, said = harness(
        *typed_eval(two_path, "--limit", "1", "--max-cost", amount), "--model", model
    )
    assert code == 2
    assert words in said
    assert not Path("run").exists()


@pytest.mark.exhaustive
def test_processes_that_drive_add_up_what_they_spend(there: Server, harness: Typed) -> None:
    typed = (
        "drive", "--model", "mine", "--condition", "6g", "--seeds", "0:1", "--episodes", "40", "--no-cache",
        "--workers", "2", "--batch-size", "4", "--out", "driven", "--max-cost", f"{60 * EACH:.6f}",
    )  # fmt: skip
    code, _, said = harness(*typed)
    assert code == 3, said
    assert 60 <= len(there.asked) < 60 + 4 * 64
    assert "are spent" in said
