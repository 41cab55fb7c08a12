"""What benchmarks share whose figures stand in the table of README.md."""

import json
from collections.abc import Iterable
from typing import NamedTuple


class Row(NamedTuple):
    """A figure of the table; `limit` is of the same run and in the same unit."""

    what: str
    measured: float
    unit: str
    n: int  # measurements whose median it is, or whose least
    limit: float | None = None
    peer: str = ""  # another program's figure in the same run
    aim: str = ""


def finish(rows: Iterable[Row], **others: object) -> None:
    """Print the line of JSON that ends a benchmark:
    rows of the table, and whatever else it measured.
    """
    print(json.dumps({"rows": [row._asdict() for row in rows], **others}, default=str))
