"""CPU seconds of a read-out and of a JSON answer of one card on each of its engines,
as the card comes.

    python benchmarks/engines.py [--model smollm2-135m] [--questions 12]
    python benchmarks/engines.py --dtype bfloat16 --answers readout

The fixed questions of `harness model check`, with prompt v2, one at a time after one that warms up,
on the engine's usual threads, in this process. An engine is opened anew for each kind of answer,
since prompts of two kinds begin alike. The limit is of transformers: of what all prompts begin with
nothing, of the rest of each the matrix products at the rate of one of the model's own shape, and
for each written token one reading of all weights at the rate at which memory is summed up.
"""

import argparse
import json
import time
from typing import Any

import numpy as np
from answer_modes import product_rate

from harness.backends import cards
from harness.backends.engine import common_length
from harness.backends.llama_cpp.engine import open_here
from harness.backends.registry import open_backend
from harness.backends.weights import find_gguf
from harness.evaluate.agent import Agent
from harness.extensions.checkups import questions
from harness.prompts import versions

SMALLEST = "--model swarm-tiny --questions 1 --answers readout"
NEEDS = "torch llama_cpp"
AIMS = {"readout": 5.0, "json": 3.0}  # times fewer CPU seconds on transformers


def main() -> None:
    """Print the figures as a table and as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--model", default="smollm2-135m")
    arguments.add_argument("--questions", type=int, default=12)
    arguments.add_argument("--answers", nargs="+", choices=AIMS, default=[*AIMS])
    arguments.add_argument("--dtype", help="of transformers; the card's if left out")
    given = arguments.parse_args()
    found: dict[str, dict[str, float]] = {}
    for answer in given.answers:
        aim = AIMS[answer]
        of = {engine: measure(given, engine, answer) for engine in OPENED}
        ours, limit, tokens = of["transformers"]
        theirs = of["llama-cpp"][0]
        print(
            f"{answer:<8} n = {given.questions}, {tokens:.0f} tokens: transformers {ours:.2f} CPU "
            f"s, llama-cpp {theirs:.2f}, {theirs / ours:.1f} times as many (aim {aim:g}); limit "
            f"{limit:.2f}, {ours / limit:.1f} times it"
        )
        found[answer] = {
            "transformers": ours,
            "llama-cpp": theirs,
            "limit": limit,
            "tokens": tokens,
        }
    print(json.dumps(found | vars(given)))


def of_transformers(given: argparse.Namespace) -> Any:
    """The card's model on transformers."""
    card = cards.resolve(given.model, "transformers")
    return open_backend(card, device="cpu", dtype=given.dtype, batch_size=1)


def of_llama(given: argparse.Namespace) -> Any:
    """The card's model on llama.cpp, in this process, whose CPU seconds are known."""
    card = cards.resolve(given.model, "llama-cpp")
    return open_here(card, find_gguf(card), "cpu", 1)


OPENED = {"transformers": of_transformers, "llama-cpp": of_llama}


def measure(given: argparse.Namespace, engine: str, answer: str) -> tuple[float, float, float]:
    """CPU seconds of an answer, their limit (0 on llama.cpp) and its written tokens."""
    card = cards.resolve(given.model, engine)
    agent = Agent(card, versions.load("v2"), answer, letters="raw")  # type: ignore[arg-type]
    backend = OPENED[engine](given)
    warm, *asked = [
        *questions.requests(agent, "helper")[:1],
        *questions.requests(agent)[: given.questions],
    ]
    backend.complete([warm])
    start_s = time.process_time()
    done = [backend.complete([request])[0] for request in asked]
    took_s = (time.process_time() - start_s) / len(asked)
    tokens = sum(c.completion_tokens for c in done) / len(done)
    if engine != "transformers":
        return took_s, 0.0, tokens
    net = backend.engine.model
    prompts = [backend.tokens(request) for request in asked]
    own = sum(map(len, prompts)) / len(prompts) - common_length([prompt[:-1] for prompt in prompts])
    layers = sum(p.numel() for p in net.model.layers.parameters() if p.ndim == 2)
    weights = sum(p.numel() * p.element_size() for p in net.parameters())
    limit_s = 2 * layers * own / product_rate(net) + (tokens - 1) * weights / streamed()
    return took_s, limit_s, tokens


def streamed() -> float:
    """Bytes a CPU second that one thread sums up, of more than a cache holds."""
    data = np.ones(1 << 26, dtype=np.float32)
    least_s = float("inf")
    for _ in range(5):
        start_s = time.process_time()
        data.sum()
        least_s = min(least_s, time.process_time() - start_s)
    return data.nbytes / least_s


if __name__ == "__main__":
    main()
