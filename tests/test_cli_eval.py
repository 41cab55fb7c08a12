"""`harness eval` as typed, from the command to the report."""

import json
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from shutil import copytree

import pytest
from evaluating import same_files

from harness.core import resources
from harness.core.resources import DATASET
from harness.dataset import load
from harness.runs.estimates import written
from harness.runs.folder import read
from harness.runs.headline import BALANCED, SUCCESS
from harness.runs.metric_names import GAINS

Said = tuple[int, str, str]


@pytest.mark.slow
def test_it_prints_a_table_and_where_the_report_is(
    harness: Callable[..., Said], small_path: Path
) -> None:
    code, out, err = harness("eval", "--dataset", small_path, "--limit", "2", "--seeds", "0:2")
    folder = Path("reports/proxy-v2-small")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert max(map(len, lines)) <= 80
    assert len(lines) <= 15
    for part in (
        "proxy · prompt v2 (not read) · json · small",
        "asked: ego 14, helper 33; all answers could be read",
        "success, % [95 % CI]",
        "single-local",
        "v2x",
        "6g",
        "local-view",
        "uniform",
        "n = 2 episodes × 2 channel seeds",
        "note: Only 2 episodes: the interval of a rate may reach 69 points",
    ):
        assert part in out
    assert lines[-2] == f"wrote {folder / 'report.html'}"
    assert {p.name for p in folder.iterdir()} >= {
        "run.json",
        "answers.jsonl",
        "decisions.parquet",
        "episodes.csv",
        "summary.csv",
        "report.html",
    }
    verbose = ("--dataset", small_path, "--limit", "2", "--seeds", "0:2", "--verbose")
    code, out, _ = harness("eval", *verbose, "--out", "again")
    assert code == 0
    assert "gain, points" in out, (
        "and of balanced success there is none: both layouts have a danger"
    )


@pytest.mark.parametrize(
    ("typed", "of_run", "next_command"),
    [
        (("--limit", "2"), "proxy", "harness eval one --model local-view"),
        (("--condition", "6g"), "proxy", "harness eval one --model local-view"),
        (("--condition", "6g"), "local-view", "harness eval one --model proxy"),
    ],
)
def test_it_ends_with_the_command_that_fits(
    typed: tuple[str, ...], of_run: str, next_command: str, harness: Callable[..., Said],
    small_path: Path,
) -> None:  # fmt: skip
    command = ("eval", "--dataset", small_path, "--limit", "2", "--seeds", "0:2")
    code, out, _ = harness(*command, *typed, "--model", of_run, "--out", "one")
    assert code == 0
    assert out.splitlines()[-1] == f"next: {next_command}"
    assert "6g over single-local" not in out, "both layouts end alike under every condition"
    following = harness(*shlex.split(next_command)[1:])
    assert following[0] == 0, following[2]


@pytest.mark.slow
def test_a_gain_that_is_not_clear_ends_with_a_plan(harness: Callable[..., Said]) -> None:
    code, out, _ = harness("eval", "--limit", "8", "--out", "pilot")
    lines = out.splitlines()
    assert (code, len(lines)) == (0, 15)
    [verdict] = [line for line in lines if line.startswith("6g over single-local: ")]
    assert verdict.endswith(", not clear")
    assert lines[-1] == "next: harness plan pilot"
    assert harness("plan", "pilot")[0] == 0


def test_a_second_run_of_the_same_scenes_is_compared_with_the_first(
    harness: Callable[..., Said], small_path: Path
) -> None:
    command = ("eval", "--dataset", small_path, "--limit", "2", "--condition", "6g")
    assert harness(*command, "--out", "one")[0] == 0
    _, out, _ = harness(*command, "--model", "local-view", "--out", "other")
    # a driver is what a model is compared with
    assert out.splitlines()[-1] == "next: harness compare other one"
    code, out, err = harness("compare", "other", "one")
    lines = out.splitlines()
    assert (code, err, len(lines) <= 15) == (0, "", True)
    assert [line.split()[0] for line in lines[-1:]] == ["next:"]
    assert "balanced success, %" in out or "success, %" in out
    _, out, _ = harness(*command, "--seeds", "7", "--out", "third")
    assert "next: harness compare" not in out, "nothing has its channel seeds"


