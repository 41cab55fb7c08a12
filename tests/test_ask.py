"""Asking only the helpers whose answers are used:
the same decisions as asking all, with fewer questions.
"""

import shutil
from pathlib import Path

import numpy as np
import pytest
from evaluating import Watched, made
from tiers import some

from harness.backends import cards
from harness.backends.base import Backend, Request
from harness.backends.card import Card
from harness.backends.registry import open_backend
from harness.coordination.named_points import named_point
from harness.core.errors import UserError
from harness.dataset import load
from harness.evaluate import run
from harness.evaluate.agent import Agent
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.live_world import LiveSource
from harness.evaluate.run import evaluate
from harness.evaluate.spec import Source, Spec
from harness.prompts import versions
from harness.runs.folder import read
from harness.runs.settings import words
from harness.studies import replayed_run
from harness.studies.axes import Setting
from harness.studies.replayed_run import ReplayedRun

pytest.importorskip("harness.extensions")  # whose conditions are asked under, too

# Some ask nobody, few, those who are there, by who is there, again where an answer fails, or what
# helpers intended before; and some hear other helpers, or blind ones.
POINTS = (
    "single-local", "v2x", "v2x:max_helpers=1", "v2x:helper_rounds=true", "6g:schedule=deadline",
    "6g:schedule=coverage,max_helpers=1", "6g:schedule=random", "v2x:attack=stale", "v2x:attack=sybil",
    "v2x:messages=blind", "6g:density_coupled=true,max_helpers=1", "v2x:schedule=never",
)  # fmt: skip
TABLES = ("decisions.parquet", "episodes.csv")


def spec(source: Source, ask: str, names: tuple[str, ...] = POINTS, model: str = "proxy") -> Spec:
    agent = Agent(cards.resolve(model), versions.load(source.scenario.prompt))
    return made(agent, source, points=tuple(map(named_point, names)), seeds=(0, 1), ask=ask)


def frozen(episodes: int = 8) -> FrozenSource:
    return FrozenSource(load.load(load.find("occluded-intersection-v2"), episodes), episodes)


def tables(folder: Path) -> list[bytes]:
    return [(folder / name).read_bytes() for name in TABLES]


def n_answers(folder: Path) -> int:
    return len(read(folder).answers)


@pytest.mark.parametrize(
    "source",
    [
        pytest.param(frozen(2), id="frozen", marks=pytest.mark.slow),
        pytest.param(LiveSource(1_000_000, 1), id="closed loop", marks=pytest.mark.exhaustive),
    ],
)
def test_decisions_are_those_of_asking_all(source: Source, tmp_path: Path) -> None:
    names = POINTS if source.kind == "closed-loop" else (*POINTS, "v2x:messages=shuffled")
    for ask in ("all", "used"):
        evaluate(spec(source, ask, names), tmp_path / ask, lambda done: None)
    assert tables(tmp_path / "used") == tables(tmp_path / "all")
    assert n_answers(tmp_path / "used") < n_answers(tmp_path / "all")


@pytest.mark.parametrize("name", ["single-local", "v2x:schedule=never", "v2x:max_helpers=0"])
def test_nobody_asks_so_no_helper_answers(name: str, tmp_path: Path) -> None:
    evaluate(spec(frozen(4), "used", (name,)), tmp_path / "run", lambda done: None)
    assert {answer.role for answer in read(tmp_path / "run").answers} == {"ego"}


@pytest.mark.exhaustive
def test_workers_change_no_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "EPISODES_AT_ONCE", 2)
    source = LiveSource(1_000_000, 4)
    for workers in (1, 2):
        evaluate(
            spec(source, "used", ("v2x",)),
            tmp_path / str(workers),
            lambda done: None,
            workers=workers,
        )
    names = [*TABLES, "answers.jsonl"]
    one, two = ([(tmp_path / w / name).read_bytes() for name in names] for w in "12")
    assert one == two


class Stops(Exception):
    pass


