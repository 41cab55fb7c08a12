"""Two processes type the same command at once: both end properly, and what is there is whole.

    python benchmarks/campaigns/writers.py [--count 14] [--seed 0]

The second begins up to a second after the first. One of the two may be refused in a line.
"""

import random
import shutil
import time
from pathlib import Path

from judging import Running, Tally, counted, workshop, writing

from harness.dataset import verify
from harness.runs import folder


def main() -> None:
    """Type everything twice."""
    given = counted(__doc__, 14)
    rng = random.Random(given.seed)
    tally = Tally()
    with workshop() as here:
        commands = writing(here, Path("it"))
        commands["eval, no --out"] = ("eval", "--dataset", here / "small", "--seeds", "0")
        commands["compare"] = ("compare", here / "run", here / "run")
        for n in range(given.count):
            name = list(commands)[n % len(commands)]
            first = Running(commands[name])
            time.sleep(rng.choice((0.0, rng.random())))
            ends = [running.ended() for running in (Running(commands[name]), first)]
            faults = [fault for end in ends for fault in end.faults]
            if all(end.code for end in ends):
                faults.append(f"neither: {ends[0].err} {ends[1].err}")
            if name in ("eval", "drive") and len(folder.read(here / "it").decisions) == 0:
                faults.append("no decisions")
            if name == "dataset build":
                faults += verify.check(here / "it")
            faults += [
                f"left: {path}" for left in (".*.part", ".work") for path in here.rglob(left)
            ]
            tally.add(name, f"case {n}", faults)
            for left in ("it", "reports"):
                shutil.rmtree(here / left, ignore_errors=True)
        tally.end()


if __name__ == "__main__":
    main()
