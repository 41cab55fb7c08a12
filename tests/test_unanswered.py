"""What could not be asked is no answer:
exit code 3, the server's words, and the same command asks again.
"""

import json
import re
import zlib
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from xml.etree import ElementTree

import pytest
import served
from misbehaving import Asked, Server, completion, serving, tokens_of
from run_on_disk import Row, answers_of, made_up
from tiers import some

from harness.core import resources, work
from harness.core.errors import EXIT_CODES
from harness.evaluate import costs, servers
from harness.evaluate.asking import FIRST, IN_A_ROW
from harness.runs.unanswered import MOST_LOST, Tally

pytestmark = pytest.mark.usefixtures("svg_alone")

Typed = Callable[..., tuple[int, str, str]]
WORDS = 'model "m" not found'
CARD = """
engine = "openai"
description = "d"
weights = "m"
[server]
base_url = "{}"
retries = 0
[latency]
source = "paper"
basis = "none"
"""


def of_helper(asked: Asked) -> bool:
    return any(words in json.dumps(asked.body) for words in (" help car ", " assist the ego car "))


def of_fusion(asked: Asked) -> bool:
    return "MESSAGES id risk" in json.dumps(asked.body)


def of_ego(asked: Asked) -> bool:
    return not of_helper(asked) and not of_fusion(asked)


class Play:
    """Answers by the question alone, but refuses what `refuses` says."""

    def __init__(self) -> None:
        self.refuses: Callable[[Asked], bool] = lambda asked: False
        self.bodies: list[str] = []

    def __call__(self, asked: Asked) -> None:
        self.bodies.append(json.dumps(asked.body, sort_keys=True))
        if self.refuses(asked):
            asked.reply({"error": {"message": WORDS}}, 404)
        else:
            served.answer(asked, prompt_tokens=tokens_of(asked))

    def again(self, refuses: Callable[[Asked], bool] = lambda asked: False) -> None:
        """Forget what was asked, and refuse other questions from now on."""
        self.refuses, self.bodies = refuses, []


def one_of(of: Callable[[Asked], bool], every: int) -> Callable[[Asked], bool]:
    """Every so many questions of this kind, told by what they say."""
    return lambda asked: (
        of(asked) and zlib.crc32(json.dumps(asked.body, sort_keys=True).encode()) % every == 0
    )


def first_of(of: Callable[[Asked], bool], every: int) -> Callable[[Asked], bool]:
    """Every so many questions of this kind, in the order in which they come."""
    counted = count()
    return lambda asked: of(asked) and next(counted) % every == 0


@pytest.fixture(scope="module")
def play() -> Play:
    return Play()


@pytest.fixture(scope="module")
def there(play: Play) -> Iterator[Server]:
    with serving(play) as server:
        yield server


@pytest.fixture
def ask(harness: Typed, play: Play, there: Server, small_path: Path, tmp_path: Path) -> Typed:
    """The command as typed in a project whose card `mine` names the server;
    it has a cache of its own.
    """
    (tmp_path / resources.MARKER).touch()
    (tmp_path / "models").mkdir()
    (tmp_path / "models/mine.toml").write_text(CARD.format(there.url))
    play.again()

    def typed(command: str, *options: str | Path) -> tuple[int, str, str]:
        data = () if command == "drive" else ("--dataset", small_path)
        return harness(*command.split(), "--model", "mine", *data, *options)

    return typed


EVAL = (
    "--limit",
    "2",
    "--condition",
    "single-local",
    "--condition",
    "6g",
    "--seeds",
    "0:1",
    "--no-cache",
)


