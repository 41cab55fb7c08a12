"""Compute a run again from its answers alone; no model is asked, and rules, which are here, are."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from harness.backends.base import Backend, Completion, Request
from harness.backends.card import Card
from harness.backends.registry import open_backend
from harness.backends.replay import Kept
from harness.core import work
from harness.core.figures import amount
from harness.dataset.load import Dataset
from harness.evaluate import latency as latencies
from harness.evaluate.of_run import check_prompts, points_of, spec_of
from harness.evaluate.run import evaluate
from harness.evaluate.spec import Spec
from harness.runs.contradictions import close, contradictions
from harness.runs.difficulty import REFERENCES
from harness.runs.folder import Run, read
from harness.runs.records import Episode, Latency

RULES = ("driver", "proxy")  # engines that are no models


class Held:
    """Asks a rule, which is here, and counts the answers that a run states otherwise."""

    def __init__(self, rule: Backend, kept: Kept) -> None:
        self._rule, self._kept, self.wrong = rule, kept, 0

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        stated, here = self._kept.complete(requests), self._rule.complete(requests)
        self.wrong += sum(a.text != b.text for a, b in zip(stated, here, strict=True))
        return here

    def identity(self) -> dict[str, Any]:
        return self._kept.identity()

    def latency(self) -> Latency:
        return self._kept.latency()


def computed(stated: Run, spec: Spec, out: Path, progress: Callable[[int], None]) -> tuple[Run, int]:
    """Compute a run again, and count the answers that the rule here gives otherwise; 0 of other models."""
    kept, held = Kept(stated), list[Held]()

    def opens(card: Card, **options: Any) -> Backend:
        if card.engine not in RULES:
            return kept
        held.append(Held(open_backend(card, **options), kept))
        return held[-1]

    try:
        evaluate(spec, out, progress, opens=opens)
    except KeyboardInterrupt as stop:
        stop.__notes__ = []  # that the folder keeps what is done: it is deleted
        raise
    work.tidy(out)
    return read(out), sum(each.wrong for each in held)


def differences(run: Run, dataset: Dataset, out: Path, progress: Callable[[int], None]) -> list[str]:
    """Compute a run of frozen scenes again, in an empty folder; return what its tables say otherwise.

    Args:
        run: the run, which is not changed.
        dataset: its own.
        out: the folder, which is written.
        progress: called with the number of answers that were read again.

    Raises UserError if a prompt, a channel or the like is not here as it was, or an answer is missing.
    """
    spec = spec_of(run, dataset.of_episodes(run.grid.episodes))
    check_prompts(run, spec)
    manifest = run.manifest
    if manifest.device_profile is None:
        times = latencies.as_declared(manifest.latency)
        spec = replace(spec, latency=times)
    spec = replace(
        spec, points=tuple(points_of(run).values()), ask=manifest.ask,
        device_profile=manifest.device_profile, device_model=manifest.device_model,
    )  # fmt: skip
    ours, otherwise = computed(run, spec, out, progress)
    wrong = [*contradictions(run), *_of_episodes(run, ours), *_of_decisions(run, ours)]
    wrong += _of_layouts(run, dataset)
    if otherwise:
        wrong.append(f"answers.jsonl has {amount(otherwise, 'answer')} otherwise than the rule here")
    return wrong


def _of_episodes(stated: Run, ours: Run) -> Iterator[str]:
    """Yield which columns of episodes.csv differ; a column that an older run lacks does not."""
    for name in Episode.__struct_fields__:
        theirs, here = ([getattr(episode, name) for episode in run.episodes] for run in (stated, ours))
        wrong = sum(not close(a, b) for a, b in zip(theirs, here, strict=True))
        if wrong and any(value is not None for value in theirs):
            yield f"episodes.csv has another {name} in {amount(wrong, 'row')} than its answers make"


def _of_layouts(run: Run, dataset: Dataset) -> Iterator[str]:
    """Yield whether difficulty.csv says otherwise than the trees of its layouts."""
    if not run.layouts:
        return
    trees = dataset.of_episodes(frozenset(layout.episode for layout in run.layouts))
    success = trees.reference_success()
    known = np.column_stack([success[name] for name in REFERENCES])
    here = dict(zip(trees.episodes, known.tolist(), strict=True))
    stated = {each.episode: (each.local_view, each.cruise, each.uniform) for each in run.layouts}
    wrong = sum(not all(map(close, stated[number], here[number])) for number in stated)
    if wrong:
        yield f"difficulty.csv has {amount(wrong, 'row')} that the trees of the dataset do not have"


def _of_decisions(stated: Run, ours: Run) -> Iterator[str]:
    """Yield which columns of decisions.parquet differ."""
    if len(stated.decisions) != len(ours.decisions):
        yield (
            f"decisions.parquet has {amount(len(stated.decisions), 'row')}, and its answers make "
            f"{len(ours.decisions)}"
        )
        return
    theirs, here = stated.decisions.table, ours.decisions.table
    for name in (name for name in here.column_names if name in theirs.column_names):
        if theirs[name].equals(here[name]) or theirs[name].null_count == len(theirs):  # an older run's
            continue
        pairs = zip(theirs[name].to_pylist(), here[name].to_pylist(), strict=True)
        if wrong := sum(not close(a, b) for a, b in pairs):
            yield f"decisions.parquet has another {name} in {amount(wrong, 'row')} than its answers make"
