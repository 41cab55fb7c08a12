"""From scenarios to a small model that drives in them, in stages that a kill does not undo."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
import transformers

from harness.backends.card import Card
from harness.backends.gguf_export import export
from harness.backends.registry import locate
from harness.core import work
from harness.core.errors import UserError, printable
from harness.core.files import canonical_json, sha256_bytes, sha256_file, write_whole
from harness.core.formats import WORK
from harness.core.parallel import Workers
from harness.extensions.learn.training import published
from harness.extensions.learn.training.lessons import draw
from harness.extensions.learn.training.model import WEIGHTS, save_tokenizer
from harness.extensions.learn.training.student import Progress, Student
from harness.extensions.learn.training.train import STAGES, Plan
from harness.prompts.versions import Prompt
from harness.world import scenarios
from harness.world.scenario import Scenario

FACTS = "training.json"  # written last


@dataclass(frozen=True)
class Curriculum:
    """Describe what a model is trained from: scenarios, prompts, layouts, and initial weights.

    A layout is a start situation of a scenario, drawn from a seed. The decisions in it, with what
    should be answered, are what the model learns.
    """

    prompts: Mapping[Scenario, tuple[Prompt, ...]]  # of each scenario, the versions that are learnt
    layouts: int  # number of layouts of each scenario
    seed: int  # layout seed of the first; the others follow
    # folder of a model of texts that was distilled here, which it begins as, or the card (the
    # description in a file) of a published one; None begins with random weights
    base: Path | Card | None = None

    def __post_init__(self) -> None:
        names = [scenario.name for scenario in self.prompts]
        if twice := next((name for name in names if names.count(name) > 1), None):
            # whose layouts have the same seeds and names, and so one place for their lessons
            raise UserError(
                f"scenario {printable(twice)} is given twice, with other settings; give it once"
            )
        if not isinstance(self.base, Card):
            return
        name = printable(self.base.name)
        if self.base.vision or self.base.adapter:
            has = "takes pictures" if self.base.vision else "has an adapter already"
            raise UserError(f"--base {name} {has}; give a plain model of texts")
        if any(prompt.image for prompts in self.prompts.values() for prompt in prompts):
            raise UserError(
                f"--base {name} is taught texts alone; leave image prompts out of --prompt"
            )
        locate(self.base)  # now, and not after the layouts are drawn

    def settings(self) -> dict[str, Any]:
        """Return as plain values the settings that a resumed training must not change.

        They are digests of scenarios, prompts and the weights of the model that it begins as, and
        the number and the first seed of layouts (start situations).
        """
        scenarios = {}
        for scenario in self.prompts:
            parameters = canonical_json(scenario.parameters.stated())
            scenarios[scenario.name] = sha256_bytes(parameters.encode())
        weights = sha256_file(self.base / WEIGHTS) if isinstance(self.base, Path) else None
        settings = {
            "scenarios": scenarios,
            "prompts": {p.version: p.sha256 for prompts in self.prompts.values() for p in prompts},
            "layouts": self.layouts,
            "first_seed": self.seed,
            "base_sha256": weights,
        }
        if isinstance(self.base, Card):
            settings["base"] = published.base_name(self.base)
        return settings


def distill(
    curriculum: Curriculum,
    plan: Plan,
    out: Path,
    drawing: Callable[[int], None],
    progress: Progress,
    device: str,
    threads: int | None = None,
    workers: Workers = 1,
) -> dict[str, Any]:
    """Train a small language model to drive, by decisions whose best answer is known.

    It writes checkpoint, tokenizer, GGUF file and card (the file that describes the model) to
    `out`. Returns what the card states, as plain values by name: data, plan, loss curves, and how
    the model's probabilities fit the right ones on held-out layouts (start situations). A killed
    call resumes.

    Args:
        curriculum: the scenarios, prompts and layouts, and the initial weights.
        plan: the length of the training, its rates, seed and objective.
        out: the folder to make; its name becomes the model's.
        drawing: called with the number of layouts just drawn.
        progress: called with the stage, the sequences seen in it and the loss.
        device: where to train, such as `cpu` or `cuda:0`.
        threads: PyTorch's CPU threads; None lets PyTorch choose.
        workers: processes that draw layouts.

    Raises:
        UserError: `out` holds a finished model or something else.
    """
    if threads:
        torch.set_num_threads(threads)
    if (out / FACTS).is_file() and not (out / WORK).is_dir():
        raise UserError(
            f"--out {printable(out)} already holds a finished model; choose another folder or "
            "delete it"
        )
    learnt = curriculum.settings()  # once: the base's file may change while this learns from it
    settings = {**learnt, **plan.settings()}
    if start := work.start_of(out, work.WorkStart):
        work.same(out, settings, start.settings)
    with work.working(out, start or work.WorkStart(settings=settings)) as place:
        layouts, seed, folder = curriculum.layouts, curriculum.seed, place / "lessons"
        lessons = [
            draw(scenario, prompts, layouts, seed, folder / scenario.name, workers, drawing)
            for scenario, prompts in curriculum.prompts.items()
        ]
        lessons = [replace(each, balanced=plan.objective == "values") for each in lessons]
        student = Student(lessons, plan, place, device, curriculum.base)
        facts = _trained(learnt, student, out, progress)
        work.tidy(out)
    return facts


def _trained(
    learnt: Mapping[str, Any], student: Student, out: Path, progress: Progress
) -> dict[str, Any]:
    """Train what is missing, and write the model's folder;
    its card states what is `learnt` from.
    """
    plan = student.plan
    curves = {name: student.stage(name, progress) for name in STAGES}
    weights = student.rounded()
    facts = {
        **learnt,
        "scenes": {each.scenario.name: len(each.scenes) for each in student.lessons},
        "spellings": [scenarios.argument(each.scenario) for each in student.lessons],
        "plan": asdict(plan),
        "parameters": sum(p.numel() for p in student.model.parameters() if p.requires_grad),
        "held_out": student.held_out_facts(),
        "curves": curves,
    }
    student.model.eval()
    if student.published:
        facts |= {
            "base_sha256": student.published.sha256,
            "licence": student.published.card.licence,
        }
        student.published.write(out, weights)
        return _described(out, facts, published.model_card)
    facts |= {
        "vocabulary": student.tokenizer.get_vocab_size(),
        "sees": hasattr(student.model.config, "vision_config"),
    }
    transformers.utils.logging.disable_progress_bar()  # of a file that is written in no time
    student.model.save_pretrained(out, state_dict=weights)
    save_tokenizer(student.tokenizer, out)
    export(out, out / f"{out.absolute().name}-f16.gguf")
    return _described(out, facts, model_card)


def _described(
    out: Path, facts: dict[str, Any], card: Callable[[str, Mapping[str, Any]], str]
) -> dict[str, Any]:
    """Write the facts for people and for programs, and return them."""
    write_whole(out / "README.md", card(out.absolute().name, facts))
    write_whole(out / FACTS, json.dumps(facts, indent=1) + "\n")
    return facts


def model_card(name: str, facts: Mapping[str, Any]) -> str:
    """Return the README.md of a model trained from random weights: data, losses and limits.

    `name` is the model's, and `facts` has what was learnt and measured, the dict that `distill`
    returns.
    """
    plan, base = facts["plan"], facts["base_sha256"]
    begins = f"from the weights with sha256 `{base}`" if base else "from random weights"
    before = " The base may have learnt from these layouts, as its own card says." if base else ""
    kind = "Qwen3-VL" if facts["sees"] else "Qwen3"
    loss_rows = []
    for stage, curve in facts["curves"].items():
        if curve:
            first, last = f"{curve[0][1]:.3f}", f"{curve[-1][1]:.3f}"
            loss_rows.append(f"| `{stage}` | {plan['samples'][stage]} | {first} | {last} |")
    held_out_rows = []
    for row in facts["held_out"]:
        scenario = row["scenario"]
        held_out_rows.append(
            f"| `{scenario}` | {facts['scenes'][scenario]} | {row['layouts']} | "
            f"{row['questions']} | {row['kl_nats']:.3f} | {row['kl_of_the_mean_nats']:.3f} | "
            f"{row['value']:.3f} | {row['value_of_the_mean']:.3f} |"
        )
    losses, held_out = "\n".join(loss_rows), "\n".join(held_out_rows)
    return f"""# {name}

