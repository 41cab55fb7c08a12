"""Prompts: what a model is sent, word by word, and everything that can be wrong with a version."""

import os
import pickle
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from evaluating import scenes_of, spec_of
from graphs import ACTIONS, CAR, CASES, MESSAGES, STANDING, TRUCK, graph
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec import structs

from harness.backends.base import Completion
from harness.backends.tokens import counter, tokenizer
from harness.core.errors import UserError
from harness.core.resources import folder
from harness.dataset.load import Dataset, load
from harness.evaluate.answers import answer_of
from harness.evaluate.requests import fusion_request, requests
from harness.prompts import versions as prompts
from harness.prompts.densest import EVIDENCE, densest_messages
from harness.prompts.examples import EXAMPLES
from harness.world import scenarios

GOLDEN = Path(__file__).parent / "golden"
VERSIONS = prompts.names()
CROSSING = scenarios.get(scenarios.DEFAULT).prompt_words
LISTS_NOBODY = [v for v in VERSIONS if "in objects" not in prompts.load(v).texts["ego"]]
DRAFT = "my-draft"  # no version that ships is called so
ID = re.compile(r"\bv[1-9][0-9]?\b")


def text_of(messages: tuple[dict[str, str], ...]) -> str:
    return "".join(f"--- {m['role']}\n{m['content']}\n" for m in messages)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("version", VERSIONS)
def test_a_prompt_is_the_golden_text(version: str, case: str) -> None:
    """After a wanted change: `UPDATE_GOLDEN=1 pytest tests/test_prompts.py`,
    and read the difference.
    """
    seen, messages = CASES[case]
    said = text_of(prompts.load(version).render(seen, ACTIONS, messages, CROSSING))
    file = GOLDEN / f"{version}-{case}.txt"
    if os.environ.get("UPDATE_GOLDEN"):
        file.write_text(said, encoding="utf-8")
    assert said == file.read_text(encoding="utf-8")


def test_every_golden_text_is_of_a_version_and_a_case() -> None:
    assert {f.stem for f in GOLDEN.glob("*.txt")} == {
        f"{v}-{case}" for v in VERSIONS for case in CASES
    }


# -- what is told ----------------------------------------------------------------------------------


@pytest.mark.parametrize("version", VERSIONS)
def test_those_in_conflict_are_listed_first_then_the_nearest_and_the_rest_is_counted(
    version: str,
) -> None:
    near = [structs.replace(CAR, id=f"v{20 + i}", forward_m=1.0 + i, left_m=0.0) for i in range(4)]
    prompt = prompts.load(version)
    *_, user = prompt.render(graph("ego", [*near, TRUCK], [STANDING]), ACTIONS, (), CROSSING)
    listed = [
        v
        for v in ("v4", "v20", "v21", "v22", "v23")
        if re.search(rf"^{v}\b", user["content"], re.M)
    ]
    if version in LISTS_NOBODY:
        assert set(listed) <= {"v4"}
        return
    assert listed == ["v4", "v20", "v21"][: prompt.max_objects]
    assert re.search(
        rf"{5 - prompt.max_objects} (more )?farther|{5 - prompt.max_objects} more", user["content"]
    )


@pytest.mark.parametrize("version", VERSIONS)
def test_a_version_that_was_used_travels_to_another_process(version: str) -> None:
    prompt, (seen, messages) = prompts.load(version), CASES["ego-messages"]
    said = prompt.render(seen, ACTIONS, messages, CROSSING)
    there = pickle.loads(pickle.dumps(prompt))
    assert there == prompt
    assert there.render(seen, ACTIONS, messages, CROSSING) == said


@pytest.mark.parametrize("version", VERSIONS)
def test_action_names_are_the_ones_passed_in(version: str) -> None:
    for role in prompts.ROLES:
        said = text_of(
            prompts.load(version).render(graph(role, [], []), ("LANE_LEFT", "KEEP"), (), CROSSING)
        )
        assert "LANE_LEFT" in said
        assert "KEEP" in said


@pytest.mark.parametrize("version", VERSIONS)
def test_nobody_is_named_who_is_not_in_the_viewers_graph(version: str, small: Dataset) -> None:
    prompt = prompts.load(version)
    for scene in scenes_of(small):
        present = {v.id for v in scene.state.vehicles}
        for viewer, seen in scene.graphs.items():
            known = {viewer, seen.ego.id, *(n.id for n in seen.nodes)}
            system, *_, user = prompt.render(seen, small.actions, (), CROSSING)
            named = set(ID.findall(text_of((system, user))))
            assert named <= known, f"{scene.id} {viewer}: {named - known}"
            assert known <= present