@pytest.mark.exhaustive
def test_a_stopped_run_asks_the_same_in_the_same_batches(tmp_path: Path) -> None:
    batches: dict[str, list[tuple[str, ...]]] = {}

    def opening(into: str, most: int):
        def opens(card: Card, **options: object) -> Backend:
            backend = open_backend(card, **options)  # type: ignore[arg-type]
            complete = backend.complete

            def counted(requests: list[Request]):
                if len(batches.setdefault(into, [])) == most:
                    raise Stops
                batches[into].append(tuple(request.id for request in requests))
                return complete(requests)

            backend.complete = counted  # type: ignore[method-assign,assignment]
            return backend

        return opens

    wanted = spec(frozen(12), "used", ("v2x:max_helpers=1", "6g"))
    evaluate(wanted, tmp_path / "whole", lambda done: None, opens=opening("whole", -1))
    with pytest.raises(Stops):
        evaluate(wanted, tmp_path / "stopped", lambda done: None, opens=opening("stopped", 3))
    evaluate(wanted, tmp_path / "stopped", lambda done: None, opens=opening("resumed", -1))
    # A rule's kept answers are held against the rule; all else is asked as if it had not stopped.
    kept = {name for batch in batches["stopped"] for name in batch}
    others = [batch for batch in batches["resumed"] if not kept.issuperset(batch)]
    assert batches["stopped"] + others == batches["whole"]
    for name in (*TABLES, "answers.jsonl"):
        assert (tmp_path / "stopped" / name).read_bytes() == (
            tmp_path / "whole" / name
        ).read_bytes()


@pytest.mark.parametrize("ask", ["all", "used"])
def test_the_command_that_repeats_a_run_asks_alike(ask: str) -> None:
    typed = " ".join(words(spec(frozen(2), ask).settings))
    assert ("--ask all" in typed) == (ask == "all")
    assert "--ask used" not in typed  # the default


STUDIED = [
    Setting(name, named_point(name), 4) for name in ("v2x", "v2x:tau_nats=0.2", "6g:attack=stale")
]


@pytest.mark.slow
def test_a_study_of_a_run_that_asked_few_is_that_of_one_that_asked_all(tmp_path: Path) -> None:
    for ask in ("all", "used"):
        evaluate(spec(frozen(2), ask, ("single-local",)), tmp_path / ask, lambda done: None)
    shutil.copytree(tmp_path / "used", tmp_path / "alone")
    watched = {"all": Watched(), "used": Watched()}
    by_run = [
        [one for [one] in ReplayedRun(tmp_path / ask, progress=each).walked(STUDIED, (0, 1))]
        for ask, each in watched.items()
    ]
    for one, other in zip(*by_run, strict=True):
        for of in ("ends", "columns"):
            assert getattr(one, of).keys() == getattr(other, of).keys()
            for name, values in getattr(one, of).items():
                np.testing.assert_array_equal(values, getattr(other, of)[name])
    assert sum(watched["used"].asked) > sum(watched["all"].asked) > 0
    with pytest.raises(
        UserError, match=r"--no-model: .* did not ask; leave it out, .* --ask all$"
    ) as told:
        list(ReplayedRun(tmp_path / "alone", asks=False).walked(STUDIED, (0, 1)))
    assert "\n" not in str(told.value)
    assert not (tmp_path / "alone" / replayed_run.MORE).exists()


@pytest.mark.exhaustive
def test_a_trust_study_that_may_not_ask_leaves_out_what_lacks_an_ego(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    evaluate(spec(frozen(8), "all", ("single-local",)), out, lambda done: None)
    monkeypatch.setattr(replayed_run, "open_backend", None)  # nothing opens a model
    source = ReplayedRun(out, asks=False)
    run_bench = pytest.importorskip("harness.extensions.trust.study").run_bench
    bench = run_bench(
        source, "6g", ("linear",), ("liar",), (1 / 3,), (0, 1), tmp_path / "trust", Watched()
    )
    left = np.isnan(bench.at("linear", "liar", 1 / 3).success)
    assert 0 < left.sum() < left.size
    assert np.array_equal(left, np.isnan(bench.at("linear", "liar", 1 / 3).nats))
    assert not np.isnan(bench.alone).any()
    assert f"one of {len(source.left_out)} decision points" in " ".join(bench.caveats)


@pytest.mark.parametrize("ask", some(["used"], exhaustive=["all"]))
def test_how_much_is_asked_is_said_once_and_first(ask: str, tmp_path: Path) -> None:
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    evaluate(
        spec(frozen(1), ask, ("single-local",), "swarm-tiny"), tmp_path / "run", lambda done: None
    )
    watched = Watched()
    list(ReplayedRun(tmp_path / "run", progress=watched).walked(STUDIED[:1], (0,)))
    owed, text, *others = watched.events
    questions = "1 question" if owed == "1" else f"{owed} questions"
    assert f"is asked {questions} now that the run did not ask (about " in text
    assert ("it lacks" in text) == (ask == "used")
    assert others
    assert all(each.isdigit() for each in others)
