"""The record of a run: a row a decision with every raw text, and a row an episode."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd

from harness.dataset.load import Scene
from harness.files import canonical_json
from harness.metrics import known_mean
from harness.parse import Parsed
from harness.run.asking import Answer
from harness.run.intents import Intents
from harness.run.scoring import Scored, Table
from harness.run.spec import Spec


def rows(spec: Spec, laid: Table, known: Intents, runs: Sequence[Scored]) -> Iterator[str]:
    """Lines of `rows.jsonl`: a decision point, its answers, and what each condition and seed made of it."""
    tables = [_decisions(run, spec.dataset.scenes, spec.dataset.actions) for run in runs]
    for i, scene in enumerate(spec.dataset.scenes):
        yield canonical_json({
            "scene": scene.id,
            "episode": scene.record["episode"],
            "step": scene.record["step"],
            "danger": scene.record["danger"]["sector"],
            "answers": {
                viewer: _answer(answer, parsed, "ego" if j == 0 else "helper")
                for j, (viewer, answer, parsed)
                in enumerate(zip(scene.viewers, known.answers[i], known.parsed[i], strict=False))
                if answer and parsed
            },
            "safe": laid.safe[i].tolist(),
            "delay_s": [_number(d) for d in laid.delay_s[i].tolist()],
            "decisions": [table[i] for table in tables],
        }) + "\n"  # fmt: skip


def _answer(answer: Answer, parsed: Parsed, role: str) -> dict[str, Any]:
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


def _decisions(run: Scored, scenes: Sequence[Scene], actions: tuple[str, ...]) -> list[dict[str, Any]]:
    """One condition and seed, a mapping a decision."""
    c = run.coordination
    # Lists first: taking numbers out of arrays one by one is most of what a row would cost.
    entropy, triggered, failed = c.entropy_nats.round(6).tolist(), c.triggered.tolist(), c.own_failed.tolist()
    asked, delivered, on_time = c.asked.tolist(), c.delivered.tolist(), c.on_time.tolist()
    arrival_ms, weights = (c.arrival_s * 1000).round(3).tolist(), c.weights.round(6).tolist()
    fused, action = c.fused.round(6).tolist(), c.action.tolist()
    latency_ms, missed = (c.latency_s * 1000).round(3).tolist(), c.deadline_missed.tolist()
    timed, safe, delay_s = (~np.isnan(c.latency_s)).tolist(), run.safe.tolist(), run.delay_s.tolist()
    made = []
    for i, scene in enumerate(scenes):
        messages = [
            {
                "from": viewer, "delivered": delivered[i][j], "on_time": on_time[i][j],
                "arrival_ms": _number(arrival_ms[i][j]), "weight": weights[i][j + 1],
            }
            for j, viewer in enumerate(scene.viewers[1:]) if asked[i][j]
        ]  # fmt: skip
        made.append({
            "condition": run.point.name, "seed": run.seed, "entropy_nats": entropy[i],
            "triggered": triggered[i], "messages": messages, "own_weight": weights[i][0],
            "own_failed": failed[i], "fused": fused[i], "action": actions[action[i]],
            "latency_ms": _number(latency_ms[i]), "deadline_missed": missed[i] if timed[i] else None,
            "safe": safe[i], "delay_s": _number(delay_s[i]),
        })  # fmt: skip
    return made


def episodes(spec: Spec, laid: Table, runs: Sequence[Scored]) -> pd.DataFrame:
    """The table of `episodes.csv`."""
    scenes = spec.dataset.scenes
    first = [scenes[row[0]].record for row in laid.index]
    frames = []
    for run in runs:
        c, verdict = run.coordination, run.verdict

        def per_episode(values: Any, sums: bool = False) -> Any:
            laid_out = laid.by_episode(np.asarray(values, dtype=float))
            return np.nansum(laid_out, axis=1) if sums else known_mean(laid_out, axis=1)

        frames.append(pd.DataFrame({
            "model": spec.card.name, "prompt": spec.prompt.version,
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


def _number(value: float) -> float | None:
    """JSON has no NaN and no infinity: unknown and never are null."""
    return value if np.isfinite(value) else None
