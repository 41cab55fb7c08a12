"""ego-prompt: the ego's model merges the messages that arrived and answers again."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluating import FILES, Scripted, ask, decisions, figure, rows_of, run, says, spec_of, sure
from harness.evaluate.again import Asking
from harness.evaluate.evaluate import Evaluated, evaluate

from harness.coordination.channel import Draws
from harness.coordination.operating_point import POINTS, named_point
from harness.core.errors import UserError
from harness.core.files import digest
from harness.dataset.load import Dataset
from harness.evaluate import merging
from harness.prompts.versions import load as prompt
from harness.studies.axes import Setting
from harness.studies.stored import Stored

MERGE = named_point("6g:consensus=ego-prompt")
LANGUAGE_MODEL = "swarm-tiny"  # its card: answers come from a script, or from itself


def clear(n: int, helpers: int = 3) -> Draws:
    """Every message crosses."""
    return Draws(np.full((n, helpers, 2), 0.9), np.zeros((n, helpers)))


def first_scene(small: Dataset) -> Dataset:
    return replace(small, scenes=small.scenes[:1])


def test_it_is_asked_with_the_messages_of_those_it_heard(small: Dataset, tmp_path: Path) -> None:
    """v2 and v4 are heard, v3's reply is lost: two lines of messages, with intent, risk and evidence."""
    data = first_scene(small)
    [scene] = data.scenes
    spec = spec_of(data, LANGUAGE_MODEL, points=(MERGE,), seeds=(0,))
    lines = {
        f"{scene.id}/v1": says((0.3, 0.4, 0.3)),
        f"{scene.id}/v2": says((0.8, 0.1, 0.1), "helper").replace("clear", "one comes fast"),
    }
    known = replace(ask(spec, Scripted(lines), tmp_path), inference_s=np.full((1, 4), 0.1))
    draws = clear(1)
    draws.link[0, 1] = 0.0
    codes = merging.delivered(known, [MERGE, POINTS["v2x"]], [draws])
    assert codes.tolist() == [0b101]
    [request] = merging.requests(spec, known, codes)
    assert request.id == f"{scene.id}/v1+v2+v4"
    assert request.role == "ego"
    text = request.messages[1]["content"]
    [_, told] = text.split("MESSAGES")
    assert "v2 low 0.80 0.10 0.10 one comes fast" in told
    assert "v4 low 0.00 1.00 0.00 clear" in told
    assert "v3" not in told


def test_each_set_of_messages_is_asked_once_whatever_delivers_it(small: Dataset, tmp_path: Path) -> None:
    unsure = {f"{s.id}/v1": says((0.3, 0.4, 0.3)) for s in small.scenes}
    spec = spec_of(small, LANGUAGE_MODEL, points=(MERGE,))
    n = len(small.scenes)
    known = replace(ask(spec, Scripted(unsure), tmp_path), inference_s=np.full((n, 4), 0.1))
    all_cross = clear(n)
    slow = named_point("v2x:consensus=ego-prompt,window_s=0.4")
    once = merging.delivered(known, [MERGE], [all_cross])
    assert len(once) == n
    assert merging.delivered(known, [MERGE, slow], [all_cross, all_cross]).tolist() == once.tolist()
    nobody = Draws(np.zeros((n, 3, 2)), all_cross.jitter)
    assert merging.delivered(known, [MERGE], [nobody]).size == 0


def test_who_was_heard_has_one_code_a_decision() -> None:
    heard = np.array([[False] * 3, [True, False, True], [True] * 3])
    codes = merging.codes_of(heard)
    assert codes.tolist() == [0, 8 + 5, 16 + 7]
    assert [merging.places_of(code, 3) for code in codes.tolist()] == [[], [1, 3], [1, 2, 3]]


def test_a_set_that_was_never_asked_about_is_no_guess(small: Dataset) -> None:
    spec = spec_of(first_scene(small), LANGUAGE_MODEL)
    nothing = merging.merged(spec, np.array([5]), [answer("v1")], np.array([0.1]))
    with pytest.raises(LookupError):
        nothing(np.array([[True, True, False]]))


def answer(raw: str) -> dict[str, Any]:
    return {"raw": raw, "finish_reason": "stop", "error": None}


def test_its_answers_keep_their_place_and_a_failed_one_says_so(small: Dataset) -> None:
    spec = spec_of(small, LANGUAGE_MODEL)
    codes = np.array([1 << 3 | 2, 4 << 3 | 7])
    second = merging.merged(spec, codes, [answer(sure("SLOWER")), answer("no idea")], np.array([0.1, 0.2]))
    heard = np.zeros((6, 3), dtype=bool)
    heard[1, 1] = heard[4] = True
    intents, seconds = second(heard)
    assert intents[1].tolist() == [1.0, 0.0, 0.0]
    assert np.isnan(intents[[0, 2, 3, 4, 5]]).all()
    assert seconds[[1, 4]].tolist() == [0.1, 0.2]
    assert [p.verdict for p in second.parsed] == ["strict", "failed"]


