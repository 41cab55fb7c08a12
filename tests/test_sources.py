"""What a run keeps of what made it, and what is made of it once the originals are gone."""

import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from reading import details
from run_on_disk import digested
from tiers import some

from harness import cli
from harness.core.errors import UserError
from harness.core.places import nameless
from harness.prompts.versions import digest
from harness.report.compare import words
from harness.report.compare.difference import compare
from harness.report.compare.pair import pair
from harness.runs.folder import read
from harness.runs.run_dataset import dataset_of
from harness.runs.sources import prompt_of

Typed = Callable[..., tuple[int, str, str]]
Once = Callable[[str, Callable[[Path], object]], Path]
PROFILE = """model = "constant"
description = "a radio of one's own"
source = "this test"
status = "assumed"
[parameters]
latency_s = 0.01
loss = 0.1
bandwidth_bps = 1e7
access = "parallel"
"""
OF_RUN = (
    "--prompt", "mine", "--dataset", "own/scenes", "--condition", "mine", "--condition", "6g:round_trip=5g-city",
)  # fmt: skip
EVAL = ("eval", "--model", "proxy", "--seeds", "0", "--limit", "1", "--quiet")


def prompt(version: str, word: str) -> None:
    """A version of the project's own, which asks in another word."""
    shipped = Path(__file__).parent.parent / "prompts" / "v2"
    shutil.copytree(shipped, Path("prompts") / version, dirs_exist_ok=True)
    for file in ("ego.j2", "helper.j2"):
        text = (shipped / file).read_text()
        changed = text.replace("{% block user -%}\n", "{% block user -%}\n" + word)
        assert changed != text
        (Path("prompts") / version / file).write_text(changed)


def _make(out: Path, scenes: Path) -> None:
    """Make a project with a prompt, a channel, and a run of them on a dataset of its own."""
    shutil.copytree(scenes, out / "own/scenes")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(out)
        Path("swarmdrive.toml").touch()
        prompt("mine", "Mind: ")
        Path("channels").mkdir()
        Path("channels/mine.toml").write_text(PROFILE)
        patch.setattr(sys, "argv", ["harness", *EVAL, *OF_RUN, "--out", "reports/run"])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert not ended.value.code


@pytest.fixture
def project(once: Once, small_path: Path, harness: Typed, tmp_path: Path) -> Path:
    """A copy of that project, which is the current folder."""
    made = once("project", lambda out: _make(out, small_path))
    return Path(shutil.copytree(made, tmp_path, dirs_exist_ok=True))


def kept(run: Path) -> dict[str, str]:
    root = run / "sources"
    return {
        p.relative_to(root).as_posix(): p.read_text()
        for p in sorted(root.rglob("*"))
        if p.is_file()
    }


def prompts_shown(page: Path) -> list[str]:
    every = details(page.read_text()).values()
    return [m["content"] for detail in every for sent in detail["prompts"] for m in sent]


@pytest.mark.slow
def test_a_run_keeps_each_file_that_made_it_once(project: Path, harness: Typed) -> None:
    files, manifest = kept(project / "reports/run"), read(project / "reports/run").manifest
    assert sorted(files) == [
        "channels/6g.toml", "channels/mine.toml", "models/proxy.toml", "networks/5g-city.toml", "prompts/mine/ego.j2",
        "prompts/mine/helper.j2", "prompts/mine/prompt.toml", "schemas/mine/ego.json",
        "schemas/mine/helper.json",
    ]  # fmt: skip
    for name in ("prompts/mine/ego.j2", "channels/mine.toml"):
        assert files[name] == Path(name).read_text()
    texts = {name: files[f"prompts/mine/{name}"] for name in ("ego.j2", "helper.j2", "prompt.toml")}
    assert digest(texts) == manifest.prompt["sha256"]
    schema = json.loads(files["schemas/mine/ego.json"])
    assert tuple(schema["properties"]["action_distribution"]["required"]) == manifest.actions
    assert harness(*EVAL, *OF_RUN, "--out", "again")[0] == 0
    assert kept(Path("again")) == files


@pytest.mark.slow
def test_a_mixed_swarm_keeps_the_prompts_of_all(project: Path, harness: Typed) -> None:
    prompt("theirs", "Look: ")
    typed = (*EVAL, "--dataset", "own/scenes", "--condition", "6g", "--out", "mixed")
    assert harness(*typed, "--prompt", "mine", "--helper-prompt", "theirs")[0] == 0
    files = kept(Path("mixed"))
    assert {name.split("/")[1] for name in files if name.startswith("prompts/")} == {
        "mine",
        "theirs",
    }
    run = read(Path("mixed"))
    shutil.rmtree("prompts")
    for agent in (run.manifest.agent(0), *run.manifest.helpers):
        found = prompt_of(run, agent["prompt"])
        assert found is not None
        assert found.sha256 == agent["prompt"]["sha256"]


