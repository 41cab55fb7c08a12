"""Extensions: the one that docs/extend.md shows, and those that do not work;
and the core without any.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluating import A_TENTH, spec_of
from msgspec import structs
from packaged import register
from reference import DOCS, blocks

import harness as package
from harness.cli.commands import COMMANDS
from harness.coordination.added_parts import added_parts
from harness.coordination.counterparts import COUNTERPARTS
from harness.coordination.encodings import ENCODINGS
from harness.coordination.part_settings import more_parts
from harness.coordination.schedules import READERS
from harness.core import extensions as known
from harness.core import plugins
from harness.core.errors import UserError, printable
from harness.core.extensions import Extension
from harness.core.plugins import Plugins
from harness.core.work import working
from harness.dataset.load import Dataset
from harness.evaluate import resolve
from harness.evaluate.command_options import OPTIONS
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.lifecycle import begin, unfinished
from harness.radio.profiles import MODELS
from harness.report import sections
from harness.runs import metric_values
from harness.runs.folder import read
from harness.runs.metrics import METRICS, entry
from harness.runs.settings import of_words, text_of, words

ROOT = Path(__file__).parents[2]
OURS, PACKAGES = ROOT / "harness" / "extensions", "harness.extensions."
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
ENTRIES = PROJECT["entry-points"]
# kinds of plug-ins that conditions name, and of what reads their files
NAMED = (
    "agents",
    "channel_models",
    "contents",
    "drives",
    "encodings",
    "families",
    "options",
    "readers",
    "rules",
    "schedules",
    "stopping_rules",
    "timers",
)
Said = tuple[int, str, str]
Typed = Callable[..., Said]
Installed = Callable[..., None]


def of_the_page(folder: Path) -> Path:
    """Write the package that docs/extend.md shows, in the order in which it shows its files."""
    page = (DOCS / "extend.md").read_text()
    [project] = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    extension, study = [
        block for language, block in blocks(DOCS / "extend.md") if language == "python"
    ][:2]
    for name, text in {
        "pyproject.toml": project,
        "doubt/__init__.py": extension,
        "doubt/study.py": study,
    }.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def in_process(packages: Sequence[Path], folder: Path, *typed: str) -> Said:
    """Type a command in a process of its own that has these folders of packages."""
    done = subprocess.run(
        [sys.executable, "-m", "harness", *typed], cwd=folder, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, packages))}, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


@pytest.mark.exhaustive
def test_the_extension_of_the_page_installs_and_runs(tmp_path: Path, two_path: Path) -> None:
    site = tmp_path / "site"
    options = [
        "--quiet",
        "--disable-pip-version-check",
        "--no-index",
        "--no-deps",
        "--no-build-isolation",
    ]
    pip = [sys.executable, "-m", "pip", "install", *options, "--target", str(site)]
    subprocess.run([*pip, str(of_the_page(tmp_path / "package"))], check=True)
    asked = ("--model", "proxy", "--condition", "6g", "--seeds", "0:2", "--dataset", str(two_path))
    typed = ("--doubt-above", "0.25", "--quiet", "--out", "reports/run")
    assert in_process([ROOT, site], tmp_path, "eval", *asked, *typed) == (0, "", "")
    stated = tomllib.loads((tmp_path / "reports" / "run" / "run.toml").read_text())
    assert stated["extensions"] == {"doubt_above": 0.25}
    manifest = json.loads((tmp_path / "reports" / "run" / "run.json").read_text())
    assert manifest["settings"]["extensions"] == {"doubt_above": 0.25}
    assert "--doubt-above 0.25" in manifest["command"]
    page = (tmp_path / "reports" / "run" / "report.html").read_text()
    assert "<h2>Doubt</h2>" in page
    assert page.count("Decisions in doubt") == 2  # its head, and the name of its region
    assert "decisions have a normalised entropy above 0.25." in page
    again = in_process(
        [ROOT, site], tmp_path, "eval", "reports/run", "--quiet", "--out", "reports/again"
    )
    assert again == (0, "", "")
    other = tmp_path / "reports" / "again" / "run.json"
    assert json.loads(other.read_text())["settings"]["extensions"] == {"doubt_above": 0.25}
    assert "doubt_rate" in (tmp_path / "reports" / "run" / "summary.csv").read_text()
    code, out, err = in_process(
        [ROOT, site], tmp_path, "study", "doubt", "reports/run", "--out", "reports/doubt"
    )
    assert (code, err) == (0, "")
    assert out.startswith("Doubt of run\n1 of 1 conditions have the metric.\n")
    listed = json.loads(in_process([ROOT, site], tmp_path, "run", "ls", "--json")[1])
    assert {one["name"]: one["kind"] for one in listed} == {
        "run": "eval",
        "again": "eval",
        "doubt": "doubt",
    }
    assert "\n  doubt " in in_process([ROOT, site], tmp_path, "study", "--help")[1]


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Installed:
    """Have a package register extensions, each with the text that makes it."""

    def put(**extensions: str) -> None:
        entries = "".join(f"{name} = of_others:{name.upper()}\n" for name in extensions)
        made = "".join(f"{name.upper()} = {text}\n" for name, text in extensions.items())
        source = f"from harness import Extension, Setting\n{made}"
        register(tmp_path / "site", f"[{known.GROUP}]\n{entries}", of_others=source)
        monkeypatch.syspath_prepend(tmp_path / "site")
        monkeypatch.delitem(sys.modules, "of_others", raising=False)

    return put


ODD = {
    'Extension(name="odd", interface=9)': "extension odd is for version 9 of "
    "`Extension`, and this is "
    "version 1; install a version of its package for this harness",
    'Extension(name="other")': "extension odd calls itself other; give both the same name",
    'Extension(name="odd", commands=["study x"])': "extension odd: its commands "
    "are no table of texts",
    'Extension(name="odd", adds={5: {"a": "x:y"}})': "extension odd: its adds are no table of t"
    "exts",
    'Extension(name="odd", adds={"rules": 3})': "extension odd: its adds are no table of texts",
    'Extension(name="odd", commands={"": "x:y"})': "extension odd: nobody can "
    "type '' of its commands",
    'Extension(name="odd", '
    'commands={"study  x": "x:y"})': "nobody can type 'study  x' of its commands",
    'Extension(name="odd", studies={"../x": "x"})': "extension odd: nobody can "
    "type '../x' of its studies",
    'Extension(name="odd", spellings={"old": ""})': "extension odd: nobody can "
    "type '' of its spellings",
    'Extension(name="odd", settings={"level": 3})': "extension odd: its settings "
    "are no table of Setting",
    'Extension(name="odd", '
    'settings={"a": Setting(int, "x", '
    '"")})': "its settings are no table of Setting",
    'Extension(name="odd", '
    'settings={"class": Setting(int, 1, '
    '"")})': "its settings are no table of Setting",
    'Extension(name="odd", '
    'settings={"help": Setting(int, 1, '
    '"")})': "its settings are no table of Setting",
    'Extension(name="odd", settings={"a": '
    'Setting(float, float("nan"), "")})': "are no table of Setting",
    'Extension(name="odd", settings={"a": Setting(tuple, ("x",), "")})': "are no table of Setting",
    'Extension(name="odd", settings={"a": Setting(int, 1, "", only="b")})': "no table of Setting",
    'Extension(name="odd", settings={"a": Setting(int, 10**30, "")})': "are no table of Setting",
    'Extension(name="odd", settings={"a": Setting(str, "\\ud800", "")})': "are no table of Setting",
    'Extension(name="odd", settings={"A '
    'b": Setting(int, 1, "")})': "its settings are no table of Setting",
    "1 / 0": "plug-in 'odd' (swarmdrive.extensions): "
    "of_others:ODD does not load (division by zero)",
    "Extension": "is of type type and no Extension",
    "exit()": "ends the program (SystemExit",
    "__import__('absent_package')": "does not load (No module named 'absent_package')",
}


@pytest.mark.parametrize(("text", "said"), ODD.items())
def test_an_extension_that_does_not_work_is_one_line_and_all_else_works(
    installed: Installed, harness: Typed, text: str, said: str
) -> None:
    installed(odd=text)
    code, out, err = harness("study", "--help")
    assert (code, err.count("\n")) == (0, 1), err
    assert said in err
    assert err.endswith("; all else works\n")
    assert "sweep" in out


def test_a_name_that_is_taken_is_left_out_with_a_line(installed: Installed, harness: Typed) -> None:
    installed(
        odd='Extension(name="odd", commands={"eval": "x:y", "odd": "x:y"}, studies={"sweep": '
        '"mine"})',
        other='Extension(name="other", commands={"odd": "x:z"})',
    )
    assert harness("eval", "--help")[0] == 0
    assert known.studies()["sweep"] == "sweep"
    code, _, err = harness("nothing")
    assert code == 2
    assert "extension odd: eval of its commands is taken; it is left out" in err
    assert "extension other: odd of its commands is taken" in err


@pytest.mark.parametrize("path", ["run", "run ls again", "benchmark", "serve"])
def test_no_command_of_a_package_hides_another_or_a_group(
    installed: Installed, harness: Typed, path: str
) -> None:
    installed(odd=f'Extension(name="odd", commands={{"{path}": "x:y"}})')
    code, out, err = harness("--help")
    assert code == 0
    assert err.count("\n") == 1
    assert f"extension odd: {path} of its commands is taken" in err
    assert "  benchmark  " in out


def test_no_spelling_of_a_package_hides_an_option(installed: Installed, harness: Typed) -> None:
    usual = harness("eval", "--limit", "x")
    installed(odd='Extension(name="odd", spellings={"eval --limit": "study sweep"})')
    assert harness("eval", "--limit", "x") == usual


@pytest.mark.parametrize("kind", ["spellings", "short"])
@pytest.mark.parametrize("path", ["run", "eval", "serve", "benchmark"])
def test_no_spelling_of_a_package_hides_a_command_or_a_group(
    installed: Installed, harness: Typed, kind: str, path: str
) -> None:
    usual = harness(path, "--help")
    installed(odd=f'Extension(name="odd", {kind}={{"{path}": "study sweep"}})')
    assert harness(path, "--help") == usual


def test_what_a_package_prints_as_it_loads_is_no_output_of_a_command(
    installed: Installed, harness: Typed
) -> None:
    installed(odd='print("hello") or Extension(name="odd")')
    code, out, err = harness("run", "ls", ".", "--json")
    assert (code, err) == (0, "hello\n")
    assert json.loads(out) == []


def test_what_sections_and_metrics_print_is_no_output_of_a_command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    loud_section = {"loud": lambda run: print("from a section")}
    monkeypatch.setattr(
        sections, "SECTIONS", Plugins("swarmdrive.sections", Callable, loud_section)
    )
    assert sections._written("loud", None) is None
    loud = replace(METRICS["success_rate"], name="loud")
    assert list(metric_values._values(loud, lambda: print("from a metric") or np.zeros(2), 2)) == [
        0.0,
        0.0,
    ]
    assert capsys.readouterr() == ("", "from a section\nfrom a metric\n")


def test_a_panel_may_name_what_is_not_there(installed: Installed, harness: Typed) -> None:
    installed(odd='Extension(name="odd", panels={"absent": "More", "gone": "Mine"})')
    code, out, err = harness("--help")
    assert (code, err) == (0, "")
    assert "Mine" not in out


def test_a_command_of_a_package_lies_in_any_module_and_its_failures_are_one_line(
    installed: Installed, harness: Typed
) -> None:
    places = {"study good": "of_others:command", "study gone": "of_others:absent", "lost": "absent"}
    installed(odd=f'Extension(name="odd", commands={places})')
    source = Path(sys.path[0]) / "of_others.py"
    source.write_text(f"{source.read_text()}\ndef command():\n    'Help it.'\n    print('done')\n")
    assert harness("study", "good") == (0, "done\n", "")
    for typed in (["study", "gone"], ["lost"]):
        code, _, err = harness(*typed)
        assert (code, err.count("\n")) == (2, 1)
        assert f"command {' '.join(typed)} (" in err
    code, out, err = harness("study", "--help")
    assert (code, err) == (0, "")
    assert "its package does not work" in out
    assert "Help it." in out


def test_a_file_sets_what_an_installed_extension_has_and_to_its_kind(
    installed: Installed, harness: Typed
) -> None:
    installed(odd='Extension(name="odd", settings={"level": Setting(float, 1.0, "h")})')
    for text, said in {
        "level = 'x'": "settings stated.toml: level = 'x'; allowed: float",
        "none = 2": "settings stated.toml: none is a setting of an "
        "extension that is not installed; "
        "install",
    }.items():
        Path("stated.toml").write_text(f"[extensions]\n{text}\n")
        code, out, err = harness("eval", "stated.toml")
        assert (code, out) == (2, "")
        assert said in err


@pytest.mark.parametrize("name", sorted(known.beside()))
def test_a_key_that_is_mistyped_is_told_those_of_extensions(
    name: str, harness: Typed, tmp_path: Path
) -> None:
    table, _, key = known.beside()[name].path(name).rpartition(".")
    wrong = key.replace("_", "-") + "s"
    text = f"[{table}]\n{wrong} = 1" if table else f"{wrong} = 1"
    (tmp_path / "typed.toml").write_text(text)
    code, _, error = harness("eval", tmp_path / "typed.toml", "--dry-run")
    assert (code, error.count("\n")) == (2, 1)
    assert key in error.partition("known: ")[2].strip().split(", ")
    by_name = f"[extensions]\n{name}s = 1"
    (tmp_path / "typed.toml").write_text(by_name)
    both = f"{text.replace(wrong, key)}\n[extensions]\n{name} = 1"
    (tmp_path / "both.toml").write_text(both)
    said = "stands by name in [extensions], too; leave one of both out"
    assert said in harness("eval", tmp_path / "both.toml", "--dry-run")[2]
    assert f"did you mean {name!r}?" in harness("eval", tmp_path / "typed.toml", "--dry-run")[2]


def test_another_package_takes_no_name_of_what_ships(installed: Installed, harness: Typed) -> None:
    name = next(iter(ENTRIES[known.GROUP]))
    installed(**{name: f'Extension(name="{name}")'})
    _, _, err = harness("study", "--help")
    assert known.extensions()[name].commands
    assert f"'{name}' (swarmdrive.extensions) is in two packages" in err


def test_what_extensions_add_is_found_like_what_the_core_has(
    installed: Installed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(METRICS, "_loaded", dict(METRICS.built_in))
    installed(odd='Extension(name="odd", adds={"metrics": {"success_again": "of_others:AGAIN"}})')
    source = Path(sys.path[0]) / "of_others.py"
    metric = 'replace(METRICS["success_rate"], name="success_again", primary=False)'
    imports = "from dataclasses import replace\nfrom harness.runs.metrics import METRICS\n"
    source.write_text(f"{source.read_text()}\n{imports}AGAIN = {metric}\n")
    entry.cache_clear()
    assert METRICS["success_again"].name == "success_again"
    assert "success_again" in METRICS


def test_a_package_adds_a_name_for_python_and_replaces_none(
    installed: Installed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(known.PYTHON, "_loaded", {})
    names = dict.fromkeys(("answer", "load"), "of_others:ANSWER")
    installed(odd=f'Extension(name="odd", adds={{"python": {names}}})')
    source = Path(sys.path[0]) / "of_others.py"
    source.write_text(f"{source.read_text()}\nANSWER = 42\n")
    assert package.answer == 42
    assert package.load.__module__ == "harness.api"
    assert "answer" in dir(package)


def test_an_extension_takes_plug_ins_of_a_kind_of_its_own(
    installed: Installed, capsys: pytest.CaptureFixture[str]
) -> None:
    installed(
        odd='Extension(name="odd", kinds={"tastes": "what is tasted"}, adds={"tastes": '
        '{"sweet": "of_others:SWEET"}})',
        other='Extension(name="other", adds={"tastes": {"sour": "of_others:ODD"}})',
        sweet="'sugar'",
    )
    tastes = Plugins("swarmdrive.tastes", str, {})
    known.extensions()
    assert "tastes" not in capsys.readouterr().err
    assert sorted(tastes) == ["sour", "sweet"]
    assert tastes["sweet"] == "sugar"
    with pytest.raises(UserError, match="is of type Extension and no str"):
        tastes["sour"]


def test_a_setting_of_a_package_puts_counterparts_beside_conditions(
    installed: Installed, monkeypatch: pytest.MonkeyPatch, small: Dataset
) -> None:
    """Runs state the conditions and not the setting, whoever has it; what is no setting is refused."""
    monkeypatch.setattr(COUNTERPARTS, "_loaded", {})
    setting = 'settings={"worse": Setting(tuple, (), "h")}'
    adds = 'adds={"counterparts": {"worse": "of_others:LOSS"}}'
    said = '{"0.5": "loss=0.5", "odd": "odd=1", "none": None}'
    installed(odd=f'Extension(name="odd", {setting}, {adds})', loss=f"{said}.__getitem__")
    typed = ("harness", "eval", "--condition", "single-local", "--condition", "6g")
    settings = of_words((*typed, "--worse", "0.5"))
    assert (settings.extensions, words(settings)) == (
        {"worse": ("0.5",)},
        (*typed, "--worse", "0.5"),
    )
    assert tomllib.loads(text_of(settings))["extensions"] == {"worse": ["0.5"]}
    played = resolve.spec(settings, FrozenSource(small)).settings
    assert played.condition == ("single-local", "6g", "6g:loss=0.5")
    assert played.extensions == {}
    assert "--worse" not in words(played)
    for text, line in {
        "odd": "unknown setting of operating point 6g 'odd'",
        "none": "worse: its package failed: its answer holds what is no text",
        "absent": "worse: its package failed: 'absent'",
    }.items():
        with pytest.raises(UserError, match=re.escape(line)):
            resolve.points(["6g"], {"worse": [text]})


@pytest.mark.parametrize("name", ENTRIES[known.GROUP])
def test_the_metadata_name_what_an_extension_that_ships_has(name: str) -> None:
    """They say what a command or study was part of where its folder is gone."""
    extension = known.extensions()[name]
    plug_ins = [f"{kind} {each}" for kind in NAMED for each in extension.adds.get(kind, {})]
    plug_ins += [f"settings {each}" for each in extension.settings]
    places = [each.place for each in extension.settings.values() if each.place]
    plug_ins += [f"settings {place}" for place in places]
    assert ENTRIES[known.GROUP][name] == f"{PACKAGES}{name}:EXTENSION"
    for group, names in (
        (known.COMMANDS, [*extension.commands, *extension.spellings, *extension.short]),
        (known.STUDIES, extension.studies),
        (known.NAMES, extension.adds.get("python", {})),
        (known.PLUG_INS, plug_ins),
    ):
        named = {
            key
            for key, package in ENTRIES.get(group, {}).items()
            if package.partition(" ")[0] == f"{PACKAGES}{name}"
        }
        assert named == set(names)
    for setting, each in extension.settings.items():
        idle = "" if each.default in (None, ()) else str(each.default)
        assert known.setting_of_run(setting) == known.OfExtension(name, idle)
        if each.place:
            assert known.setting_of_run(each.place) == known.OfExtension(name, idle)
    for part in extension.adds.get("parts", {}):
        for setting, default in structs.asdict(more_parts()[part]()).items():
            idle = "" if default is None else str(default)
            assert known.setting_of_extension(setting) == known.OfExtension(name, idle)
        for control in more_parts()[part].controls:
            assert control in known.control_settings().values()


def test_every_folder_of_an_extension_is_registered() -> None:
    folders = {path.parent.name for path in OURS.glob("*/__init__.py")}
    assert folders == set(ENTRIES[known.GROUP])


def test_registering_loads_nothing_but_the_record() -> None:
    """Every command reads these modules."""
    code = (
        "import sys\nfrom harness.core.extensions import extensions\nassert extensions()\n"
        "print([name for name in ('numpy', 'msgspec', 'typer', 'jinja2') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("[]\n", "")


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the checkout in which the folder of extensions is deleted."""
    copy = tmp_path_factory.mktemp("core") / "checkout"
    left_out = shutil.ignore_patterns("__pycache__", "extensions")
    shutil.copytree(ROOT / "harness", copy / "harness", ignore=left_out)
    for name in (
        "prompts",
        "models",
        "channels",
        "devices",
        "networks",
        "schedules",
        "pyproject.toml",
    ):
        (copy / name).symlink_to(ROOT / name)
    return copy


