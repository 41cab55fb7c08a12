"""A run's model is asked by the user's own card alone, whatever the run says of it."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from misbehaving import Server, completion, serving
from run_on_disk import digested
from tiers import some

from harness.backends import cards
from harness.backends.card import Card, Latency
from harness.backends.cards import find_own
from harness.backends.servers import Server as Place
from harness.core.errors import UserError
from harness.core.resources import folder

pytestmark = pytest.mark.usefixtures("svg_alone")
Said = tuple[int, str, str]
GOOD = '{"action_distribution":{"SLOWER":0.70,"IDLE":0.20,"FASTER":0.10},"confidence":0.9,"evidence":"v2"}'
CARD = """engine = "openai"
description = "d"
weights = "m"
{more}
[server]
base_url = "{url}"
retries = 0
[latency]
source = "paper"
basis = "b"
"""
STUDY = ("study", "attribute", "run", "--sample", "2")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the project is kept, once a test has made it."""
    return tmp_path_factory.mktemp("made") / "project"


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving(lambda asked: asked.reply(completion(GOOD))) as server:
        yield server


@pytest.fixture
def run(
    server: Server,
    made: Path,
    harness: Callable[..., Said],
    small_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Server:
    """A run of a server of the user's own, in a project with its card."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(Path("cache").absolute()))
    if made.exists():
        shutil.copytree(made, ".", dirs_exist_ok=True)
    else:
        Path("models").mkdir()
        Path("swarmdrive.toml").touch()
        Path("models/mine.toml").write_text(CARD.format(url=server.url, more=""))
        said = harness(
            "eval", "--model", "mine", "--dataset", small_path, "--limit", "1", "--seeds", "0:1",
            "--condition", "6g", "--out", "run",
        )  # fmt: skip
        assert said[0] == 0, said
        shutil.copytree(".", made)
    server.asked.clear()
    return server


def test_a_study_asks_the_server_of_the_users_card(
    run: Server, harness: Callable[..., Said]
) -> None:
    assert harness(*STUDY)[0] == 0
    assert run.asked


@pytest.mark.parametrize("changed", some([True], exhaustive=[False]))
def test_a_study_names_the_prompt_that_its_run_keeps(
    changed: bool, run: Server, small_path: Path, harness: Callable[..., Said]
) -> None:
    shutil.copytree(folder("prompts") / "v2", "prompts/mine")
    options = ("--limit", "1", "--seeds", "0:1", "--condition", "6g", "--out", "of-mine")
    assert (
        harness("eval", "--model", "mine", "--prompt", "mine", "--dataset", small_path, *options)[0]
        == 0
    )
    if changed:
        text = Path("prompts/mine/ego.j2").read_text()
        Path("prompts/mine/ego.j2").write_text(text.replace("You drive", "You now drive"))
    else:
        shutil.rmtree("prompts/mine")
    study = [word if word != "run" else "of-mine" for word in STUDY]
    code, _, err = harness(*study)
    how = "has changed since" if changed else "is not here"
    copy = "copy of-mine/sources/prompts/mine to prompts/, or run again"
    assert (code, err) == (2, f"harness: of-mine: prompt mine {how}; {copy}\n")
    shutil.copytree("of-mine/sources/prompts/mine", "prompts/mine", dirs_exist_ok=True)
    assert harness(*study)[0] == 0


def test_what_the_run_says_of_a_server_changes_nothing(
    run: Server, harness: Callable[..., Said]
) -> None:
    """Its card may have moved: the identity of what is opened is compared."""
    with serving(lambda asked: asked.reply(completion(GOOD))) as theirs:
        state(base_url=theirs.url, key_env="HOME", timeout_s=1.0, retries=9)
        assert harness(*STUDY)[0] == 0
        assert (len(theirs.asked), bool(run.asked)) == (0, True)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (
            'thinking = "always"\n',
            "its model mine is not what it was (thinking of your card differs)",
        ),
        (
            "max_new_tokens = 9\nthinking_tokens = 7\n",
            "(max_new_tokens, thinking_tokens of your card differs)",
        ),
    ],
)
def test_a_card_that_asks_otherwise_is_refused(
    more: str, said: str, run: Server, harness: Callable[..., Said]
) -> None:
    Path("models/mine.toml").write_text(CARD.format(url=run.url, more=more))
    code, _, err = harness(*STUDY)
    assert (code, err.count("\n"), run.asked) == (2, 1, [])
    assert said in err


def test_another_identity_is_refused_before_a_question(
    run: Server, harness: Callable[..., Said]
) -> None:
    with serving(lambda asked: asked.reply(completion(GOOD))) as other:
        Path("models/mine.toml").write_text(CARD.format(url=other.url, more=""))
        code, _, err = harness(*STUDY)
        assert (code, other.asked) == (2, [])
    assert "the model is not what it was (base_url); run again" in err


@pytest.mark.parametrize(
    "study",
    [
        pytest.param(STUDY, marks=pytest.mark.slow),
        *(
            pytest.param(("study", *words.split()), marks=pytest.mark.exhaustive)
            for words in (
                "sweep run --over consensus --grid ego-prompt --out swept",
                "trust run --attacks jump --rules linear --out trusted",
                "schedule compare run --schedule entropy --out scheduled",
            )
        ),
    ],
    ids=lambda study: study[0],
)
def test_a_model_that_is_no_card_is_not_asked_and_the_line_says_what_to_type(
    study: tuple[str, ...], run: Server, harness: Callable[..., Said]
) -> None:
    Path("models/mine.toml").unlink()
    code, _, err = harness(*study)
    assert run.asked == []
    if code:  # a study that has all answers asks nothing
        assert (code, err.count("\n")) == (2, 1)
        assert (
            "run: its model mine is none of your cards; to ask it, give --model with its folder"
            in err
        )
    assert code == 2 or study[1] in ("trust", "schedule")


def test_a_replay_asks_no_server_that_its_run_names(
    run: Server, harness: Callable[..., Said], small_path: Path
) -> None:
    Path("models/mine.toml").unlink()
    code, _, err = harness(
        "eval", "--model", "replay:run", "--dataset", small_path, "--limit", "1", "--seeds", "0:1",
        "--condition", "6g:messages=blind", "--out", "replayed",
    )  # fmt: skip
    assert (code, run.asked) == (2, [])
    assert (
        "its model mine is none of your cards; write one of that name, or make the run again" in err
    )


@pytest.mark.exhaustive
def test_a_run_of_a_model_that_no_longer_ships_is_read_and_runs_again_with_its_card(
    run: Server, harness: Callable[..., Said]
) -> None:
    for name in ("run.json", "run.toml"):
        file = Path("run") / name
        file.write_text(file.read_text().replace('"mine"', '"qwen3-8b"'))
    digested(Path("run"))
    shutil.rmtree("cache", ignore_errors=True)
    card = Path("models/mine.toml").rename("kept.toml")
    for read in (("report", "run"), ("compare", "run", "run"), ("run", "check", "run")):
        assert harness(*read)[0] == 0, read
    again = ("eval", "run", "--out", "again")
    for asks in (STUDY, again):
        code, _, err = harness(*asks)
        assert (code, err.count("\n"), run.asked) == (2, 1, [])
        assert "model 'qwen3-8b' no longer ships; copy its card " in err
    card.rename("models/qwen3-8b.toml")
    for asks in (STUDY, again):
        assert harness(*asks)[0] == 0
    assert run.asked


def test_a_name_of_a_shipped_card_does_not_lend_it_a_server() -> None:
    stated = Card(
        "proxy", "openai", "d", Latency("paper", None, "b"), "m", server=Place("http://evil/v1")
    )
    with pytest.raises(
        UserError, match=r"proxy is not what it was \(\[server\] of your card differs\)"
    ):
        find_own(stated, (), "run", "")
    assert find_own(cards.load("proxy"), (), "run", "") == cards.load("proxy")


@pytest.mark.parametrize(
    "name", ["../mine", "models/mine", "", "mine\0", "MINE", "proxy:", "a/b", "replay:run"]
)
def test_a_name_in_a_run_is_no_path(name: str, run: Server) -> None:
    stated = Card(
        name, "openai", "d", Latency("paper", None, "b"), "m", server=Place("http://evil/v1")
    )
    with pytest.raises(UserError):
        find_own(stated, (), "run", "give --model")


def test_a_model_that_the_user_gives_is_taken_for_the_runs_of_its_name(tmp_path: Path) -> None:
    given = Card("my", "llama-cpp", "d", Latency("paper", None, "b"), "/here/my.gguf")
    stated = Card("my", "llama-cpp", "d", Latency("paper", None, "b"), "/theirs/my.gguf")
    assert find_own(stated, (given,), "run", "").weights == "/here/my.gguf"
    with pytest.raises(UserError, match="engine"):
        find_own(Card("my", "transformers", "d", given.latency, "/theirs"), (given,), "run", "")


def state(**values: Any) -> None:
    """Change what the run states of its server."""
    file = Path("run/run.json")
    manifest = json.loads(file.read_text())
    manifest["model"]["server"].update(values)
    file.write_text(json.dumps(manifest))
    digested(file.parent)
    shutil.rmtree("cache", ignore_errors=True)
