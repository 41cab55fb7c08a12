"""Runs whose every text is an attack, and the attacks: each way into markup with each thing to do there."""

import csv
import json
from dataclasses import asdict

from harness.coordination.operating_point import POINTS

WAYS_IN = (
    "{}", '">{}', "'>{}", "</td></tr></table>{}", "</title>{}", "</style>{}", "</script>{}", "</textarea>{}",
    "</pre>{}", "-->{}", "]]>{}", "</details></main>{}", '\\");{}', "</svg>{}", "</noscript>{}",
)  # fmt: skip
DEEDS = (
    "<script>alert(1)</script>",
    "<img src=x onerror=alert(1)>",
    "<svg onload=alert(1)>",
    "<iframe srcdoc='<script>alert(1)</script>'></iframe>",
    "<details open ontoggle=alert(1)>x</details>",
    "<a href=javascript:alert(1)>x</a>",
)
OTHERS = (
    '" onmouseover="alert(1)',
    "' onfocus='alert(1)' autofocus='",
    "javascript:alert(1)",
    "data:text/html,<script>alert(1)</script>",
    "{{constructor.constructor('alert(1)')()}}",
    "{{ 7 * 7 }}{% for x in y %}",
    "${alert(1)}",
    "`${alert(1)}`",
    "<scr<script>ipt>alert(1)</scr</script>ipt>",
    "<ScRiPt>alert(1)</sCrIpT>",
    "\u202e<script>alert(1)</script>\u202c",
    "<\x00script>alert(1)</script>",
    "<svg><animate onbegin=alert(1) attributeName=x dur=1s>",
    "<math><mtext><style><img src=x onerror=alert(1)>",
    "=cmd|'/c calc'!A0",
    "@SUM(1+1)*cmd|'/c calc'!A0",
    "+cmd|'/c calc'!A0",
    "-2+3+cmd|'/c calc'!A0",
    "&lt;img src=x onerror=alert(1)&gt;",
    "&#60;script&#62;alert(1)&#60;/script&#62;",
    "%3Cscript%3Ealert(1)%3C/script%3E",
    "\ud800<script>alert(1)</script>",
    "__proto__",
    "constructor",
    "datum['constructor']",
    "signal:alert(1)",
)
PAYLOADS = tuple(way.format(deed) for way in WAYS_IN for deed in DEEDS) + OTHERS


class Attacker:
    """Says one payload after the other."""

    def __init__(self, start):
        self.turn = start

    def __call__(self):
        self.turn += 1
        return PAYLOADS[self.turn % len(PAYLOADS)]


def hostile(folder, dataset, n, conditions=PAYLOADS[:1]):
    """Make a run: its manifest says nothing but payload n, its answers and decisions say all in turn."""
    mine, said = PAYLOADS[n], Attacker(n)
    scenes = dataset.scenes[::8]
    rows = [
        {
            "scene": s.id,
            "episode": s.record["episode"],
            "step": s.record["step"],
            "danger": said(),
            "answers": {v: _answer(said, s.record["graphs"][v]["role"]) for v in s.viewers},
            "safe": [True, True, False],
            "delay_s": [0.0, 0.0, None],
            "decisions": [_decision(dataset.actions[2], name, s.viewers) for name in conditions],
        }
        for s in scenes
    ]
    config = {
        "format": "swarmdrive-run/1",
        "name": mine,
        "created": mine,
        "command": mine,
        "model": {"name": mine, "engine": mine, mine: mine},
        "identity": {mine: mine},
        "prompt": {"version": mine, "sha256": mine},
        "dataset": {"name": mine, "path": str(dataset.path), "sha256": dataset.sha256},
        "actions": dataset.actions,
        "answer": mine,
        "conditions": [asdict(POINTS["6g"]) | {"name": name} for name in conditions],
        "seeds": [0],
        "latency": {"source": mine, "inference_s": {mine: 0.1}, "basis": mine},
        "versions": {"harness": mine, mine: mine},
    }
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps(config))
    (folder / "rows.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    names = [name for name in conditions if "\ud800" not in name]  # which is no UTF-8
    _table(
        folder / "summary.csv",
        (
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
        ),
        [("m", "p", name, "success_rate", 0.5, 0.4, 0.6, 4, 0, "episodes") for name in names]
        + [("m", "p", name, "latency_proxy_ms", 150, 149, 151, 4, 0, "episodes") for name in names]
        + [("m", "p", "all", mine, 1, 1, 1, 4, 0, mine)] * ("\ud800" not in mine),
    )
    _table(
        folder / "episodes.csv",
        ("condition", "seed", "episode", "success"),
        [(name, 0, s.record["episode"], True) for name in names for s in scenes],
    )
    return folder


def _table(file, head, rows):
    with file.open("w", newline="", encoding="utf-8") as out:
        csv.writer(out).writerows([head, *rows])


def _answer(said, role):
    """Role, because it says which answers are the ego's; all else is free."""
    return {
        "role": role,
        "raw": said(),
        "finish_reason": said(),
        "error": said(),
        "status": said(),
        "verdict": said(),
        "repairs": [said()],
        "detail": said(),
        "intent": [0.2, 0.3, 0.5],
        "mass": 0.9,
        "message": {said(): said(), "evidence": said(), "risk": said()},
        "prompt_tokens": 300,
        "completion_tokens": 30,
        "seconds": 0.1,
    }


def _decision(action, condition, viewers):
    """One reply in time, one lost, one late."""
    return {
        "condition": condition,
        "seed": 0,
        "entropy_nats": 0.9,
        "triggered": True,
        "messages": [
            {
                "from": viewer,
                "delivered": k != 1,
                "arrival_ms": None if k == 1 else 160.0 + 60.0 * k,
                "on_time": k == 0,
                "weight": 0.3,
            }
            for k, viewer in enumerate(viewers[1:])
        ],
        "own_weight": 0.4,
        "own_failed": False,
        "fused": [0.1, 0.2, 0.7],
        "action": action,
        "latency_ms": 150.0,
        "deadline_missed": False,
        "safe": False,
        "delay_s": None,
    }
