"""Seconds and MB from nothing to a first run:
environment, base install, `harness eval --model proxy`.

    python benchmarks/install.py [--against COMMIT]

Each checkout is cloned, gets an environment of its own, and pip keeps nothing. The limit of the
time is the registry's: the same packages are fetched again without being installed.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any

from rows import Row, finish

UNTESTED = "it installs from a registry, which takes a minute"
TABLE = ""
HERE = Path(__file__).parents[1]
PIP = ("--no-cache-dir", "--quiet", "--disable-pip-version-check")


def main() -> None:
    """Print a table and one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--against", help="commit to install beside this one")
    against = arguments.parse_args().against
    rows = [row(None), *([row(against)] if against else [])]
    columns = ("environment", "install", "first run", "all", "fetch")
    print(
        " " * 10 + "".join(f"{name:>12}" for name in columns) + f"{'fetched':>10}{'installed':>10}"
    )
    for r in rows:
        seconds = [r[name] for name in ("environment_s", "install_s", "run_s")]
        times = "".join(f"{s:10.1f} s" for s in (*seconds, sum(seconds), r["fetch_s"]))
        print(f"{r['commit']:<10}{times}{r['fetched_mb']:7.0f} MB{r['mb']:7.0f} MB")
        print("  " + ", ".join(f"{name} {mb:.0f}" for name, mb in r["largest_mb"].items()))
    here = rows[0]
    whole_s = here["environment_s"] + here["install_s"] + here["run_s"]
    finish(
        [
            Row("from nothing to a first run, wall", whole_s, "s", 1, here["fetch_s"]),
            Row("a first run in a new environment, wall", here["run_s"], "s", 1, aim="≤ 30"),
            Row("files of the base install", here["mb"], "MB", 1, aim="≤ 520"),
        ],
        commits=rows,
    )


def row(commit: str | None) -> dict[str, Any]:
    """Measure one checkout; None is this one's last commit."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        clone, environment = place / "clone", place / "environment"
        run("git", "clone", "--quiet", HERE, clone)
        if commit:
            run("git", "-C", clone, "checkout", "--quiet", commit)
        python = environment / "bin/python"
        environment_s = run(sys.executable, "-m", "venv", environment)
        bare = size_mb(environment)
        install_s = run(python, "-m", "pip", "install", *PIP, clone)
        mb = size_mb(environment) - bare
        run_s = run(environment / "bin/harness", "eval", "--model", "proxy", at=place)
        wheels = place / "wheels"
        fetch_s = run(python, "-m", "pip", "download", *PIP, "--dest", wheels, clone)
        fetched_mb = size_mb(wheels)
        packages = {
            p.name: size_mb(p) for p in next(environment.glob("lib/*/site-packages")).iterdir()
        }
        largest = dict(sorted(packages.items(), key=lambda item: -item[1])[:6])
    times = {
        "environment_s": environment_s,
        "install_s": install_s,
        "run_s": run_s,
        "fetch_s": fetch_s,
    }
    return {
        "commit": commit or "here",
        **times,
        "fetched_mb": fetched_mb,
        "mb": mb,
        "largest_mb": largest,
    }


def run(*command: object, at: Path = HERE) -> float:
    """Run a command to its end; seconds."""
    begun_s = perf_counter()
    subprocess.run(list(map(str, command)), check=True, cwd=at, stdout=subprocess.DEVNULL)
    return perf_counter() - begun_s


def size_mb(place: Path) -> float:
    """Size of all files below a place."""
    return (
        sum(f.stat().st_size for f in place.rglob("*") if f.is_file() and not f.is_symlink()) / 1e6
    )


if __name__ == "__main__":
    main()
