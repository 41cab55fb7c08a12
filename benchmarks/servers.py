"""Asking servers: how near a run comes to what they can answer, and the client's CPU a request.

Each server is a process of its own on this machine that answers chat completions after a fixed
time, so many at once, whatever is asked. Ideal is that each of them is always full. Asked are the
shipped dataset's prompts: by `complete` alone, and by all that `harness eval` does to get, read and
keep answers. The limit is sockets alone: the same bytes are written, and answers read, on
connections that stay open. With `--workers` so many processes do each of these, as those of
`harness eval --workers` do: each asks parts of the requests, keeps the answers of a part in a file,
and has its share of the batch size. What its start takes is not timed.

    python benchmarks/servers.py [--servers 1] [--requests 4000] [--repeats 5] [--seconds 0.05]
                                 [--at-once 20] [--batch-size 20] [--workers 1]
"""

import argparse
import asyncio
import json
import math
import multiprocessing
import os
import resource
import selectors
import statistics
import subprocess
import sys
import tempfile
import urllib.request
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from rows import Row, finish

from harness.backends import cards
from harness.backends.base import Backend, Request
from harness.backends.openai import backend as client  # before processes part: each would import it
from harness.backends.openai.shapes import body
from harness.backends.registry import opened
from harness.backends.servers import Server
from harness.coordination.named_points import POINTS
from harness.core.parallel import each, share
from harness.core.resources import DATASET
from harness.dataset import load
from harness.evaluate.agent import Agent
from harness.evaluate.asking import Asker
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.latency import PAPER
from harness.evaluate.requests import requests
from harness.evaluate.spec import Spec
from harness.prompts import versions as prompts
from harness.runs.settings import Settings

SMALLEST = "--requests 80 --repeats 1 --seconds 0.005 --workers 2"
TABLE = "--requests 1000 --repeats 3"
NEEDS = "aiohttp"
AIMS = {"of_ideal": 0.95, "cpu_ms": 0.25}
EGO = '{"action_distribution":{"SLOWER":0.20,"IDLE":0.70,"FASTER":0.10}}'
HELPER = f'{EGO[:-1]},"evidence":"a car comes from the left, 34 m away","risk":"high"}}'
LISTED = {"data": [{"id": "m", "owned_by": "benchmark"}]}
# What a server does with more requests than it takes at once: they wait, are refused with HTTP 429,
# or all take longer, twice as long at that number.
LOADS = ("waits", "refuses", "slows")
MOST = 1 << 13  # requests of a part, which memory holds at once: 256 layouts have some more
assert client


class Part(NamedTuple):
    """What a process took for a part of the requests."""

    begun_s: float  # by a clock that all processes share
    ended_s: float
    cpu_s: float
    memory_mb: float  # the most that the process has had so far