@pytest.mark.slow
def test_a_server_that_refuses_everything_is_asked_little_and_its_words_stand_first(
    ask: Typed, harness: Typed, play: Play, tmp_path: Path
) -> None:
    play.again(lambda asked: True)
    # more questions than that at once
    code, out, err = ask("eval", *EVAL, "--ask", "all", "--out", "run")
    assert (code, out) == (3, "")
    said = (
        rf"harness: HTTP 404: {re.escape(WORDS)} \({FIRST} times\): no answer to \d+ of \d+ "
        rf"questions to "
    )
    assert re.match(said, err)
    assert "type the same command to continue: harness eval --model mine" in err
    assert err.count("\n") == 1
    assert len(play.bodies) == FIRST
    assert not (tmp_path / "run/run.json").exists()

    assert harness("run", "export", "run", "--junit", "run.xml")[0] == 0
    suite = ElementTree.parse(tmp_path / "run.xml").getroot()
    assert (suite.attrib["tests"], suite.attrib["failures"], suite.attrib["errors"]) == (
        "1",
        "0",
        "1",
    )
    [error] = suite.iter("error")
    assert error.attrib["message"].startswith(f"HTTP 404: {WORDS}")

    gate = ("--fail-if", "success_rate < -0.01", "--junit", "gates.xml")
    code, out, err = harness("compare", "run", "run", *gate)
    assert (code, out) == (2, "")
    assert err.startswith(f"harness: HTTP 404: {WORDS}")
    assert [e.tag for e in ElementTree.parse(tmp_path / "gates.xml").getroot()[0]] == ["error"]
    code, _, err = harness("run", "export", "run", "--csv")
    assert code == 2
    assert f"run is no finished run, since its model could not be asked: HTTP 404: {WORDS}" in err
    code, _, err = harness("report", str(tmp_path))
    assert code == 2
    assert f"since the model of a run in it could not be asked: HTTP 404: {WORDS}" in err

    play.again()
    code, _, err = ask("eval", *EVAL, "--ask", "all", "--out", "run")
    assert (code, err) == (0, "")
    assert not (tmp_path / "run/.work").exists()


def test_repeats_that_could_not_be_asked_are_errors_in_junit(
    ask: Typed, harness: Typed, play: Play, tmp_path: Path
) -> None:
    play.again(lambda asked: True)
    code, _, err = ask(
        "study repeats", *EVAL, "--repeats", "2", "--temperature", "1", "--out", "several"
    )
    assert code == 3, err
    assert harness("run", "export", "several", "--junit", "several.xml")[0] == 0
    [error] = ElementTree.parse(tmp_path / "several.xml").getroot().iter("error")
    assert error.attrib["message"].startswith(f"HTTP 404: {WORDS}")
    code, _, err = harness("compare", "several", "several", "--fail-if", "success_rate < 0")
    assert code == 2
    assert err.startswith(f"harness: HTTP 404: {WORDS}")


@pytest.mark.slow
def test_nothing_is_lost_so_that_another_model_or_setting_may_begin_in_the_folder(
    ask: Typed, play: Play, there: Server, tmp_path: Path
) -> None:
    """A server that has pulled the model by now lists it, and so has another identity."""
    play.again(lambda asked: True)
    listed, there.listed = there.listed, lambda asked: asked.reply({"data": []})
    assert ask("eval", *EVAL)[0] == 3
    [out] = (tmp_path / "reports").iterdir()
    assert work.idle(out)
    there.listed = listed
    play.again()
    assert ask("eval", *EVAL)[0] == 0
    assert [path.name for path in (tmp_path / "reports").iterdir()] == [out.name]


