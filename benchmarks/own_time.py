"""The harness's own CPU time for a decision: the slope of an evaluation between two sizes.

A decision is a decision point that some walk came to: one ego answer and up to three helper
answers, scored under three conditions and five seeds. Sizes are copies of the dataset. Own time is
the process's CPU time less what `backend.complete` takes, and less what making the copies takes.
Loading the dataset is apart, since it is done once.

    python benchmarks/own_time.py [DATASET] [--layouts N] [--sizes 1 5] [--repeats 3]
                                  [--prompt v2]
"""

import argparse
import gc
import hashlib
import json
import statistics
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from time import process_time
from typing import Any
from unittest.mock import patch

import copies
from rows import Row, finish

from harness.backends import cards
from harness.backends.proxy import Proxy
from harness.cli import COLLECT_AFTER
from harness.coordination.named_points import POINTS
from harness.core.files import canonical_json
from harness.core.resources import DATASET
from harness.dataset import load
from harness.evaluate import asking, requests, run, walk
from harness.evaluate.agent import Agent
from harness.evaluate.asking import Asker
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.kept_answers import KeptAnswers
from harness.evaluate.spec import Spec
from harness.prompts import versions as prompts
from harness.prompts.template import Template
from harness.runs import run_parts
from harness.runs.folder import read
from harness.world.scene_graph import SceneGraph

SMALLEST = "--layouts 1 --sizes 1 2 --repeats 1"
TABLE = "--sizes 1 2"
AIM_MS = 0.2
# Functions whose time makes up a part; what the backend and the copies take is no part of the
# harness.
PARTS: dict[str, list[tuple[Any, str]]] = {
    "proxy": [(Proxy, "complete")],
    "copies": [(copies.Copies, "scenes"), (copies, "_tree")],
    "graph": [(SceneGraph, "plain")],
    "template": [(Template, "render")],
    "answer": [(asking, "answer_of")],
    "lay out": [(Asker, "laid_out")],
    "coordinate": [(walk, "exchange"), (walk, "fuse")],
    "keep": [(KeptAnswers, "append")],
    "table": [(run, "table"), (run_parts, "part_files"), (run_parts, "write_part")],
    "score": [(run, "_gather")],
}
OTHERS = ("proxy", "copies")
LIMIT = "limit"


