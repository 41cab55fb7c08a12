"""Two processes type the same command at once: both end properly, and what is there is whole.

    python benchmarks/campaigns/writers.py [--count 14] [--seed 0]

The second begins up to a second after the first. One of the two may be refused in a line.
"""

import random
import shutil
import time

from judging import Running, Tally, counted, dataset, typed, workshop

from harness.dataset import verify
from harness.runs import folder


def main() -> None:
    """Type everything twice."""
    given = counted(__doc__, 14)
    rng = random.Random(given.seed)
    tally = Tally()
    with workshop() as here:
        small, run = dataset(here / "small", 1), here / "run"
        one = ("--dataset", small, "--seeds", "0")
        assert typed("eval", *one, "--out", run).code == 0
        drive = ("drive", "--episodes", 2, "--condition", "6g", "--seeds", "0", "--workers", 2, "--out")
        assert typed(*drive, here / "driven").code == 0
        commands: dict[str, tuple[object, ...]] = {
            "eval": ("eval", *one, "--out", "it"),
            "eval, no --out": ("eval", *one),
            "drive": (*drive, "it"),
            "dataset build": ("dataset", "build", "occluded-intersection", "--episodes", 1, "--out", "it"),
            "sweep": ("sweep", run, "--over", "tau", "--grid", "0.2,0.7", "--out", "it"),
            "report": ("report", run, "--out", "it.html"),
            "export": ("export", run, "--csv", "--out", "it"),
            "fidelity": ("fidelity", run, here / "driven", "--out", "it"),
            "video": ("video", here / "driven", 0, "--out", "it.gif"),
            "campaign paper": (
                "campaign", "paper", "--episodes", 10, "--sweep-episodes", 10, "--seeds", "0:2",
                "--out", "it",
            ),
            "compare": ("compare", run, run),
            "init": ("init", "it"),
        }  # fmt: skip
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
            faults += [f"left: {path}" for left in (".*.part", ".work") for path in here.rglob(left)]
            tally.add(name, f"case {n}", faults)
            for left in ("it", "reports"):
                shutil.rmtree(here / left, ignore_errors=True)
        tally.end()


if __name__ == "__main__":
    main()