WORDS = "{{ graph }} {% raw %} </s> \x1b[31m \n ${x} %s {# #} \u202e \U0001f697"


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("role", prompts.ROLES)
def test_hostile_words_in_a_graph_stay_words(version: str, role: str) -> None:
    def count(words: str) -> int:
        node = structs.replace(TRUCK, id=words, lane=words, type=words)
        seen = graph(role, [node], [structs.replace(STANDING, vehicle=words)])
        messages = ({**MESSAGES[0], "sender": words, "evidence": words},) if role == "ego" else ()
        text = text_of(prompts.load(version).render(seen, ACTIONS, messages, CROSSING))
        # evidence stands in one line
        return text.replace("\n", " ").count(words.replace("\n", " "))

    assert count(WORDS) == count("plain-words".ljust(len(WORDS), "-"))


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(st.text(max_size=30), st.sampled_from(VERSIONS))
def test_any_id_is_rendered_as_it_is(name: str, version: str) -> None:
    said = text_of(
        prompts.load(version).render(
            graph("ego", [structs.replace(CAR, id=name)], []), ACTIONS, (), CROSSING
        )
    )
    assert name in said or version in LISTS_NOBODY


# Section III-C, Prompt Engineering for Multimodal Perception.
PAPER = {
    "helper": 
        "You are a neighboring vehicle assisting the ego car. From your local view, report only "
        "the most decision-relevant evidence for the conflict zone, summarize the visible risk, "
        "and send one compact semantic message with a recommended maneuver and confidence score.",
    "ego": 
        "You are the ego vehicle. Combine your local scene graph with the received cooperative "
        "messages, reason step by step over occlusion, conflict-zone risk, and message agreement, "
        "and then output only the final JSON action distribution over A. Prioritize safety over "
        "efficiency when the evidence is uncertain or conflicting.",
}  # fmt: skip


@pytest.mark.parametrize("role", prompts.ROLES)
def test_the_papers_prompt_begins_with_its_own_words(role: str) -> None:
    [system, _] = prompts.load("paper").render(graph(role, [CAR], []), ACTIONS)
    assert system["content"].split("\n")[0] == PAPER[role]


@pytest.mark.parametrize("case", CASES)
def test_v6_is_v2_with_two_examples_and_a_repair_turn(case: str) -> None:
    asked, messages = CASES[case]
    plain, chat = (prompts.load(v).render(asked, ACTIONS, messages, CROSSING) for v in ("v2", "v6"))
    assert (chat[0], chat[-1]) == plain
    assert [m["role"] for m in chat[1:-1]] == ["user", "assistant"] * 2
    assert prompts.load("v6").repair_turn == prompts.ROLES


@pytest.mark.parametrize("case", [case for case, (_, messages) in CASES.items() if not messages])
def test_v3_differs_from_v2_in_messages_alone(case: str) -> None:
    v2, v3 = (prompts.load(v).render(CASES[case][0], ACTIONS) for v in ("v2", "v3"))
    assert v3 == v2


# -- versions that are wrong -----------------------------------------------------------------------


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """A folder of versions like the harness's own, with its pins."""
    where = tmp_path / "prompts"
    shutil.copytree(folder("prompts"), where)
    return where


Edit = Callable[[str, str, str], prompts.Prompt]


@pytest.fixture
def draft(copied: Path) -> Edit:
    """A draft, which is `v2` with one piece of one file replaced."""
    shutil.copytree(copied / "v2", copied / DRAFT)

    def edit(file: str, old: str, new: str) -> prompts.Prompt:
        text = (copied / DRAFT / file).read_text(encoding="utf-8")
        assert old in text
        (copied / DRAFT / file).write_text(text.replace(old, new), encoding="utf-8")
        return prompts.load(DRAFT, copied)

    return edit


def one_line(error: pytest.ExceptionInfo[UserError]) -> str:
    message = str(error.value)
    assert message.isprintable(), message
    return message


