"""A proxy that fails on purpose: as declared, as often as declared, and counted to the answer."""

from collections import Counter
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from evaluating import decisions, figure, run, same_decisions, scenes_of, spec_of
from run_on_disk import answers_of
from scipy.stats import binom

from harness.backends import cards
from harness.backends.base import Request
from harness.backends.card import Failures
from harness.backends.proxy import answers, draw_failure, spoil
from harness.backends.registry import open_backend
from harness.coordination.named_points import POINTS
from harness.coordination.operating_point import OperatingPoint
from harness.core.statistics import rate_interval
from harness.dataset.load import Dataset
from harness.parsing.parse import parse

FAULTY = cards.load("proxy-faulty").failures or Failures()
STATUS = {
    "fence": "recovered",
    "prose": "recovered",
    "truncation": "truncated_json",
    "nan": "non_finite",
    "unknown_action": "unknown_action",
    "unclosed_think": "truncated_reasoning",
    None: "strict",
}
FAILED = {how for how, status in STATUS.items() if status not in ("recovered", "strict")}


def made_up(n: int, start: int = 0) -> list[str]:
    return [f"{i // 6:05d}-{i % 6}/v1" for i in range(start, start + n)]


def questions(dataset: Dataset, form: str) -> list[Request]:
    return [
        Request(
            f"{scene.id}/{viewer}",
            graph.role,
            (),
            dataset.actions,
            64,
            form,
            view=graph,
            scenario=dataset.scenario,
        )
        for scene in scenes_of(dataset)
        for viewer, graph in scene.graphs.items()
    ]


@pytest.mark.parametrize("form", ["distribution", "recommendation"])
@pytest.mark.parametrize("how", [how for how in STATUS if how])
@pytest.mark.parametrize("every", [7, pytest.param(1, marks=pytest.mark.exhaustive)])
def test_every_failure_has_its_status_whatever_was_answered(
    how: str, form: str, every: int, small: Dataset
) -> None:
    asked = questions(small, form)[::every]
    assert {request.role for request in asked} == {"ego", "helper"}
    for request in asked:
        text, finish_reason = spoil(answers([request])[0], how, request.actions)
        parsed = parse(
            text, role=request.role, actions=request.actions, finish_reason=finish_reason
        )
        assert parsed.status == STATUS[how], text


def test_there_is_a_status_for_every_failure_and_no_other_way_to_spoil() -> None:
    assert {how for how in STATUS if how} == set(FAULTY.texts)
    with pytest.raises(ValueError, match="no failure 'shrug'"):
        spoil("{}", "shrug", ())


@pytest.mark.slow
def test_failures_come_as_often_as_declared() -> None:
    """10,000 answers: each count within the range that holds 99.99 % of such counts."""
    n = 10_000
    found = [draw_failure(FAULTY, name) for name in made_up(n)]
    counts = Counter(how for how, _ in found)
    slow = sum(slow_s == FAULTY.slow_s for _, slow_s in found)
    assert {slow_s for _, slow_s in found} == {0.0, FAULTY.slow_s}
    for count, share in [
        *((counts[h], share) for h, share in FAULTY.texts.items()),
        (slow, FAULTY.slow_tail),
    ]:
        low, high = binom.interval(0.9999, n, share)
        assert low <= count <= high
    assert sum(counts.values()) == n
    both = sum(how is not None and slow_s > 0 for how, slow_s in found)
    low, high = binom.interval(0.9999, n, sum(FAULTY.texts.values()) * FAULTY.slow_tail)
    assert low <= both <= high, "slowness comes on top, of good and bad answers alike"


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_never_is_never_and_always_is_always(share: float) -> None:
    failures = Failures(nan=share, slow_tail=share, slow_s=0.4 * share)
    expected = ("nan", 0.4) if share else (None, 0.0)
    assert {draw_failure(failures, name) for name in made_up(2000)} == {expected}


@pytest.mark.exhaustive
def test_the_intervals_cover_the_declared_rate_as_often_as_they_say() -> None:
    """The failed rate of 400 runs of 150 answers each, by the interval of the summary:
    95 % of them.
    """
    truth = sum(share for how, share in FAULTY.texts.items() if how in FAILED)
    covered = 0
    for start in range(0, 400 * 150, 150):
        failed = np.array(
            [float(draw_failure(FAULTY, name)[0] in FAILED) for name in made_up(150, start)]
        )
        interval = rate_interval(failed)
        covered += interval.low <= truth <= interval.high
    assert 0.92 <= covered / 400 <= 0.99


def test_a_run_counts_what_was_drawn_exactly(small: Dataset, tmp_path: Path) -> None:
    done = run(spec_of(small, "proxy-faulty"), tmp_path / "run")
    verdicts: dict[str, list[str]] = {"ego": [], "helper": []}
    for given in answers_of(tmp_path / "run"):
        how, slow_s = draw_failure(FAULTY, given.id)
        assert (given.status, given.slow_s) == (STATUS[how], slow_s)
        verdicts[given.role].append("failed" if how in FAILED else STATUS[how])
    for role, each in verdicts.items():
        assert len(set(each)) == 3, "a dataset in which nothing fails would show nothing"
        for verdict in ("strict", "recovered", "failed"):
            row = figure(done, "all", f"{verdict}_rate_{role}", "answers")
            assert (row.n, row.value) == (
                len(each),
                pytest.approx(each.count(verdict) / len(each), abs=1e-12),
            )
            assert row.low <= row.value <= row.high
    assert done.manifest.identity["failures"] == asdict(FAULTY)


def test_a_slow_answer_is_late_by_what_was_declared(small: Dataset, tmp_path: Path) -> None:
    """Alone, an ego decides after 145 ms, or 545 ms where its answer was drawn slow."""
    asks = OperatingPoint.of("asks", "6g", tau_nats=0.0)  # at every step
    run(spec_of(small, "proxy-faulty", points=(POINTS["single-local"], asks)), tmp_path / "run")
    alone = decisions(tmp_path / "run", "single-local")
    expected = [145.0 + 1000 * draw_failure(FAULTY, f"{d.scene}/v1")[1] for d in alone]
    found = [d.latency_ms for d in alone]
    assert found == pytest.approx(expected)
    assert set(found) <= {145.0, 545.0}
    heard = decisions(tmp_path / "run", "asks")
    arrivals = [m.arrival_ms for d in heard for m in d.messages if m.delivered]
    assert min(arrivals) < 400 < max(arrivals), "a slow helper is heard late"


@pytest.mark.exhaustive
def test_neither_batches_nor_a_replay_nor_company_change_a_failure(
    small: Dataset, tmp_path: Path
) -> None:
    run(spec_of(small, "proxy-faulty"), tmp_path / "run")
    run(spec_of(small, "proxy-faulty", batch_size=1), tmp_path / "single")
    run(spec_of(small, f"replay:{tmp_path / 'run'}"), tmp_path / "again")
    first = (tmp_path / "run" / "answers.jsonl").read_bytes()
    for twin in ("single", "again"):
        assert first == (tmp_path / twin / "answers.jsonl").read_bytes()
        assert same_decisions(tmp_path / twin, tmp_path / "run")
    backend = open_backend(cards.load("proxy-faulty"))
    asked = questions(small, "distribution")
    together = {c.request_id: c for c in backend.complete(asked)}
    for request in reversed(asked):
        assert backend.complete([request]) == [together[request.id]]
