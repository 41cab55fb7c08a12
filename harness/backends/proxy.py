"""The proxy backend: a deterministic rule in place of a language model,
which reads the viewer's scene graph.

It exercises the whole pipeline without a model. It plans on what its viewer sees, as `local-view`
does, and is less sure the more of the ego's sectors it cannot see. Its numbers are chosen, not
fitted: its scores say something about the harness and nothing about any language model. Its card
may make it fail at known rates.
"""

import re
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from harness.backends.base import Completion, FinishReason, Request, by_scenario
from harness.backends.card import Card, Failures
from harness.backends.registry import BUILT_IN
from harness.core import noise
from harness.core.files import canonical_json
from harness.core.rounding import rounded
from harness.prompts.answer_schema import plainest
from harness.world.planner import plan, plans
from harness.world.scenario import Scenario
from harness.world.scene_graph import SceneGraph

SURE_SLOWER = 0.90  # probability of SLOWER if the viewer sees a conflict that calls for it
# probability of SLOWER with every sector in sight, and with one hidden
LEAST_DOUBT, MOST_DOUBT = 0.05, 0.38
OTHER = 0.10  # probability shared by the actions that are neither SLOWER nor the planned one


def open(card: Card, **_: Any) -> "Proxy":
    """Return the backend of the rule `proxy`, which spoils some answers as its model card says.

    A model card is the TOML file that describes a model. Options of other engines are ignored.
    """
    return Proxy(card.failures)


class Proxy:
    """Answer requests by a fixed rule in place of a language model, for tests without one.

    It plans on what the vehicle sees, and answers in the form that the prompt asks for. With
    `failures`, shares of the answers are spoilt on purpose.
    """

    def __init__(self, failures: Failures | None = None) -> None:
        self._failures = failures

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        completions = []
        for request, text in zip(requests, answers(requests), strict=True):
            finish_reason: FinishReason = "stop"
            how, slow_s = (
                draw_failure(self._failures, request.id) if self._failures else (None, 0.0)
            )
            if how:
                text, finish_reason = spoil(text, how, request.actions)
            completions.append(
                Completion(request.id, text, None, None, finish_reason, None, 1, slow_s=slow_s)
            )
        return completions

    def identity(self) -> dict[str, Any]:
        return {
            "engine": "proxy",
            "answers": BUILT_IN["proxy"].answers,
            "calibration_label": "none: chosen by hand",
            "failures": asdict(self._failures) if self._failures else None,
        }


def answers(requests: Sequence[Request]) -> list[str]:
    """Return the texts that the rule `proxy` answers to requests, in order, before any is spoilt.

    The rule stands in for a model in tests.
    """
    return by_scenario(requests, _answers)


def _answers(requests: Sequence[Request]) -> list[str]:
    scenario, views = requests[0].scenario, [request.view for request in requests if request.view]
    if scenario is None or len(views) < len(requests):
        raise ValueError("a request has no view of a scenario; the proxy reads nothing else")
    return [
        _text(request, view, _hedged(scenario.actions, planned, view))
        for request, view, planned in zip(requests, views, plans(scenario, views), strict=True)
    ]


def _text(request: Request, view: SceneGraph, intent: dict[str, float]) -> str:
    best = max(intent, key=intent.__getitem__)
    body = {name: plainest(schema) for name, schema in request.shape.further.items()}
    if request.role == "helper":
        unsure = intent["SLOWER"] > (LEAST_DOUBT + MOST_DOUBT) / 2
        risk = "high" if best == "SLOWER" else "medium" if unsure else "low"
        body |= {"evidence": _reason(view), "risk": risk}
    if key := request.shape.named:
        body |= {key: best, "confidence": intent[best]}
    else:
        body["action_distribution"] = intent
    if request.reasons_first:
        return f"{_reason(view)} {canonical_json(body)}"
    return canonical_json(body)


def distribution(scenario: Scenario, view: SceneGraph) -> dict[str, float]:
    """Return the probability that the rule `proxy` gives each action, by the action's name.

    `view` is what the vehicle that is asked sees. The action that the rule plans on it is
    likeliest, and less so the more of the directions that cars may come from the vehicle cannot
    see.
    """
    return _hedged(scenario.actions, plan(scenario, view), view)


def _hedged(actions: Sequence[str], planned: str, view: SceneGraph) -> dict[str, float]:
    if planned == "SLOWER":
        braking = SURE_SLOWER
    else:
        hidden = max((1.0 - sector.seen_share for sector in view.sectors), default=0.0)
        braking = LEAST_DOUBT + (MOST_DOUBT - LEAST_DOUBT) * hidden
    rest = 1.0 - braking
    rest_actions = [a for a in actions if a not in ("SLOWER", planned)]
    shares = {a: min(OTHER, rest) / len(rest_actions) for a in rest_actions}
    if planned == "SLOWER":
        shares = {a: rest / len(rest_actions) for a in rest_actions}
    else:
        shares[planned] = rest - sum(shares.values())
    return dict(zip(actions, rounded([shares.get(a, braking) for a in actions]), strict=True))


def _reason(view: SceneGraph) -> str:
    for conflict in view.conflicts:
        if conflict.other.braking and conflict.kind == "ahead":
            away_m = conflict.ego.arc_m
            return (
                f"{conflict.vehicle} brakes {away_m:.0f} m ahead of the ego, {conflict.lane} lane."
            )
    if view.conflicts:
        first = min(view.conflicts, key=lambda conflict: abs(conflict.other.arc_m))
        return (
            f"{first.vehicle} from {first.sector} {first.other.arc_m:.0f} m before the ego's path."
        )
    return f"Nothing on the ego's path; hidden: {', '.join(view.occluded) or 'none'}."


def draw_failure(failures: Failures, request_id: str) -> tuple[str | None, float]:
    """Draw how a request's answer is spoilt (None if not), and its extra delay in seconds.

    `failures` has the shares of answers that are spoilt. The first is a name of `Failures.texts`,
    such as `prose`. The draw depends on the id only, so batch, order, prompt and the settings that
    are scored do not change it.
    """
    text, slow = noise.uniforms((2,), "proxy failure", request_id).tolist()
    slow_s = failures.slow_s if slow < failures.slow_tail else 0.0
    for how, share in failures.texts.items():
        if text < share:
            return how, slow_s
        text -= share
    return None, slow_s


def spoil(text: str, how: str, actions: Sequence[str]) -> tuple[str, FinishReason]:
    """Return a good answer's text spoilt as `how` says, and its finish reason.

    `text` ends in compact JSON, `how` is a name of `Failures.texts`, such as `fence`, and `actions`
    are the names of the meta-actions. Raises ValueError for another `how`.
    """
    match how:
        case "fence":
            return f"```json\n{text}\n```", "stop"
        case "prose":
            return f"Here is what I would do.\n\n{text}\n\nThis keeps a safe distance.", "stop"
        case "truncation":
            return text[: text.rindex(":") + 1], "length"
        case "nan":
            return re.sub(r":[\d.]+", ":NaN", text, count=1), "stop"
        case "unknown_action":
            for action in actions:
                text = text.replace(f'"{action}"', f'"NOT_{action}"')
            return text, "stop"
        case "unclosed_think":
            return f"<think>\nPerhaps {text}", "length"
    raise ValueError(f"no failure {how!r}")
