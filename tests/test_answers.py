"""The answers of a run as its file has them: the same as a list, however they stand in it."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.core.files import canonical_json
from harness.evaluate.answer_arrays import payload_bits
from harness.runs.answers import MARKS, Answers
from harness.runs.records import Answer

ANSWER = Answer(
    scene="", viewer="", role="ego", raw=
        "I would wait.", finish_reason="stop", error=None, prompt_tokens=1,
    completion_tokens=None, seconds=None, batch_size=1, label_mass=None, retries=0, cached=False, slow_s=0.0,
    prompt_sha256="", status="strict", verdict="strict", repairs=(), intent=(0.2, 0.3, 0.5), mass=1.0,
    message=None, detail="",
)  # fmt: skip
# Without the marks that stand beside names in keys.
NAMES = st.text(st.characters(exclude_categories=["Cs"], exclude_characters=MARKS), max_size=3)
MADE = st.lists(
    st.builds(
        lambda scene, viewer, raw: msgspec.structs.replace(ANSWER, scene=scene, viewer=viewer, raw=raw),
        st.sampled_from("abc"), NAMES, NAMES,
    ),
    unique_by=lambda answer: (answer.scene, answer.key),
)  # fmt: skip


def written(answers: list[Answer], between: bytes = b"") -> bytes:
    return b"".join(msgspec.json.encode(answer) + b"\n" + between for answer in answers)


@given(MADE, st.sampled_from([b"", b"\n", b" \n\n"]))
def test_they_are_read_in_order_and_by_scene(made: list[Answer], between: bytes) -> None:
    answers = Answers(between + written(made, between), 3)
    assert len(answers) == len(made)
    assert [*answers] == [*answers] == made
    by_scene = {
        scene: [a for a in made if a.scene == scene]
        for scene in dict.fromkeys(a.scene for a in made)
    }
    assert dict(answers.by_scene) == by_scene
    assert [*answers.by_scene] == [*by_scene], "in the order of the file"


@given(MADE.filter(bool), st.data())
def test_one_that_is_there_twice_is_refused_wherever_it_stands(
    made: list[Answer], data: st.DataObject
) -> None:
    again = data.draw(st.sampled_from(made))
    at = data.draw(st.integers(0, len(made)))
    with pytest.raises(ValueError, match="an answer is there twice"):
        Answers(written([*made[:at], again, *made[at:]]), 3)


def test_another_number_of_probabilities_is_refused() -> None:
    with pytest.raises(ValueError, match=r"answer a/v has 3 probabilities"):
        Answers(written([msgspec.structs.replace(ANSWER, scene="a", viewer="v")]), 5)


@pytest.mark.parametrize(
    "intent", [(-1.0, 1.0, 1.0), (0.8, 0.9, 0.3), (0.0, 0.0, 0.0), (1e308, 1e308, 1e308)]
)
def test_an_intent_that_is_no_distribution_is_refused(intent: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"answer a/v has an intent that is no distribution"):
        Answers(written([msgspec.structs.replace(ANSWER, scene="a", viewer="v", intent=intent)]), 3)


METRES = st.floats(-1e6, 1e6) | st.sampled_from([-0.0, -0.04, 0.05, 0.25, 12.35])
SHARES = st.floats(0.0, 1.0) | st.sampled_from([0.005, 0.045, 0.1, 0.125, 0.995])
SAYS = st.fixed_dictionaries(
    {"evidence": st.none() | NAMES, "risk": st.none() | NAMES, "confidence": SHARES}
)


@given(METRES, METRES, st.none() | st.tuples(SHARES, SHARES, SHARES), st.none() | SAYS, NAMES)
def test_a_message_weighs_what_its_json_does(x_m, y_m, intent, message, viewer) -> None:
    answer = msgspec.structs.replace(ANSWER, viewer=viewer, intent=intent, message=message)
    says = {
        "from": viewer, "xy_m": [round(x_m, 1), round(y_m, 1)],
        "intent": intent and [round(share, 2) for share in intent], "says": message,
    }  # fmt: skip
    assert payload_bits((x_m, y_m), answer) == 8 * len(canonical_json(says).encode())
