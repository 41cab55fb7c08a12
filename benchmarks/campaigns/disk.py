"""A disk that is full, and one that is read-only:
one line, and after room is made the same command goes on.

    python benchmarks/campaigns/disk.py [--count 22] [--seed 0]

Each case writes to a disk in memory, which takes root:
of a size that is drawn, or mounted read-only.
"""

import random
import subprocess
from pathlib import Path

from judging import Tally, counted, typed, workshop, writing


def main() -> None:
    """Fill, type, judge."""
    given = counted(__doc__, 22)
    rng = random.Random(given.seed)
    tally = Tally()
    with workshop() as here:
        commands = writing(here, Path("locked/it"))
        commands["dataset show"] = (
            "dataset",
            "show",
            here / "small",
            "00000-0",
            "--out",
            "locked/it.svg",
        )
        locked = here / "locked"
        locked.mkdir()
        for n in range(given.count):
            name, full = list(commands)[n // 2 % len(commands)], n % 2
            mount(locked, f"size={rng.choice((4, 8, 16, 64))}k" if full else "ro")
            ended = typed(*commands[name])
            faults = ended.faults
            if not full and ended.code != 2:
                faults.append(f"exit code {ended.code}: {ended.err[-200:]}")
            faults += [f"left: {part.name}" for part in locked.rglob(".*.part")]
            if full and ended.code == 2:
                mount(locked, "remount,size=64m")
                again = typed(*commands[name])
                faults += again.faults + ([f"does not go on: {again.err}"] if again.code else [])
            subprocess.run(["umount", locked], check=True)
            tally.add(f"{name}, {'full' if full else 'read-only'}", f"case {n}", faults)
        tally.end()


def mount(folder: Path, options: str) -> None:
    """Put a disk in memory at a folder."""
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], check=True)


if __name__ == "__main__":
    main()
