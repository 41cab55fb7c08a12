"""The model card of a distilled model: what it learnt from, how well, and what it is not."""

from collections.abc import Mapping
from typing import Any


def model_card(name: str, facts: Mapping[str, Any]) -> str:
    """README.md of a model's folder, from what `distill` returns."""
    data, plan, apart = facts["dataset"], facts["plan"], facts["held_out"]
    losses = "\n".join(
        f"| `{stage}` | {plan['samples'][stage]} | {curve[0][1]:.3f} | {curve[-1][1]:.3f} |"
        for stage, curve in facts["curves"].items()
    )
    return f"""# {name}

A Qwen3 of {facts["parameters"]:,} parameters and {facts["vocabulary"]} tokens, trained from random weights
by `harness distill` to imitate one planner in one scenario. It shows the harness with a real language model
that fits beside the source; it says nothing about Qwen3-4B or any other model, and drives nothing but
`occluded-intersection`.

- Data: `{data["name"]}`, {data["episodes"]} episodes from seed {data["seed"]}, {data["scenes"]} scenes
  (manifest sha256 `{data["sha256"]}`), prompts {", ".join(facts["prompts"])}; every viewer, and the ego with
  messages.
- Teacher: the scenes' outcome tables, as soft labels over the actions that turned out safe. A viewer that
  cannot tell scenes apart learns their mean, so what is hidden makes it unsure.
- Seed {plan["seed"]}, batches of {plan["batch"]}, Muon {plan["muon_lr"]:g} and AdamW {plan["adam_lr"]:g}.
- Read-out on {apart["questions"]} questions of {apart["episodes"]} episodes held out: KL to the soft labels
  {apart["kl_nats"]:.3f} nats; always answering the mean label would give {apart["kl_of_the_mean_nats"]:.3f}.

| stage | sequences | first loss | last loss |
|---|---|---|---|
{losses}

`alone` fits the probabilities of one letter an action and a report in words; `excerpts` before it does so
on prompts that show nothing but the conflicts, `messages` after it with helpers' messages in the ego's
prompt. `answers` is the JSON text, which states the read-out's own distribution. The losses are of different
sums and compare within a stage only; curves are in `training.json`.
"""
