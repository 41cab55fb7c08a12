"""Decisions a second of each answer mode,
against a plain `generate` loop and lm-evaluation-harness.

    python benchmarks/answer_modes.py [--model swarm-tiny] [--prompts 32] [--batch-size 8]
                                      [--repeats 1]
    python benchmarks/answer_modes.py --shape 0.6b --tokenizer GGUF --dtype bfloat16 --prompts 4
    python benchmarks/answer_modes.py --model smollm2-135m --modes readout cyclic --prompts 8

All on the same prompts: the ego's of the shipped dataset, with prompt v2. The baseline (a) is
transformers' `generate`, one prompt at a time, greedy. (b) is lm-evaluation-harness's `hf` model on
the rendered prompts (left out where `lm_eval` is not installed). `--shape` takes random weights of
a Qwen3's shape and Qwen's vocabulary: such weights never stop, so every free answer is given the
tokens of a JSON answer. `readout` reads its letters once, `cyclic` over all cyclic orders. Without
`json` among the modes there are no baselines. CPU seconds of this process (wall on CUDA), the
median of repeats in turn; what llama.cpp does in its own process is its answers' wall time. The
limit has the matrix products alone, of each prompt's tokens after what all begin with and of the
answer's, at the rate of one such product. At batch 1 a second limit is nearer: each pass reads all
weights, so it takes as long as the product of one row with each of them.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

import shapes
from rows import Row, finish

from harness.backends import cards
from harness.backends.base import Request
from harness.backends.card import Card
from harness.backends.engine import common_length
from harness.backends.language_model import LanguageModel
from harness.backends.registry import open_backend
from harness.coordination.named_points import POINTS
from harness.core.resources import DATASET
from harness.dataset import load
from harness.evaluate.agent import Agent
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.requests import requests
from harness.evaluate.spec import Spec
from harness.prompts import versions as prompts

SMALLEST = "--prompts 1 --batch-size 2 --modes json"
TABLE = "--prompts 32 --batch-size 32"
NEEDS = "torch llama_cpp"
JSON_TOKENS = 43  # of a compact answer with three actions, in Qwen's vocabulary
PLAIN, PEER = "a: generate, batch 1", "b: lm-evaluation-harness"
MODES = ("json", "constrained", "readout", "cyclic")
CYCLIC_AIM = 1.4  # times the CPU of one pass, with three actions
AIMS = {"json": 3.0, "readout": 6.0}  # times lm-evaluation-harness at the same batch size
PRODUCT_ROWS = 1024  # tokens in the matrix product that the limit is taken from


def main() -> None:
    """Print the rates as a table and as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--model", default="swarm-tiny")
    arguments.add_argument("--shape", choices=sorted(shapes.SHAPES))
    arguments.add_argument(
        "--tokenizer", type=Path, help="tokenizer.json or GGUF with Qwen's vocabulary"
    )
    arguments.add_argument("--modes", nargs="+", choices=MODES, default=MODES)
    arguments.add_argument("--device", default="cpu")
    arguments.add_argument("--dtype", default="float32")
    arguments.add_argument("--prompts", type=int, default=32)
    arguments.add_argument(
        "--alone", type=int, help="how many of the prompts are asked one at a time"
    )
    arguments.add_argument("--batch-size", type=int, default=8)
    arguments.add_argument("--threads", type=int, default=1)
    arguments.add_argument("--repeats", type=int, default=1)
    given = arguments.parse_args()

    import torch

    torch.set_num_threads(given.threads)
    os.environ["OMP_NUM_THREADS"] = str(given.threads)  # of llama.cpp as well
    with tempfile.TemporaryDirectory() as folder:
        model = given.model
        if given.shape:
            model = str(shapes.build(given.shape, given.tokenizer, Path(folder) / "shape"))
        card = cards.resolve(model, "transformers")
        rates, limits, limits_at_one = measure(card, given)
        if not given.shape and find_spec("llama_cpp"):
            rates |= of_llama(cards.resolve(given.model, "llama-cpp"), given)
    peers = {"(a)": rates.get(PLAIN), "(b)": rates.get(PEER)}

    def compared(rate: float) -> str:
        return "".join(f", {rate / peer:.1f} of {name}" for name, peer in peers.items() if peer)

    for name, rate in rates.items():
        print(f"{name:<40}{rate:9.2f} decisions/s{compared(rate)}")
    for mode, (limit, own, of_all) in limits.items():
        print(f"{mode}: {own:.0f} of {of_all:.0f} tokens of a prompt are its own")
        ours, aim = rates[f"{mode}, batch {given.batch_size}"], AIMS.get(mode)
        aimed = f", aim {aim:g} of (b)" if aim else ""
        print(
            f"{mode}: limit {limit:.2f} decisions/s{compared(limit)}{aimed}; reached "
            f"{ours / limit:.2f} of it"
        )
        streamed, alone = limits_at_one[mode], rates[f"{mode}, batch 1"]
        print(
            f"{mode}, batch 1: limit by reading weights {streamed:.2f}; reached "
            f"{alone / streamed:.2f} of it"
        )
    if {"readout", "cyclic"} <= {*given.modes}:
        for size in (f"batch {n}" for n in dict.fromkeys((1, given.batch_size))):
            times = rates[f"readout, {size}"] / rates[f"cyclic, {size}"]
            print(f"cyclic, {size}: {times:.2f} times one pass, aim {CYCLIC_AIM}")
    peer = (
        f"lm-evaluation-harness {rates[PEER]:.0f} /s"
        if PEER in rates
        else f"`generate` {rates[PLAIN]:.0f} /s"
    )
    rows = [
        Row(
            f"{mode} of {given.model}, batch {given.batch_size}, decisions a CPU second",
            rates[f"{mode}, batch {given.batch_size}"],
            "/s",
            given.repeats,
            limit,
            peer,
        )
        for mode, (limit, *_) in limits.items()
    ]
    finish(rows, rates=rates, limits=limits, limits_at_one=limits_at_one, **vars(given))


