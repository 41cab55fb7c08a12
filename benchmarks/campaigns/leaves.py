"""Single changed leaves in all that the program reads:
one line, never a traceback, a hang or a gigabyte.

    python benchmarks/campaigns/leaves.py [--count 5000] [--seed 0] [--kind run] [--memory 1]

A leaf is a value in a JSON, TOML, CSV or Parquet file: of a dataset, its trees and scenes; of a
run, frozen or driven, whole or begun; of a suite's; of a project's prompts, cards, channels,
devices, networks, schedules and suites. It becomes another type, sign, size or name, is removed or
stands twice. Then a command is typed that reads it. Files are drawn with equal odds, and so are the
leaves of a file and its commands. A dataset's digests are made anew, so that what is read is the
leaf and not the digest.
"""

import argparse
import csv
import hashlib
import importlib
import io
import json
import math
import os
import pkgutil
import random
import re
import resource
import shutil
import signal
import time
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pyarrow as pa
import pyarrow.parquet as pq
from judging import Running, Tally, dataset, typed, workshop

import harness
from harness.core.resources import folder

LIMIT_S = 120.0
# what takes long to import, or runs
SKIPPED = ("training", "llama_cpp", "transformers", "__main__")
GONE, TWICE = object(), object()
VALUES: tuple[Any, ...] = (
    None,
    True,
    False,
    0,
    1,
    -1,
    -0.5,
    2,
    10**9,
    2**31,
    2**63,
    10**30,
    10**400,
    1e9,
    1e18,
    1e308,
    -1e308,
    5e-324,
    1e-12,
    math.nan,
    math.inf,
    -math.inf,
    "",
    " ",
    "x",
    "nan",
    "nobody-of-this-name",
    "x" * 300,
    "x" * 2_000_000,
    "\x1b[31m\u202e",
    "../../..",
    "/dev/zero",
    "a\x00b",
    "\ud800",
    "9" * 5000,
    [],
    {},
    [None],
    [[]],
    {"a": 1},
    ["x"] * 1000,
)


@dataclass(frozen=True)
class Subject:
    """One file, in a folder of its own, and the commands that read it.

    Attributes:
        kind: what it is of, in the counts.
        file: the file.
        commands: the commands, typed in `where`.
        where: the folder.
        inside: name of the JSON file in it, where it is an archive.
    """

    kind: str
    file: Path
    commands: tuple[tuple[object, ...], ...]
    where: Path
    inside: str = ""


def main() -> None:
    """Change, type, judge."""
    arguments = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    arguments.add_argument("--count", type=int, default=5000)
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--kind", action="append", help="only subjects of this kind; repeatable")
    arguments.add_argument(
        "--memory", type=float, default=1.0, help="gigabytes that a command may take"
    )
    given = arguments.parse_args()
    rng, tally, most = random.Random(given.seed), Tally(), 0
    with workshop() as here:
        load_all()
        subjects = made(here, given.kind)
        for n in range(given.count):
            subject = rng.choice(subjects)
            files = [subject.file, *subject.file.parent.glob("manifest.json")]
            original = {path: path.read_bytes() for path in files}
            shown = changed(rng, subject)
            command = rng.choice(subject.commands)
            os.chdir(subject.where)
            running = Running(command, prepare=bounded)
            ended = running.ended(LIMIT_S)
            faults = ended.faults
            most = max(most, ended.peak)
            if ended.peak > given.memory * 1e9:
                faults.append(f"{ended.peak / 1e9:.1f} GB")
            words = " ".join(map(str, command)).replace(str(here), "")
            tally.add(subject.kind, f"case {n}, {shown} in {subject.file.name}, {words}", faults)
            os.chdir(here)
            cleared(subject.where)
            for path, data in original.items():
                path.write_bytes(data)
        print(f"\nlargest: {most / 1e9:.2f} GB", end="")
        tally.end()