@pytest.mark.parametrize("role", some(["helpers"], exhaustive=["ego"]))
def test_the_same_command_asks_only_the_errors_and_makes_the_run_that_had_none(
    role: str, ask: Typed, play: Play, tmp_path: Path
) -> None:
    play.again()
    assert ask("eval", *EVAL, "--out", "whole")[0] == 0
    asked = len(play.bodies)
    refuses = one_of(of_helper, 5) if role == "helpers" else one_of(of_ego, 2)
    play.again(refuses)
    code, _, err = ask("eval", *EVAL, "--out", "run")
    assert code == 3
    assert f"HTTP 404: {WORDS}" in err
    assert f" questions to {'the ego' if role == 'ego' else role}" in err
    before = set(play.bodies)
    errors = refused(refuses, before)
    assert errors
    files = sorted((tmp_path / "run/.work").rglob("*.jsonl"))
    kept = [
        row
        for file in files
        if file.name not in (servers.FILE, costs.FILE)
        for row in rows_in(file)
    ]
    assert kept
    assert not [row for row in kept if row["error"]]
    served = [row["id"] for file in files if file.name == servers.FILE for row in rows_in(file)]
    assert len(served) == len(play.bodies) - len(errors), "only answers have a server"
    play.again()
    code, _, err = ask("eval", *EVAL, "--out", "run")
    assert (code, err) == (0, "")
    assert set() < set(play.bodies) & before <= errors
    if role == "helpers":  # whose errors were found at the end
        assert len(play.bodies) < asked / 2
    assert without_batches(tmp_path / "run") == without_batches(tmp_path / "whole")
    for name in ("episodes.csv", "summary.csv"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def refused(refuses: Callable[[Asked], bool], bodies: set[str]) -> set[str]:
    """Those of some questions that are refused."""
    return {body for body in bodies if refuses(Asked("", {}, json.loads(body), 0, None))}


def rows_in(file: Path) -> list[Row]:
    return [json.loads(line) for line in file.read_text().splitlines()]


def without_batches(run: Path) -> list[Row]:
    rows = rows_in(run / "answers.jsonl")
    return [
        {k: v for k, v in row.items() if k not in ("batch_size", "seconds", "token_s")}
        for row in rows
    ]


@pytest.mark.slow
def test_a_few_helpers_without_an_answer_are_lost_messages_that_are_counted_and_shown(
    ask: Typed, harness: Typed, play: Play, tmp_path: Path
) -> None:
    play.again(first_of(of_helper, 40))
    device = ("--device-profile", "agx-orin", "--device-model", "qwen3-4b")
    code, out, err = ask("eval", *EVAL, *device, "--out", "run")
    assert (code, err) == (0, "")
    errors = [answer for answer in answers_of(tmp_path / "run") if answer.error]
    helpers = [answer for answer in answers_of(tmp_path / "run") if answer.role == "helper"]
    assert 0 < len(errors) < MOST_LOST * len(helpers)
    assert {(answer.role, answer.status, answer.intent) for answer in errors} == {
        ("helper", "engine_error", None)
    }
    lost = f"{len(errors)} of {len(helpers)} questions to helpers: each counts as a lost message"
    assert lost in " ".join(out.split())
    assert lost in (tmp_path / "run/report.html").read_text()
    assert harness("compare", "run", "run", "--fail-if", "success_rate < 0")[0] == 0, (
        "a gate may judge it"
    )


def test_a_server_that_breaks_in_the_middle_is_soon_asked_no_more(ask: Typed, play: Play) -> None:
    play.again(lambda asked: len(play.bodies) > 30)
    assert ask("eval", *EVAL, "--out", "other")[0] == 3
    assert len(play.bodies) <= 30 + 3 * IN_A_ROW


@pytest.mark.slow
def test_fusion_calls_count_as_the_egos(ask: Typed, play: Play, tmp_path: Path) -> None:
    fusion = (
        "--condition",
        "6g:consensus=ego-prompt",
        "--seeds",
        "0:1",
        "--limit",
        "1",
        "--no-cache",
    )
    play.again(of_fusion)
    code, _, err = ask("eval", *fusion, "--out", "run")
    assert code == 3
    assert " questions to fusion calls" in err
    play.again()
    assert ask("eval", *fusion, "--out", "run")[0] == 0
    assert len(play.bodies) < len(answers_of(tmp_path / "run"))


@pytest.mark.exhaustive
@pytest.mark.parametrize("role", ["helpers", "ego"])
def test_a_driven_run_asks_only_the_errors_again(
    role: str, ask: Typed, play: Play, tmp_path: Path
) -> None:
    options = (
        "--episodes",
        "2",
        "--condition",
        "6g",
        "--seeds",
        "0:1",
        "--no-cache",
        "--workers",
        "1",
    )
    play.again(one_of(of_helper, 5) if role == "helpers" else one_of(of_ego, 2))
    code, out, err = ask("drive", *options, "--out", "run")
    assert (code, out) == (3, "")
    assert f"HTTP 404: {WORDS}" in err
    before, refuses = set(play.bodies), play.refuses
    play.again()
    assert ask("drive", *options, "--out", "run")[0] == 0
    assert set() < set(play.bodies) & before <= refused(refuses, before)
    assert not [answer for answer in answers_of(tmp_path / "run") if answer.error]


@pytest.mark.exhaustive
def test_a_shard_is_not_done_while_too_many_of_its_questions_have_no_answer(
    ask: Typed, harness: Typed, play: Play
) -> None:
    options = (
        "--episodes",
        "2",
        "--condition",
        "6g",
        "--seeds",
        "0:1",
        "--workers",
        "1",
        "--shard",
        "1/1",
    )
    play.again(one_of(of_helper, 5))
    assert ask("drive", *options, "--out", "shard")[0] == 3
    code, _, err = harness("run", "merge", "shard", "--out", "run")
    assert code == 2
    assert "shard" in err
    play.again()
    assert ask("drive", *options, "--out", "shard")[0] == 0
    assert harness("run", "merge", "shard", "--out", "run")[0] == 0


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("command", "options"),
    [
        (
            "study grid",
            ("--prompt", "v1,v2", "--limit", "1", "--seeds", "0:1", "--condition", "6g"),
        ),
        (
            "study repeats",
            ("--repeats", "2", "--temperature", "0.7", "--limit", "1", "--seeds", "0:1"),
        ),
        ("study twins", ("--limit", "1", "--workers", "1", "--twin", "order")),
    ],
)
def test_every_study_ends_the_same_way_and_goes_on(
    command: str, options: tuple[str, ...], ask: Typed, play: Play, tmp_path: Path
) -> None:
    play.again(one_of(of_ego, 2))
    code, out, err = ask(command, *options, "--no-cache", "--out", "study")
    assert (code, out) == (3, "")
    assert err.startswith(f"harness: HTTP 404: {WORDS}")
    assert re.search(r"no answer to \d+ of \d+ questions to the ego", err)
    assert not list((tmp_path / "study").glob("*.html"))
    before, refuses = set(play.bodies), play.refuses
    play.again()
    code, _, err = ask(command, *options, "--no-cache", "--out", "study")
    assert (code, err) == (0, "")
    assert set() < set(play.bodies) & before <= refused(refuses, before)


