"""Build a release into dist/ from a clean clone of the last commit, and try it: `make release`.

    python release.py [PYTHON ...]    # interpreters to try it with; by default those found by name

dist/ then has the wheel, the sdist, requirements.txt (all that the wheel needs, with digests, out
of requirements.lock), licences.md (of these packages, by their own metadata) and SHA256SUMS. Each
interpreter gets two empty environments outside the checkout, one by pip with the locked packages
and one by uv with the newest, and evaluates `proxy` there. RELEASE.md says how to publish.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Collection, Sequence
from hashlib import sha256
from pathlib import Path
from time import perf_counter

CHECKOUT = Path(__file__).parent
DIST, LOCK = CHECKOUT / "dist", CHECKOUT / "requirements.lock"
EXTRAS = "sim,report"
PYTHONS = tuple(f"python3.{minor}" for minor in range(11, 16))
TOOLS = Path(sys.executable).parent  # of build, twine, pip-licenses and uv
LICENCES = (
    "# Licences\n\nOf all packages that the wheel {of} needs, as they state them; written by "
    "`make release`.\n\n## The wheel alone\n\n{base}\n\n## In addition with the extras {extras}"
    "\n\n{more}\n"
)
SMALL = ("eval", "--model", "proxy", "--limit", "5", "--quiet", "--out", "run")


def main() -> None:
    """Build, list and try; print a line for each that holds, and end with 1 at the first fault."""
    if typed("git", "status", "--porcelain"):
        print("release.py: uncommitted changes are not in the release", file=sys.stderr)
    shutil.rmtree(DIST, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix="release-") as folder:
        place = Path(folder)
        wheel = built(place / "clone")
        pythons = sys.argv[1:] or [each for each in PYTHONS if starts(each)]
        if not pythons:
            sys.exit(f"release.py: none of {', '.join(PYTHONS)} starts; name an interpreter")
        write_lists(wheel, pythons[0], place / "listed")
        for python in pythons:
            try_with(python, wheel, place)
    files = sorted(DIST.iterdir())
    sums = [f"{sha256(file.read_bytes()).hexdigest()}  {file.name}\n" for file in files]
    (DIST / "SHA256SUMS").write_text("".join(sums))
    for file in files:
        print(f"dist/{file.name}: {file.stat().st_size / 1e6:.1f} MB")


def typed(*command: str | Path, at: Path = CHECKOUT) -> str:
    """Return what a command prints, run in a folder; end with what it says if it fails.

    It sees neither the checkout's packages nor those of this environment.
    """
    environment = {name: of for name, of in os.environ.items() if name != "PYTHONPATH"}
    words = [str(word) for word in command]
    done = subprocess.run(
        words, cwd=at, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"release.py: {' '.join(words)} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


def starts(python: str) -> bool:
    """Return whether there is such an interpreter; a name may stand for none that is installed."""
    found = shutil.which(python)
    return bool(found) and not subprocess.run([python, "-V"], capture_output=True).returncode


def built(clone: Path) -> Path:
    """Build the sdist from a clone, and the wheel from the sdist; return the wheel's path."""
    typed("git", "clone", "--quiet", "--no-hardlinks", CHECKOUT, clone)
    python = TOOLS / "python"
    typed(python, "-m", "build", "--no-isolation", "--outdir", DIST, clone)
    typed(python, "-m", "twine", "check", "--strict", *DIST.iterdir())
    [wheel] = DIST.glob("*.whl")
    print(f"built and checked by twine: {', '.join(sorted(file.name for file in DIST.iterdir()))}")
    return wheel


def write_lists(wheel: Path, python: str, listed: Path) -> None:
    """Write what the wheel needs, locked, and under which licences, from an environment of it."""
    pins = listed.with_suffix(".txt")
    pins.write_text("\n".join(re.findall(r"^[\w.-]+==\S+", LOCK.read_text(), re.MULTILINE)))
    typed(python, "-m", "venv", listed)
    inside = listed / "bin/python"
    names = list[list[str]]()
    for what in (wheel, f"{wheel}[{EXTRAS}]"):
        typed(inside, "-m", "pip", "install", "--no-compile", "--constraint", pins, what)
        frozen = typed(inside, "-m", "pip", "freeze", "--exclude", "swarmdrive-harness")
        names.append(re.findall(r"^([\w.-]+)==", frozen, re.MULTILINE))
    base = names[0]
    more = [name for name in names[1] if name not in base]
    text = f"# base\n{locked(base)}\n# {EXTRAS}\n{locked(more)}"
    (DIST / "requirements.txt").write_text(text)
    of = re.sub("-py3-.*", "", wheel.name)
    tables = {"base": licences(inside, base), "more": licences(inside, more)}
    (DIST / "licences.md").write_text(LICENCES.format(of=f"`{of}`", extras=EXTRAS, **tables))
    print(f"listed, locked and with licences: {len(base)} packages, {len(more)} with {EXTRAS}")


def locked(names: Collection[str]) -> str:
    """Return the blocks of requirements.lock with some packages, each with its digests.

    Raises SystemExit if one is not in the lock.
    """
    found = {}
    for block in re.findall(r"^[\w.-]+==.*(?:\n +.*)*\n", LOCK.read_text(), re.MULTILINE):
        found[_as_one(block.partition("==")[0])] = block
    wanted = sorted(_as_one(name) for name in names)
    if missing := [name for name in wanted if name not in found]:
        sys.exit(f"release.py: not in requirements.lock: {', '.join(missing)}; write it again")
    return "".join(found[name] for name in wanted)


def _as_one(name: str) -> str:
    """Return the one spelling of a package's name."""
    return re.sub(r"[-_.]+", "-", name).lower()


def licences(python: Path, names: Sequence[str]) -> str:
    """Return a table of packages in an environment, with their licences and addresses."""
    table = ("--format", "markdown", "--with-urls")
    return typed(TOOLS / "pip-licenses", *table, "--python", python, "--packages", *names).strip()


def try_with(python: str, wheel: Path, place: Path) -> None:
    """Install the wheel twice with an interpreter, and evaluate a rule outside of the checkout."""
    says = typed(python, "-V").strip()
    base = place / "base.txt"
    base.write_text((DIST / "requirements.txt").read_text().partition(f"# {EXTRAS}")[0])
    uv = TOOLS / "uv"
    for way in ("pip, locked", "uv, newest"):
        begun_s, environment = perf_counter(), place / "tried"
        inside = environment / "bin/python"
        if way.startswith("pip"):
            typed(python, "-m", "venv", environment)
            pip = (inside, "-m", "pip", "install", "--no-compile")
            typed(*pip, "--require-hashes", "--requirement", base)
            typed(*pip, "--no-deps", wheel)
            typed(inside, "-m", "pip", "check")
        else:
            typed(uv, "venv", "--quiet", "--python", python, environment)
            typed(uv, "pip", "install", "--quiet", "--python", inside, wheel)
            typed(uv, "pip", "check", "--python", inside)
        empty = place / "empty"
        empty.mkdir()
        typed(environment / "bin/harness", *SMALL, at=empty)
        if not (empty / "run/report.html").is_file():
            sys.exit(f"release.py: {says}, {way}: no report was written")
        print(f"tried: {says}, {way}: {perf_counter() - begun_s:.0f} s")
        shutil.rmtree(environment)
        shutil.rmtree(empty)


if __name__ == "__main__":
    main()