def in_the_core(core: Path, folder: Path, code: str) -> "subprocess.CompletedProcess[str]":
    """Run Python code in a process whose `harness` has no extensions,
    with the packages of this one.
    """
    return subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(core), *sys.path])}, check=True,
    )  # fmt: skip


@pytest.mark.exhaustive
def test_the_core_writes_the_same_run_without_extensions(
    core: Path, two_path: Path, harness: Typed, tmp_path: Path
) -> None:
    asked = ("eval", "--model", "proxy", "--dataset", str(two_path), "--seeds", "0:2", "--quiet")
    assert in_process([core], tmp_path, *asked, "--out", "without") == (0, "", "")
    assert harness(*asked, "--out", "with") == (0, "", "")
    for file in ("answers.jsonl", "episodes.csv", "summary.csv", "decisions.parquet"):
        one, other = ((tmp_path / run / file).read_bytes() for run in ("without", "with"))
        assert one == other, file
    assert in_process([core], tmp_path, "--help")[0] == 0


def test_whatever_is_typed_of_an_extension_that_is_gone_says_what_it_was_part_of(
    core: Path, tmp_path: Path
) -> None:
    """Old and short spellings, too."""
    code = (
        "import sys\nfrom harness.__main__ import main\n"
        f"for words in {[*ENTRIES[known.COMMANDS]]!r}:\n"
        "    sys.argv = ['harness', *words.split()]\n"
        "    try:\n        main()\n    except SystemExit as end:\n        print(end.code)\n"
    )
    done = in_the_core(core, tmp_path, code)
    said = done.stderr.splitlines()
    assert done.stdout.split() == ["2"] * len(said)
    for (command, place), line in zip(ENTRIES[known.COMMANDS].items(), said, strict=True):
        groups_too = re.match("(benchmark|model device|radio|study schedule)(?= )", command)
        typed = f"`harness {groups_too[0] if groups_too else command}`"
        if groups_too:  # of the extension that opens the group, whoever has the command
            place = next(
                each
                for name, each in ENTRIES[known.COMMANDS].items()
                if name.startswith(f"{groups_too[0]} ")
            )
        if " --" in command:  # an option that has become a command
            typed = command.split()[1]
        part = f"is part of the extension {place.rpartition('.')[2]}, which is not installed in "
        assert line.startswith(f"harness: {typed} {part}")


