"""A finished run whose episodes end otherwise."""

from collections.abc import Sequence
from pathlib import Path

from run_on_disk import Row, change

SEEDS = (0, 1)


def ends(run: Path, condition: str, by_seed: Sequence[Sequence[str]]) -> None:
    """Write down how episodes 0, 1, ... end in each seed; nothing is a success."""

    def end(row: Row) -> None:
        if row["condition"] == condition:
            failure = by_seed[row["seed"]][row["episode"]]
            row |= {"failure": failure, "success": failure == ""}

    change(run, episode=end)
