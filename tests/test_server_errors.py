"""Errors that a server sends with HTTP 200, in one piece or in a stream:
their words, and what is retried.
"""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from misbehaving import LISTED, Asked, completion, pieces, serving

from harness.backends.base import Completion, Request
from harness.backends.card import Card, Latency
from harness.backends.openai import backend as openai_backend
from harness.backends.openai import pool as openai_pool
from harness.backends.openai.faults import Fault, fault_in
from harness.backends.servers import Server
from harness.core.errors import UserError

WORDS = "the provider is overloaded"


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(openai_pool, "FIRST_WAIT_S", 0.01)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")


def card(url: str) -> Card:
    where = Server(url, key_env="NO_KEY", timeout_s=20.0, retries=2)
    return Card("mine", "openai", "d", Latency("paper", None, "b"), "m", server=where)


def ask(*replies: Any, timed: bool = False, **headers: str) -> tuple[Completion, list[Asked]]:
    """Ask once; the server gives these replies one after the other,
    and the last one from then on.
    """

    def play(asked: Asked) -> None:
        reply = replies[min(asked.number, len(replies) - 1)]
        asked.stream(*reply) if timed else asked.reply(reply, **headers)

    with serving(play) as there:
        asking = Request(
            "s/v1", "ego", ({"role": "user", "content": "?"},), ("A", "B"), 64, timed=timed
        )
        [done] = openai_backend.open(card(there.url), batch_size=1).complete([asking])
    return done, there.asked


ERRORS = [
    {"error": {"message": WORDS}},
    {"error": WORDS},
    {"detail": WORDS},
    {"message": WORDS, "object": "error"},
    {"error": {"message": WORDS, "code": "rate_limit_exceeded"}},
    {"error": {"message": WORDS, "code": 400}},
    {"choices": None, "error": {"message": WORDS}},
    {"choices": [], "detail": WORDS},
    {"choices": [{"error": {"message": WORDS, "code": 403}, "message": {"content": "a"}}]},
    {"error": {"message": "Provider returned error", "metadata": {"raw": WORDS}}},
    WORDS,
    f"{WORDS}\n".encode(),
]  # fmt: skip


@pytest.mark.parametrize("error", ERRORS)
def test_an_error_with_200_is_an_error_with_its_words(error: Any) -> None:
    done, asked = ask(error)
    assert (done.text, done.finish_reason, done.retries, len(asked)) == ("", "error", 0, 1)
    assert done.error is not None
    assert WORDS in done.error
    assert "with HTTP 200: " in done.error


@pytest.mark.parametrize("code", [429, 500, 502, 503, 529, "429", "503"])
@pytest.mark.parametrize("place", ["inside", "beside", "choice"])
def test_it_is_tried_again_by_its_code(code: Any, place: str) -> None:
    coded = {"message": WORDS, "code": code}
    places = {"inside": {"error": coded}, "beside": {"error": WORDS, "status": code},
              "choice": {"choices": [{"error": coded}]}}  # fmt: skip
    error = places[place]
    done, asked = ask(error, error, completion("hello"), retry_after="0")
    assert (done.text, done.retries, len(asked)) == ("hello", 2, 3)
    done, asked = ask(error)
    assert (done.error, len(asked)) == (f"error {code} with HTTP 200: {WORDS}", 3)


@pytest.mark.parametrize("error", [*ERRORS[:5], {"error": {"message": WORDS, "code": 400}}])
def test_a_stream_says_it_too(error: Any) -> None:
    begun = pieces("hel", finish_reason=None)[:2]
    done, asked = ask([*begun, error], timed=True)
    assert done.error == f"the stream broke off: {WORDS}"
    coded = (
        isinstance(error, dict)
        and isinstance(error.get("error"), dict)
        and error["error"].get("code") == 400
    )
    assert len(asked) == (1 if coded else 3), "a stream that breaks off may go through next time"
    done, asked = ask([*begun, error], pieces("hello"), timed=True)
    assert done.text == ("" if coded else "hello")


@pytest.mark.parametrize(
    "data", [json.dumps({"message": WORDS}), json.dumps(WORDS), WORDS, json.dumps({"error": WORDS})]
)
def test_an_event_named_error_is_one(data: str) -> None:
    done, _ = ask([f"event: error\ndata: {data}\n\n".encode()], timed=True)
    assert done.error == f"the stream broke off: {WORDS}"


def test_an_event_after_an_error_of_another_name_is_none() -> None:
    sent = [b"event: message\n", *pieces("hello")]
    assert ask(sent, timed=True)[0].text == "hello"


def test_a_list_of_models_that_is_an_error_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def listed(asked: Asked) -> None:
        asked.reply({"error": {"message": "no such key", "code": 401}})

    with (
        serving(lambda asked: None, listed) as there,
        pytest.raises(UserError, match="refuses the key"),
    ):
        openai_backend.open(card(there.url), batch_size=1)


def test_what_is_no_error_is_none() -> None:
    for good in (
        completion("a"), {**completion("a"), "error": None}, {**completion("a"), "detail": WORDS}, LISTED, {},
        [], None, 3, "", {"message": {"role": "assistant", "content": "a"}},
    ):  # fmt: skip
        assert fault_in(good) is None
    assert fault_in(WORDS, of_chat=False) is None
    assert fault_in({"detail": WORDS}, of_chat=False) is None
    assert fault_in({"error": WORDS}, of_chat=False) == Fault(WORDS)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(
        st.sampled_from(["choices", "error", "message", "detail", "code", "status", "metadata", "raw"]), inner
    ),
)  # fmt: skip


@given(json_values, st.booleans())
def test_whatever_comes_is_a_fault_or_none(payload: Any, of_chat: bool) -> None:
    fault = fault_in(payload, of_chat)
    assert fault is None or (
        isinstance(fault.words, str) and (fault.code is None or 400 <= fault.code <= 599)
    )
