"""Mixed swarms: the ego and its helpers have different models, prompts or answer modes."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from evaluating import live_spec_of, run, same_decisions, spec_of
from former import SCENARIO
from run_on_disk import answers_of, damage

from harness.backends import cards
from harness.backends.base import Backend
from harness.backends.card import Card
from harness.backends.registry import open_backend
from harness.coordination.named_points import POINTS
from harness.core.at_once import AtOnce
from harness.core.errors import UserError
from harness.dataset.load import Dataset
from harness.evaluate.agent import Agent
from harness.evaluate.latency import declared
from harness.evaluate.resolve import agents
from harness.evaluate.spec import Spec
from harness.prompts import versions
from harness.runs.folder import read
from harness.runs.records import Answer
from harness.runs.settings import Settings, changed

RULE = "proxy · v2 · json"


def helper(model: str = "proxy", prompt: str = "v2", **asked: Any) -> Agent:
    return Agent(cards.resolve(model), versions.load(prompt), **asked)


def mixed(data: Dataset, *helpers: Agent, model: str = "proxy", **options: Any) -> Spec:
    return spec_of(data, model, helpers=helpers, **options)


def by_id(out: Path, role: str) -> dict[str, Answer]:
    return {answer.id: answer for answer in answers_of(out) if answer.role == role}


@pytest.fixture(scope="module")
def mix(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The proxy as ego, with helpers that stumble."""
    return run(mixed(small, helper("proxy-faulty")), tmp_path_factory.mktemp("mix") / "mix").out


