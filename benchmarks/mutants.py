"""What tests catch: mutants of the harness's own lines, drawn by a seed,
before two versions of the tests.

    pip install pytest-cov
    python benchmarks/mutants.py reach CHECKOUT FILE [-m MARKS]
    python benchmarks/mutants.py try OLD OLD_FILE NEW NEW_FILE [--page FILE]

`reach` runs the tests of a checkout and writes which test runs which line. `try` draws two mutants
of each of fifteen rooms from lines that OLD's tests run. OLD and NEW are checkouts with the same
`harness/`, which is changed in both, one mutant at a time, and restored. Each version stops at its
first failure. Tests that run the line are tried, 80 at most, the most specific first: those that
run the fewest lines. Of few, all tests of their files follow, since what a shared fixture runs
counts as run by its first test. What OLD catches and NEW has not caught by then is shown to all of
NEW's tests. With --page, the same command goes on after a kill.
"""

import argparse
import ast
import json
import os
import random
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

from pages import markdown

UNTESTED = "it runs whole suites of tests, for hours"

ROOMS = (
    "core",
    "radio",
    "world",
    "dataset",
    "prompts",
    "parsing",
    "coordination",
    "runs",
    "backends",
    "evaluate",
    "extensions",
    "report",
    "studies",
    "cli",
)
FIRST = 40  # tests that are tried before the others which run the line
MOST = 80  # tests that are tried of those which run the line
MOST_S = 1800  # a suite that takes longer has caught a mutant that does not end
COVERAGE = """[run]
source = harness
context = ${PYTEST_CURRENT_TEST-}
patch = subprocess
parallel = true
relative_files = true
disable_warnings = no-data-collected,module-not-measured,module-not-imported
data_file = {}
"""

Reach = dict[str, dict[int, list[str]]]  # tests by line, by file


class Mutant(NamedTuple):
    """A change of one line of a file."""

    file: str
    line: int
    rule: str
    start: int  # in the file's text
    end: int
    text: str  # instead


class Verdict(NamedTuple):
    """Whether tests caught a mutant: the first that failed, how many ran, in what time."""

    caught: str
    tests: int
    took_s: float


def main() -> None:
    """Measure which tests run which lines, or try mutants."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(required=True)
    measured = commands.add_parser("reach")
    measured.add_argument("checkout", type=Path)
    measured.add_argument("file", type=Path)
    measured.add_argument(
        "-m", dest="marks", default="", help="tests of these marks alone, as pytest's -m"
    )
    measured.set_defaults(run=lambda given: reach(given.checkout, given.file, given.marks))
    tried = commands.add_parser("try")
    for name in ("old", "old_file", "new", "new_file"):
        tried.add_argument(name, type=Path)
    tried.add_argument("--seed", type=int, default=59)
    tried.add_argument("--each", type=int, default=2, help="mutants of each room")
    tried.add_argument("--new-marks", default="not exhaustive", help="which of NEW's tests count")
    tried.add_argument(
        "--page", type=Path, help="file to which the table is written, a row at a time"
    )
    tried.set_defaults(run=compare)
    given = parser.parse_args()
    given.run(given)


def reach(checkout: Path, file: Path, marks: str) -> None:
    """Run a checkout's tests and write which of them run which line."""
    from coverage import CoverageData

    with tempfile.TemporaryDirectory() as folder:
        config, data = Path(folder, "coverage.ini"), Path(folder, "data")
        config.write_text(COVERAGE.replace("{}", str(data)))
        options = [
            "--cov",
            "--cov-context=test",
            f"--cov-config={config}",
            "--cov-report=",
            "-m",
            marks,
        ]
        command = [sys.executable, "-m", "pytest", "-n", "2", "--dist", "worksteal", *options]
        subprocess.run(command, cwd=checkout, env=environment(checkout), check=False)
        found = CoverageData(str(data))
        found.read()
        rows = {}
        for name in sorted(found.measured_files()):
            at = name.replace("\\", "/").rfind("harness/")
            lines = found.contexts_by_lineno(name)
            rows[name[at:]] = {
                line: sorted({test_of(c) for c in tests} - {""}) for line, tests in lines.items()
            }
    file.write_text(json.dumps(rows))


