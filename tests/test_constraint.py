"""Whether an answer keeps to the constraint that a server was sent: whole, or cut off anywhere."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import jsonschema
import pytest
from hypothesis import given
from hypothesis import strategies as st
from misbehaving import Asked, completion, serving

from harness.backends.base import Completion, Request
from harness.backends.card import Card, Latency
from harness.backends.openai import backend as openai_backend
from harness.backends.openai.constraint import broken, constraint
from harness.backends.servers import KINDS, Kind, Server
from harness.core import resources

ACTIONS = ("SLOWER", "SLOW", "IDLE")  # one name begins another
FORMS = (("ego", "distribution"), ("helper", "distribution"), ("helper", "recommendation"))
PATTERNS: tuple[Kind, ...] = ("vllm", "llama-server", "llama-cpp-python")
SCHEMAS = tuple(kind for kind in KINDS if kind not in PATTERNS)


def request(role: str = "ego", form: str = "distribution") -> Request:
    messages = ({"role": "user", "content": "Clear."},)
    return Request("s/v1", role, messages, ACTIONS, 64, form, "constrained")  # type: ignore[arg-type]


def regex(asked: Request) -> str:
    sent: str = constraint("vllm", asked.shape)["structured_outputs"]["regex"]
    return sent


def schema(asked: Request) -> Any:
    return constraint("generic", asked.shape)["response_format"]["json_schema"]["schema"]


compact = st.sampled_from(FORMS).flatmap(lambda form: st.tuples(st.just(form), st.from_regex(
    regex(request(*form)), fullmatch=True)))  # fmt: skip
numbers = st.floats(0, 1).map(json.dumps) | st.sampled_from(
    ["0", "1", "0.5", "5e-1", "1E0", "0.25e+0"]
)


@st.composite
def loose(draw: st.DrawFn) -> tuple[tuple[str, str], str]:
    """JSON under the schema: any order, blanks anywhere, numbers of any length."""
    form = draw(st.sampled_from(FORMS))
    blank = st.sampled_from(["", " ", "\n\t"])

    def written(part: Any) -> str:
        if "enum" in part:
            return json.dumps(draw(st.sampled_from(part["enum"])))
        if part["type"] == "number":
            return draw(numbers)
        members = [
            f"{draw(blank)}{json.dumps(name)}{draw(blank)}:{draw(blank)}{written(value)}{draw(blank)}"
            for name, value in draw(st.permutations(list(part["properties"].items())))
        ]
        return f"{{{','.join(members)}}}"

    return form, f"{draw(blank)}{written(schema(request(*form)))}{draw(blank)}"


# -- what fits -------------------------------------------------------------------------------------


@given(compact, st.sampled_from(PATTERNS), st.data())
def test_what_the_pattern_allows_fits_and_so_does_its_beginning(
    made: tuple[tuple[str, str], str], kind: Kind, data: st.DataObject
) -> None:
    form, text = made
    asked = request(*form)
    assert broken(kind, asked, text, ended=True) is None
    cut = text[: data.draw(st.integers(0, len(text) - 1))]
    assert broken(kind, asked, cut, ended=False) is None
    assert broken(kind, asked, cut, ended=True) == f"it ends after {len(cut)} characters"


@given(loose(), st.sampled_from(SCHEMAS), st.data())
def test_what_the_schema_allows_fits_and_so_does_its_beginning(
    made: tuple[tuple[str, str], str], kind: Kind, data: st.DataObject
) -> None:
    form, text = made
    asked = request(*form)
    assert broken(kind, asked, text, ended=True) is None
    cut = text[: data.draw(st.integers(0, len(text.rstrip()) - 1))]
    assert broken(kind, asked, cut, ended=False) is None
    assert broken(kind, asked, cut, ended=True)


# -- what does not ---------------------------------------------------------------------------------

spoilt = st.tuples(
    st.integers(0, 200), st.integers(0, 3), st.text(' {}":,0159.-eSLOWERIx\n', max_size=3)
)


def changed(text: str, how: tuple[int, int, str]) -> str:
    at, count, by = how
    at %= len(text)
    return text[:at] + by + text[at + count :]


@given(compact, spoilt)
def test_it_judges_a_changed_answer_as_the_pattern_does(
    made: tuple[tuple[str, str], str], how: tuple[int, int, str]
) -> None:
    form, text = made
    asked, text = request(*form), changed(text, how)
    assert (broken("vllm", asked, text, ended=True) is None) == bool(
        re.fullmatch(regex(asked), text)
    )


@given(loose(), spoilt)
def test_it_judges_a_changed_answer_as_a_validator_does(
    made: tuple[tuple[str, str], str], how: tuple[int, int, str]
) -> None:
    form, text = made
    asked, text = request(*form), changed(text, how)

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        assert len(dict(pairs)) == len(pairs)
        return dict(pairs)

    try:
        stated = json.loads(text, object_pairs_hook=once)
        valid = jsonschema.Draft202012Validator(schema(asked)).is_valid(stated)
    except (ValueError, AssertionError):
        valid = False
    assert (broken("generic", asked, text, ended=True) is None) == valid


@pytest.mark.parametrize(
    ("kind", "text", "said"),
    [
        (
            "vllm",
            '{"action_distribution": {"SLOWER":0.70',
            "' {\"SLOWER\":0.70' after 23 characters",
        ),
        ("vllm", "The gap is short.", "'The gap is short.' after 0 characters"),
        ("vllm", '{"action_distribution":{"SLOWER":0.7,', "'0.7,' after 33 characters"),
        ("vllm", '{"action_distribution":{"IDLE":', "'\"IDLE\":' after 24 characters"),
        ("generic", '{"action_distribution":{"SLOWER":1.5,', "'1.5,' after 33 characters"),
        (
            "generic",
            '{"action_distribution":{"SLOWER":0.5,"SLOWER"',
            "'\"SLOWER\"' after 37 characters",
        ),
        ("generic", '```json\n{"action', "'```json\\n{\"action' after 0 characters"),
    ],
)
def test_a_cut_answer_that_can_never_fit_is_said_with_its_place(
    kind: Kind, text: str, said: str
) -> None:
    assert broken(kind, request(), text, ended=False) == said


@pytest.mark.parametrize(
    "text", ["", "{", '{"action_distribution":{"SLOWER":', '{"action_distribution":{"SLOWER":0']
)
@pytest.mark.parametrize("kind", KINDS)
def test_what_may_still_become_an_answer_is_cut_off_and_not_broken(kind: Kind, text: str) -> None:
    assert broken(kind, request(), text, ended=False) is None


# -- through the backend ---------------------------------------------------------------------------


def asked_for(
    kind: Kind, made: Any, monkeypatch: pytest.MonkeyPatch, thinking: Any = "none"
) -> Completion:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with serving(lambda asked: asked.reply(made)) as there:
        card = Card("mine", "openai", "d", Latency("paper", None, "b"), "m", thinking=thinking,
                    server=Server(there.url, kind, key_env="NO_KEY", timeout_s=20.0))  # fmt: skip
        [done] = openai_backend.open(card, batch_size=1).complete([request()])
        assert len(there.asked) == 1, "an answer that breaks it would come again"
    return done


FREE = '{"action_distribution": {"SLOWER": 0.7, "SLOW": 0.2, "IDLE": 0.1}}'


@pytest.mark.parametrize("kind", get_args(Kind))
def test_a_server_that_drops_the_constraint_gives_no_constrained_answer(
    kind: Kind, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = FREE if kind in PATTERNS else f"Sure! {FREE}"
    done = asked_for(kind, completion(free), monkeypatch)
    assert (done.text, done.finish_reason) == ("", "error")
    assert done.error is not None
    assert done.error.startswith("the server did not keep to the constraint that was sent: ")
    assert "; use --answer json, or a server that keeps to it" in done.error
    assert asked_for("generic", completion(FREE), monkeypatch).text == FREE, (
        "the schema allows blanks"
    )


def test_a_constrained_answer_that_was_cut_off_stays_one(monkeypatch: pytest.MonkeyPatch) -> None:
    done = asked_for("vllm", completion(FREE.replace(" ", "")[:36], "length"), monkeypatch)
    assert (done.finish_reason, done.error) == ("length", None)
    assert asked_for("vllm", completion(FREE[:40], "length"), monkeypatch).error


def test_an_answer_that_nobody_constrained_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    def play(asked: Asked) -> None:
        asked.reply(completion("I would rather wait."))

    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with serving(play) as there:
        card = Card("mine", "openai", "d", Latency("paper", None, "b"), "m",
                    server=Server(there.url, "vllm", key_env="NO_KEY"))  # fmt: skip
        [done] = openai_backend.open(card, batch_size=1).complete([request().alike(answer="json")])
    assert (done.text, done.error) == ("I would rather wait.", None)


def test_model_check_says_so_in_its_table(
    harness: Callable[..., tuple[int, str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    (tmp_path / resources.MARKER).touch()
    (tmp_path / "models").mkdir()
    with serving(lambda asked: asked.reply(completion(FREE))) as there:
        (tmp_path / "models/mine.toml").write_text(
            'engine = "openai"\ndescription = "d"\nweights = "m"\n'
            f'[server]\nbase_url = "{there.url}"\nkind = "vllm"\nkey_env = "NO_KEY"\n'
            '[latency]\nsource = "paper"\nbasis = "b"\n'
        )
        code, out, _ = harness("model", "check", "mine")
    lines = {line.split(" ")[0]: line for line in out.splitlines()}
    assert code == 1, "its answer in json has actions that are none"
    assert FREE in lines["json"]
    assert (
        "no answer: the server did not keep to the constraint that was sent: ' {"
        in lines["constrained"]
    )
    assert "no answer: the server gives no log-probabilities" in lines["readout"]
