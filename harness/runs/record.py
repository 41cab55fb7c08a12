"""The record of a run: a row a decision with every raw text, and a row an episode."""

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.core.files import canonical_json
from harness.core.statistics import known_mean
from harness.dataset.load import Scene
from harness.evaluate.asking import Answer
from harness.evaluate.intents import Answered
from harness.evaluate.merging import Merged, places_of, request_id
from harness.evaluate.scoring import Scored
from harness.evaluate.spec import Spec
from harness.evaluate.success import Table
from harness.parsing.parse import Parsed

if TYPE_CHECKING:
    import pandas as pd


def rows(
    spec: Spec, laid: Table, known: Answered, runs: Sequence[Scored], second: Merged | None = None
) -> Iterator[str]:
    """Lines of `rows.jsonl`: a decision point, its answers, and what each condition and seed made of it.

    `merged` has the ego's second answers by whose messages it had, where there are any.
    """
    again = by_scene(spec.dataset.scenes, known, second) if second else {}
    scenes = spec.dataset.scenes
    helpers = [scene.viewers[1:] for scene in scenes]
    tables = [_decisions(run, helpers, spec.dataset.actions) for run in runs]
    for i, (scene, *made) in enumerate(zip(scenes, *tables, strict=True)):
        yield canonical_json({
            "scene": scene.id,
            "episode": scene.record["episode"],
            "step": scene.record["step"],
            "danger": scene.record["danger"]["sector"],
            "answers": by_viewer(scene, known, i),
            **({"merged": again[i]} if i in again else {}),
            "safe": laid.safe[i].tolist(),
            "delay_s": [number(d) for d in laid.delay_s[i].tolist()],
            "decisions": made,
        }) + "\n"  # fmt: skip


def by_viewer(scene: Scene, known: Answered, i: int) -> dict[str, dict[str, Any]]:
    """The answers of a scene, the i-th of `known`, by who gave them."""
    said = zip(scene.viewers, known.answers[i], known.parsed[i], strict=False)
    return {
        viewer: answered(answer, parsed, "ego" if j == 0 else "helper")
        for j, (viewer, answer, parsed) in enumerate(said) if answer and parsed
    }  # fmt: skip


def by_scene(scenes: Sequence[Scene], known: Answered, second: Merged) -> dict[int, dict[str, Any]]:
    """The ego's second answers by place of the scene and by whose messages it had."""
    found: dict[int, dict[str, Any]] = {}
    helpers = known.valid.shape[1]
    for code, answer, parsed in zip(second.codes.tolist(), second.answers, second.parsed, strict=True):
        i = code >> helpers
        heard = request_id(scenes[i], places_of(code, helpers)).partition("/")[2]
        found.setdefault(i, {})[heard] = answered(answer, parsed, "merge")
    return found


def answered(answer: Answer, parsed: Parsed, role: str) -> dict[str, Any]:
    """An answer with its raw text, and what was read in it."""
    return {
        **answer,
        "role": role,
        "status": str(parsed.status),
        "verdict": parsed.verdict,
        "repairs": [str(r) for r in parsed.repairs],
        "intent": parsed.intent and list(parsed.intent),
        "mass": parsed.mass,
        "message": parsed.message,
        "detail": parsed.detail,
    }


def _decisions(
    run: Scored, helpers: Sequence[tuple[str, ...]], actions: tuple[str, ...]
) -> Iterator[dict[str, Any]]:
    """One condition and seed, a mapping a decision."""
    c = run.coordination
    # Lists first: taking numbers out of arrays one by one is most of what a row would cost.
    replies = zip(
        c.asked.tolist(), helpers, c.delivered.tolist(), c.on_time.tolist(),
        (c.arrival_s * 1000).round(3).tolist(), c.weights.round(6).tolist(), strict=True,
    )  # fmt: skip
    decisions = zip(
        c.entropy_nats.round(6).tolist(), c.triggered.tolist(), c.own_failed.tolist(),
        c.fused.round(6).tolist(), c.action.tolist(), (c.latency_s * 1000).round(3).tolist(),
        c.deadline_missed.tolist(), run.safe.tolist(), run.delay_s.tolist(), strict=True,
    )  # fmt: skip
    for (asked, viewers, *reply, weights), decision in zip(replies, decisions, strict=True):
        entropy, triggered, failed, fused, action, latency_ms, missed, safe, delay_s = decision
        messages = [
            {
                "arrival_ms": number(arrival_ms), "delivered": delivered, "from": viewer,
                "on_time": on_time, "weight": number(weight),
            }
            for viewer, was_asked, delivered, on_time, arrival_ms, weight
            in zip(viewers, asked, *reply, weights[1:], strict=False) if was_asked
        ] if triggered else []  # fmt: skip
        # Members stand in the order in which they are written, which spares sorting them.
        yield {
            "action": actions[action], "condition": run.point.name,
            "deadline_missed": None if math.isnan(latency_ms) else missed, "delay_s": number(delay_s),
            "entropy_nats": entropy, "fused": fused, "latency_ms": number(latency_ms),
            "messages": messages, "own_failed": failed, "own_weight": number(weights[0]), "safe": safe,
            "seed": run.seed, "triggered": triggered,
        }  # fmt: skip


def episodes(spec: Spec, laid: Table, runs: Sequence[Scored]) -> "pd.DataFrame":
    """The table of `episodes.csv`."""
    import pandas as pd

    scenes = spec.dataset.scenes
    first = [scenes[row[0]].record for row in laid.index]
    frames = []
    for run in runs:
        c, verdict = run.coordination, run.verdict

        def per_episode(values: Any, sums: bool = False) -> Any:
            laid_out = laid.by_episode(np.asarray(values, dtype=float))
            return np.nansum(laid_out, axis=1) if sums else known_mean(laid_out, axis=1)

        frames.append(pd.DataFrame({
            "model": spec.card.name, "prompt": spec.prompt.version, "answer": spec.answer,
            "condition": run.point.name, "seed": run.seed,
            "episode": laid.episodes, "danger": [r["danger"]["sector"] or "none" for r in first],
            "success": verdict.success, "failure": _failures(spec, laid, run),
            "delay_s": verdict.delay_s.round(3),
            "messages": per_episode(c.messages, sums=True).astype(int),
            "trigger_rate": per_episode(c.triggered),
            "latency_ms": per_episode(c.latency_s * 1000).round(3),
            "deadline_misses": per_episode(c.deadline_missed, sums=True).astype(int),
        }))  # fmt: skip
    return pd.concat(frames, ignore_index=True)


def _failures(spec: Spec, laid: Table, run: Scored) -> list[str]:
    """How each episode failed: the outcome of its first unsafe decision, `late`, or nothing."""
    actions, found = spec.dataset.actions, []
    for row, unsafe, late in zip(laid.index, run.verdict.unsafe, run.verdict.late, strict=True):
        how = "late" if late else ""
        if unsafe:
            i = next(i for i in row[row >= 0] if laid.safe[i].any() and not run.safe[i])
            how = spec.dataset.scenes[i].record["outcomes"][actions[run.coordination.action[i]]]["result"]
        found.append(how)
    return found


def number(value: float) -> float | None:
    """JSON has no NaN and no infinity: unknown and never are null."""
    return value if math.isfinite(value) else None
