"""What answers and decisions depend on has versions:
whoever changes a result raises the version with it.

The golden file has the version of each engine, of the parser and of the decisions, and what they
gave. After a wanted change raise the version, then `UPDATE_GOLDEN=1`; an update without a new
version is refused.
"""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from corpus import ACTIONS, CASES
from evaluating import run, scenes_of, spec_of
from former import DATASET
from misbehaving import completion, serving
from test_every_backend import answered
from test_real_answers import FILE as REAL_ANSWERS
from tiers import some

from harness.backends import cards
from harness.backends.base import AnswerMode, Completion, Request
from harness.backends.card import Card
from harness.backends.driver import REFERENCES
from harness.backends.openai import shapes
from harness.backends.openai.faults import fault_in
from harness.backends.registry import BUILT_IN, missing, open_backend
from harness.coordination.contents import CONTENTS, INTENT, INTENTS
from harness.coordination.named_points import POINTS, named_point
from harness.coordination.rules import RULES, reads
from harness.coordination.schedules import SCHEDULES
from harness.core import versions
from harness.core.files import sha256_bytes
from harness.dataset.load import Dataset, find, load
from harness.evaluate.requests import requests
from harness.parsing.parse import parse
from harness.runs import folder

GOLDEN = Path(__file__).parents[1] / "golden" / "versions.json"
ASKED = 3  # questions to each engine
TOLERANCE = 0.02  # of a probability: float32 is summed in another order on another processor
CARDS = {
    "proxy": ("proxy", ("json",)),
    "proxy-faulty": ("proxy", ("json",)),
    **dict.fromkeys(REFERENCES, ("driver", ("json",))),
    "openai-example": ("openai", get_args(AnswerMode)),
    "systemone-example": ("systemone", ("decision",)),
    "decisions-example": ("decisions", ("decision",)),
    "sparrow-general": ("sparrow", ("decision",)),
    "sparrow-robot": ("sparrow", ("decision",)),
    "swarm-tiny": ("llama-cpp", get_args(AnswerMode)),
    "swarm-tiny:transformers": ("transformers", get_args(AnswerMode)),
}
ENGINES = [(name, answer) for name, (_, modes) in CARDS.items() for answer in modes]
DEAREST = ("swarm-tiny", "json")  # which writes most tokens


@pytest.fixture(scope="module")
def shipped() -> Dataset:
    return load(find(DATASET), limit=2)


def held(name: str, version: int, result: Any, same: Any = lambda now, then: now == then) -> None:
    """Compare a result with the golden one under its version;
    by name, more results may be added.
    """
    golden = json.loads(GOLDEN.read_text()) if GOLDEN.exists() else {}
    then = golden.get(name)
    moved = then is None or not same(result, then["result"])
    grown = then and isinstance(result, dict) and then["result"].items() <= result.items()
    older = then is None or then["version"] < version
    if os.environ.get("UPDATE_GOLDEN") and (older or (moved and grown)):
        golden[name] = {"version": version, "result": result}
        GOLDEN.write_text(json.dumps(dict(sorted(golden.items())), indent=1) + "\n")
        return
    assert not moved, (
        f"{name} gives other results: raise its version, now {version}, then UPDATE_GOLDEN=1"
    )
    assert then["version"] == version


def near(now: list[str], then: list[str]) -> bool:
    """Whether texts are equal, but for the last digits of their numbers."""
    return len(now) == len(then) and all(map(_near, now, then))


def _near(now: str, then: str) -> bool:
    try:
        pair = [json.loads(text) for text in (now, then)]
        p, q = (np.array(list(each["action_distribution"].values())) for each in pair)
    except (ValueError, KeyError, TypeError):
        return now == then
    rest = [{k: v for k, v in each.items() if k != "action_distribution"} for each in pair]
    return rest[0] == rest[1] and bool(np.abs(p - q).max() <= TOLERANCE)


@contextmanager
def served(name: str) -> Iterator[Card]:
    """A model's card; that of a served one is answered by a server of ours."""
    card = cards.load(name)
    if card.server is None:
        yield card
        return
    with serving(answered) as there:
        yield replace(card, server=replace(card.server, base_url=there.url))


@pytest.mark.parametrize(
    ("name", "answer"),
    some(
        [case for case in ENGINES if case != DEAREST],
        exhaustive=[DEAREST],
    ),
)
def test_an_engine_answers_as_its_version_did(
    name: str, answer: AnswerMode, shipped: Dataset
) -> None:
    engine, _ = CARDS[name]
    with served(name) as card:
        if lacking := missing(card):
            pytest.skip(f"needs {lacking}")
        spec = spec_of(shipped, name, answer=answer)
        asked = list(requests(spec, scenes_of(shipped)))[:ASKED]
        device = "cpu" if BUILT_IN[engine].capabilities.has_weights else None
        backend = open_backend(card, batch_size=1, device=device)
        completions: list[Completion] = backend.complete(asked)
    assert backend.identity()["answers"] == BUILT_IN[engine].answers
    held(f"{name} {answer}", BUILT_IN[engine].answers, [c.text for c in completions], near)


