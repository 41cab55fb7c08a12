"""Examples of a prompt version: earlier turns of the chat,
from train seeds and never from what is asked.
"""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from evaluating import Scripted, live_spec_of, run, scenes_of, spec_of, with_ego
from graphs import ACTIONS, CAR, COMING, STANDING, TRUCK, graph
from tiers import some

from harness.backends import cards
from harness.backends.registry import open_backend
from harness.coordination.named_points import POINTS
from harness.core.errors import UserError
from harness.core.resources import folder
from harness.dataset.load import Dataset, load
from harness.evaluate.agent import example_actions
from harness.evaluate.answers import answer_of
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.live_world import LiveSource
from harness.evaluate.requests import fusion_request, requests
from harness.evaluate.spec import Spec
from harness.prompts import difference
from harness.prompts import versions as prompts
from harness.prompts.examples import EXAMPLES, Example, Examples, read, text_of
from harness.world import scenarios

Said = tuple[int, str, str]
Harness = Callable[..., Said]
CROSSING = scenarios.get(scenarios.DEFAULT)


SEES, STANDS = graph("ego", [CAR, TRUCK], [COMING]), graph("ego", [TRUCK], [STANDING])
HELPS = graph("helper", [CAR], [COMING])
YIELD = '{"action_distribution":{"SLOWER":0.90,"IDLE":0.10,"FASTER":0.00}}'
GO = '{"action_distribution":{"SLOWER":0.00,"IDLE":0.25,"FASTER":0.75}}'
WARN = f'{{"evidence":"v2 from left","risk":"high",{YIELD[1:]}'
SHOWN = Examples(
    scenarios.DEFAULT,
    (Example(100_007, SEES, YIELD), Example(100_009, STANDS, GO)),
    (Example(100_007, HELPS, WARN),),
)


@pytest.fixture
def draft(tmp_path: Path) -> Callable[[Any], prompts.Prompt]:
    """`mine`, which is `v2` with these examples."""
    where = tmp_path / "prompts"
    shutil.copytree(folder("prompts") / "v2", where / "mine")

    def written(shown: Any) -> prompts.Prompt:
        text = shown if isinstance(shown, str) else json.dumps(shown)
        (where / "mine" / EXAMPLES).write_text(text, encoding="utf-8")
        return prompts.load("mine", where)

    return written


def with_examples(spec: Spec, shown: Examples = SHOWN) -> Spec:
    return with_ego(spec, prompt=replace(spec.ego.prompt, examples=shown))


# -- what a model is sent --------------------------------------------------------------------------


def test_they_are_turns_between_the_systems_message_and_the_question(draft: Any) -> None:
    mine, plain = draft(text_of(SHOWN)), prompts.load("v2")
    asked = graph("ego", [CAR], [])
    [system, question] = plain.render(asked, ACTIONS, (), CROSSING.prompt_words)
    [_, first], [_, second] = (
        plain.render(g, ACTIONS, (), CROSSING.prompt_words) for g in (SEES, STANDS)
    )
    assert mine.render(asked, ACTIONS, (), CROSSING.prompt_words) == (
        system,
        first, {"role": "assistant", "content": YIELD},
        second, {"role": "assistant", "content": GO},
        question,
    )  # fmt: skip
    assert [m["content"] for m in mine.render(HELPS, ACTIONS) if m["role"] == "assistant"] == [WARN]


def test_a_version_without_them_is_what_it_was(draft: Any) -> None:
    """Its digest is over its three files; with them it is another."""
    mine = draft(text_of(SHOWN))
    assert mine.examples == SHOWN
    without = prompts.load("v2")
    assert without.examples is None
    assert mine.sha256 != without.sha256
    other = draft(text_of(replace_answer(SHOWN, GO)))
    assert other.sha256 != mine.sha256


def replace_answer(shown: Examples, answer: str) -> Examples:
    first, *rest = shown.ego
    return Examples(
        shown.scenario, (Example(first.layout_seed, first.graph, answer), *rest), shown.helper
    )


def test_a_fusion_call_has_them_before_its_question_alone(small: Dataset) -> None:
    spec, scene = with_examples(spec_of(small)), scenes_of(small)[0]
    asked = list(requests(spec, [scene]))
    answers = {r.id.partition("/")[2]: answer_of(r, Scripted({}).complete([r])[0]) for r in asked}
    chat = fusion_request(spec, scene, answers, scene.viewers[1:]).messages
    assert [m["role"] for m in chat] == ["system", *["user", "assistant"] * 2, "user"]
    assert ["MESSAGES" in m["content"] for m in chat if m["role"] == "user"] == [False, False, True]


