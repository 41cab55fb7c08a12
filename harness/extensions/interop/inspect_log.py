"""A run as a log of Inspect AI, for its viewer and its data frames: a sample an answer.

The package writes the file;
nothing here knows the format. https://inspect.aisi.org.uk/eval-logs.html
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from inspect_ai import log, model
from inspect_ai.scorer import Score
from inspect_ai.viewer import ViewerConfig

from harness.core.errors import UserError
from harness.core.files import digest, replacing
from harness.core.places import nameless, text
from harness.dataset.load import Dataset, Scene
from harness.evaluate.fusion import messages_of, source_of
from harness.evaluate.sharing import as_asked
from harness.report.details import prompts_of
from harness.report.page import refuse_less
from harness.runs.folder import Run
from harness.runs.records import Answer, FrozenScenes
from harness.runs.run_dataset import check_scenes, dataset_of
from harness.runs.sources import lacking

# as Inspect calls correct, partial and incorrect
VALUES = {"strict": "C", "recovered": "P", "failed": "I"}
STOPS = {"stop": "stop", "length": "max_tokens", "refusal": "content_filter"}
SPOKEN = {
    "system": model.ChatMessageSystem,
    "user": model.ChatMessageUser,
    "assistant": model.ChatMessageAssistant,
}


def write(run: Run, path: Path, dataset: Path | None = None) -> Path:
    """Write a run as an Inspect AI log to `path`: an `.eval` file, or JSON if its name ends so.

    `dataset` is the folder of the run's dataset; None takes the one that the run states. Returns
    the path. Raises UserError if the file is there and the new one would lose its prompts.
    """
    frozen, scenes = _scenes(run, dataset)
    if isinstance(run.manifest.world, FrozenScenes):
        why = lacking(run) or (None if scenes else "its dataset is not here")
        refuse_less(path, {"prompts": why} if why else {}, "--inspect")
    with replacing(path) as part:
        log.write_eval_log(
            log_of(run, frozen, scenes),
            str(part),
            format="json" if path.suffix == ".json" else "eval",
        )
    return path


def log_of(run: Run, dataset: Dataset | None, scenes: Mapping[str, Scene]) -> log.EvalLog:
    """Return a run as an Inspect AI log, with a sample for each answer and the run's scores.

    `dataset` is the run's, and `scenes` has its decision points by id; without them, samples have
    no prompts. The log's task is named by dataset and prompt version.
    """
    manifest, variant = run.manifest, run.manifest.variant
    whole = manifest.as_file()
    record = nameless(whole)
    arguments = ("prompt", "helpers", "answer", "thinking", "seeds", "conditions")
    samples = list(_samples(run, dataset, scenes))
    name = digest(whole)[:22]
    return log.EvalLog(
        status="success",
        eval=log.EvalSpec(
            eval_id=name,
            run_id=name,
            task_id=name,
            created=manifest.created,
            task=f"{run.source} {variant.prompt}",
            task_version=variant.prompt,
            tags=list(manifest.tags),
            dataset=log.EvalDataset(name=run.source, samples=len(samples)),
            model=f"{manifest.model['engine']}/{variant.model}",
            config=log.EvalConfig(),
            task_args={key: record[key] for key in arguments},
            packages={"swarmdrive-harness": manifest.versions.get("harness", "unknown")},
            metadata={key: record[key] for key in ("command", "world", "latency", "identity")},
            viewer=ViewerConfig(trust_content=False),  # what a model writes may be anything
        ),
        results=log.EvalResults(
            total_samples=len(samples), completed_samples=len(samples), scores=list(_results(run))
        ),
        samples=samples,
    )


def _results(run: Run) -> Iterator[log.EvalScore]:
    for condition in dict.fromkeys(score.condition for score in run.scores):
        metrics = {
            s.metric: log.EvalMetric(
                name=s.metric, value=s.value, metadata={"low": s.low, "high": s.high, "n": s.n}
            )
            for s in run.scores
            if s.condition == condition and s.interval != "seed means" and s.value is not None
        }
        yield log.EvalScore(name=condition, scorer="swarmdrive-harness", metrics=metrics)


def _samples(
    run: Run, dataset: Dataset | None, scenes: Mapping[str, Scene]
) -> Iterator[log.EvalSample]:
    sent = prompts_of(run)
    d = run.decisions
    regret, safe = d["regret"], d.of_actions("safe")
    condition = d.codes("condition", run.conditions)
    episode, step = d.whole("episode"), d.whole("step")
    for name, rows in d.scenes.items():
        answers = {answer.key: answer for answer in run.answers_by_scene.get(name, ())}
        kept = _kept(run, condition[rows.start : rows.stop], regret[rows.start : rows.stop])
        target = [
            a for a, is_safe in zip(run.actions, safe[rows.start] == 1.0, strict=True) if is_safe
        ]
        facts = {"scene": name, "episode": int(episode[rows.start]), "step": int(step[rows.start])}
        for answer in answers.values():
            prompt: Sequence[Mapping[str, str]] = ()
            if sent and dataset and name in scenes:
                source = source_of(name, answer.heard)
                answers_by_key = {each.key: each for each in run.answers_by_scene.get(source, ())}
                heard = messages_of(answers_by_key, answer.heard, run.actions)
                scene = as_asked(dataset.scenario, scenes[name], answer, scenes.get(source))
                prompt = sent(scene, answer.viewer, heard)
            yield _sample(
                run, answer, prompt, target, kept if answer.role in ("ego", "merge") else {}, facts
            )


def _sample(
    run: Run,
    answer: Answer,
    prompt: Sequence[Mapping[str, str]],
    target: list[str],
    kept: Mapping[str, Score],
    facts: Mapping[str, Any],
) -> log.EvalSample:
    here = bool(prompt) and digest(prompt) == answer.prompt_sha256
    chat = (
        [SPOKEN[message["role"]](content=message["content"]) for message in prompt] if here else []
    )
    reply = model.ChatMessageAssistant(content=answer.raw, source="generate")
    usage = None
    if answer.prompt_tokens is not None and answer.completion_tokens is not None:
        n = answer.prompt_tokens, answer.completion_tokens
        usage = model.ModelUsage(input_tokens=n[0], output_tokens=n[1], total_tokens=sum(n))
    stop = STOPS.get(answer.finish_reason, "unknown")
    plain = msgspec.to_builtins(answer) | {"detail": text(answer.detail)}
    left_out = ("raw", "prompt_tokens", "completion_tokens", "finish_reason", "error", "seconds")
    intent = (
        "failed"
        if answer.intent is None
        else " ".join(
            f"{action} {p:.2f}" for action, p in zip(run.actions, answer.intent, strict=True)
        )
    )
    verdict = Score(
        value=VALUES[answer.verdict],
        answer=intent,
        explanation=f"{answer.status}: {plain['detail']}",
    )
    return log.EvalSample(
        id=answer.id,
        epoch=1,
        input=chat or f"a prompt that is not here, sha256 {answer.prompt_sha256}",
        target=target,
        messages=[*chat, reply],
        output=model.ModelOutput(
            model=run.agent(answer)["model"]["name"],
            usage=usage,
            time=answer.seconds,
            error=answer.error and text(answer.error),
            choices=[model.ChatCompletionChoice(message=reply, stop_reason=stop)],
        ),
        scores={"parsed": verdict, **kept},
        metadata={**facts, **{key: value for key, value in plain.items() if key not in left_out}},
    )


def _kept(run: Run, condition: Any, regret: Any) -> dict[str, Score]:
    """Of each condition in which it is known,
    the share of seeds whose decision gave success away.
    """
    scores = {}
    for n, name in enumerate(run.conditions):
        regrets = regret[(condition == n) & ~np.isnan(regret)]
        if len(regrets):
            explanation = (
                f"{int(regrets.sum())} of {len(regrets)} seeds decide so that success is given away"
            )
            scores[f"regret {name}"] = Score(value=float(regrets.mean()), explanation=explanation)
    return scores


def _scenes(run: Run, folder: Path | None) -> tuple[Dataset | None, dict[str, Scene]]:
    """Return the run's dataset and decision points;
    none if it is not here as it was, or it was driven.
    """
    if not isinstance(run.manifest.world, FrozenScenes):
        return None, {}
    try:
        names, dataset = list(run.decisions.scenes), dataset_of(run, folder)
        check_scenes(run, dataset)
        return dataset, dict(zip(names, dataset.scenes(names), strict=True))
    except UserError:
        if folder:
            raise
        return None, {}
