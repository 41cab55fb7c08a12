"""The command line as typed: bad input is one line on stderr and exit code 2, whatever it is."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from evaluating import run, spec_of, with_ego
from tokenizers import Tokenizer, models

from harness import __version__, cli
from harness.cli.run import default_out
from harness.core import work
from harness.core.errors import UserError
from harness.core.resources import DATASET
from harness.dataset.load import Dataset, load
from harness.evaluate.run import evaluate
from harness.prompts import versions
from harness.runs.settings import parse_seeds

HEAVY = (
    "numpy", "pandas", "scipy", "torch", "transformers", "tokenizers", "jinja2", "jsonschema", "json_repair",
    "highway_env", "gymnasium", "shapely", "matplotlib", "rich", "starlette", "uvicorn",
    "aiohttp",
)  # fmt: skip


@dataclass(frozen=True)
class Said:
    code: int
    out: str
    err: str


Harness = Callable[..., Said]


@pytest.fixture
def harness(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Harness:
    """Runs a command line in an empty folder."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")

    def run(*args: str | Path) -> Said:
        monkeypatch.setattr(sys, "argv", ["harness", *map(str, args)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return Said(int(ended.value.code or 0), *capsys.readouterr())

    return run


def one_line(said: Said) -> str:
    """The one line of a refusal."""
    assert (said.code, said.out) == (2, ""), said
    assert said.err.startswith("harness: ")
    assert said.err.endswith("\n")
    line = said.err.removesuffix("\n")
    assert line.isprintable(), said.err
    assert os.listdir() == [], "a refusal writes nothing"
    return line


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["eval", "--model", "proxi"], "unknown model 'proxi'; did you mean 'proxy'?"),
        (["eval", "--model", "replay:nowhere"], "no such run directory"),
        (["eval", "--model", "swarm-"], 
            "did you mean one of swarm-smol, "
            "swarm-tiny, swarm-tiny-six, "),
        (["eval", "--prompt", "v22"], "unknown prompt 'v22'; did you mean 'v2'?"),
        (["eval", "--prompt", "../prompts/v2"], "unknown prompt '../prompts/v2'"),
        (["eval", "--condition", "5g"], "unknown operating point '5g'; known: 6g, cloud, "),
        (["eval", "--condition", "6g", "--condition", "\x1b[31m"], "unknown operating point"),
        (["eval", "--limit", "0"], "--limit 0: give 1 or more episodes"),
        (["eval", "--limit", "-3"], "--limit -3: give 1 or more episodes"),
        (["eval", "--limit", "ten"], "Invalid value for '--limit'"),
        (["eval", "--seeds", ""], "--seeds : give a range such as 0:5, or a list"),
        (["eval", "--seeds", "5:0"], "--seeds 5:0: give a range"),
        (["eval", "--seeds", "5"], 
            "--seeds 5: give 0:5 for seeds from 0 "
            "on, or 5:6 for seed 5 alone"),
        (["eval", "--seeds", "1,1"], "--seeds [1, 1]: give one or more different whole numbers"),
        (["eval", "--seeds", "a,b"], "--seeds a,b: give a range"),
        (["eval", "--seeds", "0:99999999999999999999"], "of 1000 seeds at most"),
        (["eval", "--batch-size", "0"], "--batch-size 0: give 1 or more"),
        (["eval", "--batch-size", "all"], "--batch-size all: give a number, 1 or more, or auto"),
        (
            ["eval", "--model", "swarm-tiny", "--batch-size", "auto"],
            "--batch-size auto: swarm-tiny is not asked at servers, which alone say what they take; "
            "give a number, 1 or more",
        ),
        (["eval", "--workers", "0"], 
            "--workers 0: give 1 to 256 "
            "processes, or ray for a Ray cluster"),
        (
            ["eval", "--model", "swarm-tiny", "--workers", "2"],
            "--workers 2: rules and servers answer to several processes, and swarm-tiny is a "
            "language model of one; give --batch-size",
        ),
        (["eval", "--thinking"], "--thinking: proxy cannot think; leave it out"),
        (["eval", "--device", "cuda"], 
            "--device cuda: proxy has no weights "
            "here (engines transformers"),
        (["eval", "--dtype", "int3"], 
            "--dtype int3: proxy has no weights "
            "here (engines transformers"),
        (["eval", "--modle", "proxy"], "No such option: --modle"),
        (["eval", "extra"], 
            "settings extra: there is no such file; give "
            "a run.toml or the folder of a run"),
        (["eval", "run.toml", "extra"], "unexpected extra argument"),
        (["evaluate"], "No such command 'evaluate'"),
        (["--verbose"], "No such option: --verbose"),
        (["prompt", "shwo"], "No such command 'shwo'"),
        (["run", "reports/mine"], "; known: ls, check, merge, export"),
        (["dataset", "show", "small"], "Missing argument 'scene'"),
        (["prompt", "show", "v99", "--scene", "00000-0"], "unknown prompt 'v99'"),
        (["prompt", "show", "v2", "--scene", "99999-9"], "unknown scene '99999-9'"),
        (["prompt", "show", "v2", "--scene", "00000-0", "--viewer", "v77"], 
            "unknown viewer of scene"),
        (["prompt", "check", "v2", "--tokenizer", "absent.gguf"], "no tokenizer at absent.gguf"),
        (["prompt", "release", "v2"], "prompt v2 is released already; copy it to a new version"),
        (["prompt", "release", "v99"], "unknown prompt 'v99'"),
        (["prompt", "show", "v2", "--viewer"], "Option '--viewer' requires an argument"),
        (["model", "check"], "Missing argument 'name'"),
        (["dataset", "check", __file__], "is a file; a dataset is a folder that `harness dataset"),
        (["eval", "--dataset", __file__], "is a file; a dataset is a folder that `harness dataset"),
        (["report", __file__], "is a file; a run is a folder, made by `harness eval`"),
        (["run", "check", __file__], "is a file; a run is a folder, made by `harness eval`"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_that_says_what_is_allowed(
    harness: Harness, args: list[str], said: str, small_path: Path
) -> None:
    if args[0] == "eval":
        args = ["eval", "--dataset", str(small_path), *args[1:]]
    if args[:2] in (["prompt", "show"], ["prompt", "check"]):
        args = [*args[:2], "--dataset", str(small_path), *args[2:]]
    assert said in one_line(harness(*args))


@pytest.fixture
def broken(small_path: Path, tmp_path: Path) -> Path:
    """A copy of the dataset to break."""
    return Path(shutil.copytree(small_path, tmp_path / "broken"))


@pytest.mark.parametrize("command", ["eval", "drive"])
@pytest.mark.parametrize("name", ["FOLDER", DATASET, "suite:v2v-safety-2"])
def test_a_dataset_in_place_of_settings_is_told_where_it_goes(
    command: str, name: str, small_path: Path, harness: Harness
) -> None:
    name = name.replace("FOLDER", str(small_path))
    assert one_line(harness(command, name)) == (
        f"harness: {name} is a dataset, and no settings; type `harness eval --dataset {name}`"
    )


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("eval proxy", "proxy is a model, and no settings; type `harness eval --model proxy`"),
        (
            "eval http://h:1/v1",
            "is a server, and no settings; give its address with --model: http://h",
        ),
        ("drive replay:r", "replay:r is a model, and no settings; type `harness drive --model"),
        ("drive --limit 3", "--limit is none of `harness drive`; give --episodes in `harness"),
        ("eval --scenario x", "--scenario is none of `harness eval`; give --dataset in `harness"),
        ("eval --condition 6g:tau", "'6g:tau': tau has no value; give it one, as in 6g:window_s="),
    ],
)
def test_what_stands_in_a_wrong_place_is_told_where_it_goes(
    typed: str, said: str, harness: Harness
) -> None:
    assert said in one_line(harness(*typed.split()))