@pytest.mark.parametrize("name", ENTRIES[known.NAMES])
def test_a_name_for_python_that_is_gone_says_what_it_was_part_of(
    core: Path, tmp_path: Path, name: str
) -> None:
    code = (
        f"import harness\nprint(dir(harness))\ntry:\n    harness.{name}\n"
        "except harness.UserError as error:\n    print(error)\nassert not hasattr(harness, "
        "'absent')\n"
    )
    done = in_the_core(core, tmp_path, code)
    names, said = done.stdout.splitlines()
    assert f"'{name}'" not in names
    extension = ENTRIES[known.NAMES][name].rpartition(".")[2]
    assert said == f"`harness.{name}` is part of the extension {extension}, which is not installed"


@pytest.mark.slow
def test_what_is_gone_does_nothing_or_says_what_it_was_part_of(core: Path, tmp_path: Path) -> None:
    """Runs have it, whether it did something or not."""
    code = (
        "from harness.coordination.named_points import named_point\nfrom harness.coordination.operating_point import OperatingPoint\nfrom "
        "harness.core.errors import UserError\nfrom harness.world.scenarios import get\n"
        "from harness.cli.scenario import drives_of\n"
        "print(OperatingPoint.from_dict({'name': '6g', "
        "'profile': '6g', 'calibration': ''}).record() == OperatingPoint.from_dict({'name': '6g', "
        "'profile': '6g'}).record())\nfor ask in (lambda: OperatingPoint.from_dict({'name': '6g', "
        "'calibration': 'l1'}), lambda: named_point('6g:calibration=l1'), lambda: "
        "named_point('6g:content=objects'), lambda: named_point('6g:schedule=margin'), "
        "lambda: named_point('6g:schedule=learnt'), lambda: get('env:merge-v0:decisions=2'), "
        "lambda: named_point('its-g5'), lambda: named_point('mine'), "
        "lambda: named_point('6g:consensus=auction'), lambda: named_point('6g:rounds=2'), "
        "lambda: named_point('6g:encoding=etsi'), "
        "lambda: drives_of(get('all-way-crossing:agent_share=1'))):\n    try:\n        "
        "ask()\n    except UserError as error:\n        print(error)\n"
    )
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "channels").mkdir()
    profile = 'description = "x"\nsource = "x"\nstatus = "assumed"\nmodel = "trace"\n'
    (tmp_path / "channels/mine.toml").write_text(profile)
    done = in_the_core(core, tmp_path, code)
    of_one = "is part of the extension calibration, which is not installed"
    mine = printable(tmp_path / "channels/mine.toml")
    learnt = f"file {printable(core / 'schedules/learnt.toml')}: what reads it"
    assert done.stdout.splitlines() == [
        "True",
        *[f"setting calibration=l1 of a condition {of_one}"] * 2,
        "content objects is part of the extension contents, which is not installed",
        *[
            f"schedule {what} is part of the extension schedules, which is not installed"
            for what in ("margin", learnt)
        ],
        "scenario env:merge-v0:decisions=2 is part of the extension environments, which is not "
        "installed",
        *[
            f"channel file {file}: model {model} is part of the extension radio, which is not "
            "installed"
            for file, model in (
                (printable(core / "channels/its-g5.toml"), "its-g5"),
                (mine, "trace"),
            )
        ],
        "consensus auction is part of the extension plan, which is not installed",
        "setting rounds=2 of a condition is part of the extension plan, which is not installed",
        "encoding etsi is part of the extension radio, which is not installed",
        "all-way-crossing with several agents: how reference drivers drive it is part of the "
        "extension joint_plans, which is not installed",
    ]


