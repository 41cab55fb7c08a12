"""What a run's questions cost, by the price in a card,
and a limit that stops it before it asks more.
"""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from misbehaving import Asked, Server, completion, serving
from served import answer

from harness.backends import cards
from harness.core.errors import UserError

Typed = Callable[..., tuple[int, str, str]]
CARD = """engine = "openai"
description = "One that costs something"
weights = "m"

[server]
base_url = "URL"

[price]
input = 1000.0
output = 2000.0
currency = "EUR"

[latency]
source = "paper"
basis = "none declared"
"""
# of an answer of 12 tokens read and 20 written, which the server states
EACH = (12 * 1000 + 20 * 2000) / 1e6


@pytest.fixture(autouse=True)
def local(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "models").mkdir()


@pytest.fixture
def there(tmp_path: Path) -> Any:
    with serving(answer) as server:
        (tmp_path / "models" / "mine.toml").write_text(CARD.replace("URL", server.url))
        yield server


def typed_eval(data: Path, *more: str) -> tuple[str | Path, ...]:
    fixed = (
        "--condition",
        "6g",
        "--seeds",
        "0:1",
        "--ask",
        "all",
        "--batch-size",
        "4",
        "--out",
        "run",
    )
    return "eval", "--model", "mine", "--dataset", data, *fixed, *more


def cost_of(run: str) -> Any:
    return json.loads(Path(run, "run.json").read_text()).get("cost")


@pytest.mark.slow
def test_a_run_states_what_its_questions_cost(
    there: Server, two_path: Path, harness: Typed, tmp_path: Path
) -> None:
    code, said, _ = harness(*typed_eval(two_path, "--limit", "1"))
    asked = len(there.asked)
    assert code == 0
    assert cost_of("run") == {
        "mine": {
            "currency": "EUR", "amount": pytest.approx(asked * EACH), "asked": asked, "uncounted": 0,
            "read_tokens": 12 * asked, "written_tokens": 20 * asked,
        }
    }  # fmt: skip
    spent = f"cost: {asked * EACH:.4g} EUR for {asked} questions to mine"
    assert spent in said
    assert spent in Path("run/report.html").read_text()
    # What the cache has costs nothing.
    code, said, _ = harness(*typed_eval(two_path, "--limit", "1"), "--out", "again")
    assert (code, len(there.asked), cost_of("again")) == (0, asked, None)
    assert "cost:" not in said


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
    tmp_path: Path, small_path: Path, harness: Typed
) -> None:
    """A server that states no `usage` would be asked without end."""

    def mute(asked: Asked) -> None:
        asked.reply({key: value for key, value in completion().items() if key != "usage"})

    with serving(mute) as server:
        (tmp_path / "models" / "mine.toml").write_text(CARD.replace("URL", server.url))
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


def test_a_dry_run_says_what_it_would_cost(there: Server, two_path: Path, harness: Typed) -> None:
    tokenizer = Path(cards.__file__).parents[2] / "models/swarm-tiny/tokenizer.json"
    typed = (
        *typed_eval(two_path, "--limit", "1", "--dry-run", "--tokenizer", str(tokenizer)),
        "--json",
    )
    counted = json.loads(harness(*typed)[1])
    n = counted["requests_by_role"]
    tokens = sum(each["n"] * each["mean"] for each in counted["prompt_tokens"].values())
    cost = counted["cost"]["mine"]
    assert cost["prompts"] == pytest.approx(tokens * 1000 / 1e6, rel=0.001)
    assert cost["answers"] > sum(n.values()) * 2000 / 1e6
    said = harness(*typed[:-3], "--repeats", "2", "--temperature", "1")[1]
    assert (
        f"cost of mine, EUR: prompts not counted, {2 * cost['answers']:.4g} for answers of the "
        f"greatest" in said
    )
    assert there.asked == []


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


@pytest.mark.parametrize(
    ("was", "now", "words"),
    [
        ('currency = "EUR"', 'currency = "euros"', "three capitals, such as USD"),
        ("input = 1000.0", "input = -1", "0 or more"),
        ("output = 2000.0\n", "", "output"),
        ('engine = "openai"', 'engine = "transformers"', "goes with engine = "),
    ],
)  # fmt: skip
def test_a_wrong_price_is_one_line(
    was: str, now: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = CARD.replace("URL", "http://127.0.0.1:9/v1").replace(was, now)
    if "transformers" in now:
        text = re.sub(r"\[server\]\n.*\n", "", text)
    (tmp_path / "models" / "mine.toml").write_text(text)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=re.escape(words)) as raised:
        cards.load("mine")
    assert "\n" not in str(raised.value)


@pytest.mark.exhaustive
def test_a_suite_costs_what_its_runs_cost(there: Server, harness: Typed) -> None:
    code, said, error = harness(
        "eval", "--model", "mine", "--dataset", "suite:v2v-safety-2", "--limit", "1", "--condition", "6g",
        "--seeds", "0:1", "--no-cache", "--out", "suite",
    )  # fmt: skip
    assert code == 0, error
    asked = len(there.asked)
    assert (
        sum(cost_of(f"suite/{run.name}")["mine"]["asked"] for run in Path("suite").glob("*-v*"))
        == asked
    )
    assert f"cost: {asked * EACH:.4g} EUR for {asked} questions to mine" in said


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
