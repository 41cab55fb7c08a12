"""Damaged run folders, work, datasets, cards, prompts and weights: one line, never a traceback.

    python benchmarks/campaigns/damaged.py [--count 150] [--seed 0]

Each case damages one thing, drawn with the damage, and types a command that reads it: bytes cut,
changed or replaced, a file that is gone, a folder or a link in its place, a value of another kind
anywhere in its JSON.
"""

import json
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from judging import Running, Tally, counted, dataset, typed, workshop

VALUES: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    10**9,
    1e308,
    "",
    "x" * 300,
    "\x1b[31m\u202e",
    "../../..",
    [],
    {},
    [None],
    {"a": 1},
    "9" * 5000,
)


def main() -> None:
    """Damage, type, judge."""
    given = counted(__doc__, 150)
    rng = random.Random(given.seed)
    tally = Tally()
    with workshop() as here:
        made(here)
        commands: dict[str, list[tuple[object, ...]]] = {
            "run": [
                ("report", "it"),
                ("compare", "it", here / "run"),
                ("run", "ls", "."),
                ("run", "export", "it", "--csv"),
                ("study", "sweep", "it", "--over", "tau", "--no-model"),
                ("study", "fidelity", "it", here / "driven"),
                ("eval", "--model", "replay:it", "--dataset", here / "small", "--out", "again"),
            ],
            "driven": [
                ("report", "it"),
                ("run", "video", "it", 0),
                ("study", "fidelity", here / "run", "it"),
                ("run", "ls", "."),
            ],
            "begun": [
                ("eval", "--dataset", here / "small", "--seeds", "0", "--out", "it"),
                ("run", "ls", "."),
            ],
            "small": [("dataset", "check", "it"), ("eval", "--dataset", "it", "--seeds", "0")],
            "prompts": [
                ("prompt", "check", "mine"),
                ("eval", "--prompt", "mine", "--limit", 1, "--dry-run"),
            ],
            "models": [("model", "list"), ("eval", "--model", "mine", "--limit", 1, "--dry-run")],
        }
        for n in range(given.count):
            kind = list(commands)[n % len(commands)]
            case = here.parent / f"case-{n}"
            case.mkdir()
            os.chdir(case)
            project = kind in ("prompts", "models")
            shutil.copytree(
                here / ("project" if project else kind),
                case if project else case / "it",
                dirs_exist_ok=True,
            )
            inside = case / kind if project else case / "it"
            files = sorted(p for p in inside.rglob("*") if p.is_file() and p.suffix != ".md")
            file = rng.choice(files)
            how = damage(rng, file)
            command = rng.choice(commands[kind])
            running = Running(command)
            ended = running.ended()
            faults = ended.faults + [f"{len(left)} left" for left in [running.left()] if left]
            tally.add(
                kind,
                f"case {n}, {how} in {file.relative_to(case)}, {' '.join(map(str, command))}",
                faults,
            )
            os.chdir(here)
            shutil.rmtree(case)
        tally.end()


def made(here: Path) -> None:
    """One sound example of each."""
    dataset(here / "small")
    seeds = ("--seeds", "0")
    assert typed("eval", "--dataset", here / "small", *seeds, "--out", here / "run").code == 0
    drive = ("drive", "--episodes", 2, "--first-seed", 0, "--condition", "6g")
    assert typed(*drive, *seeds, "--out", here / "driven").code == 0
    assert typed("init", here / "project").code == 0
    card = next((here / "project/models").glob("*.toml"))
    card.rename(card.with_stem("mine"))
    running = Running(("eval", "--dataset", here / "small", *seeds, "--out", here / "begun"))
    while not (here / "begun/.work/answers.jsonl").exists():
        pass
    os.kill(running.pid, 9)
    running.ended()


def damage(rng: random.Random, file: Path) -> str:
    """Damage a file; says how."""
    ways: list[Callable[[random.Random, Path], str]] = [cut, changed, replaced, gone, folder, link]
    if file.suffix in (".json", ".jsonl", ".toml", ".csv"):
        ways = [*ways, value, value, value, value]
    return rng.choice(ways)(rng, file)


def cut(rng: random.Random, file: Path) -> str:
    """A file that ends early."""
    data = file.read_bytes()
    file.write_bytes(data[: rng.randrange(len(data) + 1)])
    return f"cut to {file.stat().st_size} of {len(data)} bytes"


def changed(rng: random.Random, file: Path) -> str:
    """A few other bytes."""
    data = bytearray(file.read_bytes() or b" ")
    for _ in range(rng.choice((1, 3, 30))):
        data[rng.randrange(len(data))] = rng.randrange(256)
    file.write_bytes(data)
    return "other bytes"


def replaced(rng: random.Random, file: Path) -> str:
    """Another content."""
    content = rng.choice(
        (b"", b"\xff\xfe\x00", b"{", b"[" * 100_000, b"[]", b"3", b"null", b"PAR1PAR1", b"a,b\n1\n")
    )
    file.write_bytes(content)
    return f"content {content[:10]!r}"


def gone(rng: random.Random, file: Path) -> str:
    """No file."""
    file.unlink()
    return "gone"


def folder(rng: random.Random, file: Path) -> str:
    """A folder in its place."""
    file.unlink()
    file.mkdir()
    return "a folder"


def link(rng: random.Random, file: Path) -> str:
    """A link in its place: to nowhere, to itself, to a file that never ends."""
    file.unlink()
    to = rng.choice(("nowhere", file.name, "/dev/zero"))
    file.symlink_to(to)
    return f"a link to {to}"


def value(rng: random.Random, file: Path) -> str:
    """A value of another kind, or a key that is gone."""
    if not file.stat().st_size:
        return replaced(rng, file)
    if file.suffix in (".toml", ".csv"):
        lines = file.read_text().splitlines()
        at = rng.randrange(len(lines))
        other = rng.choice(("", "9" * 5000, "1e308", '"x"', "[" * 500, "true", "-1", "nan", "\x1b"))
        mark = "=" if file.suffix == ".toml" else ","
        first, found, _ = lines[at].partition(mark)
        lines[at] = f"{first}{found}{other}" if rng.random() < 0.8 else other
        file.write_text("\n".join(lines) + "\n")
        return f"line {at + 1} is {lines[at][:40]!r}"
    lines = file.read_text().splitlines() if file.suffix == ".jsonl" else [file.read_text()]
    at = rng.randrange(len(lines))
    root = json.loads(lines[at])
    path, node = [], root
    while True:
        key = rng.choice(list(node) if isinstance(node, dict) else list(range(len(node))))
        path.append(str(key))
        if not isinstance(node[key], dict | list) or not node[key] or rng.random() < 0.3:
            break
        node = node[key]
    shown = "gone"
    if isinstance(node, dict) and rng.random() < 0.2:
        del node[key]
    else:
        node[key] = rng.choice(VALUES)
        shown = repr(node[key])[:40]
    lines[at] = json.dumps(root)
    file.write_text("\n".join(lines) + "\n")
    return f"{'.'.join(path)} is {shown}"


if __name__ == "__main__":
    main()
