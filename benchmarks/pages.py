"""What benchmarks share whose tables stand on a page of the documentation."""

import re
import subprocess
import sys
from pathlib import Path


def harness(*words: str) -> None:
    """Run a command of the harness, and say which."""
    print(f"harness {' '.join(words)}", file=sys.stderr, flush=True)
    subprocess.run([sys.executable, "-m", "harness", *words], check=True, stdout=sys.stderr)


def write_tables(page: Path, tables: str) -> None:
    """Write tables between a page's marks."""
    text = page.read_text("utf-8")
    text = re.sub(
        r"(<!-- tables -->\n).*(<!-- end -->)", lambda m: f"{m[1]}{tables}\n{m[2]}", text, flags=re.S
    )
    page.write_text(text, "utf-8")