def cleared(where: Path) -> None:
    """Delete what a command wrote, and put back what it went on with."""
    for path in (where / "out", where / "out.html"):
        shutil.rmtree(path, ignore_errors=True)
        path.unlink(missing_ok=True)
    if (where / "stopped").is_dir():
        shutil.copytree(where / "stopped", where / "out")


def load_all() -> None:
    """Import the program once, and not in every command."""
    for module in pkgutil.walk_packages(harness.__path__, "harness."):
        if not any(part in SKIPPED for part in module.name.split(".")):
            with suppress(ImportError):
                importlib.import_module(module.name)


def bounded() -> None:
    """Give a command three gigabytes of address space more than the program itself takes."""
    now = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (now + (3 << 30), now + (3 << 30)))


def made(here: Path, kinds: list[str] | None) -> list[Subject]:
    """Make one sound example of everything, and list its files."""
    project = here / "project"
    subjects = [*_project(project)]
    if not kinds or {"dataset", "tree", "scene"} & set(kinds):
        subjects += _dataset(here / "data")
    if not kinds or {"run", "driven"} & set(kinds):
        subjects += _runs(here)
    if not kinds or "begun" in kinds:
        subjects += _begun(here / "begun")
    if not kinds or "suite" in kinds:
        subjects += _suite(here / "suite")
    found = [subject for subject in subjects if not kinds or subject.kind in kinds]
    typed_in = {(subject.where, command) for subject in found for command in subject.commands}
    # a sound one ends well, or a fault could hide another
    for where, command in sorted(typed_in, key=str):
        os.chdir(where)
        ended = typed(*command)
        assert ended.code in (0, 1), (command, ended.err)
        cleared(where)
    os.chdir(here)
    return found


CHANNELS = {
    "my-6g": "6g",
    "my-mode4": "mode4",
    "my-mode2": "mode2",
    "my-its": "its-g5",
    "my-coupled": "density-coupled",
}
TRACE = "distance_m,reception,sight,latency_ms\n" + "".join(
    f"{d},{1 - d / 1000},{sight},5\n"
    for d in (10, 200, 400)
    for sight in ("clear", "vehicle", "building")
)
CURVES = (
    "distance_m,reception,configuration,source\n10,0.9,density_per_km=60,b\n200,0.5,rate_hz=10,b\n"
)


