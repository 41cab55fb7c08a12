"""What a prompt shows in place of values is found in its template,
and is no evidence when it comes back.
"""

import json
from dataclasses import replace

import pytest

from harness.backends.base import Request
from harness.parsing.parse import Parsed, parse
from harness.prompts import versions
from harness.prompts.placeholders import placeholders

ACTIONS = ("SLOWER", "IDLE", "FASTER")


@pytest.mark.parametrize(
    ("template", "found"),
    [
        ('{"evidence":"max 12 words","risk":"low|medium|high","confidence":0 to 1}',
         ("max 12 words", "low|medium|high", "0 to 1")),
        ('{"evidence": "what you see, and where", "risk": how grave}',
         ("what you see, and where", "how grave")),
        (
            '{"action_distribution":{ {%- for a in actions %}"{{ a }}":p{{ "," }}{% '
            'endfor -%} }}', ("p",)),
        ('{"maneuver": "{{ actions | join("|") }}", "confidence": {# hm: "x": y #}number}', ()),
        (
            'Answer in JSON with two keys: "evidence" names what you see; "risk" is one of '
            'low, high.', ()),
        ("{{ graph.ego.id }}: {{ words.task }}", ()),
        ("", ()),
    ],
)  # fmt: skip
def test_a_template_shows_its_placeholders(template: str, found: tuple[str, ...]) -> None:
    assert placeholders(template) == found


def said(evidence: str, prompt: versions.Prompt) -> Parsed:
    shares = {"SLOWER": 0.7, "IDLE": 0.2, "FASTER": 0.1}
    decision = (
        {"action_distribution": shares}
        if prompt.helper_answer == "distribution"
        else {"recommended_maneuver": "IDLE", "confidence": 0.7}
    )
    text = json.dumps({"evidence": evidence, "risk": "low", **decision})
    return parse(text, **prompt.shape("helper", ACTIONS)._asdict())


@pytest.mark.parametrize("version", versions.names())
def test_no_shipped_prompts_own_placeholder_is_evidence(version: str) -> None:
    prompt = versions.load(version)
    for shown in prompt.placeholders["helper"]:
        parsed = said(shown, prompt)
        assert (parsed.status, list(parsed.repairs)) == ("recovered", ["evidence_echo"]), shown
        assert parsed.message is not None
        assert parsed.message["evidence"] is None
    assert said("v3 from left, gap 2 s", prompt).status == "strict"


def test_nor_is_that_of_a_users_prompt() -> None:
    prompt = versions.load("v6")
    helper = (
        prompt.texts["helper"]
        .replace("max 12 words", "what hides whom")
        .replace("low|", "none|low|")
    )
    own = replace(prompt, texts={**prompt.texts, "helper": helper})
    for shown in ("What  hides whom.", "None|low", "Low or none"):
        assert said(shown, own).repairs == ("evidence_echo",)
        assert said(shown, prompt).status == "strict"
    assert said("none", own).status == "strict", "a choice by itself is one"


def test_a_request_has_those_of_its_prompt() -> None:
    shown = versions.load("v6").placeholders["helper"]
    asked = Request("s/v1", "helper", (), ACTIONS, 64, placeholders=shown)
    assert asked.shape.placeholders == shown
