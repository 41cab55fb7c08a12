"""CPU seconds and peak memory of whole commands,
in turn with those of another checkout if one is given.

    python benchmarks/commands.py [--repeats 3] [--against CHECKOUT] [--copies 14] [--only TEXT]

CPU is user and system time of the process and its children; memory is that of the largest process.
The other checkout (a commit of before, say, from `git worktree add`) runs with this interpreter's
packages. `--copies` also evaluates the shipped dataset so many times over, each copy with other
episode numbers and layout seeds; 0 leaves that out. `--only` runs the commands whose name has that
text. Medians, and the least; every command runs once before it counts, so caches are warm.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from zipfile import ZipFile

from rows import Row, finish

from harness.core.files import canonical_json, digest, sha256_bytes
from harness.core.resources import DATASET
from harness.dataset.load import find

SMALLEST = "--only help --repeats 1 --copies 0"
TABLE = "--copies 0"
HERE = Path(__file__).resolve().parent.parent
ALL, MANY = "eval, the shipped dataset", "eval, 20 160 decision points"
TRUST = "study trust, every attack and rule"
AIMS = {  # CPU seconds, and MB of peak memory
    "--help": (0.12, None),
    "model list": (0.12, None),
    "eval --limit 1": (0.8, None),
    ALL: (3.5, 250),
    MANY: (35.0, 800),
    "run ls": (0.15, None),
    "study paper": (1.5, None),
    "study sweep, 100 points": (1.5, None),
    TRUST: (30.0, None),
}
CHILD = """
import os, resource, subprocess, sys
subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)
"""


def main() -> None:
    """Print a table and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--repeats", type=int, default=3)
    arguments.add_argument("--against", type=Path)
    arguments.add_argument("--copies", type=int, default=14)
    arguments.add_argument("--only", default="")
    given = arguments.parse_args()
    checkouts = {"here": HERE, **({"against": given.against.resolve()} if given.against else {})}
    measured, rows = {}, list[Row]()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        proxy = ["eval", "--model", "proxy", "--quiet", "--out", "OUT"]
        commands = {
            "--help": ["--help"],
            "model list": ["model", "list"],
            "eval --limit 1": [*proxy, "--limit", "1"],
            ALL: proxy,
            "run ls": ["run", "ls", "RUNS"],
            "study paper": ["study", "paper", "--quiet", "--out", "STUDY"],
            "study sweep, 100 points": [
                "study",
                "sweep",
                "RUN",
                "--over",
                "tau",
                "--grid",
                "0.1:1.09:0.01",
                "--quiet",
                "--out",
                "STUDY",
            ],
            TRUST: ["study", "trust", "RUN", "--quiet", "--out", "STUDY"],
        }
        if given.only in MANY and given.copies:
            large = copied(given.copies, work / "large")
            commands[MANY] = [*proxy, "--dataset", str(large)]
        heads = f"{'CPU s':>8}{'least':>8}{'peak MB':>9}{'aim s':>7}{'aim MB':>8}"
        print(f"{'command':<30}{'checkout':<9}{heads}")
        for name, command in commands.items():
            if given.only not in name:
                continue
            if "RUN" in command and given.only not in ALL:
                for checkout, path in checkouts.items():
                    run(path, proxy, work / checkout)
            repeats = 1 if name in (MANY, TRUST) else given.repeats
            figures: dict[str, list[tuple[float, float]]] = {checkout: [] for checkout in checkouts}
            for n in range(repeats + (repeats > 1)):
                for checkout, path in checkouts.items():
                    figure = run(path, command, work / checkout)
                    if n or repeats == 1:
                        figures[checkout].append(figure)
            for checkout, each in figures.items():
                cpu_s, peak_mb = (statistics.median(column) for column in zip(*each, strict=True))
                (aim_s, aim_mb), least_s = AIMS[name], min(each)[0]
                shown = f"{cpu_s:>8.2f}{least_s:>8.2f}{peak_mb:>9.0f}{aim_s:>7}{aim_mb or '':>8}"
                print(f"{name:<30}{checkout:<9}{shown}")
                if checkout == "here":
                    aim = f"≤ {aim_s:g} s" + (f", {aim_mb} MB" if aim_mb else "")
                    rows.append(Row(f"`harness {name}`, CPU", cpu_s, "s", len(each), aim=aim))
                    rows.append(Row(f"`harness {name}`, peak memory", peak_mb, "MB", len(each)))
                measured[f"{name}, {checkout}"] = {
                    "cpu_s": cpu_s,
                    "least_s": least_s,
                    "peak_mb": peak_mb,
                    "n": len(each),
                }
    finish(rows, **measured)