def _project(project: Path) -> Iterator[Subject]:
    def of(kind: str, name: str, *commands: tuple[object, ...]) -> Subject:
        return Subject(kind, project / name, commands, project)

    for name in ("channels", "networks", "devices", "schedules", "models", "datasets", "prompts"):
        (project / name).mkdir(parents=True)
    (project / "swarmdrive.toml").write_text("")
    for name, shipped in CHANNELS.items():
        shutil.copy(folder("channels") / f"{shipped}.toml", project / f"channels/{name}.toml")
        drive = (
            "eval",
            "--limit",
            1,
            "--seeds",
            "0",
            "--model",
            "cruise",
            "--condition",
            name,
            "--out",
            "out",
        )
        yield of(
            "channel", f"channels/{name}.toml", ("radio", "list"), ("radio", "show", name), drive
        )
    (project / "channels/trace.toml").write_text(
        'model = "trace"\ndescription = "d"\nsource = "s"\nstatus = "measured"\n'
        '[parameters]\nfile = "trace.csv"\n'
        'latency_s = 0.01\nbeyond = "held"\n'
    )
    (project / "channels/trace.csv").write_text(TRACE)
    for name in ("trace.toml", "trace.csv"):
        yield of("channel", f"channels/{name}", ("radio", "list"), ("radio", "show", "trace"))
    (project / "curves.csv").write_text(CURVES)
    yield of("curves", "curves.csv", ("radio", "check", "mode4", "--against", "curves.csv"))
    shutil.copy(folder("networks") / "5g-city.toml", project / "networks/mine.toml")
    quick = ("eval", "--limit", 1, "--seeds", "0", "--dry-run")
    yield of("network", "networks/mine.toml", (*quick, "--condition", "cloud:round_trip=mine"))
    shutil.copy(folder("devices") / "agx-orin.toml", project / "devices/mine.toml")
    yield of(
        "device",
        "devices/mine.toml",
        ("model", "device", "list"),
        ("model", "device", "show", "mine"),
    )
    shutil.copy(folder("schedules") / "learnt.toml", project / "schedules/mine.toml")
    yield of(
        "schedule",
        "schedules/mine.toml",
        (*quick, "--condition", "6g:schedule=mine"),
        ("eval", "--limit", 1, "--seeds", "0", "--condition", "6g:schedule=mine", "--out", "out"),
    )
    for name, shipped in {
        "faulty": "proxy-faulty",
        "weights": "qwen3-4b",
        "served": "openai-example",
        "eyes": "swarm-tiny-vl",
    }.items():
        shutil.copy(folder("models") / f"{shipped}.toml", project / f"models/{name}.toml")
        yield of("card", f"models/{name}.toml", ("model", "list"), ("model", "list", "--json"))
    yield of("card", "models/faulty.toml", (*quick, "--model", "faulty"))
    for name, shipped in {"shots": "v6", "eyes": "v8"}.items():
        shutil.copytree(folder("prompts") / shipped, project / f"prompts/{name}")
        show = (
            "prompt",
            "show",
            name,
            "--scene",
            "00003-0",
            "--dataset",
            "occluded-intersection-v2",
        )
        for file in sorted((project / f"prompts/{name}").iterdir()):
            if file.suffix in (".toml", ".json"):
                yield of("prompt", f"prompts/{name}/{file.name}", ("prompt", "list"), show)
    (project / "prompts/released.toml").write_text('other = "0"\n')
    yield of("prompt", "prompts/released.toml", ("prompt", "list"))
    (project / "datasets/suites.toml").write_text(
        '[mine]\ndescription = "d"\ndatasets = ["occluded-intersection-v2"]\n'
    )
    yield of("suite", "datasets/suites.toml", (*quick, "--dataset", "suite:mine"))
    (project / "config.json").write_text(
        '{"policy_frequency": 1, "simulation_frequency": 15, "screen_width": 600}'
    )
    yield of(
        "env-config",
        "config.json",
        (
            "drive",
            "--env",
            "merge-v0",
            "--env-config",
            "config.json",
            "--episodes",
            1,
            "--seeds",
            "0",
            "--model",
            "cruise",
            "--condition",
            "6g",
            "--out",
            "out",
        ),
    )


def _dataset(where: Path) -> Iterator[Subject]:
    dataset(where / "small", 1)
    # The answers of a model that reads no prompt take the least time.
    check, run = (
        ("dataset", "check", "small"),
        (
            "eval",
            "--dataset",
            "small",
            "--seeds",
            "0",
            "--out",
            "out",
            "--model",
            "cruise",
            "--condition",
            "6g",
        ),
    )
    yield Subject("dataset", where / "small/manifest.json", (check, run), where)
    with ZipFile(where / "small/layouts.zip") as file:
        names = sorted(file.namelist())
    yield Subject("tree", where / "small/layouts.zip", (check, run), where, names[-1])
    yield Subject("scene", where / "small/layouts.zip", (check, run), where, names[0])


def _begun(where: Path) -> Iterator[Subject]:
    """A run that was killed, and the same command again."""
    where.mkdir()
    os.chdir(where)
    command = ("eval", "--limit", 20, "--seeds", "0", "--condition", "6g", "--out", "out")
    running, kept = Running(command), where / "out/.work/answers.jsonl"
    while not (kept.is_file() and kept.stat().st_size):
        time.sleep(0.01)
    os.killpg(running.pid, signal.SIGKILL)
    running.ended()
    assert (where / "out/.work/config.json").is_file(), "it was done before it was killed"
    os.replace(where / "out", where / "stopped")
    cleared(where)
    for name in ("config.json", "answers.jsonl"):
        yield Subject("begun", where / "out/.work" / name, (("run", "ls", "."), command), where)