@pytest.mark.parametrize("gone", some(["deleted"], exhaustive=["edited"]))
def test_the_page_is_the_same_once_the_prompt_is_gone(
    gone: str, project: Path, harness: Typed
) -> None:
    assert harness("report", "reports/run", "--full")[0] == 0
    page = Path("reports/run/report.html")
    before, shown = page.read_bytes(), prompts_shown(page)
    assert any("Mind: " in text for text in shown)
    if gone == "edited":
        prompt("mine", "Do otherwise: ")
    else:
        shutil.rmtree("prompts")
    assert harness("report", "reports/run", "--full")[0] == 0
    assert page.read_bytes() == before


@pytest.mark.exhaustive
def test_prompts_that_are_gone_are_still_compared(project: Path, harness: Typed) -> None:
    prompt("other", "Beware: ")
    typed = (*EVAL, "--dataset", "own/scenes", "--condition", "mine", "--out", "reports/other")
    assert harness(*typed, "--prompt", "other")[0] == 0
    shutil.rmtree("prompts")
    both = ("compare", "reports/run", "reports/other", "--html", "page.html", "--verbose")
    code, out, _ = harness(*both)
    assert code == 0
    assert all(word in out for word in ("[-Mind:-]", "{+Beware:+}"))
    assert all(word in Path("page.html").read_text() for word in ("Mind:", "Beware:"))
    found = compare(pair(Path("reports/run"), Path("reports/other")))
    assert words.prompts(found, 0)[-1] == "  2 more changes: the page of --html has them"
    shutil.rmtree("reports/run/sources")
    code, out, err = harness(*both)
    assert (code, out) == (2, "")
    assert "page.html is kept: a new page would lack its prompts" in err
    assert harness("compare", "reports/run", "reports/other", "--html", "less.html")[0] == 0
    assert "is not here" in Path("less.html").read_text()
    assert harness("compare", "reports/run", "reports/other", "--html", "less.html")[0] == 0


@pytest.mark.slow
def test_a_page_is_never_replaced_by_one_that_says_less(project: Path, harness: Typed) -> None:
    assert harness("report", "reports/run")[0] == 0
    page = Path("reports/run/report.html")
    before = page.read_bytes()
    shutil.rmtree("prompts")
    shutil.rmtree("reports/run/sources")
    code, out, err = harness("report", "reports/run")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "a new page would lack its prompts (prompt mine with sha256" in err
    assert page.read_bytes() == before
    assert harness("report", "reports/run", "--out", "less.html")[0] == 0
    assert prompts_shown(Path("less.html")) == []
    assert harness("report", "reports/run", "--out", "less.html")[0] == 0, "it says as much"


def _edit(file: Path) -> None:
    file.write_text(file.read_text() + "more")


def _pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


@pytest.mark.parametrize("spoil", [_edit, _pipe, Path.unlink])
def test_a_kept_prompt_that_is_not_what_the_run_states_is_not_used(
    spoil: Callable[[Path], None], project: Path
) -> None:
    run = read(project / "reports/run")
    shutil.rmtree("prompts")
    assert prompt_of(run, run.manifest.prompt) is not None
    spoil(run.path / "sources/prompts/mine/ego.j2")
    assert prompt_of(run, run.manifest.prompt) is None


@pytest.mark.parametrize("place", ["sources", "sources/prompts", "sources/prompts/mine/ego.j2"])
def test_no_link_among_a_runs_sources_is_followed(
    place: str, project: Path, harness: Typed
) -> None:
    run = read(project / "reports/run")
    shutil.rmtree("prompts")
    link = run.path / place
    link.rename("before")
    link.symlink_to("/proc")  # where whoever walks comes upon what cannot be read
    for typed in (("report", run.path), ("run", "check", run.path)):
        code, out, err = harness(*typed)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert f"{place} is a link; put the file itself there, or delete it" in err
    with pytest.raises(UserError, match="is a link"):
        prompt_of(run, run.manifest.prompt)


def test_a_kept_prompt_with_another_text_is_named(project: Path, harness: Typed) -> None:
    _edit(Path("reports/run/sources/prompts/mine/ego.j2"))
    code, out, _ = harness("run", "check", "reports/run")
    assert code == 1
    said = "sources/prompts/mine has another digest than prompt mine in run.json"
    assert said in " ".join(out.split())


@pytest.mark.parametrize("version", ["../mine", "..", "", "\0", "mine/../mine", "/etc"])
def test_a_run_can_name_no_prompt_outside_its_folder(version: str, project: Path) -> None:
    run = read(project / "reports/run")
    stated = {**run.manifest.prompt, "version": version}
    assert prompt_of(run, stated) is None


