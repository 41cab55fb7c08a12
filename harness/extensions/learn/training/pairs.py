"""A run's questions with the answers that they should have had, as chats for fine-tuning.

A line a question, in TRL's conversational form: a prompt, and its completion or a chosen and a
rejected one. The answer states the soft label of `lessons.py`, with the outcomes of the dataset's
decision trees: the best action has most of it. Chats are messages, since a chat template is the
model's own.
"""

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from harness.backends.base import BARE
from harness.core.errors import UserError, printable
from harness.core.files import write_whole
from harness.core.seeds import FIRST, purpose, seeds_text
from harness.dataset import rebuilt
from harness.evaluate.agent import in_mode, sent_messages
from harness.evaluate.fusion import messages_of, source_of
from harness.evaluate.sharing import as_asked
from harness.evaluate.texts import refuse_others
from harness.extensions.learn.training.answers import answer
from harness.extensions.learn.training.lessons import Lessons, label
from harness.extensions.learn.training.questions import question
from harness.prompts import readout
from harness.runs.folder import Run
from harness.runs.records import ASKED, Answer, FrozenScenes
from harness.runs.run_dataset import check_episodes, check_scenes, dataset_of
from harness.runs.sources import prompt_of

ROUNDING = 1e-9  # of probabilities that sum to 1


def write(
    run: Run,
    path: Path,
    report_seeds_too: bool,
    dataset: Path | None = None,
    margin: float | None = None,
) -> Path:
    """Write a run's chats for fine-tuning to a file as JSON Lines, and return its path.

    Without `margin` each line has the right answer, known from the scene's decision tree (every
    course that actions can lead to). With it, a line also has the model's own, and only answers
    that are worth less than the right one by `margin` or more, 0 to 1, are written. `dataset` is
    the folder of the run's dataset; None finds it. Raises UserError if the run was driven, its
    dataset or prompt is not here as it was, or an answer does not match its text; and, unless
    `report_seeds_too`, if it has report seeds (start situations for results), or layouts that their
    seeds do not give.
    """
    option = "--sft" if margin is None else "--dpo"
    if not isinstance(run.manifest.world, FrozenScenes):
        raise UserError(
            f"{option}: {printable(run.path)} was driven, and only frozen scenes know what each "
            "action leads to; give a run of `harness eval`"
        )
    if not report_seeds_too:
        what = f"{option} {printable(path)}: {printable(run.path)}"
        _check_seeds(what, {episode.layout_seed for episode in run.episodes})
        # What a run says of its layouts is a table that may be edited; its questions are the
        # dataset's.
        layouts = dataset_of(run, dataset).of_episodes(run.grid.episodes)
        _check_seeds(what, layouts.seeds)
        check_episodes(run, layouts)
        rebuilt.refuse(layouts)
    lines = pairs(run, dataset) if margin is None else preferences(run, margin, dataset)
    write_whole(path, msgspec.json.Encoder().encode_lines(lines))
    return path


def _check_seeds(what: str, seeds: Collection[int]) -> None:
    """Raise UserError if numbers are reported of any of some layout seeds."""
    least, most = min(seeds), max(seeds)
    if most >= FIRST["report"]:
        raise UserError(
            f"{what} has {seeds_text(least, most - least + 1)}, and a model that learns from them "
            "can no longer be measured on them; make a run on a dataset of train seeds, `harness "
            f"dataset build --seed {FIRST['train']}`, or give --report-seeds-too"
        )


def pairs(run: Run, folder: Path | None = None) -> Iterator[dict[str, Any]]:
    """Yield each question of a run as a chat, with the right answer, to fine-tune a model on.

    The right answer is known from the decision tree, every course that actions can lead to. A dict
    has `prompt` and `completion` (chat messages), and the scene, viewer (the vehicle asked), seed
    and actions, with the right `probabilities` of actions and the `values` of these. Fusion calls
    (the ego is asked again with messages) are included; a decision point at which no action
    succeeds is left out. `folder` has the dataset; None finds the one that the run states. Raises
    UserError if the dataset or the prompt is not here as it was.
    """
    for row, completion, _ in _answered(run, folder):
        yield {"prompt": row.pop("prompt"), "completion": _reply(completion), **row}