def main() -> None:
    """Print the slopes as a table and as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("dataset", nargs="?", default=DATASET)
    arguments.add_argument("--layouts", type=int, help="of the dataset; else all")
    arguments.add_argument("--sizes", nargs=2, type=int, default=[1, 5])
    arguments.add_argument("--repeats", type=int, default=3)
    arguments.add_argument("--prompt", default="v2")
    given = arguments.parse_args()

    gc.set_threshold(COLLECT_AFTER, 10, 10)  # as a command has it
    load.load(load.find(given.dataset), limit=1)  # pays for imports
    start = process_time()
    dataset = load.load(load.find(given.dataset), limit=given.layouts)
    loading_ms = (process_time() - start) * 1000 / len(dataset.forest.ids)
    agent = Agent(cards.resolve("proxy"), prompts.load(given.prompt))
    specs = [
        Spec(
            agent,
            FrozenSource(copies.copies(dataset, size)),
            tuple(POINTS.values()),
            tuple(range(5)),
        )
        for size in given.sizes
    ]
    first = evaluated(specs[0], OTHERS)  # pays for imports and compiled templates
    requests = first["answers"] / first["decisions"]
    # Clocks around every call take time too, so the total comes from runs with few of them.
    total = slopes(specs, OTHERS, given.repeats)
    parts = slopes(specs, list(PARTS), given.repeats)
    own_ms = total["own"]
    shown = {part: parts[part] for part in (*PARTS, "other") if part not in OTHERS}
    result = {
        "sizes": given.sizes,
        "repeats": given.repeats,
        "requests_per_decision": round(requests, 3),
        "own_ms": own_ms,
        "own_ms_per_request": own_ms / requests,
        "limit_ms": total[LIMIT],
        "own_over_limit": own_ms / total[LIMIT],
        "proxy_ms": total["proxy"],
        "parts_ms": shown,
        "loading_ms": loading_ms,
    }
    small, large = given.sizes
    print(
        f"CPU ms a decision, slope {small} to {large}, median of {given.repeats}; parts with their "
        "clocks"
    )
    for part, ms in shown.items():
        print(f"  {part:<12}{ms:8.3f}")
    print(f"own           {own_ms:8.3f}   aim {AIM_MS}; {own_ms / requests:.3f} a request")
    print(f"limit         {total[LIMIT]:8.3f}   own is {own_ms / total[LIMIT]:.2f} of it")
    print(f"proxy         {total['proxy']:8.3f}")
    print(f"loading       {loading_ms:8.3f}")
    n = given.repeats
    rows = [
        Row("own time a decision, CPU", own_ms, "ms", n, total[LIMIT], aim=f"≤ {AIM_MS}"),
        Row("own time a request, CPU", own_ms / requests, "ms", n),
        Row("reading the dataset, a decision point, CPU", loading_ms, "ms", 1),
    ]
    finish(rows, **result)


def slopes(specs: list[Spec], parts: Sequence[str], repeats: int) -> dict[str, float]:
    """Milliseconds a decision more costs, by part:
    median over repeats of the slope between two sizes.
    """
    found: dict[str, list[float]] = {}
    for _ in range(repeats):
        small, large = (evaluated(spec, parts) for spec in specs)
        more = large.pop("decisions") - small.pop("decisions")
        del large["answers"]
        for part in large:
            found.setdefault(part, []).append((large[part] - small[part]) * 1000 / more)
    return {part: statistics.median(values) for part, values in found.items()}


def evaluated(spec: Spec, parts: Sequence[str]) -> dict[str, float]:
    """CPU seconds of one evaluation: its parts, its own time, its record's limit;
    and what it counted.
    """
    assert isinstance(spec.source, FrozenSource)
    with tempfile.TemporaryDirectory() as folder:
        spent: defaultdict[str, float] = defaultdict(float)
        with ExitStack() as clocks:
            for part in parts:
                for owner, name in PARTS[part]:
                    clocks.enter_context(clocked(owner, name, spent, part))
            start = process_time()
            out = run.evaluate(spec, Path(folder) / "run", lambda done: None).out
            whole = process_time() - start
        own = whole - sum(spent[part] for part in OTHERS)
        other = whole - sum(spent.values())
        limit = limit_s(spec, out)
        made = read(out)
        counts = {"decisions": len(made.decisions.scenes), "answers": len(made.answers)}
    return {**spent, "other": other, "own": own, LIMIT: limit, **counts}


def limit_s(spec: Spec, out: Path) -> float:
    """CPU seconds of what no harness with this record can leave out.

    Every prompt hashed, every answer decoded as JSON, every line of answers encoded as JSON, with
    the standard library alone, and the decisions written by Arrow; rendering and bookkeeping for
    nothing.
    """
    assert isinstance(spec.source, FrozenSource)
    scenes = spec.source.dataset.scenes(list(read(out).decisions.scenes))
    messages = [request.messages for request in requests.requests(spec, scenes)]
    decoded = [json.loads(line) for line in (out / "answers.jsonl").read_text().splitlines()]
    decisions = read(out).decisions
    start = process_time()
    for message in messages:
        hashlib.sha256(canonical_json(message).encode()).hexdigest()
    for answer in decoded:
        json.loads(answer["raw"][answer["raw"].index("{") :])
    for answer in decoded:
        canonical_json(answer)
    decisions.write(out / "again.parquet")
    return process_time() - start


@contextmanager
def clocked(owner: Any, name: str, spent: defaultdict[str, float], part: str) -> Iterator[None]:
    """While open, the CPU time of calls of `owner.name` goes to a part.
    A generator is run out at once.
    """
    function: Callable[..., Any] = getattr(owner, name)

    def timed(*args: Any, **kwargs: Any) -> Any:
        start = process_time()
        result = function(*args, **kwargs)
        if isinstance(result, Iterator):
            result = iter(list(result))
        spent[part] += process_time() - start
        return result

    with patch.object(owner, name, timed):
        yield


if __name__ == "__main__":
    main()