def test_a_strangers_template_is_rendered_in_the_sandbox(project: Path, harness: Typed) -> None:
    folder = Path("reports/run/sources/prompts/mine")
    shutil.rmtree("prompts")
    texts = {name: (folder / name).read_text() for name in ("ego.j2", "helper.j2", "prompt.toml")}
    attack = "{{ ''.__class__.__mro__[1].__subclasses__() }}"
    texts["ego.j2"] = texts["ego.j2"].replace("Mind: ", attack)
    (folder / "ego.j2").write_text(texts["ego.j2"])
    manifest = json.loads(Path("reports/run/run.json").read_text())
    manifest["prompt"]["sha256"] = digest(texts)
    Path("reports/run/run.json").write_text(json.dumps(manifest))
    digested(Path("reports/run"))
    code, _, err = harness("report", "reports/run", "--out", "page.html")
    assert (code, err) == (0, "")
    assert "subclasses" not in " ".join(prompts_shown(Path("page.html")))


@pytest.mark.parametrize("moved", ["elsewhere", "renamed", "both", "named"])
def test_a_dataset_is_found_again(
    moved: str, project: Path, harness: Typed, tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    other = tmp_path_factory.mktemp("other")
    run = project / "reports/run"
    stated = json.loads((run / "run.json").read_text())["world"]["path"]
    assert stated == "own/scenes"
    if moved != "elsewhere":
        (project / "own").rename(other / "own")
        (project / "reports").rename(other / "reports")
        run = other / "reports/run"
    if moved == "both":  # the run's copy of an absolute path is of the old project
        text = (run / "run.json").read_text()
        (run / "run.json").write_text(text.replace('"own/scenes"', f'"{project}/own/scenes"'))
        digested(run)
    if moved == "named":
        (other / "datasets").mkdir()
        (other / "own/scenes").rename(other / "datasets/small")
    monkeypatch.chdir(tmp_path_factory.mktemp("nowhere"))
    assert dataset_of(read(run)).sha256 == read(run).manifest.world.sha256  # type: ignore[union-attr]
    assert harness("report", run, "--out", "page.html")[0] == 0


def test_a_dataset_that_is_not_the_runs_is_not_taken(project: Path, harness: Typed) -> None:
    Path("own/scenes").rename("hidden")
    code, out, err = harness("report", "reports/run")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "own/scenes, seen from here or from a folder above the run, nor known by its name" in err
    assert harness("report", "reports/run", "--dataset", "hidden")[0] == 0
    manifest = Path("hidden/manifest.json")
    manifest.write_text(manifest.read_text() + "\n")
    shutil.copytree("hidden", "own/scenes")
    for typed in (("report", "reports/run"), ("report", "reports/run", "--dataset", "hidden")):
        code, out, err = harness(*typed)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert "is not the one that reports/run was made on (sha256" in err
    with pytest.raises(UserError, match="no manifest"):
        dataset_of(read(Path("reports/run")), Path("reports"))


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        ("/home/ada/models/tiny.gguf", "tiny.gguf"),
        ("/home/ada/my models/tiny", "tiny"),
        ("C:\\Users\\ada\\tiny.gguf", "tiny.gguf"),
        ("~/models/tiny", "tiny"),
        ("../secret/tiny", "tiny"),
        ("Qwen/Qwen3-4B", "Qwen/Qwen3-4B"),
        ("datasets/own", "datasets/own"),
        ("a/b and 5 m/s, 1/2 of N/A", "a/b and 5 m/s, 1/2 of N/A"),
        ("http://ada:secret@host:80/v1?key=1", "http://host:80/v1"),
        ("cannot open /home/ada/x.bin: no file", "cannot open x.bin: no file"),
        ("file:///home/ada/x.bin", "x.bin"),
        (["/a/b/c", {"at": "/a/b/d"}], ["c", {"at": "d"}]),
        (3, 3),
    ],
)
def test_what_others_read_has_names_and_no_folders(value: object, shown: object) -> None:
    assert nameless(value) == shown
    assert nameless(shown) == shown


def test_a_command_line_has_names_and_no_folders() -> None:
    line = (
        "harness eval --model 'replay:/home/ada/my run/x' --out=/home/ada/r --server "
        "http://a:b@h/v1"
    )
    shown = "harness eval --model replay:x --out=r --server http://h/v1"
    assert nameless({"command": f"{line} --seeds 0,1"}) == {"command": f"{shown} --seeds 0,1"}


@pytest.mark.parametrize(
    "piece", ["x", "~", "/", "\\", ".", ":", "a/", "http:", "../", "C:", " /a"]
)
def test_a_long_text_is_read_once(piece: str) -> None:
    """Were it read from each of its characters to its end, this would take many minutes."""
    assert len(nameless(f"-{piece * (500_000 // len(piece))} at http://a:b@h/v1?k")) > len(
        "- at http://h/v1"
    )
