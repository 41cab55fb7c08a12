"""The parser's time by size: linear, whatever is repeated.

    python benchmarks/campaigns/sizes.py [--count 1000000] [--seed 0]

Each piece is repeated to a sixteenth, a quarter and all of `--count` characters: bare, inside an
open answer, and as a text of a whole one. CPU seconds; a time that grows more than eight times
where the size grows four times is a fault, unless it is below a tenth of a second.
"""

import sys
import time
from itertools import pairwise

from judging import counted

from harness.parsing.parse import parse

ACTIONS = ("SLOWER", "IDLE", "FASTER")
WHOLE = '{"action_distribution":{"SLOWER":0.1,"IDLE":0.9,"FASTER":0}}'
PIECES = (
    "a",
    " ",
    "\n",
    "{",
    "}",
    "[",
    '"',
    "'",
    "\\",
    "`",
    ",",
    ":",
    "0.1,",
    "9",
    "-",
    "%",
    "<",
    "/*",
    "//a\n",
    "```\n",
    '{"',
    "{'",
    "{}",
    "[]",
    '{"a":',
    "{'a':",
    '{\\"a\\":',
    "{a:1,",
    '{"a":"',
    '{"x":"{',
    '"{\\"a\\":1}"',
    "{True:",
    '{"SLOWER":',
    "SLOWER ",
    "&quot;",
    "&lt;",
    "<think>",
    "</think>",
    "<think>x</think>",
    "<think ",
    "</",
    "[think]",
    "<|channel|>analysis",
    "\u202e",
    "｛",
    "“",
    WHOLE,
)
FRAMES = ("@", '{"action_distribution":{"SLOWER":@', '{"evidence":"@",' + WHOLE[1:])


def main() -> None:
    """Measure, and print the slowest."""
    given = counted(__doc__, 1_000_000)
    slowest: list[tuple[float, str]] = []
    faults = 0
    for piece in PIECES:
        for frame in FRAMES:
            times = [
                seconds(frame.replace("@", piece * (given.count // n // len(piece))))
                for n in (16, 4, 1)
            ]
            shown = f"{piece[:24]!r} in {frame[:24]!r}"
            slowest.append((times[-1], shown))
            for less_s, more_s in pairwise(times):
                if more_s > 0.1 and more_s > 8 * less_s:
                    faults += 1
                    print(f"not linear: {shown}: {', '.join(f'{s:.3f}' for s in times)} s")
    slowest.sort(reverse=True)
    for took_s, shown in slowest[:5]:
        print(f"{took_s:8.3f} s {given.count / 1e6 / took_s:8.1f} MB/s  {shown}")
    middle_s = slowest[len(slowest) // 2][0]
    pace = given.count / 1e6 / middle_s
    print(
        f"{len(slowest)} texts of {given.count} characters, median {pace:.1f} MB/s, {faults} faults"
    )
    sys.exit(bool(faults))


def seconds(text: str) -> float:
    """CPU time to read a text."""
    begun_s = time.process_time()
    parse(text, role="helper", actions=ACTIONS)
    return time.process_time() - begun_s


if __name__ == "__main__":
    main()