@pytest.mark.parametrize(
    ("template", "said"),
    [
        ("{{ graph.nodse }}", "nodse"),
        ("{{ danger }}", "'danger' is undefined"),
        ("{{ ''.__class__.__mro__ }}", "__class__"),
        ("{{ graph.__init__.__globals__ }}", "__init__"),
        ("{{ actions.__class__ }}", "__class__"),
        ("{{ graph.update({'role': 'ego'}) }}", "update"),
        ("{% for i in range(10 ** 9) %}{% endfor %}", "Range too big"),
        ("{% include 'released.toml' %}", "no loader"),
        ("{% import 'os' as os %}{{ os }}", "no loader"),
        ("{{ 1 // 0 }}", "division"),
        ("{{ graph.nodes['first'].id }}", "first"),
        ("{{ '%d' | format('seven') }}", "number is required"),
        ("{{ '\x1b[31m' + 1 }}", "str"),
    ],
)
def test_a_template_that_fails_or_reaches_out_is_one_line(
    draft: Edit, template: str, said: str
) -> None:
    prompt = draft("ego.j2", "Distribution:", template)
    with pytest.raises(UserError) as caught:
        prompt.render(graph("ego", [CAR], []), ACTIONS)
    message = one_line(caught)
    assert message.startswith(f"prompt {DRAFT} ego.j2 does not render: ")
    assert said in message
    assert "may use graph, actions, objects, more, conflicts, messages" in message


@pytest.mark.parametrize("template", ["{% import os %}", "{{ graph.", "{% if %}", "{% endblock %}"])
def test_a_template_that_is_no_jinja_is_one_line_with_its_number(
    draft: Edit, template: str
) -> None:
    prompt = draft("helper.j2", "Message to", f"{template} Message to")
    with pytest.raises(UserError) as caught:
        prompt.render(graph("ego", [], []), ACTIONS)
    assert re.match(rf"prompt {DRAFT} helper\.j2 line \d+ is no Jinja: ", one_line(caught))


def test_a_template_without_a_block_says_which_it_needs(draft: Edit) -> None:
    prompt = draft("ego.j2", "block system", "block preamble")
    with pytest.raises(
        UserError, match=r"does not render: 'system'; it needs the blocks system and user"
    ):
        prompt.render(graph("ego", [], []), ACTIONS)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "max_objects = 3",
            "max_object = 3",
            "unknown key in prompt my-draft prompt.toml 'max_object'; did you",
        ),
        ("max_objects = 3", 'max_objects = "3"', "max_objects = '3'; allowed: a whole number"),
        ("max_objects = 3", "max_objects = true", "max_objects = True; allowed: a whole number"),
        ("max_objects = 3", "max_objects = 0", "max_objects = 0; allowed: 1 or more"),
        ("max_objects = 3", "", "has no max_objects; add it"),
        ("max_objects = 3", "max_objects = ", "is no TOML"),
        ("[200, 400]", "[200]", "token_budget = [200]; allowed: a list of length 2"),
        ("[200, 400]", "[400, 200]", r"token_budget is [400, 200], wants [least, most]"),
        ("[200, 400]", '["200", 400]', "0 = '200'; allowed: a whole number"),
        ("ego = 64", "ego = -64", "[max_answer_tokens]: ego = -64; allowed: 1 or more"),
        ("ego = 64, ", "", "max_answer_tokens wants exactly ego and helper"),
        ('"distribution"', '"distributions"', "did you mean 'distribution'?"),
    ],
)
def test_a_prompt_toml_with_a_mistake_is_one_line(
    draft: Edit, old: str, new: str, said: str
) -> None:
    with pytest.raises(UserError) as caught:
        draft("prompt.toml", old, new)
    message = one_line(caught)
    assert f"prompt {DRAFT} prompt.toml" in message
    assert said in message


def test_a_missing_or_unreadable_template_is_one_line(copied: Path) -> None:
    shutil.copytree(copied / "v2", copied / DRAFT)
    (copied / DRAFT / "helper.j2").write_bytes(b"\xff\xfe")
    with pytest.raises(UserError, match=r"helper\.j2 cannot be read"):
        prompts.load(DRAFT, copied)
    (copied / DRAFT / "helper.j2").unlink()
    with pytest.raises(UserError, match=r"helper\.j2 cannot be read: .*No such file"):
        prompts.load(DRAFT, copied)


@pytest.mark.parametrize(
    "name", ["v22", "", ".", "..", "../prompts/v2", "v2/", "\x1b[31m", "v" * 5000]
)
def test_a_version_is_a_name_and_no_path(name: str) -> None:
    with pytest.raises(UserError, match="unknown prompt") as caught:
        prompts.load(name)
    assert one_line(caught).endswith(f"known: {', '.join(VERSIONS)}")


