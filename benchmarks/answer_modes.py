"""Decisions a second of each answer mode, against a plain `generate` loop and lm-evaluation-harness.

    python benchmarks/answer_modes.py [--model swarm-tiny] [--prompts 32] [--batch-size 8]
    python benchmarks/answer_modes.py --shape 0.6b --tokenizer GGUF --dtype bfloat16 --prompts 4

All on the same prompts: the ego's of the shipped dataset, with prompt v2. The baseline (a) is transformers'
`generate`, one prompt at a time, greedy. (b) is lm-evaluation-harness's `hf` model on the rendered prompts
(left out where `lm_eval` is not installed). `--shape` takes random weights of a Qwen3's shape and Qwen's
vocabulary: such weights never stop, so every free answer is given the tokens of a JSON answer. CPU seconds of
this process (wall on CUDA); what llama.cpp does in its own process is its answers' wall time.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import shapes

from harness.backends import cards
from harness.backends.base import Request
from harness.backends.registry import open_backend
from harness.coordination.operating_point import POINTS
from harness.core.resources import DATASET
from harness.dataset import load
from harness.evaluate.agent import Agent
from harness.evaluate.asking import requests
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.spec import Spec
from harness.prompts import versions as prompts

JSON_TOKENS = 43  # of a compact answer with three actions, in Qwen's vocabulary
AIMS = {"constrained": 4.0, "readout": 12.0}


def main() -> None:
    """Print the rates as a table and as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--model", default="swarm-tiny")
    arguments.add_argument("--shape", choices=sorted(shapes.SHAPES))
    arguments.add_argument("--tokenizer", type=Path, help="tokenizer.json or GGUF with Qwen's vocabulary")
    arguments.add_argument("--device", default="cpu")
    arguments.add_argument("--dtype", default="float32")
    arguments.add_argument("--prompts", type=int, default=32)
    arguments.add_argument("--batch-size", type=int, default=8)
    arguments.add_argument("--threads", type=int, default=1)
    given = arguments.parse_args()

    import torch

    torch.set_num_threads(given.threads)
    with tempfile.TemporaryDirectory() as folder:
        model = given.model
        if given.shape:
            model = str(shapes.build(given.shape, given.tokenizer, Path(folder) / "shape"))
        card = cards.resolve(model, "transformers")
        rates = measure(card, given)
        if not given.shape:
            rates |= of_llama(cards.resolve(given.model, "llama-cpp"), given)
    base = rates["a: generate, batch 1"]
    for name, rate in rates.items():
        print(f"{name:<40}{rate:9.2f} decisions/s   {rate / base:6.1f} of (a)")
    ratios = {mode: rates[f"{mode}, batch {given.batch_size}"] / base for mode in ("json", *AIMS)}
    print("; ".join(f"{mode} {ratios[mode]:.1f}x, aim {aim:g}x" for mode, aim in AIMS.items()))
    print(json.dumps({"rates": rates, "ratios": ratios, **vars(given)}, default=str))


def asked_of(card: cards.Card, mode: str, count: int, most: int | None) -> list[Request]:
    """The ego's requests, spread over the shipped dataset."""
    dataset = load.load(load.find(DATASET))
    source, points = FrozenSource(dataset), tuple(POINTS.values())
    spec = Spec(Agent(card, prompts.load("v2"), mode), source, points, (0,))  # type: ignore[arg-type]
    ids = dataset.courses()
    scenes = dataset.scenes(ids[:: max(1, len(ids) // count)][:count])
    egos = [r for r in requests(spec, scenes) if r.role == "ego"]
    return [replace(r, max_tokens=most) for r in egos] if most and mode == "json" else egos


def measure(card: cards.Card, given: argparse.Namespace) -> dict[str, float]:
    """Rates of transformers, plain, by lm-evaluation-harness and by ours."""
    most = JSON_TOKENS if given.shape else None
    free = asked_of(card, "json", given.prompts, most)
    backend = open_backend(card, device=given.device, dtype=given.dtype, batch_size=given.batch_size)
    chat, model = backend.chat, backend.engine.model  # type: ignore[attr-defined]
    texts = [chat.render(r.messages, thinking=False) for r in free]
    found = {"a: generate, batch 1": rate(len(free), lambda: plain(model, chat, texts, free))}
    by_others = lm_eval(model, chat, texts, free, given.batch_size)
    if by_others:
        found[f"b: lm-evaluation-harness, batch {given.batch_size}"] = rate(len(free), by_others)
    for size in (1, given.batch_size):
        for mode in ("json", *AIMS):
            fresh = open_backend(card, device=given.device, dtype=given.dtype, batch_size=size)
            asked = asked_of(card, mode, given.prompts, most)
            found[f"{mode}, batch {size}"] = rate(len(asked), partial(fresh.complete, asked))
    return found


def of_llama(card: cards.Card, given: argparse.Namespace) -> dict[str, float]:
    """Rates of llama.cpp, one at a time, by the answers' own seconds."""
    backend = open_backend(card, device="cpu", batch_size=1)
    found = {}
    for mode in ("json", *AIMS):
        asked = asked_of(card, mode, given.prompts, None)
        backend.complete(asked[:1])
        seconds = sum(c.seconds or 0 for c in backend.complete(asked))
        found[f"llama.cpp {mode}, batch 1 (wall)"] = len(asked) / seconds
    return found


def rate(count: int, work: Callable[[], Any]) -> float:
    """Decisions a second, after one round to warm up."""
    import torch

    clock = time.perf_counter if torch.cuda.is_available() else time.process_time
    work()
    start = clock()
    work()
    return count / (clock() - start)


def plain(model: Any, chat: Any, texts: Sequence[str], asked: Sequence[Request]) -> None:
    """What a script without a harness does."""
    import torch

    for text, request in zip(texts, asked, strict=True):
        ids = torch.tensor([chat.encode(text)], device=model.device)
        with torch.inference_mode():
            model.generate(
                ids, attention_mask=torch.ones_like(ids), do_sample=False, max_new_tokens=request.max_tokens,
                pad_token_id=0,
            )  # fmt: skip


def lm_eval(
    model: Any, chat: Any, texts: Sequence[str], asked: Sequence[Request], batch_size: int
) -> Callable[[], Any] | None:
    """lm-evaluation-harness asked for the same; None where it is not installed."""
    try:
        from lm_eval.api.instance import Instance
        from lm_eval.models.huggingface import HFLM
    except ImportError:
        return None
    wrapped = HFLM(pretrained=model, tokenizer=chat.tokenizer, batch_size=batch_size, max_length=2048)
    arguments = {"until": ["<|im_end|>"], "do_sample": False, "max_gen_toks": asked[0].max_tokens}
    instances = [
        Instance(request_type="generate_until", doc={}, arguments=(text, arguments), idx=i)
        for i, text in enumerate(texts)
    ]
    return lambda: wrapped.generate_until(instances, disable_tqdm=True)


if __name__ == "__main__":
    main()