def main() -> None:
    """Print the medians as a table and as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--servers", type=int, default=1)
    arguments.add_argument("--requests", type=int, default=4000)
    arguments.add_argument("--repeats", type=int, default=5)
    arguments.add_argument("--seconds", type=float, default=0.05)
    arguments.add_argument("--at-once", type=int, default=20)
    arguments.add_argument("--batch-size", type=int, help="default: as many as a server takes")
    arguments.add_argument("--workers", type=int, default=1, help="client processes")
    arguments.add_argument("--ways", nargs="+", default=["sockets", "complete", "ask"])
    arguments.add_argument("--serve", choices=LOADS, help=argparse.SUPPRESS)
    given = arguments.parse_args()
    if given.serve:
        serve(given.seconds, given.at_once, given.serve)
        return
    batch_size, workers = given.batch_size or given.at_once, given.workers
    ideal_s = given.requests * given.seconds / (given.at_once * given.servers)
    size = min(MOST, math.ceil(given.requests / workers))
    parts = [range(at, min(at + size, given.requests)) for at in range(0, given.requests, size)]
    found: dict[str, list[tuple[float, float, float]]] = {}
    with ExitStack() as stack:
        urls = [
            stack.enter_context(serving(given.seconds, given.at_once)) for _ in range(given.servers)
        ]
        base = cards.load("openai-example")
        urls_of_card = urls[0] if len(urls) == 1 else tuple(urls)
        card = replace(base, server=Server(urls_of_card), thinking="none", weights="m")
        dataset = load.load(load.find(DATASET))
        spec = Spec(
            Agent(card, prompts.load("v2")),
            FrozenSource(dataset),
            tuple(POINTS.values()),
            (0,),
            settings=Settings(batch_size=batch_size),
        )
        asked = list(requests(spec, dataset.scenes(dataset.courses())))
        assert card.server
        bodies = [json.dumps(body(card, card.server, request)).encode() for request in asked]
        ways: dict[str, Callable[[range], object]] = {
            "sockets": lambda part: asyncio.run(
                bare(urls, of_part(bodies, part), share(given.at_once))
            ),
            "complete": lambda part: completed(model(spec), named(asked, part)),
            "ask": lambda part: kept(spec, model(spec), named(asked, part)),
        }
        for _ in range(given.repeats):
            for name in given.ways:
                begin = multiprocessing.Barrier(min(workers, len(parts)))
                way, took = Way(spec, asked[: 2 * batch_size], ways[name], begin), dict[int, Part]()
                WAYS["now"] = way
                each(measured, parts, workers, took.__setitem__)
                found.setdefault(name, []).append(together(list(took.values())))
        counted = [stats(url) for url in urls]
    result: dict[str, Any] = {
        "servers": given.servers,
        "requests": given.requests,
        "repeats": given.repeats,
        "seconds": given.seconds,
        "at_once": given.at_once,
        "batch_size": batch_size,
        "workers": workers,
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
        "ideal_per_s": given.requests / ideal_s,
        "answered": [int(of["answered"]) for of in counted],
        "connections": [int(of["connections"]) for of in counted],
        "server_cpu_ms": max(1000 * of["cpu_s"] / of["answered"] for of in counted),
    }
    print(
        f"{given.requests} requests, {given.servers} servers of {given.seconds * 1000:g} ms x "
        f"{given.at_once}, batch size {batch_size}, {workers} client processes on {os.cpu_count()} "
        f"cores: ideal {given.requests / ideal_s:.0f}/s; medians of {given.repeats}"
    )
    for name, times in found.items():
        wall_s, cpu_s, memory_mb = (
            statistics.median(values) for values in zip(*times, strict=True)
        )
        of_ideal, cpu_ms = ideal_s / wall_s, 1000 * cpu_s / given.requests
        shares = [ideal_s / wall for wall, _, _ in times]
        result[name] = {
            "of_ideal": of_ideal,
            "least": min(shares),
            "most": max(shares),
            "cpu_ms": cpu_ms,
            "per_s": given.requests / wall_s,
            "memory_mb": memory_mb,
        }
        aim = f"   aim {100 * AIMS['of_ideal']:g} %, {AIMS['cpu_ms']} ms" if name == "ask" else ""
        print(
            f"{name:<10}{given.requests / wall_s:7.0f}/s {100 * of_ideal:6.1f} % of ideal "
            f"({100 * min(shares):.1f} to {100 * max(shares):.1f}){cpu_ms:8.3f} ms of CPU a request"
            f"{memory_mb:7.0f} MB a process at most{aim}"
        )
    server_ms = result["server_cpu_ms"]
    print(
        f"answered by each: {result['answered']}; connections: {result['connections']}; a server "
        f"takes {server_ms:.3f} ms of CPU a request itself: {1000 / server_ms:.0f}/s at most"
    )
    rows = list[Row]()
    if {"sockets", "ask"} <= result.keys():
        limit, asking = result["sockets"], result["ask"]
        what, n = f"asking servers of {given.seconds * 1000:g} ms × {given.at_once}", given.repeats
        rows = [
            Row(
                f"{what}, of ideal, wall", 100 * asking["of_ideal"], "%", n, 100 * limit["of_ideal"]
            ),
            Row(f"{what}, a request, CPU", asking["cpu_ms"], "ms", n, limit["cpu_ms"]),
        ]
    finish(rows, **result)


class Way(NamedTuple):
    """A way to ask, and what its processes need before they begin together."""

    spec: Spec
    first: Sequence[Request]  # asked to open the connections
    ask: Callable[[range], object]
    begin: Any  # the barrier of all processes


WAYS: dict[str, Way] = {}  # processes inherit it
BEGUN: set[tuple[int, int]] = set()  # by process and way


def measured(part: range) -> Part:
    """Ask a part of the requests; a process that begins opens its connections,
    and waits for the others.
    """
    way = WAYS["now"]
    if (begun := (os.getpid(), id(way))) not in BEGUN:
        BEGUN.add(begun)
        model(way.spec).complete(way.first)
        way.begin.wait(60)
    wall_s, cpu_s = perf_counter(), process_time()
    way.ask(part)
    most_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return Part(wall_s, perf_counter(), process_time() - cpu_s, most_kb / 1000)


def together(parts: Sequence[Part]) -> tuple[float, float, float]:
    """Wall and CPU seconds of all processes, and the most memory of one, in MB."""
    begun_s, ended_s, cpu_s, memory_mb = zip(*parts, strict=True)
    return max(ended_s) - min(begun_s), sum(cpu_s), max(memory_mb)


def model(spec: Spec) -> Backend:
    """The backend of this process."""
    return opened(spec.ego.card, None, None, spec.settings.batch_size)


def of_part(drawn: Sequence[Any], part: range) -> Iterator[Any]:
    """As many as a part has, taken again and again from what was drawn,
    on from where the part begins.
    """
    at = part.start % len(drawn)
    return islice(cycle([*drawn[at:], *drawn[:at]]), len(part))


def named(asked: Sequence[Request], part: range) -> list[Request]:
    """The requests of a part, under names of their own."""
    return [
        request.alike(id=f"{n // 4}-{request.id}", view=None)
        for n, request in zip(part, of_part(asked, part), strict=True)
    ]


def completed(backend: Backend, asked: Sequence[Request]) -> None:
    """Ask by `complete` alone."""
    completions = backend.complete(asked)
    assert all(
        c.text == (EGO if r.role == "ego" else HELPER)
        for r, c in zip(asked, completions, strict=True)
    )


def kept(spec: Spec, backend: Backend, asked: Sequence[Request]) -> None:
    """Ask as an evaluation does, every answer read and kept in a file."""
    with tempfile.TemporaryDirectory() as folder:
        asker = Asker(spec, lambda: backend, PAPER, Path(folder) / "answers.jsonl")
        asker.ask(asked)
        assert len(asker.answers) == len(asked)
        assert all(answer.status == "strict" for answer in asker.answers.values())


async def bare(urls: Sequence[str], bodies: Iterator[bytes], at_once: int) -> None:
    """The same bytes on so many connections a server,
    each asked again as soon as it has answered.
    """

    async def asking(url: str) -> None:
        parts = urlsplit(url)
        reader, writer = await asyncio.open_connection(parts.hostname, parts.port)
        for data in bodies:
            writer.write(b"POST /v1/chat/completions HTTP/1.1\r\nHost: x\r\n" + sized(data))
            head = await reader.readuntil(b"\r\n\r\n")
            await reader.readexactly(int(head.rpartition(b": ")[2]))
        writer.close()

    await asyncio.gather(*(asking(url) for url in urls for _ in range(at_once)))


def sized(data: bytes) -> bytes:
    """The end of a head, and what it is of."""
    return b"Content-Length: %d\r\n\r\n%b" % (len(data), data)


# -- the server ------------------------------------------------------------------------------------


@contextmanager
def serving(seconds: float, at_once: int, load: str = "waits") -> Iterator[str]:
    """A server in a process of its own; its base URL."""
    options = ["--serve", load, "--seconds", str(seconds), "--at-once", str(at_once)]
    process = subprocess.Popen(
        [sys.executable, __file__, *options], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout
    try:
        yield process.stdout.readline().strip()
    finally:
        process.kill()
        process.communicate()


def stats(url: str) -> dict[str, float]:
    """What a server counted, and its CPU seconds."""
    with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(
        f"{url}/stats"
    ) as answer:
        counted: dict[str, float] = json.load(answer)
        return counted


def serve(seconds: float, at_once: int, load: str) -> None:
    """Answer for ever; the base URL is printed first."""
    # `select` waits for microseconds, and `epoll` for whole milliseconds, which answers would wait
    # for.
    with asyncio.Runner(
        loop_factory=partial(asyncio.SelectorEventLoop, selectors.SelectSelector())
    ) as runner:
        runner.run(served(seconds, at_once, load))


async def served(seconds: float, at_once: int, load: str) -> None:
    counts = dict.fromkeys(("answered", "connections", "busy", "refused", "most"), 0)
    loop = asyncio.get_running_loop()
    messages = [
        {"choices": [{"finish_reason": "stop", "message": {"content": text}}]}
        for text in (EGO, HELPER)
    ]
    answers, listed = (
        [json.dumps(message).encode() for message in messages],
        json.dumps(LISTED).encode(),
    )
    waiting = deque[tuple[asyncio.Transport, bytes]]()

    def reply(to: asyncio.Transport, data: bytes) -> None:
        to.write(b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n" + sized(data))

    def work(to: asyncio.Transport, answer: bytes) -> None:
        if counts["busy"] >= at_once and load == "refuses":
            counts["refused"] += 1
            to.write(b"HTTP/1.1 429 Too Many Requests\r\n" + sized(b"{}"))
        elif counts["busy"] >= at_once and load == "waits":
            waiting.append((to, answer))
        else:
            counts["busy"] += 1
            counts["most"] = max(counts["most"], counts["busy"])
            slower = 1 + counts["busy"] / at_once if load == "slows" else 1
            loop.call_later(seconds * slower, done, to, answer)

    def done(to: asyncio.Transport, answer: bytes) -> None:
        counts["busy"] -= 1
        counts["answered"] += 1
        if waiting:
            work(*waiting.popleft())
        reply(to, answer)

    class Connection(asyncio.Protocol):
        """One connection, which sends the next request after an answer."""

        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            assert isinstance(transport, asyncio.Transport)
            self.to, self.came = transport, b""
            counts["connections"] += 1

        def data_received(self, data: bytes) -> None:
            self.came += data
            head, _, rest = self.came.partition(b"\r\n\r\n")
            if head == self.came:
                return
            length = head.lower().partition(b"content-length:")[2].partition(b"\r\n")[0]
            if len(rest) < int(length or 0):
                return
            self.came = b""
            if head.startswith(b"GET"):
                stated = {**counts, "cpu_s": process_time()}
                reply(self.to, json.dumps(stated).encode() if b"/stats" in head else listed)
            else:
                work(self.to, answers[b"evidence" in rest])

    server = await loop.create_server(Connection, "127.0.0.1", 0, backlog=1000)
    print(f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/v1", flush=True)
    await server.serve_forever()


if __name__ == "__main__":
    main()
