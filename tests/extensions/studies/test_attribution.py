"""`harness study attribute`: what answers and decisions become without one object,
or one message.
"""

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import Watched, decisions, run, says, spec_of
from msgspec import structs
from reading import unpacked
from run_on_disk import answers_of

from harness.backends import cards
from harness.backends.base import Completion, Request
from harness.coordination.consensus import Fused, linear_pool
from harness.coordination.named_points import named_point
from harness.coordination.rules import RULES
from harness.core.errors import UserError
from harness.core.process import Stop
from harness.core.statistics import Estimate
from harness.dataset.load import Dataset, find, load
from harness.evaluate import run as evaluation
from harness.evaluate.agent import Agent
from harness.extensions.studies.attribution import study as attribution
from harness.extensions.studies.attribution.record import Attribution, LeftOut, of_run
from harness.extensions.studies.attribution.study import Row, attribute, draw, headline, rows
from harness.prompts.versions import listed
from harness.prompts.versions import load as prompt
from harness.report.decisions import Decisions
from harness.report.runs import gather
from harness.runs import folder
from harness.runs.records import Decision
from harness.studies import replayed_run
from harness.studies.axes import Setting
from harness.studies.replayed_run import ReplayedRun
from harness.world.perception.graph import scene_graph

Said = tuple[int, str, str]
SURE, UNSURE = (0.8, 0.15, 0.05), (0.3, 0.4, 0.3)
SIXG = named_point("6g:loss=0")


class Judging:
    """Says SLOWER where it is shown a conflict; fused, where the message of v3 is among several."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        self.asked += [request.id for request in requests]
        return [
            Completion(r.id, says(self.p(r), r.role), None, None, "stop", None, 1) for r in requests
        ]

    def p(self, request: Request) -> tuple[float, ...]:
        if "+" in request.id:
            return (0.9, 0.1, 0.0) if "+v3" in request.id else (0.0, 0.2, 0.8)
        text = request.messages[1]["content"].partition("CONFLICTS")[2]
        if request.role == "ego":
            return UNSURE
        return UNSURE if "none in sight" in text else SURE

    def identity(self) -> dict[str, Any]:
        return {"engine": "judging"}


@dataclass(frozen=True)
class Smooth:
    """The mean of what it would do now and of what it did at the last step."""

    def start(self, batch: tuple[int, ...], helpers: int, actions: int) -> Any:
        return np.full((*batch, actions), np.nan)

    def fuse(self, messages: Any, state: Any) -> Fused:
        now = linear_pool(messages.intents, messages.weights)
        policy = np.where(np.isnan(state), now, (now + state) / 2)
        return Fused(policy, messages.weights, policy)


@pytest.fixture
def judging(monkeypatch: pytest.MonkeyPatch) -> Judging:
    backend = Judging()
    for module in (evaluation, replayed_run):
        monkeypatch.setattr(module, "open_backend", lambda *_, **__: backend)
    monkeypatch.setattr(replayed_run, "default_file", lambda: None)
    monkeypatch.setitem(RULES._loaded, "smooth", Smooth())
    return backend


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where runs are that several tests copy."""
    return tmp_path_factory.mktemp("kept")


@pytest.fixture
def made(small: Dataset, kept: Path, tmp_path: Path, judging: Judging) -> Callable[..., Path]:
    """A finished run of it under some conditions."""

    def make(*points: Any, ask: str = "all") -> Path:
        points = points or (SIXG,)
        once = kept / " ".join([ask, *(point.name for point in points)])
        if not once.exists():
            run(spec_of(small, "swarm-tiny", "v4", points=points, latency="paper", ask=ask), once)
            judging.asked.clear()
        return Path(shutil.copytree(once, tmp_path / f"run-{ask}"))

    return make