@pytest.mark.parametrize(("name", "value"), [("max_cost", "2"), ("tracker", "mlflow")])
def test_an_option_of_a_command_that_is_gone_says_what_it_was_part_of(
    core: Path, tmp_path: Path, name: str, value: str
) -> None:
    """From Python, too."""
    code = (
        "import sys\nimport harness\nfrom harness.__main__ import main\n"
        f"try:\n    harness.run({name}={value!r})\n"
        "except harness.UserError as error:\n    print(error)\n"
        "for command in ('eval', 'drive'):\n"
        f"    sys.argv = ['harness', command, '--{name.replace('_', '-')}', {value!r}]\n"
        "    try:\n        main()\n    except SystemExit as end:\n        print(end.code)\n"
    )
    done = in_the_core(core, tmp_path, code)
    owner = ENTRIES[known.PLUG_INS][f"options {name}"].rpartition(".")[2]
    gone = f"is part of the extension {owner}, which is not installed"
    assert done.stdout.splitlines() == [f"setting {name} {gone}", "2", "2"]
    for line in done.stderr.splitlines():
        assert line.startswith(f"harness: --{name.replace('_', '-')} {gone} in `harness ")
    assert done.stderr.count("\n") == 2


def test_a_setting_of_a_run_that_is_gone_is_null_or_says_what_it_was_part_of(
    core: Path, tmp_path: Path
) -> None:
    """Whether it is typed, in a file of settings, or in a run; a run without it is read."""
    (tmp_path / "run.toml").write_text('device_profile = "agx-orin"\n')
    (tmp_path / "attacked.toml").write_text('control = []\nattack = ["liar"]\n')
    (tmp_path / "until.toml").write_text("[world]\nuntil_width = 10\n")
    (tmp_path / "mixed.toml").write_text('[helpers]\nmodel = "proxy-faulty"\n')
    code = (
        "import sys\nfrom harness.core.errors import UserError\nfrom harness.runs import formats, "
        "role_agents, stopping, timers\nfrom harness.__main__ import main\nidle = {'device_profile': None, "
        "'device_model': None, 'control': [], 'attack': [], 'helpers': {'model': None}, "
        "'ties': 'drawn', 'world': {'until_width': None}}\n"
        "print(formats.gathered(idle))\n"
        "print('device_profile' in formats.upgraded({**idle, 'settings': idle}))\n"
        "for ask in (lambda: formats.upgraded({'device_profile': {'name': 'mine'}}), "
        "lambda: formats.gathered({'world': {'until_width': 10.0}}), "
        "lambda: formats.gathered({'helpers': {'prompt': 'v2'}}), "
        "lambda: timers.timer('device'), lambda: stopping.rule_of({'layouts': 4}), "
        "lambda: role_agents.recorded([{}])):\n"
        "    try:\n        ask()\n"
        "    except UserError as error:\n        print(error)\n"
        "for typed in (['--device-profile', 'agx-orin'], ['run.toml'], ['--control', 'no-messages'], "
        "['attacked.toml'], ['until.toml'], ['--helper-model', 'proxy'], ['mixed.toml']):\n"
        "    sys.argv = ['harness', 'eval', *typed]\n"
        "    try:\n        main()\n    except SystemExit as end:\n        print(end.code)\n"
    )
    done = in_the_core(core, tmp_path, code)
    gone = "is part of the extension devices, which is not installed"
    early_stop = "is part of the extension early_stop, which is not installed"
    mixed = "part of the extension mixed_helpers, which is not installed"
    assert done.stdout.splitlines() == [
        "{'ties': 'drawn', 'world': {}, 'extensions': {}}",
        "False",
        f"setting device_profile {gone}",
        f"setting until_width {early_stop}",
        f"setting helpers.prompt is {mixed}",
        f"what timed the answers of a run, device, {gone}",
        f"what may stop a run, looks in its run.json, {early_stop}",
        f"helpers that the ego's agent does not answer for are {mixed}",
        *["2"] * 7,
    ]
    typed, stated, control, attack, until, helper, helpers = done.stderr.splitlines()
    assert typed.startswith(f"harness: --device-profile {gone} in `harness eval --device-profile ")
    assert stated == f"harness: setting device_profile {gone}"
    assert control.startswith("harness: --control is part of the extension controls, which is not ")
    assert (
        attack == "harness: setting attack is part of the extension trust, which is not installed"
    )
    assert until == f"harness: setting until_width {early_stop}"
    assert helper.startswith(f"harness: --helper-model is {mixed} in `harness eval --helper-model ")
    assert helpers == f"harness: setting helpers.model is {mixed}"


