"""Asking servers: how near a run comes to what they can answer, and the client's CPU a request.

Each server is a process of its own on this machine that answers chat completions after a fixed time, so
many at once, whatever is asked. Ideal is that each of them is always full. Asked are the shipped dataset's
prompts: by `complete` alone, and by all that `harness eval` does to get, read and keep answers. The limit is
sockets alone: the same bytes are written, and answers read, on connections that stay open.

    python benchmarks/servers.py [--servers 1] [--requests 4000] [--repeats 5] [--seconds 0.05] [--at-once 20]
        [--batch-size 20]
"""

import argparse
import asyncio
import json
import statistics
import subprocess
import sys
import tempfile
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import cycle, islice
from pathlib import Path
from time import perf_counter, process_time
from typing import Any
from urllib.parse import urlsplit

from rows import Row, finish

from harness.backends import cards
from harness.backends.base import Backend, Request
from harness.backends.openai.shapes import body
from harness.backends.registry import open_backend
from harness.backends.servers import Server
from harness.coordination.operating_point import POINTS
from harness.core.resources import DATASET
from harness.dataset import load
from harness.evaluate.agent import Agent
from harness.evaluate.asking import Asker, requests
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.latency import PAPER
from harness.evaluate.spec import Spec
from harness.prompts import versions as prompts

SMALLEST = "--requests 40 --repeats 1 --seconds 0.005"
TABLE = "--requests 1000 --repeats 3"
NEEDS = "aiohttp"
AIMS = {"of_ideal": 0.95, "cpu_ms": 0.3}
TEXT = '{"action_distribution":{"SLOWER":0.20,"IDLE":0.70,"FASTER":0.10}}'
LISTED = {"data": [{"id": "m", "owned_by": "benchmark"}]}