@pytest.mark.parametrize(
    ("model", "options", "said"),
    [
        ("proxy", {}, "proxy is no language model and cannot merge messages"),
        ("cruise", {}, "cruise is no language model"),
        (LANGUAGE_MODEL, {"answer": "readout"}, "a readout gives no messages to merge; use --answer json"),
    ],
)
def test_who_can_merge_nothing_is_told_so(
    model: str, options: dict[str, Any], said: str, small: Dataset
) -> None:
    with pytest.raises(UserError, match=said):
        spec_of(small, model, points=(MERGE,), **options)


# -- with the model that ships --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def done(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Evaluated:
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    points = (POINTS["single-local"], POINTS["6g"], MERGE)
    spec = spec_of(small, LANGUAGE_MODEL, points=points, latency="paper")
    return run(spec, tmp_path_factory.mktemp("merging") / "run")


def test_it_pays_a_second_inference_where_it_heard_somebody(done: Evaluated) -> None:
    """The paper's 145 ms twice and the exchange between; the same where nobody was asked."""
    rules, merged = (decisions(rows_of(done.out), name) for name in ("6g", MERGE.name))
    assert any(d["triggered"] for d in merged)
    for rule, again in zip(rules, merged, strict=True):
        heard = any(m["on_time"] for m in again["messages"])
        assert again["messages"] == [{**m, "weight": None} for m in rule["messages"]] or not heard
        assert again["latency_ms"] == pytest.approx(rule["latency_ms"] + 145 * heard)
        if not heard:
            assert again["fused"] == rule["fused"]
    assert figure(done, MERGE.name, "fusion_ms").value > 0
    assert figure(done, "6g", "fusion_ms").value == 0


def test_the_policy_is_what_it_answered_and_the_record_has_it(done: Evaluated, small: Dataset) -> None:
    again = 0
    for row, scene in zip(rows_of(done.out), small.scenes, strict=True):
        for d in row["decisions"]:
            heard = [m["from"] for m in d["messages"] if m["on_time"]]
            if d["condition"] == MERGE.name and heard:
                said = row["merged"]["+".join(["v1", *heard])]
                assert d["fused"] == pytest.approx(said["intent"])
                again += 1
        for key, said in row.get("merged", {}).items():
            heard = [
                {"sender": v, "intent": row["answers"][v]["intent"], **row["answers"][v]["message"]}
                for v in key.split("+")[1:]
            ]
            graph = scene.record["graphs"]["v1"]
            assert said["prompt_sha256"] == digest(prompt("v2").render(graph, small.actions, heard))
    assert again > 10


def test_a_replay_and_another_batch_size_score_the_same(
    done: Evaluated, small: Dataset, tmp_path: Path
) -> None:
    points = (POINTS["single-local"], POINTS["6g"], MERGE)
    replayed = run(spec_of(small, f"replay:{done.out}", points=points, latency="paper"), tmp_path / "replay")
    three = run(spec_of(small, LANGUAGE_MODEL, points=points, latency="paper", batch_size=3), tmp_path / "3")
    for twin in (replayed, three):
        columns = ["condition", "metric", "value", "ci_low", "ci_high", "n"]
        assert twin.summary[columns].equals(done.summary[columns])


def test_killed_among_the_second_answers_it_goes_on(done: Evaluated, small: Dataset, tmp_path: Path) -> None:
    points = (POINTS["single-local"], POINTS["6g"], MERGE)
    spec = spec_of(small, LANGUAGE_MODEL, points=points, latency="paper")

    class Killed(BaseException):
        pass

    def die(count: int) -> None:
        raise Killed

    with pytest.raises(Killed):
        evaluate(spec, tmp_path / "run", False, lambda n: None, more=die)
    run(spec, tmp_path / "run", resume=True)
    for file in FILES:
        assert (tmp_path / "run" / file).read_bytes() == (done.out / file).read_bytes()


def test_a_sweep_asks_what_the_run_has_not_and_asks_it_once(done: Evaluated) -> None:
    source = Stored(done.out)
    same = Setting("6g", MERGE, 4)
    asked: list[int] = []
    source.prepare([same], source.seeds, Asking(asked.append, lambda n: None))
    assert asked == [], "the run's own seeds delivered nothing else"
    made = [next(source.scored(MERGE, 4, seed))[1].verdict.success.mean() for seed in source.seeds]
    assert np.mean(made) == pytest.approx(figure(done, MERGE.name, "success_rate").value)
    fewer = Setting("6g", MERGE, 2)
    source.prepare([same, fewer], source.seeds, Asking(asked.append, lambda n: None))
    assert asked[0] > 0
    again: list[int] = []
    Stored(done.out).prepare([same, fewer], source.seeds, Asking(again.append, lambda n: None))
    assert again == []


def test_a_run_whose_prompt_has_changed_is_not_asked_more(done: Evaluated) -> None:
    source = Stored(done.out)
    source.run.config["prompt"]["sha256"] = "0" * 64
    with pytest.raises(UserError, match="prompt v2 has changed since"):
        source.prepare([Setting("6g", MERGE, 3)], source.seeds, Asking())
