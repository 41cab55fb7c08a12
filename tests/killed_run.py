"""Evaluations that are really killed: `python killed_run.py DATASET FOLDER`, a run in each subfolder.

`at-<n>` dies by SIGKILL just before the n-th call that changes the disk, for every n that there is;
`after-<ms>-<i>` is killed by its parent, whatever it is doing then.
"""

import itertools
import os
import random
import signal
import sys
import time
import traceback
from pathlib import Path

from evaluating import run, spec_of

from harness.coordination.operating_point import POINTS, named_point
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


def die_before(n: int) -> None:
    """Let this process kill itself in place of its n-th change of the disk."""
    count = itertools.count(1)
    for name in CHANGES:
        setattr(os, name, _dying(getattr(os, name), count, n))


def _dying(change, count, n):
    def call(*args, **options):
        if next(count) == n:
            os.kill(os.getpid(), signal.SIGKILL)
        return change(*args, **options)

    return call


def forked(spec: Spec, out: Path, before: int = 0) -> int:
    """Process id of a child that evaluates."""
    child = os.fork()
    if child == 0:
        status = 1  # whatever happens, a child must not go on as its parent
        try:
            if before:
                die_before(before)
            run(spec, out)
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    return child


def main(dataset: Path, folder: Path) -> None:
    spec = spec_to_kill(load(dataset))
    run(spec, folder / "whole")
    evaluation.TREES_AT_ONCE, evaluation.WALKS_AT_ONCE = TREES_AT_ONCE, WALKS_AT_ONCE
    began = time.monotonic()
    run(spec, folder / "again")
    took_s = time.monotonic() - began
    for n in itertools.count(1):
        _, status = os.waitpid(forked(spec, folder / f"at-{n}", before=n), 0)
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
