"""The command that fits what just happened, as the last line of a screen."""

import os
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from harness.cli.terminal import WIDTH
from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from harness.report.compare.difference import Comparison
    from harness.runs.folder import Run
    from harness.runs.suite import SuiteRun

MOST_BESIDE = 20  # runs beside a run, the newest, that are looked at for one to compare with
LONGEST = 4000  # characters of a path that can be typed
RULE, DRIVER = "proxy", "local-view"  # need no model, so that every installation runs them


def echo_next(*parts: object) -> None:
    """Print the command to type next, given as its words; one that is long goes on to a line.

    An option and its value stay on one line. Nothing is printed for a name that no terminal shows
    as it is, since it could not be typed.
    """
    words: list[str] = []
    for part in ("harness", *parts):
        text = str(part)
        if isinstance(part, Path) and text.startswith("-"):
            text = f"./{text}"
        if printable(text, LONGEST) != text:
            return
        word = shlex.quote(text)
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
    from harness.backends.registry import is_from_file
    from harness.report.words import compared, gain
    from harness.runs.listing import FAILED, UNREAD
    from harness.runs.metric_names import ALL

    manifest = run.manifest
    model, prompt = manifest.settings.model, manifest.prompt["version"]  # as it was typed
    failed = run.score(ALL, FAILED)
    of_file = is_from_file(manifest.answerers)
    if failed and (failed.value or 0.0) >= UNREAD:
        versions = [str(each["version"]) for each in manifest.model.get("prompts", ())]
        others = [version for version in versions if version != prompt]
        if others:
            echo_next("eval" if run.world == "frozen" else "drive", run.path, "--prompt", others[0])
        elif not of_file:
            echo_next("prompt", "check", prompt, "--model", model)
        return
    best, base = compared(run)
    if base and not gain(run, best, base)[1] and _may_plan(run, best):
        echo_next("plan", run.path)
        return
    for other in _beside(run):
        pair = (run.path, other.path) if _is_reference(run) else (other.path, run.path)
        echo_next("compare", *pair)
        return
    command = "eval" if run.world == "frozen" else "drive"
    if not of_file:
        echo_next(command, run.path, "--model", DRIVER if model == RULE else RULE)


def _may_plan(run: "Run", condition: str) -> bool:
    """Return whether a run has layouts enough to plan by: two, of each kind that is balanced."""
    from harness.runs.headline import headline_of
    from harness.runs.metrics import entry

    metric = headline_of(run)
    scores = [run.score(condition, name) for name in entry(metric).halves or (metric,)]
    return all(score is not None and score.n > 1 for score in scores)


def _is_reference(run: "Run") -> bool:
    """Return whether a driver decided, with which models are compared and not the other way."""
    from harness.backends.registry import capabilities

    return capabilities(str(run.manifest.model["engine"])).reference


def after_suite(run: "SuiteRun", edition: Sequence[object] = ()) -> None:
    """Print what to type next, given a suite's run: a rule beside which its figures can be read.

    A suite is several datasets; its run has one on each of them. `edition` has the words that
    evaluate a model on these, if `harness eval` does not know them by the suite's name.
    """
    from harness.runs.settings import Settings, parse_seeds

    settings = run.manifest.settings
    limit = getattr(settings.world, "limit", None)
    few = ("--limit", limit) if limit is not None else ()
    model = DRIVER if settings.model == RULE else RULE
    if edition:
        echo_next(*edition, "--model", model, *few)
        return
    dataset = ("--dataset", f"suite:{run.name}")
    is_usual = parse_seeds(settings.seeds) == parse_seeds(Settings().seeds)
    draws = () if is_usual else ("--seeds", settings.seeds)
    echo_next("eval", "--model", model, *dataset, *few, *draws)


def after_comparison(comparison: "Comparison", page: Path | None) -> None:
    """Print what to type next, given a comparison of two runs and its page, if it was written.

    Where no condition differs clearly, that is a plan of how many layouts decide it; else what
    shows the answers that changed side by side.
    """
    from harness.report.compare.words import of_success, verdict

    a, b = comparison.pair.a.run, comparison.pair.b.run
    changes = of_success(comparison)
    if not any(map(verdict, changes.values())):
        if all(_may_plan(run, name) for run in (a, b) for name in changes):
            echo_next("plan", a.path, b.path)
    elif page is None:
        echo_next("compare", a.path, b.path, "--html", "compare.html")
    else:
        echo_next("report", a.path, b.path, "--out", "both.html")


def _beside(run: "Run") -> Iterator["Run"]:
    """Yield the finished runs beside a run that saw the same scenes, the newest first."""
    from harness.backends.registry import reads_prompts
    from harness.runs.folder import read

    folder, engine = run.path.parent, str(run.manifest.model["engine"])
    manifests = [path for path in folder.glob("*/run.json") if path.parent != run.path]
    manifests.sort(key=lambda path: -os.stat(path).st_mtime)
    scenes = run.manifest.world.pinned, run.manifest.seeds
    for manifest in manifests[:MOST_BESIDE]:
        try:
            other = read(Path(manifest.parent))
        except UserError:  # a broken one, which `harness run ls` names
            continue
        if other.manifest.model == run.manifest.model and not reads_prompts(engine):
            continue  # a rule, which says the same whatever the prompt
        shared = set(other.conditions) & set(run.conditions)
        same = (other.manifest.world.pinned, other.manifest.seeds) == scenes
        if shared and same and other.grid.episodes == run.grid.episodes:
            yield other