def test_answers_that_cannot_be_read_ask_for_another_prompt(
    harness: Callable[..., Said], small_path: Path
) -> None:
    command = ("eval", "--dataset", small_path, "--limit", "2", "--model", "proxy-broken")
    Path(resources.MARKER).touch()
    Path("models").mkdir()
    card = resources.find("models", "proxy.toml").read_text()
    Path("models/proxy-broken.toml").write_text(f"{card}\n[failures]\ntruncation = 1.0\n")
    code, out, _ = harness(*command, "--out", "one")
    assert code == 0
    assert "None of the ego's 34 answers could be read" in out
    assert out.splitlines()[-1] == "next: harness prompt check v2 --model proxy-broken"
    broken = Path("models/proxy-broken.toml")
    broken.write_text(f"{broken.read_text()}[[prompts]]\nversion = 'v10'\nread = 24\nasked = 24\n")
    for typed, taken in (((), "v10"), (("--prompt", "v4"), "v4")):
        code, out, _ = harness(*command, *typed, "--out", taken)
        assert (code, out.startswith(f"proxy-broken · prompt {taken} ")) == (0, True)
    assert out.splitlines()[-1] == "next: harness eval v4 --prompt v10"


@pytest.mark.slow
def test_the_gain_is_of_what_leads(harness: Callable[..., Said], small_path: Path) -> None:
    command = ("eval", "--dataset", small_path, "--seeds", "0", "--verbose")
    code, out, _ = harness(*command, "--out", "run")
    assert code == 0
    lines = out.splitlines()
    assert max(map(len, lines)) <= 80
    assert "gain, points" not in out
    [head] = [n for n, line in enumerate(lines) if line.split() == ["balanced", "gain,", "in"]]
    [row] = [line for line in lines[head:] if line.startswith("6g ")]
    done = read(Path("run"))
    gain, plain = (done.score("6g", GAINS[of]) for of in (BALANCED, SUCCESS))
    assert gain is not None
    assert plain is not None
    assert gain.value != plain.value
    assert written(gain) in row
    _, out, _ = harness(*command, "--condition", "6g", "--out", "6g")
    assert "balanced success" in out
    assert "gain" not in out, "there is no condition to gain over"


@pytest.mark.slow
def test_json_is_the_manifest_and_the_summary(
    harness: Callable[..., Said], small_path: Path
) -> None:
    code, out, err = harness(
        "eval", "--dataset", small_path, "--limit", "1", "--seeds", "0", "--json"
    )
    told = json.loads(out, parse_constant=pytest.fail)
    assert (code, err) == (0, "")
    assert told["run"] == "reports/proxy-v2-small"
    assert told["manifest"]["prompt"]["version"] == "v2"
    rows = {(r["condition"], r["metric"], r["interval"]): r for r in told["summary"]}
    assert rows["single-local", "effective_loss", "episodes"]["value"] is None
    assert rows["6g", "success_rate", "episodes"]["n"] == 1


@pytest.mark.slow
def test_the_same_again_is_refused_and_goes_on_where_it_was_stopped(
    harness: Callable[..., Said], small_path: Path
) -> None:
    args = ("eval", "--dataset", small_path, "--limit", "1", "--seeds", "0", "--out", "run")
    code, first, _ = harness(*args)
    assert code == 0
    code, out, err = harness(*args)
    assert (code, out) == (2, "")
    assert (
        err
        == "harness: --out run already holds a finished run; choose another folder or delete it\n"
    )
    Path("run/.work").mkdir()  # as if it was killed while it wrote the report
    Path("run/report.html").unlink()
    code, out, err = harness(*args[:-4], "--seeds", "0:2", "--out", "run")
    assert (code, out) == (2, "")
    assert err.startswith(
        "harness: --out run was begun with --seeds 0:1, and not with --seeds 0,1; repeat its "
        "settings, "
    )
    code, again, err = harness(*args)
    assert (code, again, err) == (0, first, "")
    assert Path("run/report.html").is_file()
    assert not Path("run/.work").exists()