@pytest.fixture(scope="module")
def pure(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Each of the two alone."""
    where = tmp_path_factory.mktemp("pure")
    return {name: run(spec_of(small, name), where / name).out for name in ("proxy", "proxy-faulty")}


def test_each_half_answers_as_it_does_in_a_run_of_its_own(mix: Path, pure: dict[str, Path]) -> None:
    for role, model in (("ego", "proxy"), ("helper", "proxy-faulty")):
        here, there = by_id(mix, role), by_id(pure[model], role)
        both = here.keys() & there.keys()
        assert len(both) > 20
        assert [here[name].raw for name in sorted(both)] == [
            there[name].raw for name in sorted(both)
        ]
    verdicts = {answer.verdict for answer in by_id(mix, "helper").values()}
    assert verdicts == {"strict", "recovered", "failed"}
    assert {answer.verdict for answer in by_id(mix, "ego").values()} == {"strict"}


def test_helpers_like_the_ego_make_no_mix(
    small: Dataset, pure: dict[str, Path], tmp_path: Path
) -> None:
    same = mixed(small, helper(), helper())
    assert same.helpers == ()
    assert same_decisions(run(same, tmp_path / "same").out, pure["proxy"])


def test_a_run_says_who_answered(mix: Path) -> None:
    made = read(mix)
    assert made.manifest.variant.helpers == "proxy-faulty · v2 · json"
    assert str(made.manifest.variant) == f"{RULE} + proxy-faulty · v2 · json"
    assert (
        "--helper-model proxy-faulty --helper-prompt v2 --helper-answer json"
        in made.manifest.command
    )
    agents = {(a.role, made.agent(a)["model"]["name"]) for a in made.answers}
    assert agents == {("ego", "proxy"), ("helper", "proxy-faulty")}
    assert made.manifest.identity["helpers"][0]["engine"] == "proxy"


def test_several_helper_models_take_the_helpers_in_turn(small: Dataset, tmp_path: Path) -> None:
    spec = mixed(small, helper(), helper("proxy-faulty"))
    assert [spec.agent(place) for place in range(5)] == [0, 1, 2, 1, 2]
    made = read(run(spec, tmp_path / "run").out)
    for answers in made.answers_by_scene.values():
        names = [made.agent(a)["model"]["name"] for a in answers]
        assert names == ["proxy", "proxy", "proxy-faulty", "proxy"][: len(names)]
    faulty = {a.viewer for a in made.answers if a.verdict != "strict"}
    assert faulty == {"v3"}


@pytest.mark.slow
def test_who_answered_is_held_to_who_was_asked(
    small: Dataset, tmp_path: Path, harness: Callable[..., tuple[int, str, str]]
) -> None:
    """The answers of one helper model are not stated to be another's, nor the ego's a helper's."""
    spec = mixed(small, helper(), helper("proxy-faulty"), ask="used")
    out = run(spec, tmp_path / "run").out
    assert {1, 2} <= {answer.agent for answer in answers_of(out)}
    assert harness("run", "check", out)[0] == 0

    def swapped(row: dict[str, Any]) -> None:
        row["agent"] = {1: 2, 2: 1}.get(row["agent"], row["agent"])

    damage(out, answer=swapped)
    assert "another agent in" in harness("run", "check", out)[1]
    damage(out, answer=lambda row: row.update(agent=2))
    said = " ".join(harness("run", "check", out)[1].split())
    assert re.search(r"agent 2 of \S+/v1, which states none or another", said)


@pytest.mark.slow
def test_stored_runs_are_mixed_as_their_models_are(
    small: Dataset, mix: Path, pure: dict[str, Path], tmp_path: Path
) -> None:
    """Where neither run came to a decision point, its model is asked."""
    stored = mixed(small, helper(f"replay:{pure['proxy-faulty']}"), model=f"replay:{pure['proxy']}")
    assert same_decisions(run(stored, tmp_path / "stored").out, mix)
    again = spec_of(small, f"replay:{mix}")
    assert same_decisions(run(again, tmp_path / "again").out, mix)


def test_a_stored_run_whose_model_has_changed_is_not_asked_on(
    small: Dataset, pure: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = mixed(small, helper(f"replay:{pure['proxy-faulty']}"), model=f"replay:{pure['proxy']}")
    monkeypatch.setattr("harness.backends.proxy.Proxy.identity", lambda self: {"engine": "another"})
    with pytest.raises(UserError, match="has changed since that run; make the run again"):
        run(stored, tmp_path / "stored")
    assert not (tmp_path / "stored" / "run.json").exists()


@pytest.mark.parametrize(("stated", "dtype"), [("float32", "float32"), ("Q4_1", None)])
def test_a_stored_run_is_asked_on_in_the_number_format_that_it_states(
    small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stated: str, dtype: str | None
) -> None:
    """What a card's `auto` was when the run was made may be another on this processor."""
    formats = list[str | None]()

    def opening(card: Card, *, dtype: str | None, batch_size: AtOnce) -> Backend:
        formats.append(dtype)
        return open_backend(card, batch_size=batch_size)

    identity = {"engine": "proxy", "dtype": stated}
    monkeypatch.setattr("harness.backends.proxy.Proxy.identity", lambda self: identity)
    monkeypatch.setattr("harness.backends.replay.open_backend", opening)
    runs = [run(spec_of(small, name), tmp_path / name).out for name in ("proxy", "proxy-faulty")]
    stored = mixed(small, helper(f"replay:{runs[1]}"), model=f"replay:{runs[0]}")
    run(stored, tmp_path / "stored")
    assert set(formats) == {dtype}


def test_every_agent_takes_its_own_time(small: Dataset, tmp_path: Path) -> None:
    def at(seconds: float) -> Agent:
        agent = helper()
        latency = replace(agent.card.latency, inference_s=seconds)
        return replace(agent, card=replace(agent.card, latency=latency))

    made = run(mixed(small, at(0.3), at(0.2)), tmp_path / "run").manifest.latency
    assert (made.ego_s, made.helper_s, made.helpers_s, made.fusion_s) == (
        0.145,
        0.3,
        (0.3, 0.2),
        0.145,
    )
    decisions = read(tmp_path / "run").decisions
    arrival = {
        m.sender: m.arrival_ms
        for d in decisions.records(0, len(decisions)) for m in d.messages if m.arrival_ms is not None
    }  # fmt: skip
    assert min(arrival["v2"], arrival["v4"]) > arrival["v3"] + 50


def test_times_of_several_helper_models_are_declared_in_turn(small: Dataset) -> None:
    said = declared("ego=0.1,helper=0.2:0.3")
    assert (said.ego_s, said.helper_s, said.helpers_s, said.fusion_s) == (0.1, 0.2, (0.2, 0.3), 0.1)
    with pytest.raises(UserError, match="2 times for 1 helper models; give one, or one each"):
        mixed(small, helper("proxy-faulty"), latency="ego=0.1,helper=0.2:0.3")
    with pytest.raises(UserError, match="ego is needed"):
        declared("ego=0.1:0.2")


@pytest.mark.exhaustive
def test_a_mix_drives_as_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # so that both workers have some
    monkeypatch.setattr("harness.evaluate.run.EPISODES_AT_ONCE", 1)

    def driven(workers: int) -> Path:
        from harness.core.work import tidy
        from harness.evaluate.run import evaluate

        spec = live_spec_of(
            helpers=(helper("proxy-faulty"),), points=(POINTS["6g"],), seeds=(0,), batch_size=4
        )
        out = evaluate(spec, tmp_path / str(workers), lambda done: None, workers=workers).out
        tidy(out)
        return out

    one, two = driven(1), driven(2)
    assert same_decisions(one, two)
    assert {a.verdict for a in by_id(one, "ego").values()} == {"strict"}
    assert {a.verdict for a in by_id(one, "helper").values()} > {"strict"}


@pytest.mark.parametrize(
    ("ego", "helpers", "options", "said"),
    [
        (
            "proxy",
            ("full-view",),
            {},
            "--helper-model: full-view is a driver, which decides for an ego",
        ),
        (
            "local-view",
            ("proxy",),
            {},
            "--model local-view: it is a driver, which asks no helpers; give another model",
        ),
        (
            "proxy",
            ("swarm-tiny",),
            {"device": "cpu", "latency": "measured"},
            "--latency measured: proxy",
        ),
    ],
)
def test_a_mix_that_means_nothing_is_refused(
    ego: str, helpers: tuple[str, ...], options: dict[str, Any], said: str, small: Dataset
) -> None:
    with pytest.raises(UserError) as caught:
        mixed(small, *map(helper, helpers), model=ego, **options)
    assert str(caught.value).startswith(said)


@pytest.mark.parametrize(
    ("command", "typed", "said"),
    [
        ("eval", "--helper-answer readout", 
            "--helper-answer readout: proxy is "
            "no language model; use json"),
        ("drive", "--helper-answer readout", 
            "--helper-answer readout: proxy is "
            "no language model; use json"),
        ("study grid", "--helper-answer readout",
         "--helper-answer readout: proxy is no language model; use json"),
        ("study grid", "--helper-model proxy,proxy", 
            "--helper-model proxy,proxy: "
            "give different names"),
        ("study grid", "--helper-model proxy --helper-model proxy",
         "--helper-model proxy,proxy: give different names"),
        ("eval", 
            "--helper-model full-view "
            "--helper-model proxy", "--helper-model: full-view is a driver"),
        ("eval", "--helper-thinking", "--helper-thinking: proxy cannot think; leave it out"),
        ("eval", "--model swarm-tiny --answer readout --helper-model proxy",
         "helpers: --answer readout: proxy is no language model; use json"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_helper_names_the_option_that_was_typed(
    command: str, typed: str, said: str, harness: Callable[..., Any], small_path: Path
) -> None:
    data = () if command == "drive" else ("--dataset", small_path)
    code, out, err = harness(*command.split(), *data, *typed.split())
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"harness: {said}")


def test_a_fusion_call_takes_messages_of_its_own_form(small: Dataset) -> None:
    from harness.coordination.named_points import named_point

    asks = (named_point("6g:consensus=ego-prompt"),)
    with pytest.raises(
        UserError, match="prompt v2 fuses messages with a distribution, those of paper"
    ):
        mixed(small, helper("swarm-tiny", "paper"), model="swarm-tiny", points=asks)
    with pytest.raises(UserError, match="a readout gives no messages to fuse"):
        mixed(small, helper("swarm-tiny", answer="readout"), model="swarm-tiny", points=asks)


def test_helpers_are_flipped_where_they_read_out() -> None:
    for mode, flips in (("json", False), ("readout", True)):
        read_out = Settings(model="swarm-tiny", prompt="v4", answer="readout", flip=True)
        ego, [helpers] = agents(changed(read_out, {"helper_answer": mode}), SCENARIO)
        assert (ego.flip, helpers.flip) == (True, flips)
        assert helpers.settings().get("flip", False) == flips


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "[helpers]\nmodle = 'proxy'",
            "unknown key in settings stated.toml [helpers] 'modle'; did you mean",
        ),
        ("[helpers]\nmodel = 3", "settings stated.toml: helpers.model = 3; allowed: str"),
        (
            "[helpers]\nthinking = 'no'",
            "settings stated.toml: helpers.thinking = 'no'; allowed: bool",
        ),
        (
            "[helpers]\nmodel = ['proxy']",
            "settings stated.toml: helpers.model = ('proxy',); allowed: str",
        ),
        ("helpers = 3", "settings stated.toml: helpers = 3; allowed: a table"),
        (
            "helper_model = 'proxy'",
            "settings stated.toml: helper_model stands in a table; write model below a line "
            "[helpers] instead",
        ),
    ],
)
def test_what_is_no_setting_of_helpers_in_a_file_is_one_line(
    text: str, said: str, harness: Callable[..., Any]
) -> None:
    Path("stated.toml").write_text(text)
    code, out, err = harness("eval", "stated.toml")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"harness: {said}")


@pytest.mark.parametrize(
    ("name", "other"), [("model", "swarm-tiny"), ("prompt", "v4"), ("answer", None)]
)
def test_a_run_whose_settings_say_otherwise_than_its_helpers_is_refused(
    name: str, other: str | None, mix: Path, tmp_path: Path, harness: Callable[..., Any]
) -> None:
    shutil.copytree(mix, tmp_path / "copy")
    file = tmp_path / "copy" / "run.json"
    record = json.loads(file.read_text())
    record["settings"]["helpers"][name] = other
    file.write_text(json.dumps(record))
    code, _, err = harness("run", "check", tmp_path / "copy")
    assert (code, err.count("\n")) == (2, 1)
    assert f"its settings have helpers.{name} {other}, and beside them it is" in err
