"""Requests at a time: fixed numbers beside `--batch-size auto`, at servers that differ under load.

Each server is a process of its own on this machine, as in servers.py. One refuses what is above
`--at-once` (HTTP 429), one lets it wait, and one is slower with each: twice as long for so many.
Each number is tried on a new server, with a new backend, by `complete` alone; `lost` are requests
that got no answer. The limit of `auto` is the best fixed number that lost none.

    python benchmarks/paces.py [--requests 2000] [--seconds 0.05] [--at-once 20] [--repeats 3]
"""

import argparse
import statistics
from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter
from typing import NamedTuple

from rows import Row, finish
from servers import LOADS, serving, stats

from harness.backends import cards
from harness.backends.base import Request
from harness.backends.openai import backend as client
from harness.backends.servers import Server
from harness.core.at_once import AUTO, AtOnce

SMALLEST = "--requests 60 --seconds 0.002 --repeats 1"
TABLE = "--requests 1000 --repeats 1"
NEEDS = "aiohttp"
WORDS = {
    "waits": "where more than {} wait",
    "refuses": "that refuses more than {}",
    "slows": "twice as slow with {}",
}
TRIED: tuple[AtOnce, ...] = (1, 8, 64, AUTO)


class Asked(NamedTuple):
    """What asking a server took, and what it saw."""

    per_s: float  # answers a second
    lost: int  # requests without an answer
    refused: int
    most: int  # requests that the server worked on at once


def main() -> None:
    """Print medians as a table, and as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--requests", type=int, default=2000)
    arguments.add_argument("--seconds", type=float, default=0.05)
    arguments.add_argument("--at-once", type=int, default=20)
    arguments.add_argument("--repeats", type=int, default=3)
    given = arguments.parse_args()
    asked = [request(n) for n in range(given.requests)]
    few: dict[AtOnce, list[Request]] = {
        1: asked[: max(1, given.requests // 20)]
    }  # which take as long as so many together
    found: dict[str, dict[AtOnce, Asked]] = {}
    print(f"{'server':<9}{'at a time':>10}{'a second':>10}{'lost':>7}{'refused':>9}{'most':>6}")
    for load in LOADS:
        for tried in TRIED:
            times = [
                asking(few.get(tried, asked), tried, given.seconds, given.at_once, load)
                for _ in range(given.repeats)
            ]
            median = Asked(*(statistics.median(values) for values in zip(*times, strict=True)))
            found.setdefault(load, {})[tried] = median
            print(
                f"{load:<9}{tried:>10}{median.per_s:>10.0f}{median.lost:>7.0f}"
                f"{median.refused:>9.0f}{median.most:>6.0f}"
            )
    rows = []
    for load, by_number in found.items():
        fixed = [of.per_s for tried, of in by_number.items() if tried != AUTO and not of.lost]
        what = f"`--batch-size {AUTO}`, a server {WORDS[load].format(given.at_once)}, answers"
        rows.append(Row(what, by_number[AUTO].per_s, "/s", given.repeats, max(fixed)))
    plain = {load: {n: of._asdict() for n, of in each.items()} for load, each in found.items()}
    finish(rows, servers=plain)


def request(n: int) -> Request:
    words = ({"role": "user", "content": f"question {n}"},)
    return Request(f"s{n}/v0", "ego", words, ("SLOWER", "IDLE", "FASTER"), 64)


def asking(
    asked: Sequence[Request], tried: AtOnce, seconds: float, at_once: int, load: str
) -> Asked:
    """Ask a new server, so many requests at a time."""
    with serving(seconds, at_once, load) as url:
        card = replace(
            cards.load("openai-example"), server=Server(url), thinking="none", weights="m"
        )
        backend = client.open(card, batch_size=tried)
        begun_s = perf_counter()
        completions = backend.complete(asked)
        took_s = perf_counter() - begun_s
        counted = stats(url)
    answered = sum(completion.error is None for completion in completions)
    lost = len(asked) - answered
    return Asked(answered / took_s, lost, int(counted["refused"]), int(counted["most"]))


if __name__ == "__main__":
    main()
