"""Evaluations that are really killed:
`python killed_run.py DATASET FOLDER`, a run in each subfolder.

`at-<n>` dies by SIGKILL just before the n-th call that changes the disk, for every n that there is;
`after-<ms>-<i>` is killed by its parent, whatever it is doing then. Tests import `killed_at`, too,
for a kill of each kind.
"""

import itertools
import os
import random
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from evaluating import run, spec_of

from harness.coordination.named_points import POINTS, named_point
from harness.dataset.load import Dataset, load
from harness.evaluate import run as evaluation
from harness.evaluate.spec import Spec

CHANGES = ("fsync", "mkdir", "replace", "rmdir", "unlink")
TREES_AT_ONCE = 1  # so that some die between two parts of a run
WALKS_AT_ONCE = 1  # and some between the walks of two seeds
CONTENTS = ("6g:content=objects", "6g:content=both")


def spec_to_kill(dataset: Dataset) -> Spec:
    """Two layouts, alone and together, where helpers send objects, or intents as well."""
    return spec_of(dataset, limit=2, points=(POINTS["single-local"], *map(named_point, CONTENTS)))


PLACES = {
    "before anything": ("mkdir", ".work"),
    "before it keeps its settings": ("replace", "/.work/config.json"),
    "between two parts": ("unlink", "/.work/episodes-000000-000000.jsonl"),
    "while a part is written": ("replace", "/episodes.csv"),
    "before a table": ("replace", "/run/decisions.parquet"),
    "before the last file": ("replace", "/run/run.json"),
    "while the work is cleared away": ("unlink", "lock"),
}  # by what it is killed before: the change of the disk, and how its path ends
Dies = Callable[[str, str], bool]  # whether to die before a change, by its name and path


def nth(n: int) -> Dies:
    count = itertools.count(1)
    return lambda name, path: next(count) == n


def at(name: str, end: str) -> Dies:
    return lambda change, path: change == name and path.endswith(end)


def die_before(dies: Dies) -> None:
    """Let this process kill itself in place of a change of the disk."""
    for name in CHANGES:
        setattr(os, name, _dying(name, getattr(os, name), dies))


def _dying(name: str, change: Callable[..., Any], dies: Dies) -> Callable[..., Any]:
    def call(*args: Any, **options: Any) -> Any:
        if dies(name, _path(name, args)):
            os.kill(os.getpid(), signal.SIGKILL)
        return change(*args, **options)

    return call


def _path(name: str, args: tuple[Any, ...]) -> str:
    if name == "fsync":
        return os.readlink(f"/proc/self/fd/{args[0]}")
    return os.fspath(args[1] if name == "replace" else args[0])


def forked(spec: Spec, out: Path, dies: Dies | None = None) -> int:
    """Process id of a child that evaluates."""
    child = os.fork()
    if child == 0:
        status = 1  # whatever happens, a child must not go on as its parent
        try:
            if dies:
                die_before(dies)
            run(spec, out)
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    return child


def killed_at(spec: Spec, out: Path, dies: Dies) -> None:
    """Evaluate in a child that kills itself."""
    _, status = os.waitpid(forked(spec, out, dies), 0)
    assert os.WIFSIGNALED(status), f"the run that was to die ended with status {status}"
    assert os.WTERMSIG(status) == signal.SIGKILL


def main(dataset: Path, folder: Path) -> None:
    spec = spec_to_kill(load(dataset, limit=2))
    run(spec, folder / "whole")
    evaluation.TREES_AT_ONCE, evaluation.WALKS_AT_ONCE = TREES_AT_ONCE, WALKS_AT_ONCE
    began = time.monotonic()
    run(spec, folder / "again")
    took_s = time.monotonic() - began
    for n in itertools.count(1):
        _, status = os.waitpid(forked(spec, folder / f"at-{n}", nth(n)), 0)
        if not os.WIFSIGNALED(status):
            break
    if status:
        sys.exit(f"the run that nobody killed failed with status {status}")
    for i in range(6):
        after_s = random.uniform(0.0, took_s)
        child = forked(spec, folder / f"after-{1000 * after_s:.0f}-{i}")
        time.sleep(after_s)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