def test_of(context: str) -> str:
    """Return the test of a context of coverage, of this process or of one that it started."""
    return re.sub(r"(\|(setup|run|teardown)| \((setup|call|teardown)\))+$", "", context)


def environment(checkout: Path) -> dict[str, str]:
    """Return the environment in which a checkout's own `harness` is imported."""
    return {**os.environ, "PYTHONPATH": str(checkout.resolve()), "PYTHONDONTWRITEBYTECODE": "1"}


def compare(given: argparse.Namespace) -> None:
    """Try every mutant on both versions and print a table."""
    old = read_reach(given.old_file)
    new = read_reach(given.new_file)
    heads = ("where", "rule", "instead of", "stands", "old tests", "new tests")
    lines = read_table(given.page)
    tried_before = {row[0] for row in lines}
    for mutant in drawn(given.old, old, given.seed, given.each):
        if f"{mutant.file}:{mutant.line}" in tried_before:
            continue
        source = (given.old / mutant.file).read_text("utf-8")
        assert source == (given.new / mutant.file).read_text("utf-8"), mutant.file
        before = tried(mutant, given.old, old, "")
        after = Verdict("", 0, 0.0)
        if before.caught:
            after = tried(mutant, given.new, new, given.new_marks, known=before.caught)
        row = [
            f"{mutant.file}:{mutant.line}",
            mutant.rule,
            f"`{source[mutant.start : mutant.end]}`",
            f"`{mutant.text}`",
            before.caught or f"not caught ({before.tests})",
            "" if not before.caught else after.caught or f"**not caught** ({after.tests})",
        ]
        lines.append(row)
        print(" | ".join(row), f"{before.took_s:.0f} s, {after.took_s:.0f} s", flush=True)
        if given.page:
            given.page.write_text(markdown(heads, lines) + "\n", "utf-8")


def read_table(page: Path | None) -> list[list[str]]:
    """Read the rows that a killed run of this script wrote."""
    if page is None or not page.exists():
        return []
    rows = page.read_text("utf-8").splitlines()[2:]
    return [row.removeprefix("| ").removesuffix(" |").split(" | ") for row in rows]


def read_reach(file: Path) -> Reach:
    """Read which tests run which line."""
    rows = json.loads(file.read_text())
    return {
        name: {int(line): tests for line, tests in lines.items()} for name, lines in rows.items()
    }


def drawn(checkout: Path, reached: Reach, seed: int, each: int) -> list[Mutant]:
    """Draw mutants of each room from lines that tests run, at most one of a file."""
    chosen = []
    for room in ROOMS:
        candidates = []
        for name, lines in sorted(reached.items()):
            if name.startswith(f"harness/{room}/") and name.endswith(".py"):
                source = (checkout / name).read_text("utf-8")
                candidates += sorted(m for m in set(mutants(name, source)) if lines.get(m.line))
        draw = random.Random(f"{seed} {room}")
        rules = sorted({mutant.rule for mutant in candidates})
        files: set[str] = set()
        for rule in draw.sample(rules, len(rules)):
            # Rules first, so that frequent ones do not crowd out the others.
            left = [
                mutant for mutant in candidates if mutant.rule == rule and mutant.file not in files
            ]
            if left and len(files) < each:
                chosen.append(draw.choice(left))
                files.add(chosen[-1].file)
    return chosen


COMPARISONS = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "=="}
SIGNS = {"+": "-", "-": "+", "*": "/", "/": "*"}
DRAWS = ("generator", "uniforms", "normals", "share", "between", "draw", "keyed")


