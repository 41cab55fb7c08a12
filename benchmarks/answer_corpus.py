"""Real answers of a model to every prompt version, in both roles and at several temperatures,
as a corpus.

    python benchmarks/answer_corpus.py MODEL.gguf answers.jsonl [--questions 60] [--most 250]
                                       [--tokens 96]

Each question is asked about a moment of a tune layout and answered once at temperature 0, and twice
each at 0.5 and 1; these five go through the engine together, which reads their prompt once. Answers
are appended as they come and those that are there are not asked again, so a stopped run goes on
with the same command. `tests/golden/real-answers.jsonl.xz` was made by it;
`tests/test_real_answers.py` pins how each is parsed.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from harness.backends import cards
from harness.backends.base import Request
from harness.backends.card import Card
from harness.backends.registry import open_backend
from harness.coordination.named_points import POINTS
from harness.evaluate.agent import Agent
from harness.evaluate.live_world import LiveSource
from harness.evaluate.requests import requests
from harness.evaluate.spec import Spec
from harness.prompts import versions as prompts

SMALLEST = "swarm-tiny answers.jsonl --questions 1 --most 5 --tokens 8"
NEEDS = "llama_cpp"
FIRST_SEED = 40_000  # among the tune layouts
SCENES = "witnesses=any,radio_share=0,limits=1,perception=1"
SCENARIOS = ("occluded-intersection", "blind-merge", "roundabout-entry")
DRAWS = ((0.0, 0), (0.5, 1), (0.5, 2), (1.0, 1), (1.0, 2))  # temperature and number of the answer


def main() -> None:
    """Append answers until there are as many as asked for."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("model")
    arguments.add_argument("out", type=Path)
    arguments.add_argument(
        "--questions", type=int, default=60, help="questions to each prompt and role"
    )
    arguments.add_argument("--most", type=int, default=250, help="answers to ask for in this run")
    arguments.add_argument("--tokens", type=int, default=96, help="most tokens of an answer")
    given = arguments.parse_args()
    lines = given.out.read_text("utf-8").splitlines() if given.out.exists() else []
    there = {json.loads(line)["id"] for line in lines}
    card = cards.resolve(given.model)
    backend = open_backend(card, batch_size=len(DRAWS))
    count = 0
    for asked in questions(card, given.questions):
        if f"{asked[0].id}/0-0" in there or count >= given.most:
            continue
        asked = [replace(one, max_tokens=min(given.tokens, one.max_tokens)) for one in asked]
        with given.out.open("a", encoding="utf-8") as file:
            for one, completion in zip(asked, backend.complete(asked), strict=True):
                if completion.error:
                    raise SystemExit(f"{one.id}: {completion.error}")
                record = described(one) | {
                    "finish_reason": completion.finish_reason,
                    "text": completion.text,
                }
                file.write(json.dumps(record, ensure_ascii=False) + "\n")
        count += len(asked)
        print(f"{len(there) + count} answers", flush=True)


def described(request: Request) -> dict[str, object]:
    """What was asked, as the corpus says it."""
    scenario, version, role = request.id.split("/")[:3]
    return {
        "id": f"{request.id}/{request.temperature:g}-{request.sample}",
        "scenario": scenario,
        "prompt": version,
        "role": role,
        "temperature": request.temperature,
        "actions": request.actions,
        "reasons_first": request.reasons_first,
    }


def questions(card: Card, count: int) -> Iterator[list[Request]]:
    """Yield each question with its draws:
    every prompt and role once, then those with examples again.

    A model that is shown examples answers in many forms, and one that is not mostly in prose:
    each fifth time is enough for that.
    """
    for number in range(count):
        for version in prompts.names():
            prompt = prompts.load(version)
            if number % 5 and not prompt.examples:
                continue
            scenario = SCENARIOS[
                0 if version in prompts.OF_A_CROSSING or prompt.examples else number % 3
            ]
            source = LiveSource(FIRST_SEED + number, 1, f"{scenario}:{SCENES}")
            agent = Agent(card, prompt, image="none" if prompt.image else "own")
            spec = Spec(agent, source, tuple(POINTS.values()), (0,))
            asked = {one.role: one for one in requests(spec, [*source.trial(1, ego_alone=False)])}
            for role, one in sorted(asked.items()):
                name = f"{scenario}/{version}/{role}/{FIRST_SEED + number}"
                yield [replace(one, id=name, temperature=t, sample=s) for t, s in DRAWS]


if __name__ == "__main__":
    main()
