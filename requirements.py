"""Install from requirements.lock, which has the digests of every release's files, and write it.

    python requirements.py install dev .venv/bin/python     # one of INSTALLS, with the checkout
    python requirements.py packages base .venv/bin/python   # without the checkout
    python requirements.py rebuild llama-cpp-python .venv/bin/python
    .venv/bin/python requirements.py write                  # what .venv has; needs uv

The lock file's groups say which installs need them; all need `base`. torch stands in its first line
alone: its build differs by machine (CPU or CUDA), so it is named by its release. Building a wheel
fetches its build tools.
"""

import re
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from importlib.metadata import requires, version
from pathlib import Path

CHECKOUT = Path(__file__).parent
LOCK = CHECKOUT / "requirements.lock"
PROJECT = "swarmdrive-harness"
INSTALLS = {  # the extras of each
    "base": (), "llama-cpp": ("llama-cpp",), "docs": ("docs",), "test": ("test",),
    "dev": ("transformers", "llama-cpp", "dev"),
}  # fmt: skip
BUILDS = ("hatchling", "editables")  # what a checkout is installed with


def install(name: str, python: str, *options: str) -> None:
    """Install the locked packages of one of `INSTALLS`, then the checkout, for an interpreter."""
    packages(name, python, *options)
    extras = ",".join(INSTALLS[name])
    torch = re.findall(r"torch==[\d.]+", LOCK.read_text())[:1] if "transformers" in extras else []
    checkout = f"{CHECKOUT}[{extras}]" if extras else str(CHECKOUT)
    _pip(python, *options, *torch, "--no-build-isolation", "--editable", checkout)


def packages(name: str, python: str, *options: str) -> None:
    """Install the locked packages of one of `INSTALLS` for an interpreter,
    each checked by its digest.
    """
    groups = re.split(r"^# (.*)\n", LOCK.read_text(), flags=re.MULTILINE)[1:]
    needs = (
        text
        for head, text in zip(groups[::2], groups[1::2], strict=True)
        if {"base", name} & {*head.split()}
    )
    _hashed(python, "".join(needs), *options)


def rebuild(package: str, python: str) -> None:
    """Build and install one locked package anew, whatever wheel of it was kept."""
    [block] = re.findall(rf"^{package}==.*(?:\n +.*)*", LOCK.read_text(), flags=re.MULTILINE)
    _hashed(python, block, "--no-cache-dir", "--force-reinstall")


def _hashed(python: str, lines: str, *options: str) -> None:
    with tempfile.NamedTemporaryFile("w", suffix=".lock") as file:
        file.write(lines)
        file.flush()
        _pip(python, "--require-hashes", "--no-deps", *options, "--requirement", file.name)


def _pip(python: str, *words: str) -> None:
    command = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *words]
    if subprocess.run(command, check=False).returncode:
        sys.exit(f"requirements.py: this failed, as pip says above: {' '.join(command)}")


def write() -> None:
    """Write the lock file from what this environment has installed."""
    groups = defaultdict(list)
    by_install = {name: needed(extras) for name, extras in INSTALLS.items()}
    for package in sorted(set().union(*by_install.values()) - {"torch"}):
        names = [name for name, packages in by_install.items() if package in packages]
        groups["base" if "base" in names else " ".join(names)].append(
            f"{package}=={version(package)}"
        )
    parts = [
        f"# Written by requirements.py; by its release alone: "
        f"torch=={version('torch').partition('+')[0]}\n"
    ]
    compiles = [
        *(
            "uv",
            "pip",
            "compile",
            "--quiet",
            "--no-deps",
            "--generate-hashes",
            "--no-header",
            "--no-annotate",
        ),
        *("--python-version", ".".join(map(str, sys.version_info[:3])), "-"),
    ]
    for names, packages in sorted(groups.items()):
        asked = "\n".join(packages)
        done = subprocess.run(compiles, input=asked, stdout=subprocess.PIPE, text=True, check=True)
        parts.append(f"# {names}\n{done.stdout}")
    LOCK.write_text("\n".join(parts))


def needed(extras: tuple[str, ...]) -> set[str]:
    """Return the names of all packages that the project needs with some extras,
    on this Python and system.
    """
    met: set[tuple[str, str]] = set()
    pending = [(PROJECT, extra) for extra in ("", *extras)] + [(name, "") for name in BUILDS]
    while pending:
        for required in _requirements(*pending.pop()):
            if required not in met:
                met.add(required)
                pending.append(required)
    return {name for name, _ in met} - {PROJECT} | {*BUILDS}


def _requirements(package: str, extra: str) -> Iterator[tuple[str, str]]:
    from packaging.requirements import Requirement  # not there yet where things are installed
    from packaging.utils import canonicalize_name

    for text in requires(package) or ():
        requirement = Requirement(text)
        if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
            for inner in ("", *requirement.extras):
                yield canonicalize_name(requirement.name), inner


if __name__ == "__main__":
    {"install": install, "packages": packages, "rebuild": rebuild, "write": write}[sys.argv[1]](
        *sys.argv[2:]
    )