def asked_of(card: Card, mode: str, count: int, most: int | None) -> list[Request]:
    """The ego's requests, spread over the shipped dataset."""
    dataset = load.load(load.find(DATASET))
    source, points = FrozenSource(dataset), tuple(POINTS.values())
    answer, letters = ("readout", mode) if mode == "cyclic" else (mode, "raw")
    agent = Agent(card, prompts.load("v2"), answer, letters=letters)  # type: ignore[arg-type]
    spec = Spec(agent, source, points, (0,))
    ids = dataset.courses()
    scenes = dataset.scenes(ids[:: max(1, len(ids) // count)][:count])
    egos = [r for r in requests(spec, scenes) if r.role == "ego"]
    return [replace(r, max_tokens=most) for r in egos] if most and mode == "json" else egos


def measure(
    card: Card, given: argparse.Namespace
) -> tuple[dict[str, float], dict[str, Any], dict[str, float]]:
    """Rates of transformers, plain, by lm-evaluation-harness and by ours;
    and the limits of each mode.
    """
    most = JSON_TOKENS if given.shape else None
    asked = {mode: asked_of(card, mode, given.prompts, most) for mode in given.modes}
    backend = open_backend(
        card, device=given.device, dtype=given.dtype, batch_size=given.batch_size
    )
    chat, engine = backend.chat, backend.engine  # type: ignore[attr-defined]
    work: dict[str, Callable[[], Any]] = {}
    alone = given.alone or given.prompts
    if free := asked.get("json"):
        texts = [chat.render(r.messages, thinking=False) for r in free]
        work[PLAIN] = lambda: plain(engine.model, chat, texts[:alone], free[:alone])
        if by_others := lm_eval(engine.model, chat, texts, free, given.batch_size):
            work[PEER] = by_others
    for size, most_asked in ((1, alone), (given.batch_size, given.prompts)):
        for mode in given.modes:
            ask = LanguageModel(engine, size).complete
            work[f"{mode}, batch {size}"] = partial(ask, asked[mode][:most_asked])
    for each in work.values():
        each()  # to warm up
    found: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(given.repeats):
        for name, each in work.items():
            engine._reader._prefixes.clear()  # the modes' prompts begin alike, which no run's do
            count = alone if name == PLAIN or name.endswith(", batch 1") else given.prompts
            found[name].append(count / seconds_of(each))
    flops_per_s = product_rate(engine.model)
    limits = {mode: limit(backend, asked[mode], flops_per_s) for mode in given.modes}
    pass_s = reading_s(engine.model)
    at_one = {mode: 1 / (pass_s * passes(backend, asked[mode])) for mode in given.modes}
    return {name: median(rates) for name, rates in found.items()}, limits, at_one


def passes(backend: Any, asked: Sequence[Request]) -> float:
    """Mean number of times that an answer at batch 1 reads all weights:
    prompt, and each further token.
    """
    tokens = [
        1 if r.orders else c.completion_tokens
        for r, c in zip(asked, backend.complete(asked), strict=True)
    ]
    return sum(tokens) / len(tokens)


def reading_s(model: Any) -> float:
    """Seconds that one row's products with all matrices of layers and output take."""
    import torch

    matrices = [weights for weights in model.model.layers.parameters() if weights.ndim == 2]
    matrices.append(model.get_output_embeddings().weight)
    rows = {
        size: torch.ones(1, size, dtype=model.dtype, device=model.device)
        for size in {weights.shape[1] for weights in matrices}
    }

    def work() -> None:
        for weights in matrices:
            product = torch.nn.functional.linear(rows[weights.shape[1]], weights)
        product.sum().item()

    with torch.inference_mode():
        work()
        return min(seconds_of(work) for _ in range(5))


def product_rate(model: Any) -> float:
    """Floating-point operations a second of a product of the model's own shape."""
    import torch

    config, dtype, device = model.config, model.dtype, model.device
    weights = torch.ones(config.intermediate_size, config.hidden_size, dtype=dtype, device=device)
    rows = torch.ones(PRODUCT_ROWS, config.hidden_size, dtype=dtype, device=device)
    times = 1 + int(1e10 // (rows.numel() * config.intermediate_size))

    def work() -> None:
        for _ in range(times):
            product = torch.nn.functional.linear(rows, weights)
        product.sum().item()

    work()
    fastest_s = min(seconds_of(work) for _ in range(5))
    operations: int = 2 * rows.numel() * config.intermediate_size * times
    return operations / fastest_s


def limit(backend: Any, asked: Sequence[Request], flops_per_s: float) -> tuple[float, float, float]:
    """Decisions a second of the matrix products alone, in layers, attention and the output.

    Also the mean number of a prompt's tokens after what all begin with, and of all its tokens.
    """
    config, net = backend.engine.model.config, backend.engine.model
    prompts = [backend.tokens(request) for request in asked]
    known = common_length([prompt[:-1] for prompt in prompts])
    weights = sum(p.numel() for p in net.model.layers.parameters() if p.ndim == 2)
    a_context = 4 * config.num_hidden_layers * config.num_attention_heads * config.head_dim
    flops = 0
    for request, completion in zip(asked, backend.complete(asked), strict=True):
        # The last token of an answer is never read; of several orders, each has a distribution of
        # its own.
        end = completion.prompt_tokens + completion.completion_tokens - 1
        chosen = completion.completion_tokens * (1 + len(request.orders))
        flops += 2 * weights * (end - known) + a_context * sum(range(known + 1, end + 1))
        flops += 2 * config.vocab_size * config.hidden_size * chosen
    mean = sum(map(len, prompts)) / len(prompts)
    return len(asked) * flops_per_s / flops, mean - known, mean


def of_llama(card: Card, given: argparse.Namespace) -> dict[str, float]:
    """Rates of llama.cpp, one at a time, by the answers' own seconds."""
    backend = open_backend(card, device="cpu", batch_size=1)
    found = {}
    for mode in given.modes:
        asked = asked_of(card, mode, given.prompts, None)
        backend.complete(asked[:1])
        seconds = sum(c.seconds or 0 for c in backend.complete(asked))
        found[f"llama.cpp {mode}, batch 1 (wall)"] = len(asked) / seconds
    return found


def seconds_of(work: Callable[[], Any]) -> float:
    """CPU seconds of this process, or wall seconds where there is a GPU."""
    import torch

    clock = time.perf_counter if torch.cuda.is_available() else time.process_time
    start = clock()
    work()
    return clock() - start


def plain(model: Any, chat: Any, texts: Sequence[str], asked: Sequence[Request]) -> None:
    """What a script without a harness does."""
    import torch

    for text, request in zip(texts, asked, strict=True):
        ids = torch.tensor([chat.encode(text)], device=model.device)
        with torch.inference_mode():
            model.generate(
                ids,
                attention_mask=torch.ones_like(ids),
                do_sample=False,
                max_new_tokens=request.max_tokens,
                pad_token_id=0,
            )


def lm_eval(
    model: Any, chat: Any, texts: Sequence[str], asked: Sequence[Request], batch_size: int
) -> Callable[[], Any] | None:
    """lm-evaluation-harness asked for the same; None where it is not installed."""
    try:
        from lm_eval.api.instance import Instance
        from lm_eval.models.huggingface import HFLM
    except ImportError:
        return None
    wrapped = HFLM(
        pretrained=model, tokenizer=chat.tokenizer.hub, batch_size=batch_size, max_length=2048
    )
    arguments = {"until": ["<|im_end|>"], "do_sample": False, "max_gen_toks": asked[0].max_tokens}
    instances = [
        Instance(request_type="generate_until", doc={}, arguments=(text, arguments), idx=i)
        for i, text in enumerate(texts)
    ]
    return lambda: wrapped.generate_until(instances, disable_tqdm=True)


if __name__ == "__main__":
    main()
