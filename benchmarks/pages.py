"""What benchmarks share whose tables stand on a page of the documentation."""

import re
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path


def harness(*words: str) -> None:
    """Run a command of the harness, and say which."""
    print(f"harness {' '.join(words)}", file=sys.stderr, flush=True)
    subprocess.run([sys.executable, "-m", "harness", *words], check=True, stdout=sys.stderr)


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown, whose first column is of words."""
    ruled = f"|---|{'--:|' * (len(heads) - 1)}"
    head, *lines = (f"| {' | '.join(cells)} |" for cells in (heads, *rows))
    return "\n".join([head, ruled, *lines])


def write_tables(page: Path, tables: str) -> None:
    """Write tables between a page's marks."""
    text = page.read_text("utf-8")
    text = re.sub(
        r"(<!-- tables -->\n).*(<!-- end -->)", lambda m: f"{m[1]}{tables}\n{m[2]}", text, flags=re.S
    )
    page.write_text(text, "utf-8")