@pytest.mark.slow
def test_a_graph_without_an_object_is_one_that_no_sensor_reported(small: Dataset) -> None:
    """Its line and its conflict go, what it hid is seen, and nothing else changes."""
    opened = 0
    for scene in small.scenes(small.courses())[::4]:
        for viewer, graph in scene.graphs.items():
            for item in (node.id for node in graph.nodes):
                less = scene_graph(small.scenario, scene.state, viewer, [item])
                assert less.nodes == tuple(node for node in graph.nodes if node.id != item)
                assert less.conflicts == tuple(c for c in graph.conflicts if c.vehicle != item)
                for before, after in zip(graph.sectors, less.sectors, strict=True):
                    assert after.seen_share >= before.seen_share
                    assert item not in after.by
                    opened += after.seen_share > before.seen_share
                alike = structs.replace(
                    less, nodes=graph.nodes, conflicts=graph.conflicts, sectors=graph.sectors
                )
                assert alike == graph
    assert opened > 10


@pytest.mark.slow
def test_an_object_is_left_out_on_the_layouts_own_road(tmp_path: Path) -> None:
    crossing = load(find("sumo-crossing-v1")).of_episodes(frozenset({9}))
    done = run(spec_of(crossing, prompt="v4", points=(SIXG,), seeds=(0,)), tmp_path / "run")
    found = attribute(ReplayedRun(done.out), SIXG.name, 3, 0)
    assert {each.role for each in found.left_out} >= {"ego", "helper"}


@pytest.mark.slow
def test_each_listed_object_moves_what_a_viewer_says_of_conflicts(
    made: Callable[..., Path], small: Dataset
) -> None:
    """Only the one vehicle in conflict turns a helper, from (.8, .15, .05) to (.3, .4, .3): 0.5."""
    found = attribute(ReplayedRun(made()), SIXG.name, 12, 0)
    objects = [each for each in found.left_out if each.role != "fusion"]
    expected = {}
    for scene in {each.scene for each in objects}:
        graphs = small.scene(scene).graphs
        for viewer, graph in graphs.items():
            conflicts = [c.vehicle for c in graph.conflicts]
            for node in (graph.nodes[n] for n in listed(graph, prompt("v4").max_objects)):
                alone = viewer != "v1" and set(conflicts) == {node.id}
                kind = "other object"
                if node.id in conflicts:
                    seen = node.id in {n.id for n in graphs["v1"].nodes}
                    kind = f"{'seen' if seen else 'hidden'} conflict vehicle"
                expected[scene, viewer, node.id] = (kind, 0.5 if alone else 0.0)
    assert {
        (e.scene, e.viewer, e.item): (e.kind, pytest.approx(e.shift)) for e in objects
    } == expected
    turned = [e for e in objects if e.shift]
    assert turned
    assert {(e.action, e.instead, round(e.change or 0, 9)) for e in turned} == {
        ("SLOWER", "IDLE", -0.5)
    }
    kinds = {row.kind: row for row in rows(found) if row.role == "helper"}
    hidden = [e for e in objects if e.kind == "hidden conflict vehicle"]
    assert kinds["hidden conflict vehicle"].shift.n == len(hidden)
    assert kinds["hidden conflict vehicle"].shift.value == pytest.approx(
        np.mean([e.shift for e in hidden])
    )
    assert kinds["other object"].flips.value == kinds["other object"].shift.value == 0.0


def by_hand(each: LeftOut, d: Decision, own: dict[str, Sequence[float]]) -> Any:
    """A linear pool without one: the weights of the others share what is left."""
    [weight] = [m.weight for m in d.messages if m.sender == each.item]
    assert weight
    return (np.array(d.fused) - weight * np.array(own[each.item])) / (1 - weight)


def of_decisions(path: Path, name: str, found: Attribution) -> Iterator[Any]:
    """What was left out of fusion, the decision, and the answers of its decision point."""
    made = {(d.scene, d.seed): d for d in decisions(path, name)}
    answers = folder.read(path).answers_by_scene
    for each in found.left_out:
        if each.role == "fusion":
            assert each.seed is not None
            own = {a.viewer: a.intent for a in answers[each.scene] if not a.heard and a.intent}
            yield each, made[each.scene, each.seed], own