def test_in_a_read_out_every_question_asks_for_a_letter_and_every_example_says_one(
    small: Dataset,
) -> None:
    """SLOWER is A, IDLE B and FASTER C:
    an example says the action that its answer is likeliest to take.
    """
    spec = with_examples(with_ego(spec_of(small, "swarm-tiny"), answer="readout"))
    ego, helper = list(requests(spec, scenes_of(small)[:1]))[:2]
    question = "Answer with one letter: A SLOWER, B IDLE, C FASTER."
    for request, letters in ((ego, ["A", "C"]), (helper, ["A"])):
        assert [m["content"] for m in request.messages if m["role"] == "assistant"] == letters
        asked = [m["content"] for m in request.messages if m["role"] == "user"]
        assert all(text.endswith(f"\n{question}") and text.count(question) == 1 for text in asked)


def test_free_and_constrained_answers_have_the_same_chat(small: Dataset) -> None:
    spec = with_examples(spec_of(small, "swarm-tiny"))
    free, constrained = (
        [r.messages for r in requests(with_ego(spec, answer=how), scenes_of(small)[:2])]
        for how in ("json", "constrained")
    )
    assert free == constrained


# -- what is refused -------------------------------------------------------------------------------

LINE = {"layout_seed": 100_007, "graph": SEES.plain(), "answer": YIELD}
FILE = {"scenario": scenarios.DEFAULT, "ego": [LINE], "helper": []}


@pytest.mark.parametrize(
    ("shown", "said"),
    [
        ({**FILE, "ego": [LINE, {**LINE, "layout_seed": 7}]},
         "ego example 2 is of layout seed 7; examples come from train seeds alone, 100000 to "
         "199999"),
        ({**FILE, "ego": [{**LINE, "layout_seed": 200_000}]}, 
            "examples come from "
            "train seeds alone"),
        ({**FILE, "ego": [{**LINE, "layout_seed": -1}]}, "examples come from train seeds alone"),
        ({**FILE, "ego": [], "helper": [LINE]}, 
            "helper example 1 has the graph "
            "of a viewer whose role is"),
        ({**FILE, "ego": [{**LINE, "graph": {**SEES.plain(), "nodes": 3}}]}, 
            "[ego.0.graph]: nodes = 3"),
        ({**FILE, "ego": [{**LINE, "graph": {**SEES.plain(), "hint": "go"}}]}, "unknown key"),
        ({**FILE, "ego": [{**LINE, "reply": GO}]}, 
            "key in prompt mine examples.json [ego.0] 'reply'"),
        ({"ego": [LINE]}, "prompt mine examples.json has no scenario; add it"),
        ([FILE], "prompt mine examples.json is no object; give scenario, ego and helper"),
        ("{", "prompt mine examples.json is no JSON"),
        ("[" * 100_000, "prompt mine examples.json is no JSON"),
    ],
)  # fmt: skip
def test_a_file_that_is_wrong_is_one_line(draft: Any, shown: Any, said: str) -> None:
    with pytest.raises(UserError, match=re.escape(said)) as caught:
        draft(shown)
    assert str(caught.value).isprintable()


def test_an_evaluation_on_a_layout_that_the_examples_show_is_refused(small: Dataset) -> None:
    """By layout seed: the dataset's second episode is an example;
    without that episode it may be asked.
    """
    seed = int(small.forest.seeds[1])
    shown = Examples(scenarios.DEFAULT, (Example(seed, SEES, YIELD),))
    with pytest.raises(UserError) as caught:
        with_examples(spec_of(small), shown)
    assert str(caught.value) == (
        f"--prompt v2 has an example of layout seed {seed}, which is evaluated; leave that episode "
        "out, or draw the examples anew: `harness prompt examples --first-seed`"
    )
    others = small.of_episodes({*small.episodes} - {1})
    assert with_examples(replace(spec_of(small), source=FrozenSource(others)), shown)


def test_a_driven_layout_that_the_examples_show_is_refused_too() -> None:
    spec = replace(live_spec_of(), source=LiveSource(100_000, 9))
    assert with_examples(replace(spec, source=LiveSource(100_000, 7)))
    with pytest.raises(UserError, match="has an example of layout seed 100007, which is evaluated"):
        with_examples(spec)


def test_helpers_examples_count_as_the_egos_do(small: Dataset) -> None:
    spec = spec_of(small)
    shown = Examples(scenarios.DEFAULT, (), (Example(int(small.forest.seeds[0]), HELPS, WARN),))
    helper = replace(spec.ego, prompt=replace(prompts.load("v3"), examples=shown))
    with pytest.raises(UserError, match="--prompt v3 has an example of layout seed"):
        replace(spec, helpers=(helper,))


def test_examples_of_another_scenario_are_refused(small: Dataset) -> None:
    shown = Examples("blind-merge", SHOWN.ego)
    with pytest.raises(
        UserError, match="has examples of blind-merge, which occluded-intersection is not"
    ):
        with_examples(spec_of(small), shown)