@pytest.mark.slow
def test_a_run_of_selected_episodes_is_read_without_what_selected_them(
    core: Path, small_path: Path, harness: Typed, tmp_path: Path
) -> None:
    """Its numbers stand in it; nobody selects others, and a file that does is refused."""
    of = ("--dataset", str(small_path), "--condition", "6g", "--seeds", "0:1", "--quiet")
    assert harness("eval", *of, "--only", "1:4", "--sample", "2", "--out", "run") == (0, "", "")
    assert harness("eval", *of, "--out", "all") == (0, "", "")
    code = (
        "import sys\nfrom harness.__main__ import main\nfor typed in (['run', 'check', 'run'], "
        "['compare', 'all', 'run'], ['report', 'run'], ['eval', 'all', '--limit', '1', '--out', "
        "'b'], ['eval', 'run'], ['eval', '--sample', '2']):\n    sys.argv = ['harness', *typed]\n"
        "    try:\n        main()\n    except SystemExit as end:\n        print('code', end.code)\n"
    )
    done = in_the_core(core, tmp_path, code)
    gone = "is part of the extension selection, which is not installed"
    unchecked = f"Whether these are the episodes to select is not checked: that {gone}."
    assert "run: equal where it can be checked: " in done.stdout
    assert unchecked in " ".join(done.stdout.split())
    codes = re.findall(r"^code (.*)", done.stdout, re.MULTILINE)
    assert {*codes[:4]} == {"None", "0"}
    assert codes[4:] == ["2", "2"]
    file, typed = done.stderr.splitlines()
    assert file == f"harness: setting only {gone}"
    assert typed.startswith(f"harness: --sample {gone} in `harness eval --sample 2`")