A {kind} of {facts["parameters"]:,} parameters and {facts["vocabulary"]} tokens, trained {begins}
by `harness model distill` to imitate one planner in the scenarios below. It shows the harness with a real
language model that fits beside the source; it says nothing about Qwen3-4B or any other model.

- Data: {facts["layouts"]} layouts a scenario from seed {facts["first_seed"]}, decision points drawn from each
  level of their trees; prompts {", ".join(facts["prompts"])}; every viewer, and the ego with messages.
- Teacher: outcomes, as soft labels over the actions after which success is possible. A viewer that cannot
  tell scenes apart learns their mean, so what is hidden makes it unsure.
- Seed {plan["seed"]}, batches of {plan["batch"]}, Muon {plan["muon_lr"]:g} and AdamW {plan["adam_lr"]:g}.
- Objective: `{plan["objective"]}`, {published.OBJECTIVES[plan["objective"]]}.

The read-out on layouts held out: its KL to the soft labels in nats and its value, the probability that it
gives to actions after which the episode succeeds, layouts with a danger and without weighing alike. Beside
them stand those of always answering the mean label.{before}

| scenario | scenes learnt | layouts held out | questions | KL | of the mean | value | of the mean |
|---|---|---|---|---|---|---|---|
{held_out}

The value of who needs no model, at the same questions:

{published.references_table(facts)}

| stage | sequences | first loss | last loss |
|---|---|---|---|
{losses}

`alone` fits the probabilities of one letter an action and a report in words; `excerpts` before it does so
on prompts that show nothing but the conflicts, `messages` after it with helpers' messages in the ego's
prompt. `answers` is the JSON text, which states the read-out's own distribution. The losses are of different
sums and compare within a stage only; curves are in `training.json`.
"""  # noqa: E501