@pytest.mark.slow
def test_a_message_left_out_of_a_pool_is_exact_and_asks_nobody(
    made: Callable[..., Path], judging: Judging
) -> None:
    path = made(SIXG)
    found = attribute(ReplayedRun(path), SIXG.name, 14, 0)
    assert not [name for name in judging.asked if "~without" not in name]
    several = list(of_decisions(path, SIXG.name, found))
    assert len(several) > 30
    for each, d, own in several:
        less = by_hand(each, d, own)
        assert each.shift == pytest.approx(np.abs(less - d.fused).sum() / 2, abs=1e-4)
        assert each.instead == folder.read(path).actions[int(less.argmax())]
        assert each.action == d.action
    moved = {row.kind: row.shift.value for row in rows(found) if row.role == "fusion"}
    assert moved["helper with sight"] > moved["helper without sight"]


@pytest.mark.exhaustive
def test_helpers_that_were_never_asked_are_asked_first(
    made: Callable[..., Path], judging: Judging
) -> None:
    point = named_point("v2x:max_helpers=1")
    everybody = attribute(ReplayedRun(made(point)), point.name, 6, 0)
    path = made(point, ask="used")
    watched = Watched()
    assert attribute(ReplayedRun(path, progress=watched), point.name, 6, 0) == everybody
    missing = [name for name in judging.asked if "~without" not in name]
    assert missing
    assert {answer.id for answer in folder.read(path).answers}.isdisjoint(missing)
    assert [
        f"is asked {len(judging.asked)} questions now" in text
        for text in watched.events
        if not text.isdigit()
    ] == [True]


@pytest.mark.exhaustive
def test_a_rule_with_memory_keeps_it(made: Callable[..., Path]) -> None:
    """It is the mean of now and of what it remembers,
    so half of what moves now moves it after step 0.
    """
    plain, smooth = SIXG, named_point("6g:loss=0,consensus=smooth")
    path = made(plain, smooth)
    found = attribute(ReplayedRun(path), smooth.name, 14, 0)
    steps = set()
    for each, d, own in of_decisions(path, smooth.name, found):
        weights = {m.sender: m.weight or 0.0 for m in d.messages} | {"v1": d.own_weight or 0.0}
        now = np.sum([w * np.array(own[v]) for v, w in weights.items()], axis=0)
        less = (now - weights[each.item] * np.array(own[each.item])) / (1 - weights[each.item])
        half = 1 if d.step == 0 else 0.5
        assert each.shift == pytest.approx(half * np.abs(less - now).sum() / 2, abs=1e-4)
        steps.add(d.step)
    assert len(steps) > 2


@pytest.mark.slow
def test_a_fusion_call_is_made_again_without_the_message(
    made: Callable[..., Path], judging: Judging
) -> None:
    """With v3's message it says SLOWER, else FASTER; with nobody's, the ego's own IDLE."""
    fusion = named_point("6g:loss=0,consensus=ego-prompt")
    path = made(fusion)
    found = attribute(ReplayedRun(path), fusion.name, 10, 0)
    called = [name for name in judging.asked if "+" in name]
    assert called
    for each, d, _ in of_decisions(path, fusion.name, found):
        heard = {m.sender for m in d.messages if m.on_time} - {each.item}
        with_v3 = "v3" in {*heard, each.item}
        assert each.action == ("SLOWER" if with_v3 else "FASTER")
        assert each.instead == ("SLOWER" if "v3" in heard else "FASTER" if heard else "IDLE")
    again = judging.asked.copy()
    assert attribute(ReplayedRun(path), fusion.name, 10, 0) == found
    assert judging.asked == again


