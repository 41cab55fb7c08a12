"""What benchmarks share whose tables stand on a page of the documentation."""

import argparse
import re
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path


def options(doc: str, out: str, picture: bool = False) -> argparse.ArgumentParser:
    """Return the options that they share, with a folder under reports/ to write to."""
    parser = argparse.ArgumentParser(description=doc.split("\n")[0])
    parser.add_argument("--only", default="", help="only rows whose folder holds this text")
    parser.add_argument(
        "--layouts", type=int, help="layouts of each run or family, instead of a row's own"
    )
    parser.add_argument("--out", type=Path, default=Path("reports", out))
    parser.add_argument("--page", type=Path, help="page to write the tables to")
    if picture:
        parser.add_argument("--picture", type=Path, help="picture to write")
    return parser


def harness(*words: str) -> str:
    """Run a command of the harness, say which, and return what it prints."""
    print(f"harness {' '.join(words)}", file=sys.stderr, flush=True)
    command = [sys.executable, "-m", "harness", *words]
    printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    print(printed, file=sys.stderr, end="")
    return printed


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown, whose first column is of words."""
    ruled = f"|---|{'--:|' * (len(heads) - 1)}"
    head, *lines = (f"| {' | '.join(cells)} |" for cells in (heads, *rows))
    return "\n".join([head, ruled, *lines])


def write_tables(page: Path, tables: str) -> None:
    """Write tables between a page's marks."""
    text = page.read_text("utf-8")
    text = re.sub(
        r"(<!-- tables -->\n).*(<!-- end -->)",
        lambda m: f"{m[1]}{tables}\n{m[2]}",
        text,
        flags=re.S,
    )
    page.write_text(text, "utf-8")
