"""Fuzzed completions through the parser: it never raises, and what it reads is a distribution.

    python benchmarks/campaigns/fuzz.py [--count 1000000] [--seed 0]

A completion is one of `tests/completions`, or two spliced, with some of its characters changed for
others, for pieces that mean something to the parser, or for nothing.
"""

import random
import sys
import time
from math import isclose

from judging import TESTS, counted

from harness.parsing.parse import parse
from harness.parsing.status import Status

sys.path.insert(0, str(TESTS))
import corpus

PIECES = (
    '{"',
    '"}',
    "{",
    "}",
    "[",
    "]",
    ":",
    ",",
    '"',
    "'",
    "\\",
    '\\"',
    "```json",
    "```",
    "<think>",
    "</think>",
    "%",
    "1e999",
    "-0",
    "NaN",
    "0.333",
    ".5",
    "1/3",
    "null",
    "\u202e",
    "\x00",
    "\ud800",
    "｛",
    "，",
    "//",
    "/*",
    "*/",
    '"SLOWER":',
    '"IDLE":',
    '"FASTER":',
    '"action_distribution":',
    '"risk":"high"',
    "&quot;",
    "\n",
    "<|im_end|>",
    "9" * 5000,
    "[" * 200,
    '{"a":' * 200,
)


def main() -> None:
    """Fuzz, and count the statuses."""
    given = counted(__doc__, 1_000_000)
    rng = random.Random(given.seed)
    texts = [case.text for case in corpus.CASES]
    statuses = dict.fromkeys(Status, 0)
    wrong = characters = 0
    begun_s = time.process_time()
    for _ in range(given.count):
        text = fuzzed(rng, texts)
        characters += len(text)
        role = rng.choice(("ego", "helper"))
        thinking, cut = rng.random() < 0.2, rng.choice(("stop", "length"))
        try:
            read = parse(
                text,
                role=role,
                actions=corpus.ACTIONS,
                thinking=thinking,
                finish_reason=cut,
                reasons_first=rng.random() < 0.2,
            )
            statuses[read.status] += 1
            sound = (read.intent is None) == (read.verdict == "failed")
            if read.intent is not None:
                sound &= isclose(sum(read.intent), 1.0, abs_tol=1e-9) and all(
                    p >= 0 for p in read.intent
                )
            said = repr(read)
        except Exception as error:
            sound, said = False, repr(error)
        if not sound:
            wrong += 1
            print(f"{said} from {role}, {thinking}, {cut}: {text!r}")
    took_s = time.process_time() - begun_s
    for status, count in statuses.items():
        print(f"{status:<24}{count:>10}")
    pace = characters / took_s / 1e6
    print(f"{given.count} completions, {wrong} wrong, {pace:.1f} million characters a CPU second")
    sys.exit(bool(wrong))


def fuzzed(rng: random.Random, texts: list[str]) -> str:
    """A completion that nobody wrote."""
    text = rng.choice(texts)
    if rng.random() < 0.2:
        other = rng.choice(texts)
        text = text[: rng.randrange(len(text) + 1)] + other[rng.randrange(len(other) + 1) :]
    for _ in range(rng.choice((0, 1, 1, 2, 3, 5, 10))):
        at = rng.randrange(len(text) + 1)
        to = at + rng.choice((0, 0, 1, 1, 2, 10))
        piece = rng.choice(
            ("", chr(rng.randrange(0x110000)), chr(rng.randrange(32, 127)), rng.choice(PIECES))
        )
        text = text[:at] + piece + text[to:]
    return text


if __name__ == "__main__":
    main()