# -- release ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("file", [*prompts.FILES, EXAMPLES])
@pytest.mark.parametrize("version", VERSIONS)
def test_a_released_version_whose_text_changed_is_refused(
    version: str, file: str, copied: Path
) -> None:
    if not (copied / version / file).exists():
        pytest.skip("a version without examples")
    assert prompts.load(version, copied) == prompts.load(version)
    with (copied / version / file).open("a", encoding="utf-8") as f:
        f.write("\n")
    with pytest.raises(UserError) as caught:
        prompts.load(version, copied)
    assert one_line(caught).startswith(
        f"prompt {version} was released and its text has changed; restore it"
    )


def test_every_version_here_is_released() -> None:
    assert all(prompts.load(version).released for version in VERSIONS)


def test_a_version_says_whether_reasons_come_first_and_v1_was_released_before_it_could(
    copied: Path,
) -> None:
    asked = {name: prompts.load(name).reasons_first for name in ("v1", "v2", "paper")}
    assert asked == {"v1": ("ego", "helper"), "v2": (), "paper": ("ego",)}
    shutil.copytree(copied / "v2", copied / DRAFT)
    toml = copied / DRAFT / "prompt.toml"
    toml.write_text(
        toml.read_text(encoding="utf-8") + 'reasons_first = ["helper"]\n', encoding="utf-8"
    )
    assert prompts.load(DRAFT, copied).reasons_first == ("helper",)


@pytest.mark.parametrize(
    ("version", "of_ego", "of_helper"),
    [
        ("v1", "strict", "strict"),
        ("v2", "recovered", "recovered"),
        ("paper", "strict", "recovered"),
    ],
)
def test_reasons_before_the_answer_are_a_repair_only_if_the_prompt_did_not_ask(
    version: str, of_ego: str, of_helper: str, small: Dataset
) -> None:
    """What the v1 templates ask for, word by word, from the ego and from a helper,
    also in a fusion call.
    """
    spec = spec_of(small, prompt=version)
    scene = scenes_of(small)[0]
    ego = (
        'The truck hides the left.\n{"action_distribution": {"SLOWER": 0.7, "IDLE": 0.2, "FASTER": '
        "0.1}}"
    )
    judged = '"recommended_maneuver": "SLOWER", "confidence": 0.8'
    if spec.ego.prompt.helper_answer == "distribution":
        judged = ego.partition("{")[2][:-1]
    helper = f'A car comes from the left.\n{{"evidence": "car", "risk": "high", {judged}}}'
    told = {}
    for request in requests(spec, [scene]):
        said = Completion(
            request.id, ego if request.role == "ego" else helper, None, None, "stop", None, 1
        )
        told[request.id.partition("/")[2]] = answer_of(request, said)
    fused = fusion_request(spec, scene, told, scene.viewers[1:])
    assert fused.view is scene.graphs[scene.viewers[0]]
    told["merge"] = answer_of(fused, Completion(fused.id, ego, None, None, "stop", None, 1))
    assert {(a.role, a.status) for a in told.values()} == {
        ("ego", of_ego), ("helper", of_helper), ("merge", of_ego),
    }  # fmt: skip
    for answer in told.values():
        assert answer.repairs == (() if answer.status == "strict" else ("prose_around",))


