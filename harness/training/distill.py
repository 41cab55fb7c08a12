"""From a frozen dataset to a small model, in stages that a kill does not undo."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
import transformers

from harness.core import work
from harness.core.files import write_whole
from harness.dataset.load import Dataset
from harness.prompts.versions import Prompt
from harness.training.gguf_export import export
from harness.training.model import save_tokenizer
from harness.training.student import Progress, Student
from harness.training.train import STAGES, Plan


def distill(
    dataset: Dataset,
    prompts: Sequence[Prompt],
    plan: Plan,
    out: Path,
    progress: Progress,
    device: str,
    threads: int | None = None,
) -> dict[str, Any]:
    """Train a model on a dataset and write checkpoint, tokenizer, GGUF file and model card to `out`.

    Stages that an earlier, killed call finished are taken over, and one it had begun goes on.

    Args:
        dataset: what it learns from.
        prompts: versions that it learns to read.
        plan: how long.
        out: folder to make; its name is the model's.
        progress: called with the stage, the sequences seen in it and the loss.
        device: `cpu` or `cuda`.
        threads: on a CPU; None is PyTorch's choice.

    Returns:
        What the model card states: data, plan, curves, and the KL of the read-out on held-out episodes.

    Raises:
        UserError: the folder holds something else.
    """
    if threads:
        torch.set_num_threads(threads)
    settings = {"dataset": dataset.sha256, "prompts": [p.sha256 for p in prompts], **asdict(plan)}
    if begun := work.begun(out, work.Begun):
        work.same(out, settings, begun.settings)
    with work.working(out, begun or work.Begun(settings=settings)) as place:
        facts = _trained(dataset, Student(dataset, prompts, plan, place, device), out, progress)
        work.tidy(out)
    return facts


def _trained(dataset: Dataset, student: Student, out: Path, progress: Progress) -> dict[str, Any]:
    """Train what is missing, and write the model's folder."""
    prompts, plan = student.prompts, student.plan
    curves = {name: student.stage(name, progress) for name in STAGES}
    facts = {
        "dataset": {"name": dataset.name, "sha256": dataset.sha256, "seed": dataset.manifest.seed,
                    "episodes": dataset.manifest.episodes, "scenes": len(student.scenes)},
        "prompts": {p.version: p.sha256 for p in prompts},
        "plan": asdict(plan),
        "parameters": sum(p.numel() for p in student.model.parameters()),
        "vocabulary": student.tokenizer.get_vocab_size(),
        "held_out": student.held_out_kl(),
        "curves": curves,
    }  # fmt: skip
    student.model.eval()
    transformers.utils.logging.disable_progress_bar()  # of a file that is written in no time
    student.model.save_pretrained(out)
    save_tokenizer(student.tokenizer, out)
    export(out, out / f"{out.absolute().name}-f16.gguf")
    write_whole(out / "README.md", model_card(out.absolute().name, facts))
    write_whole(out / "training.json", json.dumps(facts, indent=1) + "\n")
    return facts


def model_card(name: str, facts: Mapping[str, Any]) -> str:
    """README.md of a model's folder, from what `distill` returns: data, losses and limits."""
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
- Teacher: the decision trees, as soft labels over the actions after which success is possible. A viewer that
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
