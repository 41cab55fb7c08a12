"""What holds for every registered kind of study: the manners of its command and of its folder.

A new kind is found by its registration. It needs a trial: `TRIALS` in `studied.py` has those of the
core, and `tests/extensions/NAME/trials.py` those of an extension.
"""

import json
import re
import shlex
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import studied
from starlette.testclient import TestClient
from studied import MORE, Trial, Tries, digests, laid, said, stands_still, trials

from harness.core import formats
from harness.core.extensions import joined

KINDS = dict(joined(formats.STUDIES, "studies"))
TRIALS = trials()
WRONG = [(kind, options) for kind, trial in TRIALS.items() for options in trial.wrong]
KILLED = [  # and of those that lie in their run's folder, without a name in lists
    pytest.param(
        kind, marks=pytest.mark.slow if kind in ("trust", "grid") else pytest.mark.exhaustive
    )
    for kind in dict.fromkeys([*KINDS, *TRIALS])
]
N = re.compile(r"\bn (= |is )|\d+ (seed means|channel seeds) of \d+ episodes")
OVER = re.compile(r"95 % intervals? (is |are )?over ")
INTERVAL = re.compile(r"([+-]?[\d.]+) \[([+-]?[\d.]+), ([+-]?[\d.]+)\]")
every = pytest.mark.parametrize("kind", KINDS)
Typed = Callable[..., tuple[int, str, str]]


@pytest.mark.slow
@every
def test_it_writes_page_and_tables_and_last_what_its_registration_says(
    kind: str, tries: Tries
) -> None:
    of = tries(kind)
    before, whole = of.said["before"], of.said["whole"]
    assert whole.code == 0
    assert "harness: " not in whole.err  # it may say points as they are known
    assert f"wrote {of.trial.folder}/index.html\n" in whole.out
    manifest = of.folder / f"{kind}.json"
    assert json.loads(manifest.read_text())["format"] == f"swarmdrive-{kind}/1"
    assert max(of.folder.iterdir(), key=lambda path: path.stat().st_mtime_ns) == manifest
    assert {path.stem for path in of.folder.glob("*.csv")} <= {
        path.stem for path in of.folder.glob("*.jsonl")
    }
    page = (of.folder / "index.html").read_text()
    # Figures in files are charts in the page, too.
    assert page.count("data-chart=") >= len(list(of.folder.glob("*.svg")))
    assert "<img " not in page
    new = whole.files.keys() - before.files.keys()
    outside = {path for path in new if not path.startswith(f"{of.trial.folder}/")}
    assert outside == set(of.trial.beside)
    assert before.files.items() <= whole.files.items()


@pytest.mark.slow
@every
def test_lists_and_the_browser_have_its_word(kind: str, tries: Tries, harness: Typed) -> None:
    of = tries(kind)
    name, parent = of.folder.name, of.folder.parent
    code, out, err = harness("run", "ls", parent, "--json")
    assert (code, err) == (0, "")
    listed = {each["name"]: (each["kind"], each["state"]) for each in json.loads(out)}
    assert listed[name] == (KINDS[kind], "finished")
    view = pytest.importorskip("harness.extensions.view.app", reason="part of the extension view")
    reader = TestClient(view.app(parent, "token"), base_url="http://127.0.0.1:7654")
    page = reader.get("/?token=token").text
    assert f'>{name}</a></th>\n<td class="kind">{KINDS[kind]}</td>' in page
    assert reader.get("/run", params={"path": name}).status_code == 200


@pytest.mark.slow
@every
def test_terminal_and_page_say_n_intervals_and_conditions(kind: str, tries: Tries) -> None:
    of = tries(kind)
    lines = of.said["whole"].out.splitlines()
    assert [line for line in lines if len(line) > 80 and not line.startswith("wrote ")] == []
    assert len(lines) <= 16, "fifteen, and the prompt that a search wrote"
    page = (of.folder / "index.html").read_text()
    for text in (" ".join(lines), page):
        words = " ".join(text.split())
        assert N.search(words)
        assert OVER.search(words)
    assert of.trial.about in " ".join(page.split())


