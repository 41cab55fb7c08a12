"""A small run folder, made from a real dataset: a rule answers in the models' place, the rest is computed."""

import csv
import json
import math
from dataclasses import asdict

import numpy as np

from harness.coordination.channel import Draws
from harness.coordination.coordinate import coordinate
from harness.coordination.intents import Intents
from harness.coordination.operating_point import POINTS
from harness.core import noise as luck
from harness.core.statistics import episode_interval, rate_interval, seed_interval

INFERENCE_S = 0.145
SEEDS = (0, 1, 2)
COLUMNS = [
    "model",
    "prompt",
    "condition",
    "metric",
    "value",
    "ci_low",
    "ci_high",
    "n",
    "n_excluded",
    "interval",
]


def write_run(folder, dataset, model="rule-of-thumb", change=lambda scene, viewer, answer: answer):
    """Write run.json, summary.csv and rows.jsonl. `change` may replace any answer."""
    folder.mkdir(parents=True, exist_ok=True)
    answers = [{v: change(s, v, _answer(s, v, dataset.actions)) for v in s.viewers} for s in dataset.scenes]
    safe, delay_s = dataset.outcome_arrays()
    decided = {(name, seed): _decide(name, seed, dataset, answers) for name in POINTS for seed in SEEDS}
    config = {
        "format": "swarmdrive-run/1",
        "name": "sample",
        "created": "2025-01-01T00:00:00+00:00",
        "harness": "0.1.0",
        "command": "harness eval --model rule-of-thumb",
        "model": {"name": model, "engine": "rule", "description": "brakes for what it sees"},
        "identity": {"engine": "rule"},
        "prompt": {"version": "v2", "sha256": "00" * 32},
        "dataset": {
            "name": dataset.name, "path": str(dataset.path), "sha256": dataset.sha256,
            "scenes": len(dataset.scenes), "episodes": dataset.manifest.episodes,
        },
        "actions": list(dataset.actions),
        "conditions": [asdict(point) for point in POINTS.values()],
        "seeds": list(SEEDS),
        "latency": {"source": "paper", "inference_s": {"ego": INFERENCE_S}, "basis": "the paper's 145 ms"},
        "delay_allowance_s": 1.0,
        "versions": dataset.manifest.versions,
    }  # fmt: skip
    rows = [
        {
            "scene": s.id,
            "episode": s.record["episode"],
            "step": s.record["step"],
            "danger": s.record["danger"]["sector"],
            "answers": answers[i],
            "safe": safe[i].tolist(),
            "delay_s": [None if math.isnan(d) else float(d) for d in delay_s[i]],
            "decisions": [
                _row(c, i, name, seed, s, dataset.actions, safe, delay_s)
                for (name, seed), c in decided.items()
            ],
        }
        for i, s in enumerate(dataset.scenes)
    ]
    (folder / "run.json").write_text(json.dumps(config))
    (folder / "rows.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    with (folder / "episodes.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["condition", "seed", "episode", "success"])
        numbers = sorted({s.record["episode"] for s in dataset.scenes})
        for (name, seed), of in decided.items():
            for number, success in zip(numbers, _success(of, dataset, safe), strict=True):
                writer.writerow([name, seed, number, bool(success)])
    with (folder / "summary.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for name in POINTS:
            for metric, e, unit in _summary(name, decided, dataset, safe):
                writer.writerow([model, "v2", name, metric, e.value, e.low, e.high, e.n, e.n_excluded, unit])
    return folder


def _answer(scene, viewer, actions):
    graph = scene.record["graphs"][viewer]
    close = [
        c for c in graph["conflicts"] if abs((c["ego"]["time_s"] or 99) - (c["other"]["time_s"] or 99)) < 1.5
    ]
    blind = any(s["occluded"] for s in graph["sectors"])
    p = (0.9, 0.08, 0.02) if close else (0.3, 0.4, 0.3) if blind else (0.05, 0.8, 0.15)
    answer = {
        "role": graph["role"], "raw": json.dumps({"action_distribution": dict(zip(actions, p, strict=True))}),
        "finish_reason": "stop", "error": None, "status": "strict", "verdict": "strict", "repairs": [],
        "intent": list(p), "mass": 1.0, "message": None, "detail": "fits the schema",
        "prompt_tokens": None, "completion_tokens": None, "seconds": None,
    }  # fmt: skip
    if graph["role"] == "helper":
        answer["message"] = {"recommended_maneuver": actions[int(np.argmax(p))], "confidence": max(p)}
    if scene.record["step"] == 2 and viewer == "v3":
        fenced = {"raw": f"```json\n{answer['raw']}\n```", "status": "recovered", "verdict": "recovered"}
        answer |= fenced | {"repairs": ["code_fence"], "detail": "read after 1 repair(s): code_fence"}
    if scene.record["step"] == 4 and viewer == "v4":
        answer |= {
            "raw": "I would slow down.",
            "status": "no_json",
            "verdict": "failed",
            "intent": None,
            "mass": None,
        }
        answer |= {"message": None, "detail": "there is no JSON object"}
    return answer


def _decide(name, seed, dataset, answers):
    scenes = dataset.scenes
    intents = np.array([[a["intent"] or [np.nan] * 3 for a in of.values()] for of in answers])
    place = np.array([[(v.x_m, v.y_m) for v in (s.state.ego, *s.state.helpers)] for s in scenes])
    helpers = intents.shape[1] - 1
    keys = [("sample", seed, s.record["episode"]) for s in scenes]
    return coordinate(
        POINTS[name],
        Intents(
            own=intents[:, 0],
            helpers=intents[:, 1:],
            valid=~np.isnan(intents[:, 1:]).any(axis=-1),
            distance_m=np.array([list(s.record["distance_m"].values()) for s in scenes]),
            range_m=np.hypot(*np.moveaxis(place[:, 1:] - place[:, :1], -1, 0)),
            payload_bits=np.full((len(scenes), helpers), 2400.0),
            inference_s=np.full((len(scenes), 1 + helpers), INFERENCE_S),
        ),
        Draws(
            link=np.array([luck.uniforms((helpers, 2), "link", *key) for key in keys]),
            jitter=np.array([luck.uniforms((helpers,), "jitter", *key) for key in keys]),
        ),
    )


def _row(c, i, name, seed, scene, actions, safe, delay_s):
    action = int(c.action[i])
    delay = float(delay_s[i, action])
    return {
        "condition": name,
        "seed": seed,
        "entropy_nats": float(c.entropy_nats[i]),
        "triggered": bool(c.triggered[i]),
        "messages": [
            {
                "from": viewer,
                "delivered": bool(c.delivered[i, h]),
                "arrival_ms": float(c.arrival_s[i, h]) * 1000 if c.delivered[i, h] else None,
                "on_time": bool(c.on_time[i, h]),
                "weight": float(c.weights[i, h + 1]),
            }
            for h, viewer in enumerate(scene.viewers[1:])
            if c.asked[i, h]
        ],
        "own_weight": float(c.weights[i, 0]),
        "own_failed": bool(c.own_failed[i]),
        "fused": c.fused[i].tolist(),
        "action": actions[action],
        "latency_ms": float(c.latency_s[i]) * 1000,
        "deadline_missed": bool(c.deadline_missed[i]),
        "safe": bool(safe[i, action]),
        "delay_s": None if math.isnan(delay) else delay,
    }


def _success(decided, dataset, safe):
    """Of each episode, 0 or 1."""
    episode = np.array([s.record["episode"] for s in dataset.scenes])
    good = safe[np.arange(len(episode)), decided.action]
    return np.array([good[episode == e].all() for e in np.unique(episode)], dtype=float)


def _summary(name, decided, dataset, safe):
    episode = np.array([s.record["episode"] for s in dataset.scenes])

    def success(seed):
        return _success(decided[name, seed], dataset, safe)

    def mean(field, seed=SEEDS[0]):
        values = np.asarray(getattr(decided[name, seed], field), dtype=float)
        return np.array([values[episode == e].mean() for e in np.unique(episode)])

    by_seed = np.array([success(seed).mean() for seed in SEEDS])
    yield "success_rate", seed_interval(by_seed), "seed means"
    yield "success_rate", rate_interval(success(SEEDS[0])), "episodes"
    yield "latency_proxy_ms", episode_interval(mean("latency_s") * 1000), "episodes"
    yield "trigger_rate", episode_interval(mean("triggered")), "episodes"
    yield "message_count", episode_interval(mean("messages")), "episodes"
    yield "entropy_nats", episode_interval(mean("entropy_nats")), "episodes"