def mutants(name: str, source: str) -> Iterator[Mutant]:
    """Return the mutants of a file's functions."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def place(line: int, column: int) -> int:
        text = source[starts[line - 1] : starts[line]]
        return starts[line - 1] + len(text.encode()[:column].decode())

    def span(node: Any) -> tuple[int, int]:
        return place(node.lineno, node.col_offset), place(node.end_lineno, node.end_col_offset)

    def between(left: Any, right: Any, signs: dict[str, str], rule: str) -> Iterator[Mutant]:
        """Replace the one operator that stands between two operands."""
        start, end = span(left)[1], span(right)[0]
        stands = source[start:end].strip(" ()\n")
        if stands in signs:
            at = source.index(stands, start)
            yield Mutant(name, left.lineno, rule, at, at + len(stands), signs[stands])

    functions = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)]
    for node in {
        inner for function in functions for part in function.body for inner in ast.walk(part)
    }:
        if isinstance(node, ast.BinOp):
            yield from between(node.left, node.right, SIGNS, "sign")
        elif isinstance(node, ast.Compare) and len(node.ops) == 1:
            yield from between(node.left, node.comparators[0], COMPARISONS, "bound")
        elif isinstance(node, ast.If) and isinstance(node.body[0], ast.Raise):
            yield Mutant(name, node.lineno, "dropped check", *span(node.test), "False")
        elif isinstance(node, ast.Tuple | ast.List) or (
            isinstance(node, ast.Call) and len(node.args) > 1
        ):
            parts = node.args if isinstance(node, ast.Call) else node.elts
            if len(parts) > 1 and isinstance(getattr(node, "ctx", ast.Load()), ast.Load):
                (start, first_end), (second, end) = span(parts[0]), span(parts[1])
                one, other = source[start:first_end], source[second:end]
                if one != other and "*" not in one + other:
                    swapped = other + source[first_end:second] + one
                    yield Mutant(name, parts[0].lineno, "swapped columns", start, end, swapped)
        elif (
            isinstance(node, ast.Constant)
            and isinstance(node.value, int | float)
            and node.value not in (0, 1)
        ):
            yield Mutant(name, node.lineno, "unit", *span(node), repr(node.value * 10))
        if isinstance(node, ast.Call) and node.args and getattr(node.func, "id", "") in DRAWS:
            start, end = span(node.args[-1])
            if not isinstance(node.args[-1], ast.Starred):
                yield Mutant(
                    name, node.args[-1].lineno, "seed", start, end, f"({source[start:end]}, 1)"
                )


def tried(mutant: Mutant, checkout: Path, reached: Reach, marks: str, known: str = "") -> Verdict:
    """Show a mutant to a version's tests, and stop at the first that fails."""
    file = checkout / mutant.file
    source = file.read_text("utf-8")
    lines = Counter(test for rows in reached.values() for tests in rows.values() for test in tests)
    tests = sorted(
        reached.get(mutant.file, {}).get(mutant.line, []), key=lambda test: (lines[test], test)
    )
    stages: list[Sequence[str]] = [tests[:FIRST], tests[FIRST:MOST]]
    if known in lines:
        stages.insert(0, [known])  # it still stands, and catches most likely what it caught before
    if len(tests) <= FIRST:
        stages.append(sorted({test.split("::")[0] for test in tests}))
    if known:
        stages.append(["tests"])
    start, count = perf_counter(), 0
    file.write_text(source[: mutant.start] + mutant.text + source[mutant.end :], "utf-8")
    try:
        for stage in stages:
            if stage:
                failed, ran = first_failure(checkout, stage, marks)
                count += ran
                if failed:
                    return Verdict(failed, count, perf_counter() - start)
    finally:
        file.write_text(source, "utf-8")
    return Verdict("", count, perf_counter() - start)


def first_failure(checkout: Path, tests: Sequence[str], marks: str) -> tuple[str, int]:
    """Return the first of some tests that fails, or an empty text, and how many ran."""
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as listed:
        listed.write("\n".join(tests))
        listed.flush()
        workers = ["-n", "2"] if len(tests) > FIRST or "::" not in tests[0] else []
        options = [
            "-x",
            "--tb=no",
            "-p",
            "no:cacheprovider",
            "-m",
            marks,
            *workers,
            f"@{listed.name}",
        ]
        command = [sys.executable, "-m", "pytest", *options]
        try:
            done = subprocess.run(
                command,
                cwd=checkout,
                env=environment(checkout),
                capture_output=True,
                text=True,
                timeout=MOST_S,
            )
        except subprocess.TimeoutExpired:
            return "does not end", len(tests)
    if done.returncode == 4 and "not found" in done.stderr:
        raise RuntimeError(done.stderr)
    counts = re.findall(r"(\d+) (?:passed|failed|error)", done.stdout)
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    if done.returncode in (0, 5):
        return "", sum(map(int, counts))
    return (failed[1] if failed else f"exit code {done.returncode}"), sum(map(int, counts))


if __name__ == "__main__":
    main()