def _suite(where: Path) -> Iterator[Subject]:
    """A suite's runs."""
    (where / "all").mkdir(parents=True)
    (where / "datasets").mkdir(exist_ok=True)
    (where / "swarmdrive.toml").touch()
    os.chdir(where)
    (where / "datasets/suites.toml").write_text(
        '[mine]\ndescription = "d"\ndatasets = ["occluded-intersection-v2", "do-not-pass-v1"]\n'
    )
    ended = typed(
        "eval",
        "--dataset",
        "suite:mine",
        "--limit",
        1,
        "--model",
        "cruise",
        "--seeds",
        "0",
        "--condition",
        "6g",
        "--out",
        "all/suite",
    )
    assert ended.code == 0, ended.err
    shutil.copytree(where / "all/suite", where / "all/other")
    yield Subject(
        "suite",
        where / "all/suite/suite.json",
        (
            ("run", "ls", "all"),
            ("run", "history", "all"),
            ("report", "all/suite", "--out", "out.html"),
            ("compare", "all/suite/do-not-pass-v1", "all/other/do-not-pass-v1"),
        ),
        where,
    )


def _runs(here: Path) -> Iterator[Subject]:
    where = here / "runs"
    (where / "all").mkdir(parents=True)
    os.chdir(where)
    small, seeds = dataset(where / "small", 1), ("--seeds", "0")
    conditions = (
        "--condition",
        "single-local",
        "--condition",
        "6g:attack=liar",
        "--condition",
        "mode4:density_per_km=90",
        "--condition",
        "cloud:round_trip=5g-city",
        "--condition",
        "v2x:schedule=learnt",
    )
    fused = ("study", "sweep", "all/words", "--over", "consensus", "--grid", "ego-prompt")
    for command in (
        ("eval", "--dataset", small, *seeds, *conditions, "--out", "all/it"),
        (
            "eval",
            "--dataset",
            small,
            *seeds,
            "--condition",
            "6g",
            "--model",
            "swarm-tiny",
            "--out",
            "all/words",
        ),
        ("study", "attribute", "all/it", "--sample", 2),
        (*fused, "--out", "all/words/fused"),
        (
            "drive",
            "--episodes",
            1,
            "--first-seed",
            0,
            *conditions[:6],
            *seeds,
            "--out",
            "all/driven",
        ),
    ):
        ended = typed(*command)
        assert ended.code == 0, (command, ended.err)
    shutil.copytree(where / "all", where / "sound")
    shutil.copytree(where / "all/it", where / "all/other")
    every = (("run", "ls", "all"), ("run", "history", "all"))
    grid = ("--over", "tau", "--grid", "0.3", "--no-model", "--out", "out")
    reads = (
        *(("report", "all/it", "--out", "out.html"),) * 3,
        ("compare", "all/it", "sound/it", "--html", "out.html"),
        ("run", "export", "all/it", "--csv", "--out", "out"),
        ("run", "export", "all/it", "--junit", "out.html"),
        ("study", "sweep", "all/it", *grid),
        (
            "study",
            "trust",
            "all/it",
            "--no-model",
            "--share",
            "1/3",
            "--attacks",
            "liar",
            "--rules",
            "linear",
            "--out",
            "out",
        ),
        ("study", "fidelity", "all/it", "sound/driven", "--out", "out"),
        ("study", "schedule", "compare", "all/it", "--out", "out"),
        (
            "eval",
            "--model",
            "replay:all/it",
            "--dataset",
            "small",
            *seeds,
            "--condition",
            "6g",
            "--out",
            "out",
        ),
    )
    files = (
        "run.json",
        "run.json",
        "run.json",
        "answers.jsonl",
        "episodes.csv",
        "summary.csv",
        "decisions.parquet",
        "attribution.json",
    )
    for name in files:
        yield Subject("run", where / "all/it" / name, (*every, *reads), where)
    told = ("report", "all/words", "--out", "out.html")
    for name in ("more-answers.jsonl", "fused/sweep.json"):
        yield Subject(
            "run", where / "all/words" / name, (*every, told, (*fused, "--out", "out")), where
        )
    drives = (
        ("report", "all/driven", "--out", "out.html"),
        ("compare", "all/driven", "sound/driven"),
        ("study", "fidelity", "sound/it", "all/driven", "--out", "out"),
        ("run", "export", "all/driven", "--csv", "--out", "out"),
    )
    for name in ("run.json", "decisions.parquet", "episodes.csv"):
        yield Subject("driven", where / "all/driven" / name, (*every, *drives), where)


