"""An edition of the benchmark: run, packed into one file,
and computed again from the answers in it.
"""

import json
import os
import re
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from shutil import copyfile, copytree
from zipfile import ZipFile

import evaluating
import numpy as np
import pytest
from run_on_disk import Row, made_up, restated
from tiers import some

from harness.core.errors import UserError
from harness.core.files import sha256_bytes, sha256_file
from harness.core.seeds import purpose
from harness.dataset.load import Dataset, released
from harness.evaluate import resolve
from harness.extensions.benchmark import board, results
from harness.extensions.benchmark.edition import named, of_file
from harness.extensions.benchmark.rescore import Here, Rescored, rescored
from harness.extensions.benchmark.results import CONTENTS, FILES, FORMAT, Contents
from harness.prompts import versions
from harness.runs.folder import Run, read
from harness.runs.suite import SuiteRun
from harness.runs.writer import record_text

Harness = Callable[..., tuple[int, str, str]]
Once = Callable[[str, Callable[[Path], object]], Path]
Change = Callable[[dict[str, bytes]], None]
ROOT = Path(__file__).parents[3]
SHIPPED = {
    "v2v-safety-1.0": "72eac34e97b6ec3154342ffafb03af7bfae3f6445e58a090c9110cc0d8f5cb10",
    "v2v-safety-1.1": "25ef2e32605a40c4a93ec2d0b7c80b863312d35b033c27b00595c253ffdd2808",
}
EDITION = """
description = "A small one"
condition = ["single-local", "6g"]
ranked_by = "6g"
seeds = "0:2"
latency = "paper"
ties = "drawn"
metrics = ["success_rate", "success_gain_over_single-local", "failed_rate_ego"]
[datasets]
small = "{}"
[prompts]
v2 = "{}"
"""


@pytest.fixture
def project(harness: Harness, tmp_path: Path, small_path: Path, small: Dataset) -> Harness:
    """The command, typed in a project that has an edition of one dataset."""
    (tmp_path / "swarmdrive.toml").touch()
    for folder in ("datasets", "editions"):
        (tmp_path / folder).mkdir()
    (tmp_path / "datasets/small").symlink_to(small_path)
    text = EDITION.format(small.sha256, versions.load("v2").sha256)
    (tmp_path / "editions/mine-1.toml").write_text(text)
    return harness


@pytest.fixture
def made(project: Harness, once: Once, tmp_path: Path) -> Path:
    """A file of results of `proxy-faulty`,
    some of whose answers are repaired and some unreadable.
    """

    def run(out: Path) -> None:
        code, _, err = project(
            "benchmark", "run", "mine-1", "--model", "proxy-faulty", "--quiet", "--out", out
        )
        assert (code, err) == (0, "")

    copytree(once("entry", run), tmp_path / "entry")

    def pack(out: Path) -> None:
        by = ("--edition", "mine-1", "--made-by", "A. N. Author")
        code, _, err = project("benchmark", "pack", "entry", *by, "--out", out)
        assert (code, err) == (0, "")

    copyfile(once("entry.zip", pack), tmp_path / "entry.zip")
    return tmp_path / "entry.zip"


def files_of(file: Path) -> dict[str, bytes]:
    with ZipFile(file) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write(file: Path, files: Mapping[str, bytes]) -> None:
    with ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)


def changed(file: Path, change: Change) -> None:
    files = files_of(file)
    change(files)
    write(file, files)


def answers(files: dict[str, bytes], change: Callable[[dict[str, object]], object]) -> None:
    """Change each answer, or leave it out where `change` returns False."""
    each = [json.loads(line) for line in files["small/answers.jsonl"].splitlines()]
    kept = [answer for answer in each if change(answer) is not False]
    files["small/answers.jsonl"] = b"".join(json.dumps(answer).encode() + b"\n" for answer in kept)
    digested(files)


def digested(files: dict[str, bytes]) -> None:
    """State the digests of what is stated, as a forger can."""
    answers_sha256 = sha256_bytes(files["small/answers.jsonl"])
    files["small/run.json"] = record_text(json.loads(files["small/run.json"]), answers_sha256)