@pytest.mark.parametrize("version", ["no-such-version", "v1.1", "über 'v'"])
def test_a_draft_may_change_until_it_is_locked(version: str, copied: Path) -> None:
    shutil.copytree(copied / "v2", copied / version)
    changed = copied / version / "ego.j2"
    assert not prompts.load(version, copied).released
    changed.write_text(changed.read_text(encoding="utf-8") + "\n", encoding="utf-8")

    digest = prompts.lock(version, copied)
    locked = prompts.load(version, copied)
    assert (locked.released, locked.sha256) == (True, digest)
    assert prompts.load("v1", copied).released
    changed.write_text(changed.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    with pytest.raises(UserError, match="was released and its text has changed"):
        prompts.load(version, copied)


def test_pins_that_cannot_be_read_are_one_line(copied: Path) -> None:
    (copied / "released.toml").write_text("<<<<<<< HEAD\n", encoding="utf-8")
    with pytest.raises(UserError, match=r"released\.toml is no TOML"):
        prompts.load("v1", copied)


def test_a_file_that_is_missing_is_named_once(copied: Path) -> None:
    file = copied / "v1" / "ego.j2"
    file.unlink()
    with pytest.raises(UserError) as said:
        prompts.load("v1", copied)
    assert (
        str(said.value)
        == f"prompt file {file} cannot be read: No such file or directory; replace the file"
    )


# -- length ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def vocabulary() -> Path:
    """Qwen2's tokenizer as a GGUF file, which is too large for this repository."""
    beside = Path(__file__).parents[2] / "shared" / "tokenizer" / "qwen2-vocab-only.gguf"
    found = Path(os.environ.get("SWARMDRIVE_TOKENIZER") or beside)
    if not found.is_file():
        pytest.skip("no tokenizer: set SWARMDRIVE_TOKENIZER to a GGUF file of the Qwen2 kind")
    return found


PICTURE = 128  # tokens, of 512 x 256 pixels with Qwen3-VL and 448 x 224 with Qwen2.5-VL
# As long as a message may be asked for: twelve words, and long ones.
LONG = tuple(
    {**MESSAGES[0], "sender": f"v{n}", "risk": "medium", "intent": (0.33, 0.33, 0.34), "confidence": 0.34,
     "evidence": 
         "Speeding vehicles approaching intersection, "
         "obscured behind parked delivery truck "
                 "conflicting trajectories imminent"}
    for n in (12, 13, 14)
)  # fmt: skip


@pytest.mark.parametrize("messages", [(), LONG], ids=["alone", "three-long-messages"])
@pytest.mark.parametrize("version", VERSIONS)
def test_every_prompt_keeps_its_token_budget(
    version: str, messages: tuple[Any, ...], small: Dataset, vocabulary: Path
) -> None:
    prompt, count = prompts.load(version), counter(vocabulary)
    assert count is not None
    least, most = prompt.token_budget
    assert most <= 400 or prompt.examples
    for scene in scenes_of(small)[::3]:
        for viewer, seen in scene.graphs.items():
            if messages and seen.role == "helper":
                continue
            n = (
                count(prompt.render(seen, small.actions, messages, CROSSING))
                + bool(prompt.image) * PICTURE
            )
            assert least <= n <= most, f"{version} {scene.id} {viewer}: {n} tokens"


@pytest.mark.parametrize("senders", [1, 2, 3])
@pytest.mark.parametrize("version", ["paper", "v3"])
def test_no_evidence_takes_a_fusion_call_over_its_budget(
    version: str, senders: int, small: Dataset, vocabulary: Path
) -> None:
    """v1 and v2 exceed 400 tokens here:
    three messages of 40 characters have no room for a token each.
    """
    prompt, count = prompts.load(version), counter(vocabulary)
    assert count is not None
    assert count([{"content": EVIDENCE}]) == len(EVIDENCE)
    for scene in scenes_of(small):
        ego, *helpers = scene.viewers
        messages = densest_messages(helpers[:senders], small.actions)
        n = count(prompt.render(scene.graphs[ego], small.actions, messages, CROSSING))
        assert 200 <= n <= 400, f"{version} {scene.id}: {n} tokens"


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("version", VERSIONS)
def test_tokens_decode_to_the_prompt_and_every_digit_is_one(
    version: str, case: str, vocabulary: Path
) -> None:
    qwen = tokenizer(vocabulary)
    said = text_of(prompts.load(version).render(CASES[case][0], ACTIONS, CASES[case][1], CROSSING))
    encoded = qwen.encode(said)
    assert qwen.decode(encoded.ids) == said
    assert [t for t in encoded.tokens if any(c.isdigit() for c in t)] == [
        c for c in said if c.isdigit()
    ]


def test_a_version_saved_with_byte_order_marks_is_the_same_version(copied: Path) -> None:
    plain = prompts.load("v6", copied)
    for file in (copied / "v6").iterdir():
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert prompts.load("v6", copied) == plain


@pytest.mark.parametrize("role", prompts.ROLES)
def test_a_block_question_ends_every_question_unless_a_letter_is_asked_for(role: str) -> None:
    prompt, seen = prompts.load("v10"), graph(role, [TRUCK], [STANDING])
    asked, letter = (prompt.render(seen, ACTIONS, (), CROSSING, of) for of in (False, True))
    assert len(asked) == len(letter) == 2 + 2 * 3
    for with_it, without in zip(asked, letter, strict=True):
        if with_it["role"] != "user":
            assert with_it == without
            continue
        question = with_it["content"].removeprefix(without["content"])
        assert question.startswith("\nAnswer in JSON with ")
        assert "JSON" not in without["content"]


@pytest.mark.slow
def test_without_a_scene_the_datasets_first_is_shown(
    small_path: Path, harness: Callable[..., tuple[int, str, str]]
) -> None:
    first = next(iter(load(small_path).forest.place))
    shown = [
        harness("prompt", "show", "v2", "--dataset", small_path, *more)
        for more in ((), ("--scene", first))
    ]
    assert shown[0] == shown[1]
    assert shown[0][0] == 0