def test_a_dataset_that_is_none_is_one_line(harness: Harness, tmp_path: Path) -> None:
    assert "unknown dataset 'nowhere'" in one_line(harness("eval", "--dataset", "nowhere"))
    (tmp_path / "empty").mkdir()
    assert "is no dataset (no manifest.json)" in one_line(
        harness("eval", "--dataset", tmp_path / "empty")
    )


@pytest.mark.parametrize("keep", [0, 1, -1, -4000])
def test_a_truncated_dataset_is_refused(harness: Harness, broken: Path, keep: int) -> None:
    data = (broken / "layouts.zip").read_bytes()
    (broken / "layouts.zip").write_bytes(data[:keep])
    assert "layouts.zip: cannot be read (" in one_line(harness("eval", "--dataset", broken))


def test_one_changed_byte_is_noticed_in_the_layouts(harness: Harness, broken: Path) -> None:
    data = bytearray((broken / "layouts.zip").read_bytes())
    data[len(data) // 2] ^= 1
    (broken / "layouts.zip").write_bytes(data)
    assert "layouts.zip 0000" in one_line(harness("prompt", "check", "v2", "--dataset", broken))
    said = harness("eval", "--dataset", broken)
    assert (said.code, said.out, said.err.count("\n")) == (2, "", 1)
    assert "layouts.zip 0000" in said.err
    assert list(Path("reports").glob("*/.work/answers.jsonl")), "what was answered by then is kept"


@pytest.mark.parametrize(
    "name", [f"{of}.schema.json" for of in ("scene", "tree", "manifest")] + ["README.md"]
)
def test_one_changed_byte_is_noticed_in_any_file(harness: Harness, broken: Path, name: str) -> None:
    data = bytearray((broken / name).read_bytes())
    data[len(data) // 2] ^= 1
    (broken / name).write_bytes(data)
    for command in (["eval"], ["prompt", "check", "v2"]):
        assert f"{name}: changed, its sha256 is not the manifest's" in one_line(
            harness(*command, "--dataset", broken)
        )


def test_a_manifest_that_is_none_is_one_line(harness: Harness, broken: Path) -> None:
    (broken / "manifest.json").write_text("{")
    assert "manifest.json cannot be read" in one_line(harness("eval", "--dataset", broken))
    (broken / "manifest.json").write_text('{"\\u001b[31m": 1}')
    assert "manifest.json: unknown key in manifest " in one_line(
        harness("eval", "--dataset", broken)
    )


def test_a_tokenizer_that_is_none_is_one_line(
    harness: Harness, small_path: Path, tmp_path: Path
) -> None:
    (tmp_path / "t.gguf").write_bytes(b"GGUF")
    args = ("eval", "--dry-run", "--dataset", small_path, "--tokenizer", tmp_path / "t.gguf")
    assert "is no readable tokenizer" in one_line(harness(*args))


def test_a_dry_run_counts_calls_no_model_and_writes_nothing(
    harness: Harness, small_path: Path
) -> None:
    scenes = len(load(small_path, 2).courses())
    said = harness("eval", "--dry-run", "--dataset", small_path, "--limit", "2", "--seeds", "7,9")
    assert (said.code, said.err, os.listdir()) == (0, "", [])
    on_courses = f"for the {scenes} scenes on the reference drivers' courses"
    assert (
        f"{scenes} requests to the ego and at most {3 * scenes} to helpers {on_courses}" in said.out
    )
    assert "; would score 3 conditions × 2 channel seeds; no model was called" in said.out
    assert "prompt tokens not counted" in said.out
    counted = ("eval", "--dry-run", "--dataset", small_path, "--limit", "2")
    assert f"{4 * scenes} requests {on_courses}" in harness(*counted, "--ask", "all").out
    for nobody in ("single-local", "v2x:schedule=never", "v2x:max_helpers=0"):
        assert f"{scenes} requests {on_courses}" in harness(*counted, "--condition", nobody).out
    said = harness("eval", "--dry-run", "--dataset", small_path, "--model", "brake", "--json")
    told = json.loads(said.out)
    scenes = len(load(small_path).courses())
    assert (told["requests"], told["seeds"], told["world"]["limit"]) == (
        scenes,
        [0, 1, 2, 3, 4],
        None,
    )
    assert told["requests_by_role"] == {"ego": scenes}
    assert [c["name"] for c in told["conditions"]] == ["single-local", "v2x", "6g"]


def test_what_says_json_is_json(harness: Harness, small_path: Path) -> None:
    listed = json.loads(harness("prompt", "list", "--json").out)
    assert [p["version"] for p in listed] == versions.names()
    args = ("prompt", "show", "v2", "--scene", "00001-0", "--dataset", small_path)
    shown = json.loads(harness(*args, "--json").out)
    assert list(shown) == ["v1", "v2", "v3", "v4"]
    assert [m["role"] for m in shown["v3"]] == ["system", "user"]
    assert list(json.loads(harness(*args, "--viewer", "v3", "--json").out)) == ["v3"]
    checked = json.loads(harness("prompt", "check", "v1", "--dataset", small_path, "--json").out)
    assert checked == {"version": "v1", "budget": [200, 400], "tokens": {}, "outside": []}


def test_one_version_that_cannot_be_used_hides_no_other(harness: Harness, tmp_path: Path) -> None:
    harness("init", "mine")
    os.chdir("mine")
    harness("prompt", "release", "mine")
    with Path("prompts/mine/ego.j2").open("a") as file:
        file.write("edited")
    for form, mark in (((), "{} "), (("--json",), '"version": "{}"')):
        said = harness("prompt", "list", *form)
        assert (said.code, said.err.count("\n")) == (2, 1)
        assert "prompt mine was released and its text has changed" in said.err
        assert all(mark.format(version) in said.out for version in ("mine", "v1", "v3"))


def test_a_version_whose_name_breaks_a_line_breaks_none(harness: Harness, tmp_path: Path) -> None:
    harness("init", "mine")
    os.chdir("mine")
    Path("prompts/mine").rename("prompts/a\nb")
    said = harness("prompt", "list")
    assert (said.code, said.err.count("\n")) == (2, 1)
    assert "prompt a\\nb has a name of more than plain signs; rename its folder" in said.err
    assert len(said.out.splitlines()) == len(versions.names())
    assert harness("prompt", "show", "a\nb", "--scene", "00000-0").err.count("\n") == 1


def test_the_version_is_printed(harness: Harness) -> None:
    assert harness("--version") == Said(0, f"harness {__version__}\n", "")


def test_people_read_the_same_in_eighty_columns(harness: Harness, small_path: Path) -> None:
    said = harness("prompt", "list")
    assert [line.split()[:2] for line in said.out.splitlines()] == [
        [v, "released"] for v in versions.names()
    ]
    assert max(map(len, said.out.splitlines())) <= 80
    said = harness(
        "prompt", "show", "v2", "--scene", "00001-0", "--viewer", "v1", "--dataset", small_path
    )
    assert said.out.startswith("--- v1 system\nYou drive car v1")
    said = harness("prompt", "check", "v2", "--dataset", small_path)
    scenes = len(load(small_path).courses())
    assert said.out.startswith(
        f"v2: renders for every viewer of {scenes} scenes; budget 200 to 400 tokens\n"
    )
    assert "tokens not counted" in said.out


def test_a_prompt_outside_its_budget_ends_with_one(
    harness: Harness, small_path: Path, tmp_path: Path
) -> None:
    """A tokenizer that takes a whole prompt for one word."""
    Tokenizer(models.WordLevel({"?": 0}, unk_token="?")).save(str(tmp_path / "words.json"))
    args = (
        "prompt",
        "check",
        "v2",
        "--dataset",
        small_path,
        "--tokenizer",
        tmp_path / "words.json",
    )
    said, data = harness(*args), load(small_path)
    scenes, first = len(data.courses()), data.forest.ids[0]
    every = 7 * scenes  # four viewers, and the ego with the messages of one, two and three
    assert said.code == 1
    assert (
        f"outside the budget: {every} of {every} prompts; the first are\nscene {first} viewer v1: 2"
        in said.out
    )
    assert f"scene {first} viewer v1 with messages of 3: 2 tokens" in said.out
    told = json.loads(harness(*args, "--json").out)
    two = {"least": 2, "mean": 2.0, "most": 2}
    assert told["tokens"] == {
        role: {"n": each * scenes, **two}
        for role, each in (("ego", 1), ("helper", 3), ("fusion", 3))
    }
    assert {o["messages"] for o in told["outside"]} == {0, 1, 2, 3}
    assert len(told["outside"]) == every


@pytest.mark.parametrize("text", ["0:5", "0,1,2,3,4"])
def test_seeds_are_a_range_or_a_list(text: str) -> None:
    assert parse_seeds(text) == (0, 1, 2, 3, 4)


@pytest.mark.parametrize(
    "text",
    [
        "",
        ":",
        "1:",
        ":1",
        "1:1",
        "1.5",
        "0:1001",
        "-9:-10",
        "9" * 5000,
        "0:1:2",
        "1,,2",
        "3,-1",
        "-5:0",
        f"3,{2**31}",
    ],
)
def test_any_other_seeds_are_refused(text: str) -> None:
    with pytest.raises(UserError, match="--seeds"):
        parse_seeds(text)


def test_a_thousand_seeds_are_the_most() -> None:
    assert len(parse_seeds("0:1000")) == 1000
    assert len(parse_seeds("1000:2000")) == 1000


HELD = """
import sys
from pathlib import Path
from harness.core.files import alone
with alone(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def interrupt(done: int) -> None:
    raise KeyboardInterrupt


def test_a_run_has_the_first_free_folder_or_goes_on_where_it_was_stopped(
    small: Dataset, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    spec = spec_of(small)
    base = Path("reports/proxy-v2-small")
    assert default_out(spec) == base
    run(spec, base)
    second, third = (base.with_name(f"proxy-v2-small-{n}") for n in (2, 3))
    assert default_out(spec) == second
    with pytest.raises(KeyboardInterrupt) as stopped:
        evaluate(spec, second, interrupt)
    assert stopped.value.__notes__ == [f"{second} keeps what is done"]
    assert default_out(spec) == second
    assert default_out(replace(spec, seeds=(7,))) == third, "it was begun with other settings"
    monkeypatch.setattr(work, "GONE_S", 0.0)
    holder = subprocess.Popen(
        [sys.executable, "-c", HELD, str(second / ".work" / "lock")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert holder.stdout.readline()
    assert default_out(spec) == third, "another process is at it"
    holder.communicate()
    (second / ".work" / "config.json").write_text("{")
    assert default_out(spec) == third, "it is damaged"
    hostile = with_ego(spec, card=replace(spec.ego.card, name="../../etc/\x00\n"))
    assert default_out(hostile).parent == Path("reports")
    assert "/" not in default_out(hostile).name


LIGHT = ["--help", "eval --help", "prompt --help", "model --help", "prompt list", "model list"]


@pytest.mark.parametrize("args", map(str.split, LIGHT), ids=LIGHT)
def test_help_and_lists_load_no_heavy_package(args: list[str]) -> None:
    code = (
        "import sys, harness.cli as c\n"
        f"sys.argv = ['harness', *{args!r}]\n"
        "try:\n    c.main()\nexcept SystemExit as end:\n    assert not end.code\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.lstrip().startswith("Usage: ") == ("--help" in args)
    # whether each prompt is a template at all
    needs = ["jinja2"] if args == ["prompt", "list"] else []
    assert done.stderr == f"{needs}\n"