def test_the_draw_is_no_choice_and_a_larger_one_has_the_smaller(made: Callable[..., Path]) -> None:
    source = ReplayedRun(made(named_point("single-local"), SIXG))
    came = {(d.scene, d.seed) for d in decisions(source.run.path, SIXG.name)}
    some, of = draw(source, SIXG.name, 10, 0)
    more, _ = draw(source, SIXG.name, 20, 0)
    assert len(some) == 10
    assert of == len({scene for scene, _ in came})
    assert list(more)[:10] == list(some)
    assert more.items() >= some.items()
    assert came >= set(more.items())
    assert {seed for _, seed in more.items()} == {0, 1}
    assert set(draw(source, SIXG.name, 10, 1)[0]) != set(some)
    assert len(draw(source, SIXG.name, 10**6, 0)[0]) == of


@pytest.mark.exhaustive
def test_a_killed_one_goes_on_and_asks_nothing_twice(
    made: Callable[..., Path], judging: Judging
) -> None:
    class Killed(Stop):
        pass

    def die(count: int) -> None:
        raise Killed

    path = made()
    with pytest.raises(Killed):
        attribute(ReplayedRun(path, progress=Watched(die)), SIXG.name, 14, 0)
    before = list(judging.asked)
    assert len(before) == 64
    found = attribute(ReplayedRun(path), SIXG.name, 14, 0)
    assert len(judging.asked) == len(set(judging.asked)) > 100
    assert {
        f"{e.scene}~without-{e.item}/{e.viewer}" for e in found.left_out if e.role != "fusion"
    } == set(judging.asked)