@pytest.mark.slow
def test_a_number_behind_the_usual_name_is_said(
    harness: Callable[..., Said], small_path: Path
) -> None:
    typed = (
        "eval",
        "--model",
        "brake",
        "--dataset",
        small_path,
        "--limit",
        "1",
        "--seeds",
        "0",
        "--quiet",
    )
    assert harness(*typed, "--condition", "single-local")[2] == ""
    code, out, err = harness(*typed, "--condition", "single-local")
    first = "reports/brake-v2-small"
    assert (code, out) == (0, "")
    assert err == f"{first} is there already; this goes to {first}-2\n"
    assert Path(f"{first}-2/run.json").is_file()


def test_a_dataset_in_the_command_has_its_name_or_a_path_from_here(
    small_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = load.find(DATASET)
    copytree(small_path, tmp_path / "data/mine")
    monkeypatch.chdir(tmp_path)
    assert load.argument(shipped) == DATASET
    assert load.argument(tmp_path / "data/mine") == load.argument(Path("data/mine")) == "data/mine"
    monkeypatch.chdir(tmp_path / "data")
    assert load.argument(tmp_path / "data/mine") == "mine"
    (tmp_path / "data/mine").rename(DATASET)
    assert load.argument(Path(DATASET)) == DATASET
    assert load.argument(shipped) == str(shipped), "that name now means the folder here"


@pytest.mark.slow
def test_the_command_in_the_manifest_runs_it_again(
    harness: Callable[..., Said], small_path: Path, tmp_path: Path
) -> None:
    harness(
        "eval",
        "--dataset",
        small_path,
        "--limit",
        "1",
        "--seeds",
        "0,3",
        "--condition",
        "6g",
        "--out",
        "a b",
    )
    manifest = json.loads((tmp_path / "a b" / "run.json").read_text())
    (tmp_path / "a b").rename(tmp_path / "first")
    code, _, _ = harness(*shlex.split(manifest["command"])[1:])
    assert code == 0
    assert same_files(tmp_path / "a b", tmp_path / "first")


@pytest.mark.slow
@pytest.mark.parametrize("command", ["eval", "drive"])
def test_the_old_spelling_of_a_full_page_writes_that_page(
    command: str, harness: Callable[..., Said], two_path: Path
) -> None:
    few = ("--dataset", two_path, "--limit", "1") if command == "eval" else ("--episodes", "1")
    asked = (command, *few, "--condition", "6g", "--seeds", "0:1", "--quiet", "--out", "run")
    code, out, err = harness(*asked, "--full")
    assert (code, out) == (0, "")
    assert err == (
        f"harness: `harness {command} --full` is now `harness report RUN --full`; the old "
        "spelling works until 0.5.0\n"
    )
    page = Path("run/report.html").read_bytes()
    assert harness("report", "run", "--full")[0] == 0
    assert Path("run/report.html").read_bytes() == page


@pytest.mark.slow
def test_a_limit_beyond_the_dataset_is_said(harness: Callable[..., Said], small_path: Path) -> None:
    code, out, err = harness("eval", "--dataset", small_path, "--limit", "9999", "--seeds", "0:1")
    assert (code, err) == (0, "--limit 9999: small has 4 episodes, all of which are used\n")
    assert "n = 4 episodes" in out


@pytest.mark.slow
def test_an_evaluation_loads_no_pandas_and_nothing_that_numpy_loads_late(tmp_path: Path) -> None:
    code = (
        "import sys, harness.cli as c\nsys.argv = ['harness', 'eval', '--model', 'proxy', "
        "'--limit', '1', '--out', sys.argv[1]]\ntry:\n    c.main()\nexcept SystemExit as end:\n    "
        "assert not end.code\nlate = ('scipy', 'pandas', 'matplotlib', 'numpy.f2py', "
        "'numpy.testing')\nprint([name for name in late if name in sys.modules], "
        "file=sys.stderr)\nimport numpy\nprint(numpy.f2py.__name__, numpy.testing.__name__, "
        "file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "run")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr.splitlines()[-2:] == ["[]", "numpy.f2py numpy.testing"]
