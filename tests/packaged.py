"""Packages that add to the harness:
importable for a test, and not in the developer's environment.
"""

import subprocess
import sys
from pathlib import Path

PLUGIN = Path(__file__).with_name("plugin")


def install(site: Path) -> None:
    """Put `tests/plugin` into a folder of packages, without what it requires, as pip does."""
    options = [
        "--quiet",
        "--disable-pip-version-check",
        "--no-index",
        "--no-deps",
        "--no-build-isolation",
    ]
    pip = [sys.executable, "-m", "pip", "install", *options, "--target", str(site), str(PLUGIN)]
    subprocess.run(pip, check=True)


def register(site: Path, entry_points: str, **modules: str) -> None:
    """Put a package into a folder of packages by hand: its entry points, and modules by name."""
    info = site / "by_hand-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: by-hand\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(entry_points)
    for name, source in modules.items():
        (site / f"{name}.py").write_text(source)