def changed(rng: random.Random, subject: Subject) -> str:
    """Change one leaf of a file; says which and how."""
    file = subject.file
    if subject.inside:
        return _archived(rng, file, subject.inside)
    if file.suffix == ".parquet":
        return _column(rng, file)
    if file.suffix == ".csv":
        return _cell(rng, file)
    if file.suffix == ".toml":
        root = tomllib.loads(file.read_text(encoding="utf-8"))
        root, shown = leaf(rng, root)
        file.write_bytes(toml_text(root).encode("utf-8", "replace"))
        return shown
    lines = (
        file.read_text(encoding="utf-8").splitlines()
        if file.suffix == ".jsonl"
        else [file.read_text()]
    )
    at = rng.randrange(len(lines))
    root, shown = leaf(rng, json.loads(lines[at]))
    lines[at] = json_text(root)
    file.write_bytes(("\n".join(lines) + "\n").encode("utf-8", "surrogatepass"))
    return shown


def leaf(rng: random.Random, root: Any) -> tuple[Any, str]:
    """Change one leaf of a value in place; of the many in a list one counts."""
    shapes: dict[tuple[str, ...], list[list[Any]]] = {}
    for path in _paths(root, []):
        shapes.setdefault(
            tuple("*" if isinstance(step, int) else step for step in path), []
        ).append(path)
    if not shapes:
        return rng.choice(VALUES), "everything"
    *way, key = rng.choice(rng.choice(list(shapes.values())))
    node = root
    for step in way:
        node = node[step]
    value = rng.choice((*VALUES, *_near(node[key]), GONE, TWICE))
    shown = "gone" if value is GONE else "twice" if value is TWICE else repr(value)[:40]
    if value is GONE:
        del node[key]
    elif value is TWICE and isinstance(node, list):
        node.insert(key, node[key])
    elif value is TWICE:
        node[key] = _Twice(node[key])
    else:
        node[key] = value
    return root, f"{'.'.join(map(str, (*way, key)))} is {shown}"


@dataclass(frozen=True)
class _Twice:
    value: Any


def _near(value: Any) -> list[Any]:
    """What is like a value, but not it."""
    if isinstance(value, bool) or value is None:
        return [not value, str(value)]
    if isinstance(value, int | float):
        return [-value, value * 1e9, value * 1000, value / 1e9, str(value), [value], value + 1]
    if isinstance(value, str):
        return [value * 2, value[:-1], value.upper(), [value], {value: value}]
    return [list(value), {str(n): each for n, each in enumerate(value)}, "x"]


def _paths(value: Any, path: list[Any]) -> Iterator[list[Any]]:
    """The paths of all leaves, and of the tables and lists on the way."""
    if path:
        yield path
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            yield from _paths(value[key], [*path, key])


def json_text(value: Any) -> str:
    """JSON in which a key may stand twice."""
    if isinstance(value, dict):
        pairs = [
            f"{json.dumps(key)}: {json_text(inner.value if isinstance(inner, _Twice) else inner)}"
            for key, inner in value.items()
            for _ in range(1 + isinstance(inner, _Twice))
        ]
        return "{" + ", ".join(pairs) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(json_text, value)) + "]"
    return json.dumps(value)


def toml_text(table: Any) -> str:
    """TOML of a table, the tables in it inline."""
    if not isinstance(table, dict):
        return _toml_value(table)
    lines = []
    for key, value in table.items():
        for _ in range(1 + isinstance(value, _Twice)):
            lines.append(
                f"{_key(key)} = {_toml_value(value.value if isinstance(value, _Twice) else value)}"
            )
    return "\n".join(lines) + "\n"