PART = """
from typing import ClassVar
import numpy as np
from dataclasses import replace
from harness.extend import Part

class Muffled(Part, frozen=True, kw_only=True):
    behind: ClassVar[str] = "content"
    muffle: float = 0.0

    def check_with(self, point):
        if point.radio.profile == "v2x":
            raise ValueError("muffle does not go with v2x")

    def before(self, intents):
        return replace(intents, helpers=(1 - self.muffle) * intents.helpers + self.muffle / 3)
"""


@pytest.mark.slow
def test_a_package_adds_a_part_of_a_condition(tmp_path: Path, two_path: Path) -> None:
    """Its setting is typed and recorded like any other,
    and refuses in one line what it does not go with.
    """
    parts = '{"parts": {"muffled": "muffled:Muffled"}}'
    extension = f'from harness import Extension\nODD = Extension(name="odd", adds={parts})\n'
    register(
        tmp_path / "site",
        f"[{known.GROUP}]\nodd = of_others:ODD\n",
        of_others=extension,
        muffled=PART,
    )
    both, alone = [ROOT, tmp_path / "site"], [ROOT]
    asked = ("eval", "--model", "proxy", "--dataset", str(two_path), "--seeds", "0:2", "--quiet")
    typed = ("--condition", "6g", "--condition", "6g:muffle=1", "--condition", "6g:muffle=0")
    assert in_process(both, tmp_path, *asked, *typed, "--out", "run") == (0, "", "")
    stated = json.loads((tmp_path / "run/run.json").read_text())["conditions"]
    assert [condition.get("muffle") for condition in stated] == [None, 1.0, None]
    decisions = read(tmp_path / "run").decisions
    names, fused = np.array(decisions.labels("condition")), decisions.of_actions("fused")
    plain, muffled, idle = (fused[names == name] for name in ("6g", "6g:muffle=1", "6g:muffle=0"))
    assert np.array_equal(plain, idle)
    assert not np.array_equal(plain, muffled)
    code, out, err = in_process(
        both, tmp_path, *asked, "--condition", "v2x:muffle=1", "--out", "other"
    )
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "muffle does not go with v2x" in err
    code, out, err = in_process(alone, tmp_path, "eval", "run", "--quiet", "--out", "again")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "muffle" in err