@pytest.mark.slow
def test_what_a_study_asks_of_a_runs_model_is_kept_but_for_errors(
    ask: Typed, harness: Typed, play: Play, tmp_path: Path
) -> None:
    assert ask("eval", *EVAL, "--out", "run")[0] == 0
    play.again(one_of(of_helper, 4))
    code, out, err = harness("study", "attribute", "run", "--sample", "3")
    assert (code, out) == (3, "")
    assert f"HTTP 404: {WORDS}" in err
    assert not (tmp_path / "run/attribution.json").exists()
    before, refuses = set(play.bodies), play.refuses
    play.again()
    assert harness("study", "attribute", "run", "--sample", "3")[0] == 0
    assert set(play.bodies) == refused(refuses, before)


@pytest.mark.slow
def test_a_study_says_what_its_run_lost_and_can_be_repeated(
    ask: Typed, harness: Typed, play: Play, monkeypatch: pytest.MonkeyPatch
) -> None:
    play.again(first_of(of_helper, 40))
    assert ask("eval", *EVAL, "--out", "run")[0] == 0
    play.again(one_of(of_helper, 50))
    study = ("study", "attribute", "run", "--sample", "20", "--verbose")
    code, out, _ = harness(*study)
    assert code == 0
    plain = " ".join(out.split())
    assert "no answer to 1 of 33 questions to helpers: each counts as a lost message" in plain
    lost = re.search(r"no answer here either to (\d+) of (\d+) questions to helpers", plain)
    assert lost
    # What was lost is all that is left to ask, so that nothing at all is answered.
    monkeypatch.setattr("harness.evaluate.asking.FIRST", 2)
    monkeypatch.setattr("harness.evaluate.asking.IN_A_ROW", 3)
    play.again(play.refuses)
    assert harness(*study)[:2] == (0, out)
    assert len(play.bodies) == int(lost[1]) > 3