@pytest.mark.parametrize("answer", ["Go!", YIELD.replace("0.90", "0.70"), f"Sure: {YIELD}", ""])
def test_an_answer_that_the_parser_would_mend_or_refuse_is_no_example(
    answer: str, small: Dataset
) -> None:
    with pytest.raises(
        UserError, match="the answer of ego example 1 is not as a model should state it"
    ):
        with_examples(spec_of(small), replace_answer(SHOWN, answer))


def test_reasons_may_stand_before_an_answer_where_the_prompt_asks_for_them() -> None:
    shown = replace_answer(SHOWN, f"v2 comes from the left.\n{YIELD}")
    asks = replace(prompts.load("v2"), examples=shown, reasons_first=("ego",))
    assert example_actions(asks, "ego", ACTIONS) == ["SLOWER", "FASTER"]


# -- with the model that ships ---------------------------------------------------------------------


@pytest.mark.parametrize("answer", some(["readout"], exhaustive=["json", "constrained"]))
def test_the_model_that_ships_takes_earlier_turns(answer: Any, small: Dataset) -> None:
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    spec = with_examples(with_ego(spec_of(small, "swarm-tiny", batch_size=4), answer=answer))
    asked = list(requests(spec, scenes_of(small)[:2]))
    backend = open_backend(cards.resolve("swarm-tiny"), batch_size=4)
    [sent, *_] = backend.rendered(asked)  # type: ignore[attr-defined]
    first = YIELD if answer != "readout" else "A"
    assert f"<|im_end|>\n<|im_start|>assistant\n{first}<|im_end|>\n<|im_start|>user\n" in sent
    completions = backend.complete(asked)
    assert all(c.error is None and c.text and c.prompt_tokens > 400 for c in completions)


@pytest.mark.slow
def test_a_replay_gives_the_run_again(small: Dataset, tmp_path: Path) -> None:
    options: dict[str, Any] = {"points": (POINTS["single-local"], POINTS["6g"]), "seeds": (0,)}
    spec = with_examples(spec_of(small, **options))
    done = run(spec, tmp_path / "run")
    again = run(with_ego(spec, card=cards.resolve(f"replay:{done.out}")), tmp_path / "again")
    assert (done.out / "answers.jsonl").read_bytes() == (again.out / "answers.jsonl").read_bytes()
    plain = with_ego(spec, card=cards.resolve(f"replay:{done.out}"), prompt=prompts.load("v2"))
    with pytest.raises(UserError, match="with another prompt or dataset"):
        run(plain, tmp_path / "plain")


# -- differences -----------------------------------------------------------------------------------


def test_a_difference_names_them_and_counts_their_words(small: Dataset) -> None:
    plain = prompts.load("v2")
    mine = replace(plain, examples=SHOWN)
    [(name, before, after)] = difference.change(plain, mine).settings
    assert (name, before) == ("examples", None)
    assert after.startswith(
        "2 ego, 1 helper, occluded-intersection, layout seeds 100007, 100009, sha256 "
    )
    ego, *_ = difference.sent(plain, mine, scenes_of(small)[0], CROSSING)
    assert list(ego.parts) == ["system", "examples", "user"]
    assert ego.parts["examples"].added == ego.words[1] - ego.words[0]
    reworded = replace(plain, examples=replace_answer(SHOWN, GO))
    assert difference.change(mine, reworded), "the same layouts, and another answer"


# -- the command -----------------------------------------------------------------------------------


@pytest.fixture
def project(harness: Harness, monkeypatch: pytest.MonkeyPatch) -> Path:
    harness("init", "project")
    monkeypatch.chdir("project")
    return Path("prompts/mine")


@pytest.mark.slow
def test_check_counts_them_and_show_shows_them(
    project: Path, harness: Harness, small_path: Path
) -> None:
    tokenizer = folder("models") / "swarm-tiny"

    def tokens() -> int:
        said = harness(
            "prompt", "check", "mine", "--dataset", small_path, "--tokenizer", tokenizer, "--json"
        )
        return int(json.loads(said[1])["tokens"]["ego"]["least"])

    before = tokens()
    (project / EXAMPLES).write_text(text_of(SHOWN), encoding="utf-8")
    assert read(text_of(SHOWN), "") == SHOWN
    assert tokens() > before + 200

    scene = scenes_of(load(small_path))[0].id
    _, out, _ = harness(
        "prompt", "show", "mine", "--scene", scene, "--dataset", small_path, "--viewer", "v1"
    )
    assert [line for line in out.split("\n") if line.startswith("--- ")] == [
        f"--- v1 {role}" for role in ("system", "user", "assistant", "user", "assistant", "user")
    ]
    (project / EXAMPLES).write_text(text_of(replace_answer(SHOWN, "Go!")), encoding="utf-8")
    code, _, err = harness("prompt", "check", "mine", "--dataset", small_path)
    assert (code, "ego example 1 is not as a model should state it" in err) == (2, True)
