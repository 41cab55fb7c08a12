"""The command that fits what just happened, as the last line of a screen."""

import os
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from harness.cli.terminal import WIDTH
from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from harness.report.compare.difference import Comparison
    from harness.runs.folder import Run

MOST_BESIDE = 20  # runs beside a run, the newest, that are looked at for one to compare with
RULE, DRIVER = "proxy", "local-view"  # need no model, so that every installation runs them


def echo_next(*parts: object) -> None:
    """Print the command to type next, given as its words; one that is long goes on to a line.

    An option and its value stay on one line.
    """
    words: list[str] = []
    for part in ("harness", *parts):
        word = shlex.quote(printable(part, 300))
        if words and words[-1].startswith("--") and " " not in words[-1]:
            words[-1] += f" {word}"
        else:
            words.append(word)
    lines = ["next:"]
    for word in words:
        if len(lines[-1]) + len(word) + 3 > WIDTH and lines[-1].strip():
            lines[-1] += " \\"
            lines.append("     ")
        lines[-1] += f" {word}"
    typer.echo("\n".join(lines))


def after_run(run: "Run") -> None:
    """Print what to type next, given a run that was just made.

    Answers that cannot be read ask for another prompt, a gain that is not clear for a plan of how
    many layouts decide it, and any other run for one to compare it with.
    """
    from harness.core.multiplicity import LEVEL
    from harness.report.words import compared, gain
    from harness.runs.headline import headline_of
    from harness.runs.listing import FAILED, UNREAD
    from harness.runs.metric_names import ALL
    from harness.runs.metrics import entry

    manifest = run.manifest
    model, prompt = manifest.model["name"], manifest.prompt["version"]
    failed = run.score(ALL, FAILED)
    if failed and (failed.value or 0.0) >= UNREAD:
        versions = [str(each["version"]) for each in manifest.model.get("prompts", ())]
        others = [version for version in versions if version != prompt]
        if others:
            echo_next("eval", "--model", model, "--prompt", others[0])
        else:
            echo_next("prompt", "check", prompt, "--model", model)
        return
    best, base = compared(run)
    metric = headline_of(run)
    scores = [run.score(best, name) for name in entry(metric).halves or (metric,)]
    if base and gain(run, best, base)[1] > LEVEL and all(score and score.n > 1 for score in scores):
        echo_next("plan", run.path)
        return
    for other in _beside(run):
        echo_next("compare", other.path, run.path)
        return
    command = "eval" if run.world == "frozen" else "drive"
    echo_next(command, run.path, "--model", DRIVER if model == RULE else RULE)


def after_suite(model: str, name: str) -> None:
    """Print what to type next, given the model of a suite's run and the suite's name.

    A suite is several datasets; its run has one on each of them. It is beside a rule that the
    model's figures can be read.
    """
    echo_next("eval", "--model", DRIVER if model == RULE else RULE, "--dataset", f"suite:{name}")


def after_comparison(comparison: "Comparison") -> None:
    """Print what to type next, given a comparison of two runs.

    Where no condition differs clearly, that is a plan of how many layouts decide it; else what
    shows the answers that changed side by side.
    """
    from harness.report.compare.words import of_success, verdict

    a, b = comparison.pair.a.run.path, comparison.pair.b.run.path
    if any(map(verdict, of_success(comparison).values())):
        echo_next("compare", a, b, "--html", "compare.html")
    else:
        echo_next("plan", a, b)


def _beside(run: "Run") -> Iterator["Run"]:
    """Yield the finished runs beside a run that saw the same scenes, the newest first."""
    from harness.runs.folder import read

    folder = run.path.parent
    manifests = [path for path in folder.glob("*/run.json") if path.parent != run.path]
    manifests.sort(key=lambda path: -os.stat(path).st_mtime)
    scenes = run.manifest.world.pinned, run.manifest.seeds
    for manifest in manifests[:MOST_BESIDE]:
        try:
            other = read(Path(manifest.parent))
        except UserError:  # a broken one, which `harness run ls` names
            continue
        shared = set(other.conditions) & set(run.conditions)
        same = (other.manifest.world.pinned, other.manifest.seeds) == scenes
        if shared and same and other.grid.episodes == run.grid.episodes:
            yield other
