"""How long `harness.load` takes to read a run of a million decisions, and how much memory.

    python benchmarks/load.py [RUN] [--decisions 1000000] [--repeats 5]

The run is made of a real one, by default of the shipped dataset: its decisions, answers and episodes stand in
it again and again under new numbers of episodes. It is read in a process of its own. The limit is what
nobody can do without: imports of pandas and pyarrow, and the same Parquet file as a data frame.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import msgspec
import pyarrow as pa

from harness.runs import folder
from harness.runs.decisions import Decisions

AIMS = {"decisions_s": 3.0, "decisions_mb": 2000.0}

# Each ends by printing wall seconds, CPU seconds and peak memory in MB of its own process.
MEASURED = """
import resource, sys, time
start = time.perf_counter()
{}
mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(time.perf_counter() - start, time.process_time(), mb)
"""
PROGRAMS = {
    "decisions": "import harness; assert len(harness.load(sys.argv[1]).decisions)",
    "all_tables": "import harness; run = harness.load(sys.argv[1]); "
    "assert all(map(len, (run.summary, run.episodes, run.decisions, run.answers)))",
    "limit": "import pandas, pyarrow.parquet as pq; "
    "assert len(pq.ParquetFile(sys.argv[1] + '/decisions.parquet').read().to_pandas())",
}


def main() -> None:
    """Print the medians as a table and as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("run", nargs="?", type=Path)
    arguments.add_argument("--decisions", type=int, default=1_000_000)
    arguments.add_argument("--repeats", type=int, default=5)
    given = arguments.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        source = given.run or evaluated(Path(scratch) / "real")
        large = repeated(folder.read(source), given.decisions, Path(scratch) / "large")
        size = {file.name: round(file.stat().st_size / 1e6, 1) for file in large.iterdir()}
        found: dict[str, float] = {}
        for name, program in PROGRAMS.items():
            times = [measured(program, large) for _ in range(given.repeats)]
            for unit, values in zip(("s", "cpu_s", "mb"), zip(*times, strict=True), strict=True):
                found[f"{name}_{unit}"] = statistics.median(values)
    for name, value in found.items():
        aim = f"   aim {AIMS[name]:g}" if name in AIMS else ""
        print(f"{name:<16}{value:9.2f}{aim}")
    ratio = found["decisions_s"] / found["limit_s"]
    print(f"{ratio:.2f} of the limit; medians of {given.repeats}; files in MB: {size}")
    print(json.dumps({**found, "over_limit": ratio, "repeats": given.repeats, "files_mb": size}))


def evaluated(out: Path) -> Path:
    """A run of the proxy on the shipped dataset."""
    command = [sys.executable, "-m", "harness", "eval", "--model", "proxy", "--no-cache", "--quiet"]
    subprocess.run([*command, "--out", out], check=True, capture_output=True)
    return out


def repeated(run: folder.Run, decisions: int, out: Path) -> Path:
    """A run of at least so many decisions: this one's, again and again."""
    times = -(-decisions // len(run.decisions))
    table, apart = run.decisions.table, max(run.grid.episodes) + 1
    names = table["scene"].combine_chunks()
    parts, episodes, answers = [], [], []
    for n in range(times):
        scenes = pa.DictionaryArray.from_arrays(
            names.indices, pa.array([f"{n}-{scene}" for scene in names.dictionary.to_pylist()])
        )
        numbers = pa.array(run.decisions.whole("episode") + n * apart)
        part = table.set_column(table.schema.get_field_index("scene"), table.schema.field("scene"), scenes)
        part = part.set_column(part.schema.get_field_index("episode"), "episode", numbers)
        parts.append(Decisions(part, run.actions, run.decisions.helpers))
        episodes += [msgspec.structs.replace(e, episode=e.episode + n * apart) for e in run.episodes]
        answers += [msgspec.structs.replace(a, scene=f"{n}-{a.scene}") for a in run.answers]
    folder.write(out, run.manifest, Decisions.concat(parts), episodes, [folder.lines(answers)], run.scores)
    return out


def measured(program: str, run: Path) -> list[float]:
    """What a program prints last, run in a new process."""
    command = [sys.executable, "-c", MEASURED.format(program), str(run)]
    return [float(value) for value in subprocess.run(command, check=True, capture_output=True).stdout.split()]


if __name__ == "__main__":
    main()