def run(checkout: Path, command: list[str], runs: Path) -> tuple[float, float]:
    """CPU seconds and peak memory in MB of one command;
    its run stays in `runs` for `ls` and `sweep`.
    """
    runs.mkdir(exist_ok=True)
    if "OUT" in command:
        shutil.rmtree(runs / "run", ignore_errors=True)
    study = runs.with_name(f"{runs.name}-study")
    shutil.rmtree(study, ignore_errors=True)  # else trust reads what it kept
    places = {"OUT": runs / "run", "RUN": runs / "run", "RUNS": runs, "STUDY": study}
    typed = [str(places.get(part, part)) for part in command]
    said = subprocess.run(
        [sys.executable, "-c", CHILD, sys.executable, "-m", "harness", *typed],
        env={**os.environ, "PYTHONPATH": str(checkout)},
        cwd=checkout,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    ).stdout
    cpu_s, peak_mb = map(float, said.split()[-2:])
    return cpu_s, peak_mb


def copied(copies: int, out: Path) -> Path:
    """The layouts of the shipped dataset so many times over, each time as others."""
    shipped = find(DATASET)
    out.mkdir()
    manifest = json.loads((shipped / "manifest.json").read_text())
    episodes, trees = manifest["episodes"], []
    with ZipFile(shipped / "layouts.zip") as layouts, ZipFile(out / "layouts.zip", "w") as file:
        for episode in range(episodes * copies):
            again, number = divmod(episode, episodes)
            names = [(f"{number:05d}-", f"{episode:05d}-")]
            seed = manifest["seed"] + number
            names += [(f'"episode_seed":{seed}', f'"episode_seed":{seed + again * episodes}')]
            names += [(f'"episode":{number},', f'"episode":{episode},')]
            tree = json.loads(layouts.read(f"{number:05d}/tree.json"))
            texts, ids = [], list[tuple[str, str]]()
            for step in range(len(tree["levels"])):
                text = layouts.read(f"{number:05d}/{step}.jsonl").decode()
                for before, after in names:
                    text = text.replace(before, after)
                lines = []
                for line in text.splitlines(keepends=True):
                    scene = json.loads(line)
                    # an id is the digest of its state, and that has the seed
                    its_id = f"{episode:05d}-{step}-{digest(scene['state'])[:12]}"
                    lines.append(line.replace(scene["scene"], its_id))
                    ids.append((scene["scene"], its_id))
                text = "".join(lines)
                file.writestr(f"{episode:05d}/{step}.jsonl", text)
                texts.append(sha256_bytes(text.encode()))
            text = json.dumps({**tree, "scenes_sha256": texts}, separators=(",", ":"))
            for before, after in names + ids:
                text = text.replace(before, after)
            file.writestr(f"{episode:05d}/tree.json", text)
            trees.append(sha256_bytes(text.encode()))
    for schema in shipped.glob("*.schema.json"):
        shutil.copy(schema, out)
    files = {
        name: sha256_bytes((out / name).read_bytes())
        for name in manifest["files"]
        if (out / name).exists()
    }
    manifest |= {
        "name": out.name,
        "episodes": episodes * copies,
        "nodes": manifest["nodes"] * copies,
        "files": files,
        "trees_sha256": trees,
    }
    (out / "manifest.json").write_text(canonical_json(manifest))
    return out


if __name__ == "__main__":
    main()