def preferences(run: Run, margin: float, folder: Path | None = None) -> Iterator[dict[str, Any]]:
    """Yield each question of a run whose answer was worth less than the right one by `margin`.

    The right answer is known from the scene's decision tree, which says after which actions success
    is possible. A dict has `prompt` (chat messages), `chosen` (the right answer), `rejected` (the
    model's) and `value_rejected` (its worth), with the scene, viewer (the vehicle asked), seed,
    actions, and the right `probabilities` and the `values` of these. An answer is worth the
    probability that it gives to actions after which success is possible; one that cannot be parsed
    is worth 0, and of a read-out (one letter an action) the likeliest letter counts. A question
    without an answer is left out. `folder` is that of the dataset; None finds it.
    """
    for row, completion, stored in _answered(run, folder):
        values, p, raw = row["values"], stored.intent, stored.raw
        letters = readout.letters(row["actions"])
        if p is not None and completion in letters:
            best = int(np.argmax(p))
            raw, p = letters[best], tuple(np.eye(len(p))[best].tolist())
        worth = 0.0 if p is None else float(np.dot(p, values))
        least = float(np.dot(row["probabilities"], values)) - margin
        if stored.error is None and raw.strip() and worth <= least + ROUNDING:
            yield {
                "prompt": row.pop("prompt"),
                "chosen": _reply(completion),
                "rejected": _reply(raw),
                **row,
                "value_rejected": worth,
            }


def _reply(text: str) -> list[dict[str, str]]:
    return [{"role": "assistant", "content": text}]


def _answered(run: Run, folder: Path | None) -> Iterator[tuple[dict[str, Any], str, Answer]]:
    """Yield each question with its labels, the answer that its tree asks for,
    and the one that was given.
    """
    prompts = {}
    for agent in (run.manifest.agent(0), *run.manifest.helpers):
        version, sha256 = (agent["prompt"][key] for key in ("version", "sha256"))
        if (prompt := prompt_of(run, agent["prompt"])) is None:
            raise UserError(
                f"{printable(run.path)} was made with prompt {printable(version)} with sha256 "
                f"{printable(sha256, 13)}, which is not here as it was; restore it, or make the "
                "run again"
            )
        if prompt.image and agent["image"] != "none":
            raise UserError(
                f"{printable(run.path)} showed pictures by prompt {printable(version)}, and the "
                "file holds texts alone; give a run with --image none, or of another prompt"
            )
        prompts[version] = prompt
    dataset = dataset_of(run, folder)
    check_scenes(run, dataset)
    refuse_others(run)
    forest, names = dataset.forest, list(run.decisions.scenes)
    ends_s = np.where(forest.safe, forest.delay_s, np.inf)
    labels = {}
    for name in names:
        place = forest.place[name]
        if forest.value[place]:
            ends_by_action = dict(zip(dataset.actions, ends_s[place].tolist(), strict=True))
            labels[name] = label(ends_by_action)
    scenes = tuple(dataset.scenes(list(labels)))
    lessons = Lessons(dataset.scenario, tuple(prompts.values()), scenes, labels)
    for scene in scenes:
        answers = {stored.key: stored for stored in run.answers_by_scene.get(scene.id, ())}
        for stored in answers.values():
            if ASKED in stored.key:
                continue
            if stored.viewer not in scene.graphs:
                raise UserError(
                    f"{printable(run.path / 'answers.jsonl')} has an answer of "
                    f"{printable(stored.viewer)!r} "
                    f"in {scene.id}, where {', '.join(scene.viewers)} were asked; make the run "
                    "again"
                )
            agent = run.agent(stored)
            prompt = prompts[agent["prompt"]["version"]]
            messages_by_key, source = answers, scene
            other = source_of(scene.id, stored.heard)
            if other != scene.id:
                messages_by_key = {each.key: each for each in run.answers_by_scene.get(other, ())}
                [source] = dataset.scenes([other])
            messages = messages_of(messages_by_key, stored.heard, run.actions)
            asked_with = as_asked(dataset.scenario, scene, stored, source)
            q = question(lessons, asked_with, stored.viewer, prompt, messages)
            texts = sent_messages(agent["image"], q.messages)
            words = q.scenario.prompt_words
            sent = in_mode(agent["answer"], prompt, texts, q.graph, q.actions, words)
            completion = answer(prompt, q.graph, q.label, q.actions)
            if agent["answer"] in BARE:
                completion = readout.letters(q.actions)[int(q.label.argmax())]
            seed = int(scene.record.episode_seed)
            safe = forest.safe[forest.place[scene.id]]
            row = {
                "prompt": sent,
                "scene": scene.id,
                "viewer": stored.key,
                "layout_seed": seed,
                "purpose": purpose(seed, 1),
                "actions": list(q.actions),
                "probabilities": q.label.tolist(),
                "values": safe.astype(float).tolist(),
            }
            yield row, completion, stored