@pytest.mark.slow
def test_an_answer_that_fails_is_counted_and_moves_nothing(
    made: Callable[..., Path], judging: Judging, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = made()
    monkeypatch.setattr(judging, "p", lambda request: (float("nan"),) * 3)
    found = attribute(ReplayedRun(path), SIXG.name, 5, 0)
    objects = [e for e in found.left_out if e.role != "fusion"]
    assert {(e.instead, e.change, e.shift) for e in objects} == {(None, None, None)}
    for row in rows(found):
        if row.role != "fusion":
            assert (row.shift.n, row.flips.n, row.failed.value) == (0, 0, 1.0)
    said = headline(rows(found))
    assert said.startswith("What moves answers most is not clear: ")
    assert "overlap: message of a helper with" in said
    sure = Row("ego", "car", Estimate(0.9, 0.8, 0.95, 9, 0), *[Estimate(0.5, 0.2, 0.8, 9, 0)] * 2)
    assert headline([*rows(found), sure]).startswith(
        "The car in the ego's prompt moves answers most: "
    )


@pytest.mark.slow
def test_the_decisions_view_has_what_was_left_out_there_alone(made: Callable[..., Path]) -> None:
    path = made()
    bare = [detail["runs"][0] for detail in unpacked(Decisions(gather([path])))]
    assert not any("left_out" in each for each in bare)
    found = attribute(ReplayedRun(path), SIXG.name, 6, 0)
    attribution.write(found, path)
    shown = Decisions(gather([path]))
    details = dict(zip(shown.ids, (d["runs"][0] for d in unpacked(shown)), strict=True))
    assert {scene for scene, d in details.items() if "left_out" in d} == {
        e.scene for e in found.left_out
    }
    for scene, detail in details.items():
        here = detail.get("left_out", [])
        assert len(here) == sum(e.scene == scene for e in found.left_out)
        shifts = [e["shift"] for e in here]
        assert shifts == sorted(shifts, reverse=True)
        assert {e["condition"] for e in here} <= {SIXG.name}


@pytest.mark.slow
def test_a_driver_is_asked_for_the_ego_alone(small: Dataset, tmp_path: Path) -> None:
    point = named_point("single-local")
    done = run(spec_of(small, "local-view", points=(point,), seeds=(0,)), tmp_path / "run")
    found = attribute(ReplayedRun(done.out), point.name, 20, 0)
    assert {e.role for e in found.left_out} == {"ego"}
    assert "seen conflict vehicle in the ego's prompt" in headline(rows(found))


@pytest.mark.slow
def test_what_cannot_be_asked_otherwise_is_refused(small: Dataset, tmp_path: Path) -> None:
    points = (named_point("single-local"),)
    proxy = run(spec_of(small, points=points, seeds=(0,)), tmp_path / "proxy").out
    replayed = run(
        spec_of(small, f"replay:{proxy}", points=points, seeds=(0,)), tmp_path / "replay"
    ).out
    with pytest.raises(
        UserError, match="no answers to other questions; give the run that it replays"
    ):
        attribute(ReplayedRun(replayed), "single-local", 5, 0)
    truth = run(spec_of(small, "full-view", points=points, seeds=(0,)), tmp_path / "truth").out
    with pytest.raises(UserError, match="full-view reads the truth and no prompt"):
        attribute(ReplayedRun(truth), "single-local", 5, 0)
    with pytest.raises(UserError, match="unknown condition '6g'"):
        attribute(ReplayedRun(proxy), "6g", 5, 0)


@pytest.mark.slow
def test_no_object_can_be_left_out_of_a_picture(
    small: Dataset, tmp_path: Path, judging: Judging
) -> None:
    points, card = (named_point("single-local"),), cards.load("swarm-tiny-vl")
    spec = spec_of(small, "swarm-tiny", "v4", points=points, seeds=(0,), latency="paper")
    ego = Agent(card, prompt("v7"))
    seen = run(replace(spec, ego=ego), tmp_path / "seen").out
    with pytest.raises(
        UserError, match="swarm-tiny-vl was shown pictures by prompt v7, and no object can be"
    ):
        attribute(ReplayedRun(seen), "single-local", 2, 0)
    text = run(replace(spec, ego=replace(ego, image="none")), tmp_path / "text").out
    assert attribute(ReplayedRun(text), "single-local", 2, 0).left_out


@pytest.mark.exhaustive
def test_typed_it_says_what_moves_most_in_eighty_columns(
    harness: Callable[..., Said], small: Dataset, tmp_path: Path
) -> None:
    control = named_point("6g:loss=0,messages=blind")
    run(spec_of(small, limit=2, points=(control, SIXG), seeds=(0,)), tmp_path / "run")
    code, out, _ = harness("study", "attribute", "run", "--sample", "10", "--verbose")
    assert code == 0
    assert max(map(len, out.splitlines())) <= 80
    assert out.splitlines()[1].startswith(("The ", "What moves answers most is not clear: "))
    assert "10 of the " in out
    assert "decision points of 6g:loss=0, drawn with sample seed 0" in " ".join(out.split())
    told = json.loads(harness("study", "attribute", "run", "--sample", "10", "--json")[1])
    kept = of_run(folder.read(tmp_path / "run"))
    assert kept
    assert told["decision_points"] == kept.decision_points == 10
    assert sum(row["shift"]["n"] for row in told["rows"]) == len(kept.left_out)
    assert harness(
        "study", "attribute", "run", "--sample", "10", "--condition", control.name, "--quiet"
    )[:2] == (0, "")
    assert harness("report", "run")[0] == 0
    page = Path("run/report.html").read_text()
    kept = of_run(folder.read(tmp_path / "run"))
    assert kept
    assert (
        f"moved the answers at {kept.decision_points} decision points under {control.name}" in page
    )


def test_a_broken_file_is_one_line(
    harness: Callable[..., Said], small: Dataset, tmp_path: Path
) -> None:
    run(spec_of(small, points=(SIXG,), seeds=(0,)), tmp_path / "run")
    (tmp_path / "run/attribution.json").write_text("{")
    code, _, err = harness("report", "run")
    assert (code, err.count("\n")) == (2, 1)
    assert "attribution.json is broken" in err


def test_other_readers_do_not_mind_the_file(made: Callable[..., Path], tmp_path: Path) -> None:
    path = made()
    before = answers_of(path)
    attribution.write(attribute(ReplayedRun(path), SIXG.name, 3, 0), path)
    assert answers_of(path) == before
    copied = Path(shutil.copytree(path, tmp_path / "copy"))
    [[walked]] = ReplayedRun(copied).walked([Setting("6g", SIXG, 4)], (0, 1))
    assert not np.isnan(walked.ends["success_rate"]).any()
