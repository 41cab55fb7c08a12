"""How many rewards a CPU second: distributions looked up in a batch, by place and by id, and texts.

Trees of train seeds, built at the first call and kept in the cache folder. Texts are what a model
might write: a strict answer, one among other words, and one that cannot be read, a third each, all
different. A step is one of the environment, with its chat. Each figure is the best of five passes.

    python benchmarks/rewards.py [--scenario NAME] [--layouts 8] [--batch 256]
"""

import argparse
from collections.abc import Callable
from itertools import cycle
from time import process_time

import numpy as np
from rows import Row, finish

import harness

SMALLEST = "--layouts 1 --batch 2"
TABLE = ""
STATED = '{"action_distribution":{%s}}'


def a_second(count: int, work: Callable[[], object]) -> int:
    """How many of `count` items a CPU second, of the best of five passes."""

    def cpu_s() -> float:
        start = process_time()
        work()
        return process_time() - start

    return round(count / min(cpu_s() for _ in range(5)))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "--scenario", default="blind-merge:witnesses=any,radio_share=0,limits=1,perception=1"
    )
    parser.add_argument("--layouts", type=int, default=8)
    parser.add_argument("--batch", type=int, default=256)
    args = parser.parse_args()
    env = harness.environment(args.scenario, layouts=args.layouts)
    values, rng = env.values, np.random.default_rng(0)
    batches, size = 2000, args.batch
    places = rng.integers(len(values.ids), size=(batches, size))
    p = rng.dirichlet(np.ones(len(values.actions)), (batches, size))
    ids = [[values.ids[place] for place in batch] for batch in places[:100].tolist()]

    rows = env.rows()
    shares = rng.multinomial(100, np.full(len(env.actions), 1 / len(env.actions)), len(rows)) / 100
    answers = [
        STATED % ",".join(f'"{a}":{n:.2f}' for a, n in zip(env.actions, row, strict=True))
        for row in shares
    ]
    forms = cycle(("%s", "I brake. %s Done.", "I do not know: %.20s"))
    texts = [form % answer for form, answer in zip(forms, answers, strict=False)]
    columns = {name: [row[name] for row in rows] for name in rows[0] if name != "prompt"}

    def step() -> None:
        env.reset(seed=1)
        for _ in range(300):
            if env.step(int(rng.integers(len(env.actions))))[2]:
                env.reset()

    rates = {
        f"distributions by place, {size} a batch": a_second(
            batches * size, lambda: [values(*each) for each in zip(places, p, strict=True)]
        ),
        f"distributions by id, {size} a batch": a_second(
            100 * size, lambda: [values(*each) for each in zip(ids, p[:100], strict=True)]
        ),
        "texts": a_second(len(texts), lambda: env.advantage(texts, texts, **columns)),
        "steps with a chat": a_second(300, step),
    }
    points = f"{args.layouts} layouts of {args.scenario}, {len(values.ids)} decision points"
    print(f"{points}, {len(rows)} rows\n\n| rewards | a CPU second |\n|---|---|")
    for what, rate in rates.items():
        print(f"| {what} | {rate} |")
    figures = [Row(f"rewards a CPU second: {what}", rate, "/s", 5) for what, rate in rates.items()]
    finish(figures, scenario=args.scenario, layouts=args.layouts, a_second=rates)


if __name__ == "__main__":
    main()
