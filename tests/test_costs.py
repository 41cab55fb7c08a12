"""What a run's questions cost, by the price in a card."""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from time import sleep

import pytest
from misbehaving import Server
from priced import CARD, EACH, cost_of, priced, typed_eval

from harness.backends import cards
from harness.backends.base import Completion
from harness.core.errors import UserError
from harness.evaluate import costs

PRICE = {"input": 1000.0, "output": 0.0, "currency": "USD"}
Typed = Callable[..., tuple[int, str, str]]


@pytest.fixture
def there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    with priced(tmp_path, monkeypatch) as server:
        yield server


@pytest.mark.slow
def test_a_run_says_while_it_goes_what_it_has_spent(
    there: Server, two_path: Path, harness: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lines come much more often than is usual, and the server takes its time."""
    monkeypatch.setattr("harness.cli.progress.LINE_S", 0.05)
    monkeypatch.setattr("harness.cli.progress.SETTLE_S", 0.0)
    play = there.play
    monkeypatch.setattr(there, "play", lambda asked: (sleep(0.02), play(asked)))
    code, _, said = harness(*typed_eval(two_path, "--limit", "2"))
    assert code == 0
    spent = re.findall(r"^asking mine \d+/\d+ (\S+) tokens, (\S+) EUR .*$", said, re.MULTILINE)
    assert spent
    for tokens, cost in spent:
        of_cost, of_tokens = (float(text.replace("k", "e3")) for text in (cost, tokens))
        assert of_cost / of_tokens == pytest.approx(EACH / 32, 0.01)


def test_a_prompt_of_no_tokens_was_not_counted() -> None:
    some, none = (Completion("q", "text", n, 5, "stop", None, 1) for n in (10, 0))
    assert costs.Asked.of("m", [some, none]) == costs.Asked("m", 2, 1, 10, 5)


def test_what_is_spent_is_read_on_from_where_it_was_read_before(tmp_path: Path) -> None:
    record = {"model": {"name": "a", "price": PRICE}, "helpers": [{"model": {"name": "b"}}]}
    spending = costs.Spending(record, tmp_path)
    assert spending() == "", "the file is not there yet"
    said = []
    with (tmp_path / costs.FILE).open("ab", 0) as file:
        for model, read in (("a", 950), ("b", 30_000), ("a", 999_000)):
            line = json.dumps(
                {"model": model, "asked": 1, "uncounted": 0, "read": read, "written": 0}
            )
            file.write(line[:9].encode())
            said.append(spending())
            file.write(f"{line[9:]}\n".encode())
            said.append(spending())
    assert said == [
        "", "950 tokens, 0.95 USD",
        "950 tokens, 0.95 USD", "30.9k tokens, 0.95 USD",
        "30.9k tokens, 0.95 USD", "1.03M tokens, 1k USD",
    ]  # fmt: skip


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
    assert there.asked == []


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
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "models").mkdir()
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


@pytest.mark.parametrize("count", ["-1000000000", "9" * 400, "1.5"])
def test_counts_that_cannot_be_cost_nothing(count: str, tmp_path: Path) -> None:
    """Anybody may have written the file of a stopped run."""
    line = '{"model":"m","asked":1,"uncounted":0,"read":%s,"written":0}\n'
    (tmp_path / costs.FILE).write_text(line % "1000000" + line % count)
    price = {"input": 2.0, "output": 3.0, "currency": "EUR"}
    settings = {"model": {"name": "m", "price": price}, "helpers": []}
    assert costs.total(settings, [tmp_path])["m"].amount == 2.0