def better(files: dict[str, bytes]) -> None:
    """State a figure that the answers do not give."""
    lines = files["small/summary.csv"].decode().splitlines(keepends=True)
    at = next(
        n for n, line in enumerate(lines) if ",6g,success_rate," in line and "episodes" in line
    )
    cells = lines[at].split(",")
    cells[6] = "0.987654"
    lines[at] = ",".join(cells)
    files["small/summary.csv"] = "".join(lines).encode()


@pytest.mark.slow
def test_a_file_of_results_has_the_answers_and_the_editions_figures_and_is_computed_again(
    project: Harness, made: Path
) -> None:
    files = files_of(made)
    assert list(files) == [CONTENTS, *(f"small/{name}" for name in FILES)]
    assert json.loads(files[CONTENTS])["made_by"] == "A. N. Author"
    figures = {line.split(",")[5] for line in files["small/summary.csv"].decode().splitlines()[1:]}
    assert figures == {"success_rate", "success_gain_over_single-local", "failed_rate_ego"}
    code, out, err = project("benchmark", "verify", made)
    assert (code, err) == (0, "")
    assert out.splitlines() == [
        f"{made}: proxy-faulty · v2 · json, made by A. N. Author",
        f"mine-1, digest {named('mine-1').digest}, as it is here",
        "equal to 12 digits: 7 figures of 4 layouts in 1 families",
    ]


def test_a_file_says_nothing_of_the_machine_and_its_bytes_follow_from_the_runs(
    project: Harness, made: Path, tmp_path: Path
) -> None:
    before = made.read_bytes()
    assert not any(str(tmp_path.parent).encode() in data for data in files_of(made).values())
    by = ("--edition", "mine-1", "--made-by", "A. N. Author")
    code, _, _ = project("benchmark", "pack", "entry/small", *by, "--out", "again.zip")
    assert code == 0
    assert Path("again.zip").read_bytes() == before


def test_a_stated_figure_that_the_answers_do_not_give_is_named(
    project: Harness, made: Path
) -> None:
    changed(made, better)
    code, out, _ = project("benchmark", "verify", made)
    assert code == 1
    assert "small: 1 differ: 6g success_rate episodes" in out
    assert "not equal to 12 digits" in out


def test_what_a_file_says_its_answers_mean_is_not_believed(project: Harness, made: Path) -> None:
    believed = {"intent": [1.0, 0.0, 0.0], "status": "ok", "mass": 9.0}
    changed(made, lambda files: answers(files, lambda a: a.update(believed)))
    assert project("benchmark", "verify", made)[0] == 0, "texts are read again"

    def brakes(answer: dict[str, object]) -> None:
        answer["raw"] = '{"SLOWER": 1.0, "IDLE": 0.0, "FASTER": 0.0}'

    changed(made, lambda files: answers(files, lambda a: brakes(a) if a["role"] == "ego" else None))
    code, out, _ = project("benchmark", "verify", made)
    assert code == 1
    assert re.search(r"small: 1 differ: \d+ answers of a rule that is here", out), (
        "which gives its own"
    )


def drop(files: dict[str, bytes]) -> None:
    answers(files, lambda answer: answer["role"] == "ego" or None)
    answers(files, lambda answer: "-2-" not in str(answer["scene"]))


def with_run(**changes: object) -> Change:
    def change(files: dict[str, bytes]) -> None:
        stated = restated(json.loads(files["small/run.json"]), changes)
        files["small/run.json"] = json.dumps(stated).encode()
        digested(files)

    return change


def with_contents(**changes: object) -> Change:
    def change(files: dict[str, bytes]) -> None:
        files[CONTENTS] = json.dumps(json.loads(files[CONTENTS]) | changes).encode()

    return change


def renamed(name: str) -> Change:
    """Have a run under a name that leads elsewhere."""

    def change(files: dict[str, bytes]) -> None:
        with_contents(runs=[name])(files)
        for file in FILES:
            files[f"{name}/{file}"] = files.pop(f"small/{file}")

    return change


def with_model(**changes: object) -> Change:
    def change(files: dict[str, bytes]) -> None:
        model = json.loads(files["small/run.json"])["model"]
        with_run(model=model | changes)(files)

    return change


def another_card(files: dict[str, bytes]) -> None:
    with_model(name="evil", engine="transformers", weights="/etc")(files)
    drop(files)