def main() -> None:
    """Print the medians as a table and as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--servers", type=int, default=1)
    arguments.add_argument("--requests", type=int, default=4000)
    arguments.add_argument("--repeats", type=int, default=5)
    arguments.add_argument("--seconds", type=float, default=0.05)
    arguments.add_argument("--at-once", type=int, default=20)
    arguments.add_argument("--batch-size", type=int, help="default: as many as a server takes")
    arguments.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    given = arguments.parse_args()
    if given.serve:
        asyncio.run(serve(given.seconds, given.at_once))
        return
    asked, batch_size = questions(given.requests), given.batch_size or given.at_once
    ideal_s = given.requests * given.seconds / (given.at_once * given.servers)
    found: dict[str, list[tuple[float, float]]] = {}
    answered: list[int] = []
    with ExitStack() as stack:
        urls = [stack.enter_context(serving(given.seconds, given.at_once)) for _ in range(given.servers)]
        base = cards.load("openai-example")
        urls_of_card = urls[0] if len(urls) == 1 else tuple(urls)
        card = replace(base, server=Server(urls_of_card), thinking="none", weights="m")
        spec = Spec(
            Agent(card, prompts.load("v2")), FrozenSource(load.load(load.find(DATASET), limit=1)),
            tuple(POINTS.values()), (0,), batch_size=batch_size,
        )  # fmt: skip
        assert card.server
        bodies = [json.dumps(body(card, card.server, request)).encode() for request in asked]
        backend = open_backend(card, batch_size=batch_size)
        backend.complete(asked[: 4 * given.at_once])  # pays for imports and connections
        for _ in range(given.repeats):
            ways: dict[str, Callable[[], object]] = {
                "sockets": lambda: asyncio.run(bare(urls, bodies, given.at_once)),
                "complete": lambda: completed(backend, asked),
                "ask": lambda: kept(spec, backend, asked),
            }
            for name, way in ways.items():
                found.setdefault(name, []).append(measured(way))
        answered = [stats(url)["answered"] for url in urls]
        connections = [stats(url)["connections"] for url in urls]
    result: dict[str, Any] = {
        "servers": given.servers, "requests": given.requests, "repeats": given.repeats,
        "seconds": given.seconds, "at_once": given.at_once, "batch_size": batch_size,
        "ideal_per_s": given.requests / ideal_s,
        "answered": answered, "connections": connections,
    }  # fmt: skip
    print(
        f"{given.requests} requests, {given.servers} servers of {given.seconds * 1000:g} ms x "
        f"{given.at_once}, batch size {batch_size}: ideal {given.requests / ideal_s:.0f}/s; medians of "
        f"{given.repeats}"
    )
    for name, times in found.items():
        wall_s, cpu_s = (statistics.median(values) for values in zip(*times, strict=True))
        of_ideal, cpu_ms = ideal_s / wall_s, 1000 * cpu_s / given.requests
        shares = [ideal_s / wall for wall, _ in times]
        result[name] = {"of_ideal": of_ideal, "least": min(shares), "most": max(shares), "cpu_ms": cpu_ms}
        aim = f"   aim {100 * AIMS['of_ideal']:g} %, {AIMS['cpu_ms']} ms" if name == "complete" else ""
        print(
            f"{name:<10}{100 * of_ideal:6.1f} % of ideal ({100 * min(shares):.1f} to {100 * max(shares):.1f})"
            f"{cpu_ms:8.3f} ms of CPU a request{aim}"
        )
    print(f"answered by each: {answered}; connections: {connections}")
    limit, asking = result["sockets"], result["ask"]
    what = f"asking servers of {given.seconds * 1000:g} ms × {given.at_once}"
    rows = [
        Row(f"{what}, of ideal, wall", 100 * asking["of_ideal"], "%", given.repeats, 100 * limit["of_ideal"]),
        Row(f"{what}, a request, CPU", asking["cpu_ms"], "ms", given.repeats, limit["cpu_ms"]),
    ]
    finish(rows, **result)


def questions(count: int) -> list[Request]:
    """So many requests of the shipped dataset, its decision points again and again under other names."""
    dataset = load.load(load.find(DATASET))
    spec = Spec(
        Agent(cards.resolve("proxy"), prompts.load("v2")), FrozenSource(dataset), tuple(POINTS.values()), (0,)
    )
    drawn = islice(cycle(requests(spec, dataset.scenes(dataset.courses()))), count)
    return [replace(request, id=f"{n // 4}-{request.id}", view=None) for n, request in enumerate(drawn)]


def measured(way: Callable[[], object]) -> tuple[float, float]:
    """Wall and CPU seconds of this process."""
    wall, cpu = perf_counter(), process_time()
    way()
    return perf_counter() - wall, process_time() - cpu


def completed(backend: Backend, asked: Sequence[Request]) -> None:
    """Ask by `complete` alone."""
    assert all(completion.text == TEXT for completion in backend.complete(asked))


def kept(spec: Spec, backend: Backend, asked: Sequence[Request]) -> None:
    """Ask as an evaluation does, every answer read and kept in a file."""
    with tempfile.TemporaryDirectory() as folder:
        asker = Asker(spec, lambda: backend, PAPER, Path(folder) / "answers.jsonl")
        asker.ask(asked)
        assert len(asker.answers) == len(asked)


async def bare(urls: Sequence[str], bodies: Sequence[bytes], at_once: int) -> None:
    """The same bytes on so many connections a server, each asked again as soon as it has answered."""
    waiting = iter(bodies)

    async def asking(url: str) -> None:
        parts = urlsplit(url)
        reader, writer = await asyncio.open_connection(parts.hostname, parts.port)
        for data in waiting:
            writer.write(b"POST /v1/chat/completions HTTP/1.1\r\nHost: x\r\n" + sized(data))
            head = await reader.readuntil(b"\r\n\r\n")
            await reader.readexactly(int(head.rpartition(b": ")[2]))
        writer.close()

    await asyncio.gather(*(asking(url) for url in urls for _ in range(at_once)))


def sized(data: bytes) -> bytes:
    """The end of a head, and what it is of."""
    return b"Content-Length: %d\r\n\r\n%b" % (len(data), data)


# -- the server ---------------------------------------------------------------------------------------------


@contextmanager
def serving(seconds: float, at_once: int) -> Iterator[str]:
    """A server in a process of its own; its base URL."""
    options = ["--serve", "--seconds", str(seconds), "--at-once", str(at_once)]
    process = subprocess.Popen([sys.executable, __file__, *options], stdout=subprocess.PIPE, text=True)
    assert process.stdout
    try:
        yield process.stdout.readline().strip()
    finally:
        process.kill()
        process.communicate()


def stats(url: str) -> dict[str, int]:
    """What a server counted."""
    with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(f"{url}/stats") as answer:
        counted: dict[str, int] = json.load(answer)
        return counted


async def serve(seconds: float, at_once: int) -> None:
    """Answer for ever; the base URL is printed first."""
    places, counts = asyncio.Semaphore(at_once), {"answered": 0, "connections": 0}
    message = {"choices": [{"finish_reason": "stop", "message": {"content": TEXT}}], "usage": {}}
    answer, listed = json.dumps(message).encode(), json.dumps(LISTED).encode()

    async def serve_one(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        counts["connections"] += 1
        try:
            while True:
                head = await reader.readuntil(b"\r\n\r\n")
                if head.startswith(b"GET"):
                    data = json.dumps(counts).encode() if b"/stats" in head else listed
                else:
                    length = head.lower().partition(b"content-length:")[2].partition(b"\r\n")[0]
                    await reader.readexactly(int(length))
                    async with places:
                        await asyncio.sleep(seconds)
                    counts["answered"] += 1
                    data = answer
                writer.write(b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n" + sized(data))
        except (asyncio.IncompleteReadError, ConnectionError):
            writer.close()

    server = await asyncio.start_server(serve_one, "127.0.0.1", 0)
    print(f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}/v1", flush=True)
    await server.serve_forever()


if __name__ == "__main__":
    main()