def _toml_value(value: Any) -> str:
    if isinstance(value, _Twice):
        value = value.value
    if isinstance(value, dict):
        return (
            "{"
            + ", ".join(f"{_key(key)} = {_toml_value(each)}" for key, each in value.items())
            + "}"
        )
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml_value, value)) + "]"
    if value is None:
        return '""'
    if isinstance(value, float) and math.isfinite(value):
        return repr(value) if "." in repr(value) or "e" in repr(value) else f"{value!r}.0"
    return re.sub("Infinity", "inf", json.dumps(value).replace("NaN", "nan"))


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name)


def _cell(rng: random.Random, file: Path) -> str:
    rows = list(csv.reader(io.StringIO(file.read_text(encoding="utf-8"))))
    row = rng.choice((0, rng.randrange(len(rows)), rng.randrange(len(rows))))
    at = rng.randrange(len(rows[row]))
    value = rng.choice((*VALUES, GONE, TWICE))
    if value is GONE:
        del rows[row][at]
    elif value is TWICE:
        rows[row].insert(at, rows[row][at])
    else:
        rows[row][at] = "" if value is None else str(value)
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    file.write_bytes(text.getvalue().encode("utf-8", "replace"))
    shown = "gone" if value is GONE else "twice" if value is TWICE else repr(value)[:40]
    return f"line {row + 1}, column {at + 1} is {shown}"


def _column(rng: random.Random, file: Path) -> str:
    table = pq.read_table(file)
    name = rng.choice(table.column_names)
    at, values = table.column_names.index(name), table[name].to_pylist()
    how = rng.choice(("gone", "twice", "one", "one", "one", "other type", "rows"))
    value = rng.choice(
        [each for each in VALUES if isinstance(each, str | int | float | bool | None)]
    )
    if how == "gone":
        table = table.drop_columns([name])
    elif how == "twice":
        table = table.append_column(name, table[name])
    elif how == "rows":
        table = rng.choice(
            (table.slice(0, 0), pa.concat_tables([table] * 2), table.slice(1), table.slice(0, 1))
        )
    else:
        one = rng.randrange(len(values))
        kind = table.schema.field(at).type
        with suppress(pa.ArrowException, OverflowError, TypeError, ValueError):
            if how == "one":
                column = pa.array(
                    [*values[:one], value, *values[one + 1 :]],
                    type=pa.string() if pa.types.is_dictionary(kind) else kind,
                )
            else:
                column = pa.array([value] * len(values))
            table = table.set_column(at, name, column)
    pq.write_table(table, file, store_schema=False)
    return f"{name}, {how} {value!r}"[:60]


def _archived(rng: random.Random, file: Path, name: str) -> str:
    with ZipFile(file) as archive:
        contents = {each: archive.read(each) for each in archive.namelist()}
    lines = contents[name].decode().splitlines()
    at = rng.randrange(len(lines))
    root, shown = leaf(rng, json.loads(lines[at]))
    lines[at] = json_text(root)
    contents[name] = ("\n".join(lines) + "\n").encode("utf-8", "replace")
    pin = file.with_name("manifest.json")
    manifest, tree_name = json.loads(pin.read_text()), f"{name.split('/')[0]}/tree.json"
    if name != tree_name:
        tree = json.loads(contents[tree_name])
        tree["scenes_sha256"][int(Path(name).stem)] = hashlib.sha256(contents[name]).hexdigest()
        contents[tree_name] = json.dumps(tree).encode()
    manifest["trees_sha256"][int(name.split("/")[0])] = hashlib.sha256(
        contents[tree_name]
    ).hexdigest()
    pin.write_text(json.dumps(manifest))
    with ZipFile(file, "w") as archive:
        for each, data in contents.items():
            archive.writestr(each, data)
    return shown


if __name__ == "__main__":
    main()
