"""The model that ships is a model: what its documents say of it holds on part of the shipped
dataset.

The bars are those of the whole dataset, where the README's table has the intervals.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from evaluating import decisions, figure, run, scenes_of, spec_of
from former import DATASET
from run_on_disk import answers_of

from harness.backends.base import Request
from harness.backends.registry import open_backend
from harness.coordination.named_points import POINTS
from harness.dataset.load import Dataset, find, load
from harness.evaluate.asking import Asker
from harness.evaluate.latency import PAPER
from harness.evaluate.lifecycle import Evaluated
from harness.evaluate.requests import requests

pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")

EPISODES = 48
# That its answers stay what they are, `conformance/test_answer_versions.py` says of a few of them.


@pytest.fixture(scope="module")
def shipped() -> Dataset:
    return load(find(DATASET), limit=EPISODES)


@pytest.fixture(scope="module")
def done(shipped: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Evaluated:
    return run(
        spec_of(shipped, "swarm-tiny", seeds=(0, 1, 2, 3, 4)), tmp_path_factory.mktemp("r") / "run"
    )


@pytest.mark.exhaustive
def test_its_answers_are_valid_as_they_come(done: Evaluated) -> None:
    said = [answer.verdict for answer in answers_of(done.out)]
    assert len(said) > 1000
    assert said.count("strict") >= 0.98 * len(said)


@pytest.mark.exhaustive
def test_it_is_unsure_where_a_danger_is_hidden(done: Evaluated, shipped: Dataset) -> None:
    """Hidden: the ego does not see the danger, and a sector of its view is occluded."""
    # nothing of it depends on luck
    said = [d for d in decisions(done.out, "single-local") if d.seed == 0]
    hidden = []
    for scene, decision in zip(shipped.scenes([d.scene for d in said]), said, strict=True):
        graph, danger = scene.graphs[scene.state.ego.id], scene.record.danger.vehicle
        seen = danger in {node.id for node in graph.nodes}
        if danger and not seen and any(sector.occluded for sector in graph.sectors):
            hidden.append(decision.entropy_nats)
    assert len(hidden) >= 50
    assert np.mean(hidden) > POINTS["6g"].ask.tau_nats, "so that it asks for help"


@pytest.mark.exhaustive
def test_its_helpers_messages_help(done: Evaluated) -> None:
    alone, helped = (figure(done, c, "success_rate").value for c in ("single-local", "6g"))
    assert helped - alone >= 0.08


@pytest.mark.slow
def test_what_it_answered_before_moves_no_answer() -> None:
    """Rounding in F16 would: so a run that resumes is the run, and repeat 3 is sampling seed 2."""
    data = load(find("occluded-intersection-v3"), limit=3)
    spec = spec_of(data, "swarm-tiny", answer="readout")
    asked = list(requests(spec, scenes_of(data)[:12]))[:24]
    backend = open_backend(spec.ego.card, device="cpu")

    def answered(some: Sequence[Request]) -> list[tuple[str, float | None]]:
        asker = Asker(spec, lambda: backend, PAPER)
        asker.ask(some)
        return [(answer.raw, answer.label_mass) for answer in asker.answers.values()]

    one, two, others = asked[:1], asked[:2], asked[8:]
    for some in (one, others, one):
        answered(some)
    at_first = answered(two)
    answered(others)
    assert answered(two) == at_first


def test_it_is_small() -> None:
    folder = Path(__file__).parents[1] / "models" / "swarm-tiny"
    assert sum(file.stat().st_size for file in folder.iterdir()) <= 10e6