PARTS = "from harness.coordination.parts import Ask, Part\nclass Own(Part, frozen=True):\n    "
BROKEN_PARTS = {
    "ODD = 3": "part odd of package by-hand is no subclass of Part; repair its package",
    f"{PARTS}tau_nats: float = 0.0\nODD = Own": "has setting tau_nats, which another part has",
    f"{PARTS}own: float = 0.0\nODD = Own": "stands behind '', which is no setting",
    f"{PARTS}controls = {{'a': 5}}\nODD = Own": "controls holds what is no text",
    f"{PARTS}usual = {{5: 'a'}}\nODD = Own": "usual holds what is no text",
    f"{PARTS}questions = ('zork',)\nODD = Own": "questions hold what is no Question",
    **{
        f"{PARTS}behind = 'tau_nats'\n    {hook}\nODD = Own": f"`{name}`, which only parts that ship"
        for name, hook in {
            "again": "def again(self, *given): return given[1:3]",
            "unasked": "def unasked(self, point): return 3",
            "unasked_of": "unasked_of = classmethod(lambda cls, text: 3)",
        }.items()
    },
    "ODD = 1 / 0": "part odd of package by-hand fails (ZeroDivisionError: division by zero at",
}


@pytest.mark.parametrize(("source", "said"), BROKEN_PARTS.items())
def test_a_part_that_does_not_work_is_one_line_and_all_else_works(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    source: str,
    said: str,
) -> None:
    extension = (
        'from harness import Extension\nEXT = Extension(name="odd", adds={"parts": {"odd": '
        '"odd_part:ODD"}})'
    )
    register(
        tmp_path / "site",
        f"[{known.GROUP}]\nodd = of_others:EXT\n",
        of_others=extension,
        odd_part=source,
    )
    monkeypatch.syspath_prepend(tmp_path / "site")
    for name in ("of_others", "odd_part"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    assert "odd" not in added_parts(["tau_nats"])
    assert said in capsys.readouterr().err


def test_the_core_names_no_command_of_an_extension() -> None:
    assert not set(COMMANDS) & set(ENTRIES[known.COMMANDS])
    assert isinstance(Extension(name="x"), Extension)


def test_a_stopped_run_resumes_with_an_extensions_setting_as_it_was(
    installed: Installed, small: Dataset, tmp_path: Path
) -> None:
    installed(odd='Extension(name="odd", settings={"level": Setting(int, 1, "h")})')
    spec = spec_of(small)
    start = begin(spec, tmp_path / "run", None, {}, A_TENTH)
    assert start.settings["settings"]["extensions"] == {"level": 1}
    with working(tmp_path / "run", start):
        pass
    assert unfinished(spec, tmp_path / "run") is not None
    with pytest.raises(UserError, match="was begun with --level 1, and not with --level 2"):
        unfinished(spec.changed(extensions={"level": 2}), tmp_path / "run")


def test_a_command_of_a_package_that_fails_is_one_line(
    installed: Installed, harness: Typed
) -> None:
    installed(
        odd='Extension(name="odd", commands={"oddly": "of_others:fail", "leave": '
        '"of_others:leave"})'
    )
    source = Path(sys.path[0]) / "of_others.py"
    fail = "def fail():\n    raise ValueError('bad\\x1b[31m')\n"
    leave = "def leave():\n    raise typer.Exit(4)\n"
    source.write_text(f"{source.read_text()}\nimport typer\n{fail}{leave}")
    code, out, err = harness("oddly")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert (
        "command oddly (of_others:fail) fails (bad\\x1b[31m); repair or uninstall its package"
        in err
    )
    assert harness("leave") == (4, "", "")


def test_metadata_that_cannot_be_read_are_one_line(
    tmp_path: Path, harness: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    register(tmp_path / "site", f"[{known.GROUP}]\nbad\n")
    monkeypatch.syspath_prepend(tmp_path / "site")
    code, _, err = harness("study", "--help")
    assert code == 0
    assert "the entry points of package by-hand cannot be read" in err
    assert known.extensions()


@pytest.mark.parametrize("registry", [MODELS, ENCODINGS, READERS, OPTIONS])
def test_no_package_adds_what_only_extensions_that_ship_add(
    installed: Installed, registry: Plugins, capsys: pytest.CaptureFixture[str]
) -> None:
    kind = registry.group.rpartition(".")[2]
    before = list(registry)
    installed(odd=f'Extension(name="odd", adds={{"{kind}": {{"mine": "of_others:ODD"}}}})')
    assert "odd" in known.extensions()
    assert f"odd adds {kind}, which only extensions that ship add; al" in capsys.readouterr().err
    assert list(registry) == before
    assert "mine" not in registry


def test_plug_ins_that_nothing_takes_are_one_line(
    installed: Installed, capsys: pytest.CaptureFixture[str]
) -> None:
    installed(odd='Extension(name="odd", adds={"colours": {"mine": "of_others:ODD"}})')
    assert "odd" in known.extensions()
    assert "extension odd adds colours, which nothing takes; allowed: " in capsys.readouterr().err


def test_kinds_of_a_package_are_shown_as_text_and_hush_nothing(
    installed: Installed, capsys: pytest.CaptureFixture[str]
) -> None:
    kinds = '"a\\x1b[31m": "", "timers": ""'
    adds = '"timers": {"mine": "of_others:ODD"}'
    installed(odd=f'Extension(name="odd", kinds={{{kinds}}}, adds={{{adds}}})')
    assert "odd" in known.extensions()
    error = capsys.readouterr().err
    assert "adds timers, which only extensions that ship add; allowed: a\\x1b[31m, a" in error


def test_every_registry_is_of_a_kind_that_extensions_may_add() -> None:
    called = re.compile(r"\b\w+(?:\[.*\])?\(\s*\"swarmdrive\.(\w+)\"")
    groups = set[str]()
    for file in Path(package.__file__).parent.rglob("*.py"):
        if "extensions" not in file.parts:
            groups |= set(called.findall(file.read_text()))
    assert groups | {"parts"} == known.KINDS | known.SHIPPED_KINDS


@pytest.mark.parametrize("name", [plugins.OURS, "Swarmdrive_Harness"])
def test_a_package_with_our_name_that_hides_what_ships_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    about = tmp_path / "swarmdrive_harness-9.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 9.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    known.extensions()
    assert (
        f"harness: the package in {tmp_path} is called swarmdrive-harness as well, and hides what "
        "the harness has; uninstall it\n"
    ) in capsys.readouterr().err


VIDEOS_THAT_FAIL = """
class Videos:
    def ready(self): return 1 / 0
    def write(self, run, most, quiet): return []
VIDEOS = Videos()
class Audit:
    def ready(self): return 1 / 0
    def found(self, *given): return ""
AUDIT = Audit()
"""


@pytest.mark.parametrize(
    "typed",
    [
        "drive --episodes 1 --save-video 1",
        "dataset build occluded-intersection --episodes 100 --out built",
    ],
)
def test_videos_and_audits_of_a_package_that_fail_are_one_line(
    installed: Installed,
    harness: Typed,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    typed: str,
) -> None:
    adds = {"videos": {"mine": "of_others:VIDEOS"}, "audits": {"mine": "of_others:AUDIT"}}
    installed(odd=f'Extension(name="odd", adds={adds})')
    source = Path(sys.path[0]) / "of_others.py"
    source.write_text(source.read_text() + VIDEOS_THAT_FAIL)
    monkeypatch.chdir(tmp_path)
    code, _, err = harness(*typed.split())
    assert code == 2
    assert "mine: its package failed: division by zero" in err.splitlines()[-1]


def test_a_plug_in_of_an_extension_with_the_name_of_a_built_in_one_is_left_out(
    installed: Installed, capsys: pytest.CaptureFixture[str]
) -> None:
    installed(odd='Extension(name="odd", adds={"metrics": {"success_rate": "of_others:X"}})')
    assert METRICS["success_rate"] is METRICS.built_in["success_rate"]
    assert len(METRICS) >= len(METRICS.built_in)
    assert (
        "'success_rate' (swarmdrive.metrics) of an extension is taken; it is left out"
        in capsys.readouterr().err
    )


def test_a_package_that_takes_long_to_load_is_named(
    installed: Installed, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("harness.core.plugins.LOADING_S", 0.05)
    monkeypatch.setattr("harness.core.strangers.LOOK_S", 0.01)
    monkeypatch.setattr("harness.core.strangers._watchers", set())
    installed(odd="__import__('time').sleep(0.2)")
    assert "odd" not in known.extensions()
    assert (
        "plug-in 'odd' (swarmdrive.extensions): of_others:ODD has not come back for 0.05 s"
        in capsys.readouterr().err
    )
