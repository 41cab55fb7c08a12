"""Decisions a second of each answer mode, against a plain `generate` loop and lm-evaluation-harness.

    python benchmarks/answer_modes.py [--model swarm-tiny] [--shape tiny|0.6b] [--prompts 32] [--batch-size 8]

All on the same prompts: the ego's of the shipped dataset, with prompt v2. The baseline (a) is transformers'
`generate`, one prompt at a time, greedy. (b) is lm-evaluation-harness's `hf` model on the rendered prompts
(left out where `lm_eval` is not installed). `--shape 0.6b` takes random weights of Qwen3-0.6B's shape with
the model's tokenizer: such weights never stop, so every free answer is as long as Qwen's tokens make it. CPU
seconds of this process; what llama.cpp does in its own process is its answers' wall time.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from harness import cards, prompts
from harness.backends.base import Request
from harness.backends.registry import open_backend
from harness.dataset import load
from harness.operating_point import POINTS
from harness.run.asking import requests
from harness.run.spec import Spec

JSON_TOKENS = 43  # of a compact answer with three actions, in Qwen's vocabulary
AIMS = {"constrained": 4.0, "readout": 12.0}


def main() -> None:
    """Print the rates as a table and as one line of JSON."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--model", default="swarm-tiny")
    arguments.add_argument("--shape", choices=["own", "0.6b"], default="own")
    arguments.add_argument("--dtype", default="float32")
    arguments.add_argument("--prompts", type=int, default=32)
    arguments.add_argument("--batch-size", type=int, default=8)
    arguments.add_argument("--threads", type=int, default=1)
    given = arguments.parse_args()

    import torch

    torch.set_num_threads(given.threads)
    with tempfile.TemporaryDirectory() as folder:
        card = cards.resolve(given.model, "transformers")
        if given.shape == "0.6b":
            card = cards.resolve(str(shaped(card, Path(folder) / "shape")), "transformers")
        rates = measure(card, given)
        if given.shape == "own":
            rates |= of_llama(cards.resolve(given.model, "llama-cpp"), given)
    base = rates["a: generate, batch 1"]
    for name, rate in rates.items():
        print(f"{name:<40}{rate:9.2f} decisions/s   {rate / base:6.1f} of (a)")
    ratios = {mode: rates[f"{mode}, batch {given.batch_size}"] / base for mode in ("json", *AIMS)}
    print("; ".join(f"{mode} {ratios[mode]:.1f}x, aim {aim:g}x" for mode, aim in AIMS.items()))
    print(json.dumps({"rates": rates, "ratios": ratios, **vars(given)}))


def asked_of(card: cards.Card, mode: str, count: int, most: int | None) -> list[Request]:
    """The ego's requests, spread over the shipped dataset."""
    dataset = load.load(load.find(load.DEFAULT))
    spec = Spec(card, prompts.load("v2"), dataset, tuple(POINTS.values()), (0,), answer=mode)  # type: ignore[arg-type]
    scenes = dataset.scenes[:: max(1, len(dataset.scenes) // count)][:count]
    egos = [r for r in requests(spec, scenes) if r.role == "ego"]
    return [replace(r, max_tokens=most) for r in egos] if most and mode == "json" else egos


def measure(card: cards.Card, given: argparse.Namespace) -> dict[str, float]:
    """Rates of transformers, plain, by lm-evaluation-harness and by ours."""
    most = JSON_TOKENS if given.shape == "0.6b" else None
    free = asked_of(card, "json", given.prompts, most)
    backend = open_backend(card, device="cpu", dtype=given.dtype, batch_size=given.batch_size)
    chat, model = backend.chat, backend.engine.model  # type: ignore[attr-defined]
    texts = [chat.render(r.messages, thinking=False) for r in free]
    found = {"a: generate, batch 1": rate(len(free), lambda: plain(model, chat, texts, free))}
    by_others = lm_eval(model, chat, texts, free, given.batch_size)
    if by_others:
        found[f"b: lm-evaluation-harness, batch {given.batch_size}"] = rate(len(free), by_others)
    for size in (1, given.batch_size):
        for mode in ("json", *AIMS):
            fresh = open_backend(card, device="cpu", dtype=given.dtype, batch_size=size)
            asked = asked_of(card, mode, given.prompts, most)
            found[f"{mode}, batch {size}"] = rate(len(asked), lambda b=fresh, a=asked: b.complete(a))
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
    """Decisions a CPU second, after one round to warm up."""
    work()
    start = time.process_time()
    work()
    return count / (time.process_time() - start)


def plain(model: Any, chat: Any, texts: Sequence[str], asked: Sequence[Request]) -> None:
    """What a script without a harness does."""
    import torch

    for text, request in zip(texts, asked, strict=True):
        ids = torch.tensor([chat.encode(text)])
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


def shaped(card: cards.Card, folder: Path) -> Path:
    """Random weights of Qwen3-0.6B's shape, with the tokenizer of another checkpoint."""
    import torch
    from transformers import AutoTokenizer, Qwen3Config, Qwen3ForCausalLM

    from harness.backends import checkpoint

    tokenizer = AutoTokenizer.from_pretrained(checkpoint.find(card))
    torch.manual_seed(0)
    config = Qwen3Config(
        vocab_size=151936, hidden_size=1024, intermediate_size=3072, num_hidden_layers=28,
        num_attention_heads=16, num_key_value_heads=8, head_dim=128, tie_word_embeddings=True,
        max_position_embeddings=4096, eos_token_id=151645, pad_token_id=tokenizer.pad_token_id,
        bos_token_id=None,
    )  # fmt: skip
    Qwen3ForCausalLM(config).to(torch.bfloat16).save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    return folder


if __name__ == "__main__":
    main()