@pytest.mark.slow
@every
def test_its_json_has_every_interval_of_its_outcome_and_tables(kind: str, tries: Tries) -> None:
    of = tries(kind)
    typed = of.said["again" if of.trial.ends else "json"]
    assert (typed.code, typed.err) == (0, "")
    records = list(numbers(json.loads(typed.out)))
    outcome, _, _ = of.said["whole"].out.rpartition("all tables and notes: ")
    shown = set(INTERVAL.findall(" ".join(outcome.split())))
    assert shown
    absent = [each for each in shown if not any(all(within(each, of)) for of in records)]
    assert absent == []


def numbers(value: Any) -> Iterator[list[float]]:
    """The numbers of every record of what JSON holds."""
    if isinstance(value, dict):
        yield [number for number in value.values() if type(number) in (int, float)]
        value = list(value.values())
    for part in value if isinstance(value, list) else ():
        yield from numbers(part)


def within(shown: tuple[str, ...], record: list[float]) -> Iterator[bool]:
    """Whether each number as it is shown is one of a record's, or a hundred times one."""
    for text in shown:
        half = 0.5 / 10 ** len(text.partition(".")[2]) + 1e-9
        found = (abs(float(text) - scale * of) <= half for of in record for scale in (1, 100))
        yield any(found)


@pytest.mark.slow
@every
def test_the_same_command_again_changes_no_byte(kind: str, tries: Tries) -> None:
    of = tries(kind)
    again = of.said["again"]
    assert again.files == of.said["whole"].files
    if of.trial.ends:
        assert (again.code, again.err) == (0, "")
    else:
        assert (again.code, again.out, again.err.count("\n"), again.writes) == (2, "", 1, 0)
        assert " already" in again.err


@pytest.mark.slow
@every
def test_another_command_is_refused_in_its_folder(kind: str, tries: Tries) -> None:
    of = tries(kind)
    other = of.said["other"]
    assert (other.code, other.out, other.err.count("\n"), other.writes) == (2, "", 1, 0)
    assert of.trial.refused in other.err


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind, trial in TRIALS.items() if trial.dry])
def test_a_dry_run_counts_questions_and_writes_nothing(kind: str, tries: Tries) -> None:
    said = tries(kind).said
    dry = said["dry"]
    assert (dry.code, dry.err, dry.writes) == (0, "", 0)
    assert "at most" in dry.out
    assert dry.files == said["before"].files


@pytest.mark.parametrize("kind", KILLED)
def test_one_that_is_killed_and_typed_again_has_the_bytes_of_one_that_ran_through(
    kind: str, tries: Tries, lay: Callable[[Path, Trial], None]
) -> None:
    of = tries(kind)
    whole, here = of.said["whole"], of.path.with_name("here")
    lay(here, of.trial)
    with stands_still():
        killed = said(of.trial.typed("whole"), here, whole.writes // 2)
        resumed = said(of.trial.typed("whole"), here)
    kept = here / MORE
    answers = kept.read_text().splitlines() if kept.exists() else []
    shutil.rmtree(here)
    assert killed.code == studied.KILLED
    assert (resumed.code, resumed.files) == (0, whole.files)
    asked = Counter(
        (a["scene"], a["viewer"], a["role"], tuple(a.get("heard", ())))
        for a in map(json.loads, answers)
    )
    assert max(asked.values(), default=1) == 1, "an answer is kept twice"


@pytest.fixture(scope="module")
def project(
    tmp_path_factory: pytest.TempPathFactory, proxy_run: Path, small_path: Path
) -> tuple[Path, dict[str, str]]:
    """A project in which nothing is written, and the digests of its files."""
    here = tmp_path_factory.mktemp("project")
    laid(here, proxy_run, None, small_path)
    return here, digests(here)


@pytest.mark.usefixtures("unrebuilt")
@pytest.mark.parametrize(("kind", "options"), WRONG)
def test_what_cannot_be_is_one_line_and_nothing_is_written(
    kind: str, options: str, harness: Typed, project: tuple[Path, dict[str, str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    trial, (here, before) = TRIALS[kind], project
    monkeypatch.chdir(here)
    code, out, err = harness(*shlex.split(f"{trial.command} {options}"))
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert trial.wrong[options] in err
    assert digests(here) == before
