"""No page and no export names a folder of the machine that it was made on."""

import json
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from evaluating import FILES
from former import DRIVE
from reading import packed
from run_on_disk import digested

from harness.report.compare.page import beside
from harness.runs.folder import read

pytestmark = pytest.mark.usefixtures("svg_alone")

Typed = Callable[..., tuple[int, str, str]]
CANARY = "canary-in-a-folder"
SECRET = "letmein"
RECORDS = {
    "run.json", "run.toml", "sweep.json", "schedule.json", "suite.json", "twins.json", "fidelity.json",
    "cells.jsonl", *FILES,
}  # fmt: skip
EVAL = (
    "--seeds",
    "0",
    "--limit",
    "1",
    "--quiet",
    "--condition",
    "single-local",
    "--condition",
    "6g",
)


@pytest.fixture
def typed(
    harness: Typed, small_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., str]:
    """The command, typed in a project below a folder of that name,
    which every option spells out.
    """
    here = tmp_path / CANARY / "project"
    (here / "datasets").mkdir(parents=True)
    (here / "swarmdrive.toml").touch()
    (here / "datasets/mine").symlink_to(small_path)
    (here / "datasets/suites.toml").write_text('[two]\ndescription = "One."\ndatasets = ["mine"]\n')
    monkeypatch.chdir(here)

    def run(*args: str | Path) -> str:
        code, out, err = harness(*args)
        assert code == 0, err
        return out

    return run


def found(folder: Path) -> Iterator[Path]:
    """The files in which the name can be read,
    but for what a run and a study record of themselves.
    """
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        text = file.read_bytes().decode("utf-8", "ignore")
        if file.suffix == ".html" and 'id="index"' in text:
            parts = [f"block-{n}" for n in range(text.count('id="block-'))]
            text += "".join(packed(text, name) for name in ("about", "index", *parts))
        named = any(word in text for word in (CANARY, SECRET))
        if named and file.name not in RECORDS and "datasets" not in file.parts:
            yield file


def spoil(run: Path) -> None:
    """Have an engine name a file of the machine in an error,
    and the card a server with a password.
    """
    first, *rest = (run / "answers.jsonl").read_text().splitlines()
    said = f"cannot read {run.resolve()}/weights.bin"
    answer = json.loads(first) | {
        "error": said,
        "detail": f"the engine: {said}",
        "status": "bad_json",
    }
    (run / "answers.jsonl").write_text("\n".join([json.dumps(answer), *rest]) + "\n")
    manifest = json.loads((run / "run.json").read_text())
    manifest["model"]["server"] = {
        "base_url": [f"http://ada:{SECRET}@localhost:80/v1?key={SECRET}"]
    }
    manifest["engine_errors"] = 1
    (run / "run.json").write_text(json.dumps(manifest))
    digested(run)


@pytest.mark.slow
def test_no_page_of_runs_names_a_folder(typed: Callable[..., str]) -> None:
    here = Path.cwd()
    data = here / "datasets/mine"
    typed("eval", "--model", "proxy", *EVAL, "--dataset", data, "--out", here / "reports/one")
    replay = f"replay:{here}/reports/one"
    typed("eval", "--model", replay, *EVAL, "--dataset", data, "--out", here / "reports/two")
    typed(
        "eval", "--model", "proxy", *EVAL, "--dataset", "suite:two", "--out", here / "reports/suite"
    )
    typed(*DRIVE, "--model", "proxy", "--episodes", "1", "--first-seed", "100", "--seeds", "0", "--quiet",
          "--condition", "6g", "--condition", "single-local", "--out", here / "reports/driven")  # fmt: skip
    one, two = here / "reports/one", here / "reports/two"
    assert CANARY in (two / "run.json").read_text(), "the record has it"
    spoil(two)
    typed("report", two)
    typed("report", one, two, "--out", here / "both.html")
    typed("compare", one, two, "--html", here / "pair.html")
    typed("compare", one, one, "--junit", here / "gates.xml", "--fail-if", "success_rate < -0.9")
    typed("compare", one, two, "--html", here.parent / "elsewhere/apart.html")
    Path("comment.md").write_text(typed("compare", one, two, "--markdown"))
    typed("run", "history", here / "reports", "--html", here / "history.html")
    typed("study", "fidelity", one, here / "reports/driven", "--out", here / "fidelity")
    typed("run", "export", two, "--csv", "--out", here / "text")
    typed("run", "export", two, "--jsonl", "--out", here / "text")
    typed("run", "export", two, "--junit", here / "episodes.xml")
    typed("run", "export", one, "--sft", here / "lessons.jsonl", "--report-seeds-too")
    typed("run", "export", one, "--dpo", here / "pairs.jsonl", "--report-seeds-too")
    if find_spec("inspect_ai"):
        typed("run", "export", two, "--inspect", here / "log.json")
    assert [str(path) for path in found(here.parent.parent)] == []
    pages = here / "pair.html", here.parent / "elsewhere/apart.html", one / "x"
    places = [beside(page)(read(one)) for page in pages]
    assert places == ["reports/one/report.html", None, "report.html"], (
        "pages of one project are linked"
    )


@pytest.mark.exhaustive
def test_no_page_of_studies_names_a_folder(typed: Callable[..., str]) -> None:
    here = Path.cwd()
    run = here / "reports/one"
    typed("eval", "--model", "proxy", *EVAL, "--dataset", here / "datasets/mine", "--out", run)
    typed(
        "study", "sweep", run, "--over", "tau", "--grid", "0.7", "--quiet", "--out", here / "swept"
    )
    typed("study", "trust", run, "--attacks", "liar", "--rules", "median", "--share", "1/3", "--quiet",
          "--out", here / "trust")  # fmt: skip
    typed(
        "study",
        "schedule",
        "compare",
        run,
        "--schedule",
        "margin",
        "--quiet",
        "--out",
        here / "schedules",
    )
    typed("study", "attribute", run, "--sample", "2", "--quiet")
    typed("report", run)
    typed("study", "twins", "--model", "proxy", "--dataset", here / "datasets/mine", "--limit", "1",
          "--quiet", "--out", here / "twins")  # fmt: skip
    assert [str(path) for path in found(here)] == []