@pytest.mark.slow
def test_helpers_that_no_condition_asks_make_no_share_of_lost_messages_smaller(
    ask: Typed, play: Play, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = "no answer to 2 of 33 questions to helpers"
    play.again(one_of(of_helper, 30))
    for who in ("used", "all"):
        code, _, err = ask("eval", *EVAL, "--ask", who, "--out", who)
        assert (code, lost in err) == (3, True), "2 of the 48 that all are asked would be too few"
    code, out, _ = ask("eval", *EVAL, "--condition", "6g:tau=0", "--out", "more")
    assert code == 0
    assert f"Where 6g asks, there is {lost}: its figures are of" in " ".join(out.split())
    assert "Where single-local" not in out
    monkeypatch.setattr("harness.runs.unanswered.MOST_LOST", 0.1)
    code, out, _ = ask("eval", *EVAL, "--ask", "all", "--out", "all")
    assert (code, lost in " ".join(out.split())) == (0, True)


# -- runs of older versions, which hold errors of the ego ------------------------------------------


@pytest.fixture
def old(tmp_path: Path) -> Path:
    def refuse(row: Row) -> None:
        row |= {
            "error": 
                f"HTTP 404: {WORDS}", "raw": "", "finish_reason": "error", "status": "engine_error",
            "verdict": "failed", "intent": None, "mass": None, "message": None,
        }  # fmt: skip

    return made_up(tmp_path / "old", answer=refuse)


def test_gates_refuse_a_finished_run_that_is_full_of_errors(
    old: Path, harness: Typed, tmp_path: Path
) -> None:
    code, out, err = harness(
        "compare", old, old, "--fail-if", "success_rate < -0.01", "--junit", "gates.xml"
    )
    assert (code, out) == (2, "")
    assert err.startswith(f"harness: HTTP 404: {WORDS}")
    assert [e.tag for e in ElementTree.parse(tmp_path / "gates.xml").getroot()[0]] == ["error"]
    code, out, _ = harness("compare", old, old)
    assert code == 0
    assert "the model could not be asked, so that this is no result" in " ".join(out.split())


def test_its_episodes_are_errors_in_junit(old: Path, harness: Typed, tmp_path: Path) -> None:
    assert harness("run", "export", old, "--junit", "old.xml")[0] == 0
    suite = ElementTree.parse(tmp_path / "old.xml").getroot()
    assert suite.attrib["errors"] == suite.attrib["tests"]
    assert suite.attrib["failures"] == "0"
    assert not list(suite.iter("failure"))
    assert {e.attrib["message"] for e in suite.iter("error")} == {
        f"HTTP 404: {WORDS}: the model could not be asked"
    }


def test_it_is_not_replayed(old: Path, harness: Typed) -> None:
    code, _, err = harness("eval", "--model", f"replay:{old}", "--out", "again")
    assert code == 2
    assert "lacks answers, so nothing replays it: HTTP 404" in err


# -- the rule, and what a check of a model ends with -----------------------------------------------


@pytest.mark.parametrize(
    ("ego", "lost", "missing"),
    [(0, 0, set()), (1, 0, {"ego"}), (0, 4, set()), (0, 5, {"helper"}), (1, 4, {"ego"})],
)
def test_one_of_the_egos_or_five_percent_of_the_helpers(
    ego: int, lost: int, missing: set[str], old: Path
) -> None:
    from msgspec.structs import replace

    answer = replace(answers_of(old)[0], error=None, role="ego")
    helpers = [replace(answer, role="helper", error="no" if n < lost else None) for n in range(100)]
    egos = [replace(answer, error="no" if n < ego else None) for n in range(100)]
    tally = Tally([*egos, *helpers])
    assert tally.missing == missing
    assert (f"{ego} of 100 questions to the ego" in str(tally)) == bool(ego)


@pytest.mark.parametrize(
    ("said", "code"),
    [(None, 3), ("I would rather not say", 1), ('{"SLOWER": 0.2, "IDLE": 0.8}', 1)],
)
def test_a_check_tells_a_model_that_cannot_be_asked_from_one_that_cannot_be_read(
    said: str | None, code: int, ask: Typed, harness: Typed, there: Server, tmp_path: Path
) -> None:
    def answer(asked: Asked) -> None:
        asked.reply(*((completion(said),) if said else ({"error": {"message": WORDS}}, 404)))

    with serving(answer) as other:
        (tmp_path / "models/mine.toml").write_text(CARD.format(other.url))
        ended, out, err = harness("model", "check", "mine")
    assert ended == code
    assert out.startswith("model        mine")
    if said is None:
        assert err == f"harness: HTTP 404: {WORDS}: no answer of mine in any answer mode\n"
    (tmp_path / "models/mine.toml").write_text(CARD.format(there.url))
    assert harness("model", "check", "mine")[0] == 0


def test_a_server_that_does_not_listen_could_not_be_asked(
    ask: Typed, harness: Typed, tmp_path: Path
) -> None:
    (tmp_path / "models/mine.toml").write_text(CARD.format("http://127.0.0.1:9/v1"))
    code, _, err = harness("model", "check", "mine")
    assert (code, err.count("\n")) == (3, 1)
    assert ask("eval", "--out", "run")[0] == 3
    assert not (tmp_path / "run").exists()


def test_the_codes_are_in_the_help_and_on_a_page(harness: Typed) -> None:
    code, out, _ = harness("--help")
    assert code == 0
    for number, meaning in EXIT_CODES.items():
        assert f"{number} {meaning}" in " ".join(out.split())
        assert f"| {number} | {meaning}" in (resources.root() / "docs/answers.md").read_text()