HOSTILE: dict[str, tuple[Change, str]] = {
    "a name above the folder": (renamed("../../escaped"), "runs: none, too many, one twice"),
    "an absolute name": (renamed("/tmp/escaped"), "runs: none, too many, one twice"),
    "a hidden name": (renamed(".hidden"), "runs: none, too many, one twice"),
    "a file too many": (lambda files: files.update({"small/x.py": b""}), 
        "it has other files "
        "than it should"),
    "a file too few": (lambda files: files.pop("small/episodes.csv"), 
        "it has other files "
        "than it should"),  # type: ignore[dict-item]
    "a bomb": (lambda files: files.update({"small/run.json": b" " * (17 << 20)}), 
        "small/run.json is "
        "larger"),
    "nothing but blanks": (
        lambda files: files.update({"small/answers.jsonl": b" " * (16 << 20)}), 
            "would unpack to 16 MB",
    ),
    "runs of another edition": (with_contents(runs=["small", "theirs"]), 
        "unknown dataset of mine-1"),
    "no contents": (lambda files: files.update({CONTENTS: b"{"}), "is no file of results"),
    "another format": (with_contents(format="swarmdrive-results/9"), "its format is not"),
    "another edition": (with_contents(edition="theirs-1"), "unknown edition 'theirs-1'"),
    "an edition that has changed": (with_contents(digest="0" * 64), "has digest"),
    "no run": (lambda files: files.update({"small/run.json": b"{}"}), "has format"),
    "other seeds": (with_run(seeds=[5, 6]), "its seeds: (5, 6), not (0, 1)"),
    "another prompt": (with_run(prompt={"version": "v9", "sha256": "0" * 64}), 
        "none of its prompts"),
    "another latency": (with_run(latency_source="card"), "its latency: card, not paper"),
    "an engine that nobody has": (with_model(engine="evil"), "evil"),
    "a replay": (with_model(engine="replay", weights="r"), "its answers are replayed"),
    "answers that are missing": (drop, "holds no answer for"),
    "a model to open": (another_card, "holds no answer for"),
    "broken answers": (lambda files: files.update({"small/answers.jsonl": b"{}\n"}), "is broken"),
    "divided sums": (with_run(sums="divide"), "its sums: divide, not refuse"),
    "blank pictures": (with_run(image="blank"), "its image: blank, not own"),
    "drawn answers": (with_run(temperature=0.5), "its temperature: 0.5, not 0"),
    "a reversed list": (with_run(flip=True), "its flip: True, not False"),
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE)
def test_a_hostile_file_is_refused_in_one_line_and_leaves_nothing(
    project: Harness, made: Path, tmp_path: Path, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is unpacked lies deep in the test's folder,
    so that what leaves its own folder is seen.
    """
    change, message = HOSTILE[what]
    changed(made, change)
    deep = tmp_path / "a/b"
    deep.mkdir(parents=True)
    monkeypatch.setattr(tempfile, "tempdir", str(deep))
    before = {path for path in tmp_path.rglob("*") if "__pycache__" not in path.parts}
    code, out, err = project("benchmark", "verify", made)
    assert (code, out) == (2, ""), err
    assert (err[:9], err.count("\n")) == ("harness: ", 1)
    assert message in err
    assert {path for path in tmp_path.rglob("*") if "__pycache__" not in path.parts} == before
    assert not Path("/tmp/escaped").exists()


def raw(data: bytes) -> Callable[[Path], object]:
    return lambda file: file.write_bytes(data)


def twice(file: Path) -> None:
    with pytest.warns(UserWarning, match="Duplicate name"), ZipFile(file, "a") as archive:
        archive.writestr(CONTENTS, b"{}")


def listed_at_length(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[-10:-6] = (1 << 30).to_bytes(4, "little")
    file.write_bytes(bytes(data))


def locked(file: Path) -> None:
    """Say of every file that it needs a password."""
    data = bytearray(file.read_bytes())
    for mark, flag in ((b"PK\1\2", 8), (b"PK\3\4", 6)):
        at = -1
        while (at := data.find(mark, at + 1)) >= 0:
            data[at + flag] |= 1
    file.write_bytes(bytes(data))


def packed_otherwise(file: Path) -> None:
    """Say of every file that it is packed by LZMA, which its bytes are not."""
    data = bytearray(file.read_bytes())
    for mark, at_method in ((b"PK\1\2", 10), (b"PK\3\4", 8)):
        at = -1
        while (at := data.find(mark, at + 1)) >= 0:
            data[at + at_method] = zipfile.ZIP_LZMA
    file.write_bytes(bytes(data))


@pytest.mark.parametrize(
    "harm",
    [
        packed_otherwise,
        raw(b""), raw(b"PK\5\6"), raw(b"\0" * 10_000), twice, listed_at_length, locked,
        lambda file: file.write_bytes(file.read_bytes()[:-30]),
        lambda file: file.unlink() or file.mkdir(),
        lambda file: file.unlink(),
    ],
)  # fmt: skip
def test_what_is_no_zip_file_of_ours_is_refused_in_one_line(
    project: Harness, made: Path, harm: Callable[[Path], object]
) -> None:
    harm(made)
    code, out, err = project("benchmark", "verify", made)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "is no file of results" in err or "entry.zip" in err


@pytest.mark.parametrize("slow_s", [-0.145, 1e308])
def test_a_delay_that_no_card_declares_is_not_taken(
    project: Harness, made: Path, slow_s: float
) -> None:
    changed(
        made, lambda files: answers(files, lambda a: a.update(prompt_tokens=10**15, slow_s=slow_s))
    )
    assert project("benchmark", "verify", made, "--quiet")[0] == 0


@pytest.mark.exhaustive
def test_who_sees_everything_is_known_here_whatever_a_file_says(project: Harness) -> None:
    code, _, err = project(
        "benchmark", "run", "mine-1", "--model", "full-view", "--quiet", "--out", "f"
    )
    assert (code, err) == (0, "")
    changed(Path("f.zip"), with_model(privileged=False))
    code, out, _ = project("benchmark", "board", "f.zip", "--json")
    [line] = json.loads(out)
    assert (code, line["rank"], line["equal"]) == (0, None, True)
    changed(Path("f.zip"), with_model(name="local-view"))
    code, out, err = project("benchmark", "verify", "f.zip")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "holds no answer for" in err, "that driver comes to other scenes"


@pytest.mark.slow
def test_a_rule_that_sees_what_vehicles_see_is_ranked_whatever_a_file_says(
    project: Harness, made: Path
) -> None:
    changed(made, with_model(privileged=True))
    code, out, _ = project("benchmark", "board", made, "--json")
    [line] = json.loads(out)
    assert (code, line["rank"], line["equal"]) == (0, 1, True)


@pytest.mark.slow
def test_a_replay_is_an_entry_of_the_model_that_was_asked(project: Harness, made: Path) -> None:
    usual = ("--dataset", "small", "--seeds", "0:2", "--latency", "paper", "--quiet")
    conditions = ("--condition", "single-local", "--condition", "6g")
    replay = ("--model", "replay:entry/small", *usual, *conditions, "--out", "again")
    assert project("eval", *replay)[0] == 0
    assert project("benchmark", "pack", "again", "--edition", "mine-1")[0] == 0
    code, out, err = project("benchmark", "board", "again.zip", "--json")
    [line] = json.loads(out)
    assert (code, err, line["equal"], line["agents"]) == (
        0,
        "",
        True,
        "proxy-faulty · a rule",
    )
    changed(Path("again.zip"), lambda files: answers(files, spoil))
    assert project("benchmark", "verify", "again.zip", "--quiet")[0] == 1, "the rule is asked"


def spoil(answer: dict[str, object]) -> None:
    answer["raw"] = str(answer["raw"]).replace("0.1", "0.2")


@pytest.mark.exhaustive
def test_a_driver_is_computed_again_from_its_own_answers(project: Harness) -> None:
    code, _, err = project(
        "benchmark", "run", "mine-1", "--model", "uniform", "--quiet", "--out", "u"
    )
    assert (code, err) == (0, "")
    assert project("benchmark", "verify", "u.zip", "--quiet")[:2] == (0, "")
    changed(Path("u.zip"), lambda files: answers(files, lambda a: a.update(raw="SLOWER")))
    assert project("benchmark", "verify", "u.zip", "--quiet")[0] == 1


@pytest.mark.parametrize(
    ("options", "why"),
    some(
        [(("--limit", "2"), "it has 2 layouts that were selected, and all count")],
        exhaustive=[
            (("--latency", "card"), "its latency: card, not paper"),
            (("--seeds", "1:3"), "its seeds: (1, 2), not (0, 1)"),
            (("--helper-model", "uniform"), None),
        ],
    ),
)
def test_runs_that_are_not_of_the_edition_are_not_packed(
    project: Harness, options: tuple[str, ...], why: str | None
) -> None:
    usual = (
        "--seeds",
        "0:2",
        "--condition",
        "single-local",
        "--condition",
        "6g",
        "--latency",
        "paper",
    )
    code, _, err = project(
        "eval", "--dataset", "small", *usual, *options, "--quiet", "--out", "run"
    )
    if why is None:
        assert code == 2, "a driver is no helper"
        return
    assert (code, err) == (0, "")
    code, out, err = project("benchmark", "pack", "run", "--edition", "mine-1")
    assert (code, out) == (2, "")
    assert why in err
    assert err.count("\n") == 1
    assert not Path("run.zip").exists()


def test_an_edition_is_its_tables_and_not_their_layout(project: Harness) -> None:
    file = Path("editions/mine-1.toml")
    text, digest = file.read_text(), of_file(file).digest
    file.write_text("# a remark\n" + text.replace('seeds = "0:2"', 'seeds   =   "0:2"'))
    assert of_file(file).digest == digest
    for old, new in (
        ('"0:2"', '"0:3"'),
        ('"drawn"', '"first"'),
        ('v2 = "', 'v2 = "0'),
        ('"6g"]', '"v2x", "6g"]'),
    ):
        assert old in text
        file.write_text(text.replace(old, new))
        assert of_file(file).digest != digest


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('ranked_by = "6g"', 'ranked_by = "7g"', "unknown ranked_by of edition"),
        ('"success_rate"', '"success_rat"', "unknown metric of edition"),
        ('seeds = "0:2"', 'seeds = "none"', "--seeds none"),
        ('ties = "drawn"', "ties = 2020-01-01", "editions/mine-1.toml"),
        ('ties = "drawn"', "", "ties"),
        (
            "[datasets]",
            '[golden]\nsha256 = ""\nlayouts = -1\n[datasets]',
            "mine-1.toml [golden]: layouts = -1; allowed: 1 or more",
        ),
    ],
)
def test_a_wrong_edition_is_one_line(project: Harness, old: str, new: str, message: str) -> None:
    file = Path("editions/mine-1.toml")
    file.write_text(file.read_text().replace(old, new))
    code, _, err = project("benchmark", "run", "mine-1")
    assert (code, err.count("\n")) == (2, 1)
    assert message in err


def test_a_dataset_that_is_not_the_editions_is_refused(project: Harness) -> None:
    file = Path("editions/mine-1.toml")
    file.write_text(file.read_text().replace('small = "', 'small = "f'))
    code, _, err = project("benchmark", "run", "mine-1")
    assert code == 2
    assert "dataset small has digest" in err


def test_an_edition_of_two_datasets_of_a_family_is_refused_at_every_door(
    project: Harness, made: Path, small_path: Path
) -> None:
    """Of which a file of results would count the last alone."""
    Path("datasets/twin").symlink_to(small_path)
    file = Path("editions/mine-1.toml")
    small = next(line for line in file.read_text().splitlines() if line.startswith("small ="))
    file.write_text(file.read_text().replace(small, f"{small}\n{small.replace('small', 'twin')}"))

    def of_two(files: dict[str, bytes]) -> None:
        contents = json.loads(files[CONTENTS])
        contents["digest"] = of_file(file).digest
        files[CONTENTS] = json.dumps(contents).encode()

    changed(made, of_two)
    twice = "has occluded-intersection twice, as datasets small and twin; give each family one"
    for typed, code in (
        (("pack", "entry/small", "entry/small", "--edition", "mine-1"), 2),
        (("verify", made), 2),
        (("board", made), 2),
    ):
        said = project("benchmark", *typed)
        assert (said[0], twice in said[2]) == (code, True), said


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_edition_is_as_it_was_released_and_of_what_is_released(name: str) -> None:
    edition = named(name)
    assert edition.digest == SHIPPED[name], "a released edition is never edited; make the next"
    assert edition.datasets.items() <= released().items()
    for version, sha256 in edition.prompts.items():
        assert (versions.load(version).sha256, versions.load(version).released) == (sha256, True)


def test_a_results_file_of_another_model_a_family_is_refused(project: Harness, made: Path) -> None:
    run = read(Path("entry/small"))
    with pytest.raises(UserError, match="another is of small, too"):
        named("mine-1").entry([run, run])


SHA256 = re.compile(r'(?m)^sha256 = "\w*"$')


def make_golden(name: str, file: Path, folder: Path) -> None:
    """Make an edition's golden file, and have the edition's file state its digest."""
    edition, runs = named(name), list[Run]()
    assert edition.golden
    for dataset in edition.datasets:
        source = edition.source(dataset, edition.golden.layouts)
        spec = resolve.spec(edition.settings(dataset, model="proxy-faulty"), source)
        evaluating.run(spec, folder / dataset)
        runs.append(read(folder / dataset))
    entry = edition.entry(runs, edition.golden.layouts)
    contents = results.Contents(
        format=results.FORMAT, edition=name, digest="", made_by="", runs=tuple(entry)
    )
    results.pack(contents, entry, edition.figures, edition.golden_file)
    pin(file, edition.golden_file)


def pin(file: Path, golden: Path) -> None:
    file.write_text(SHA256.sub(f'sha256 = "{sha256_file(golden)}"', file.read_text()))


@pytest.mark.parametrize("name", some(["v2v-safety-1.1"], exhaustive=["v2v-safety-1.0"]))
def test_figures_are_computed_as_a_shipped_edition_pins_them(name: str, tmp_path: Path) -> None:
    """The golden file has texts of `proxy-faulty`:
    strict ones, repaired ones, some that cannot be read.

    For a new edition `UPDATE_GOLDEN=NAME` makes it. That of a released edition is never made again.
    """
    if os.environ.get("UPDATE_GOLDEN") == name:
        make_golden(name, ROOT / f"editions/{name}.toml", tmp_path)
    Here().check(named(name))


@pytest.mark.exhaustive
def test_an_installation_that_computes_a_figure_otherwise_says_so(
    project: Harness, tmp_path: Path
) -> None:
    file, golden = Path("editions/mine-1.toml"), Path("editions/mine-1.golden.zip")
    file.write_text(file.read_text() + '[golden]\nsha256 = ""\nlayouts = 2\n')
    golden.touch()
    code, _, err = project("benchmark", "run", "mine-1")
    assert (code, err.count("\n")) == (2, 1)
    assert "is not the file that mine-1 pins" in err
    make_golden("mine-1", file, tmp_path / "made")
    assert project("benchmark", "verify", golden, "--quiet") == (0, "", "")
    code, out, err = project("benchmark", "board", golden)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "editions/mine-1.golden.zip pins mine-1 and is no entry" in err
    Here().check(named("mine-1"))
    changed(golden, better)
    pin(file, golden)
    code, _, err = project("benchmark", "run", "mine-1")
    assert (code, err.count("\n")) == (2, 1)
    assert "computes 1 figures of mine-1 otherwise than it pins" in err
    assert "such as small: 6g success_rate episodes" in err


@pytest.mark.slow
def test_a_board_ranks_files_and_says_who_made_them_and_what_was_computed_again(
    project: Harness, made: Path
) -> None:
    for model in ("uniform", "full-view"):
        by = ("--made-by", "<script>alert(1)</script>\u202e")
        assert (
            project("benchmark", "run", "mine-1", "--model", model, "--quiet", "--out", model, *by)[
                0
            ]
            == 0
        )
    copyfile(made, "twin.zip")
    copyfile(made, "forged.zip")
    changed(Path("forged.zip"), better)
    Path("broken.zip").write_bytes(b"no zip")
    files = ("uniform.zip", made, "twin.zip", "full-view.zip", "forged.zip")
    code, out, err = project("benchmark", "board", *files, "--json")
    assert (code, err) == (0, "")
    ranked = json.loads(out)
    success = [line["success"]["6g"]["value"] for line in ranked]
    assert success == sorted(success, reverse=True)
    assert [line["rank"] for line in ranked if line["agents"] == "full-view · a rule"] == [None]
    same = [line for line in ranked if line["agents"].startswith("proxy-faulty · a rule · ")]
    assert {"twin.zip", "forged.zip"} < {line["agents"].rpartition(" · ")[2] for line in same}
    assert [line["rank"] for line in same] == [1, 1, 1], "nobody is clearly better than itself"
    assert sorted(line["equal"] for line in same) == [False, True, True]
    assert len({json.dumps(line["success"]) for line in same}) == 1, (
        "the figures are those computed here"
    )
    page = Path("board.html").read_text()
    assert "<script>alert" not in page
    assert "⟨U+202E⟩" in page
    assert "1 figures differ" in page

    code, out, err = project("benchmark", "board", made, "broken.zip", "--out", "b.html")
    assert code == 1
    assert err.count("\n") == 1
    assert "left out: broken.zip is no file of results" in err
    assert max(map(len, out.splitlines())) <= 80
    assert "Left out: broken.zip" in Path("b.html").read_text()
    code, _, err = project("benchmark", "board", "broken.zip", "--out", "none.html")
    assert (code, Path("none.html").exists(), err.count("\n")) == (2, False, 1)
    assert "left out: broken.zip" in err


def test_a_board_does_not_take_the_place_of_a_file_that_it_ranks(
    project: Harness, made: Path
) -> None:
    before = made.read_bytes()
    Path("link.html").symlink_to(made)
    for out in ("entry.zip", "./entry.zip", "link.html"):
        code, _, err = project("benchmark", "board", made, "--out", out)
        assert (code, err.count("\n")) == (2, 1)
        assert "is one of the files to rank; name another file" in err
    assert made.read_bytes() == before


def test_a_board_does_not_take_the_place_of_what_is_no_page(project: Harness, made: Path) -> None:
    Path("notes.md").write_text("mine")
    code, _, err = project("benchmark", "board", made, "--out", "notes.md")
    assert (code, err.count("\n")) == (2, 1)
    assert "--out notes.md is a file that no command here wrote, and would be lost" in err
    assert Path("notes.md").read_text() == "mine"


def test_a_board_for_a_folder_is_refused_before_a_file_is_read(project: Harness) -> None:
    code, out, err = project("benchmark", "board", "missing.zip", "--out", "editions")
    assert (code, out) == (2, "")
    assert err == "harness: --out editions is a folder; name a file in it\n"


def test_a_check_that_is_interrupted_promises_no_folder(
    project: Harness, made: Path, tmp_path: Path
) -> None:
    """A run says which folder keeps what is done; that of a check is deleted."""

    def stop(answers: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as stopped:
        rescored(made, tmp_path / "check", stop, Here())
    assert not stopped.value.__notes__


def entry_that_loses(folder: Path, *lost: int, name: str = "v2v-safety-1.0") -> Rescored:
    """An entry of 60 layouts, half of them with a danger, that fails in some of them under 6g."""

    def end(row: Row) -> None:
        row["danger"] = "left" if row["episode"] % 2 else "none"
        if row["condition"] == "6g" and row["episode"] in lost:
            row |= {"success": False, "failure": "late"}

    run = read(made_up(folder, episode=end, episodes=60))
    edition = named(name)
    contents = Contents(
        format=FORMAT, edition=edition.name, digest="", made_by=folder.name, runs=("made-up",)
    )
    suite = SuiteRun(folder, edition.name, edition.description, {"made-up": run})
    return Rescored(contents, edition, suite, {"made-up": ()}, 0)


@pytest.mark.slow
def test_a_rank_is_one_more_than_the_entries_that_are_clearly_better(tmp_path: Path) -> None:
    """Layouts are drawn again here, of both kinds,
    to say by other means who is clearly better than whom.
    """
    lost = {"best": [0, 1], "near": [2, 3, 4], "worse": [*range(30)], "worst": [*range(55)]}
    entries = [entry_that_loses(tmp_path / name, *each) for name, each in reversed(lost.items())]
    ordered = board.lines(entries)
    assert [(line.entry.contents.made_by, line.rank) for line in ordered] == [
        *(("best", 1), ("near", 1), ("worse", 3), ("worst", 4)),
    ]

    rng = np.random.default_rng(0)
    drawn = np.stack([2 * rng.integers(0, 30, (2000, 30)) + kind for kind in (0, 1)])
    wins = {name: ~np.isin(np.arange(60), each) for name, each in lost.items()}
    for line in ordered:
        name = line.entry.contents.made_by
        more = [wins[other].astype(float) - wins[name] for other in lost]
        clearly = [np.quantile(each[drawn].mean(axis=(0, 2)), 0.025) > 0 for each in more]
        assert line.rank == 1 + sum(clearly)
        success = line.success["6g"]
        assert success is not None
        assert success.value == pytest.approx(wins[name].mean())  # as many layouts of both kinds


def test_entries_of_one_name_are_named_by_their_files_as_well(tmp_path: Path) -> None:
    one, other = (
        replace(entry_that_loses(tmp_path / name), file=f"{name}.zip") for name in ("a", "b")
    )
    assert [line.name for line in board.lines([one])] == ["made-up · a rule"]
    names = {line.name for line in board.lines([one, other])}
    assert names == {"made-up · a rule · a.zip", "made-up · a rule · b.zip"}
    alike = board.lines([one, replace(other, file=one.file)])
    numbered = [line.name for line in alike]
    assert numbered == ["made-up · a rule · a.zip", "made-up · a rule · a.zip (2)"]


def test_the_next_edition_tells_apart_what_the_first_does_not(tmp_path: Path) -> None:
    """Five of 30 layouts with a danger are lost, and nothing is won."""
    ranks = {}
    for name in SHIPPED:
        few = [entry_that_loses(tmp_path / f"{name}-{who}", *lost, name=name)
               for who, lost in (("best", ()), ("other", range(1, 11, 2)))]  # fmt: skip
        ordered = board.lines(few)
        ranks[name] = [line.rank for line in ordered]
        said = "each half of each family has one of its own" in " ".join(
            board.render(ordered, ()).split()
        )
        assert said == (name == "v2v-safety-1.0")
    assert ranks == {"v2v-safety-1.0": [1, 1], "v2v-safety-1.1": [1, 2]}


def test_sealed_seeds_follow_from_a_commit_alone(harness: Harness) -> None:
    """By hand: SHA-256 of forty zeros, a space and `blind-merge` is 600244092 modulo 10^9."""
    code, out, _ = harness("benchmark", "seeds", "0" * 40)
    assert (code, out.count("harness dataset build")) == (0, 6)
    shown = re.findall(r"build \\\n  ([^:]+):\S+ \\\n  --seed (\d+)", out)
    assert shown[-1] == ("blind-merge", "1600244092")
    assert len({seed for _, seed in shown}) == 6
    _, out, _ = harness("benchmark", "seeds", "0" * 40, "narrow-passage", "blind-merge", "--json")
    passage, merge = json.loads(out)
    assert merge["first_seed"] == 1_600_244_092
    assert purpose(passage["first_seed"], 100) == "report"


@pytest.mark.parametrize("commit", ["", "0" * 39, "0" * 7, "HEAD", "G" * 40, "0" * 41, "A" * 40])
def test_an_id_that_is_not_whole_is_one_line(harness: Harness, commit: str) -> None:
    code, out, err = harness("benchmark", "seeds", "--", commit)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "give a whole id" in err


@pytest.mark.slow
def test_a_try_of_some_layouts_is_counted_first_and_is_no_entry(project: Harness) -> None:
    code, out, _ = project("benchmark", "run", "mine-1", "--model", "proxy", "--dry-run")
    assert code == 0
    assert "no model was called" in " ".join(out.split())
    assert not Path("reports").exists()
    code, out, _ = project(
        "benchmark", "run", "mine-1", "--model", "proxy", "--limit", "1", "--out", "try"
    )
    assert code == 0
    assert out.endswith(
        "next: harness benchmark run mine-1 --model local-view --limit 1\n"
        "a try of 1 layout of each dataset is no entry: nothing was packed\n"
    )
    assert not Path("try.zip").exists()
    code, _, err = project("benchmark", "pack", "try", "--edition", "mine-1")
    assert (code, err.count("\n")) == (2, 1)
    assert "it has 1 layout that were selected, and all count" in err