def test_replies_of_a_server_are_read_as_its_version_did() -> None:
    half, parts = (
        '{"action_distribution": {"A"',
        [{"type": "thinking", "thinking": "Hm."}, {"text": "{}"}],
    )
    endings = ("stop", "length", "model_length", "MAX_TOKENS", "content_filter", "refusal", "eos")
    replies = {
        **{ending: completion(half, ending) for ending in endings},
        "filtered": completion(None, "content_filter"),
        "refusal beside a text": completion("{}", refusal="No."),
        "thought": completion("{}", reasoning_content="Hm."),
        "parts": completion(parts),
    }
    request = Request("s/v1", "ego", ({"role": "user", "content": "?"},), ("A", "B"), 64)
    result = {}
    for name, reply in replies.items():
        said = shapes.read(reply, request)
        result[name] = f"{said.finish_reason}: {said.error or said.text}"
    broken = {
        f"broken off: {end}": fault_in(completion(half, end)) for end in ("error", "abort", "stop")
    }
    faults = {name: fault.words if fault else "none" for name, fault in broken.items()}
    said = shapes.read(completion("{}", reasoning_content="Hm. " * 200), request)
    counts = {"count of a thought": str(said.completion_tokens)}
    held("openai replies", BUILT_IN["openai"].answers, result | faults | counts)


def test_every_engine_but_those_of_stored_answers_is_pinned() -> None:
    """A replay's answers are those of its run, and a file's are its own, by their digest."""
    stored = {"replay", "answers-file"}
    assert {engine for engine, _ in CARDS.values()} | stored == set(BUILT_IN)


@pytest.mark.slow
def test_answers_are_decided_as_their_version_did(shipped: Dataset, tmp_path: Path) -> None:
    """Every operating point, rule, content, attack and schedule that needs no words,
    by the proxy.
    """
    held("decisions", versions.DECISIONS, decided(shipped, tmp_path))


@pytest.mark.slow
def test_answers_are_decided_so_where_helpers_leave(tmp_path: Path) -> None:
    """Attackers stand before `linear`: `trust` refuses several voices of one helper there."""
    crossing = load(find("sumo-crossing-v1")).of_episodes(frozenset({0, 3, 9, 12, 14}))
    result = decided(crossing, tmp_path, attacked="linear")
    held("decisions where helpers leave", versions.DECISIONS, result)


def decided(dataset: Dataset, folder_of_run: Path, attacked: str = "trust") -> dict[str, str]:
    """Return a digest of what the proxy's answers are decided to, by condition.

    `attacked` is the rule that gets the messages of attackers.
    """
    attacks = pytest.importorskip("harness.extensions.trust.attacks").ATTACKS
    changes = [
        *(f"consensus={rule}" for rule in RULES.built_in if INTENTS in reads(rule)),
        *(
            f"content={name}"
            for name, content in CONTENTS.items()
            if name != INTENT
            and not (content.of_agents or (content.call and content.call.in_words))
        ),
        *(f"schedule={schedule}" for schedule in SCHEDULES if SCHEDULES.is_ours(schedule)),
    ]
    for name in sorted(set(attacks.built_in) - {"injection"}):
        target = "content=objects" if attacks[name].in_objects else f"consensus={attacked}"
        changes.append(f"{target},attack={name}:share=2/3")
    points = (*POINTS.values(), *(named_point(f"6g:{change}") for change in changes))
    spec = spec_of(dataset, "proxy", "v4", points=points, seeds=(0, 1))
    decisions = folder.read(run(spec, folder_of_run / "run").out).decisions
    condition = np.array(decisions.labels("condition"))
    rows = np.column_stack([
        decisions.codes("action", decisions.actions), decisions.of_actions("fused").round(4),
        decisions["latency_ms"].round(1), decisions["messages"],
    ])  # fmt: skip
    known = np.nan_to_num(rows + 0.0, nan=-1)  # and no zero has a sign
    return {
        point.name: sha256_bytes(known[condition == point.name].tobytes())[:16] for point in points
    }


def test_completions_are_parsed_as_their_version_did() -> None:
    """A case that is new is added to its version; one that changed wants a new version."""
    result = {}
    for case in CASES:
        parsed = parse(case.text, actions=ACTIONS, **case.asked)
        result[case.name] = ", ".join([parsed.status, *(parsed.repairs or parsed.faults[1:])])
    held("completions", versions.PARSER, result)


def test_answers_are_read_as_their_version_did() -> None:
    """`test_real_answers` says what each answer is read as;
    here its file is held to the version.
    """
    held("parser", versions.PARSER, sha256_bytes(REAL_ANSWERS.read_bytes()))


@pytest.mark.slow
def test_figures_are_those_of_their_version(tmp_path: Path) -> None:
    """Of a run's tables follow the same values and intervals;
    a new metric is added to its version.
    """
    points = [POINTS["single-local"], POINTS["6g"]]
    done = run(
        spec_of(load(find(DATASET), limit=60), seeds=(0, 1), points=points), tmp_path / "run"
    )
    rows = dict[str, list[str]]()
    for score in folder.read(done.out).scores:
        numbers = (
            f"{each:.5g}" for each in (score.value, score.low, score.high) if each is not None
        )
        rows.setdefault(score.metric, []).append(
            f"{score.condition} {score.interval} {' '.join(numbers)}"
        )
    result = {metric: sha256_bytes("\n".join(of).encode())[:16] for metric, of in rows.items()}
    assert "calibration_error_one_optimal" in result
    held("figures", versions.FIGURES, result)
