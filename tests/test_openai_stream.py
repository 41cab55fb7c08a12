"""Answers of a server in pieces: put together to what they would be whole,
and when the first token came.
"""

import json
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from misbehaving import Asked, Play, completion, event, pieces, read_out, serving

from harness.backends.base import AnswerMode, Completion, Request
from harness.backends.card import Card, Latency
from harness.backends.openai import backend as openai_backend
from harness.backends.openai import http as openai_http
from harness.backends.openai import pool as openai_pool
from harness.backends.openai.shapes import read
from harness.backends.openai.stream import Stream
from harness.backends.servers import Server

KEY = "sk-5ecret/+very"
CUT_OFF = "the stream ends before the answer does"


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(openai_pool, "FIRST_WAIT_S", 0.01)
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")


def request(answer: AnswerMode = "json", name: str = "s/v1", timed: bool = True) -> Request:
    messages = ({"role": "user", "content": "Clear."},)
    return Request(name, "ego", messages, ("A", "B", "C"), 64, answer=answer, timed=timed)


def ask(
    play: Play, requests: Sequence[Request] = (request(),), batch_size: int = 1
) -> tuple[list[Completion], list[Asked]]:
    with serving(play) as there:
        card = Card("mine", "openai", "d", Latency("paper", None, "b"), "m",
                    server=Server(there.url, "generic", timeout_s=20.0, retries=1))  # fmt: skip
        return openai_backend.open(card, batch_size=batch_size).complete(requests), there.asked


def taken(*pieces: Any, step_s: float = 1.0) -> Stream:
    """A stream of which a piece came a second, from second 1."""
    stream = Stream()
    for n, piece in enumerate(pieces, 1):
        stream.take(piece if isinstance(piece, bytes) else event(piece), n * step_s)
    return stream


# -- the times -------------------------------------------------------------------------------------


def test_the_first_token_is_the_first_text_and_not_the_first_piece() -> None:
    """Second 1 says who speaks, 2 keeps the connection alive, 3, 4 and 5 bring a text each."""
    who, *rest = pieces("{", '"a"', "}")
    assert taken(who, b": keep-alive\n\n", *rest).first_at_s == 3.0
    thinks = {"choices": [{"delta": {"reasoning_content": "Hm."}}]}
    assert taken(who, thinks, *rest).first_at_s == 2.0, "a thought is generated, too"


def test_what_comes_all_at_once_has_no_first_token() -> None:
    """A proxy that holds a stream back would make all of an answer prefill."""
    stream = taken(*pieces("{", "}"), step_s=0.0)
    assert (stream.fault, stream.first_at_s) == (None, None)


def test_an_answer_that_is_timed_alone_is_streamed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The server goes on only when a piece was read, so that no two come at once."""
    was_read = threading.Event()

    class Watched(Stream):
        def take(self, data: bytes, at_s: float) -> None:
            super().take(data, at_s)
            was_read.set()

    def on() -> None:
        assert was_read.wait(10)
        was_read.clear()

    monkeypatch.setattr(openai_http, "Stream", Watched)
    [done], [asked] = ask(lambda asked: asked.stream(*pieces("{", '"a"', "}"), between=on))
    assert asked.body["stream"] is True
    assert (done.text, done.finish_reason, done.prompt_tokens, done.completion_tokens) == (
        '{"a"}', "stop", 12, 4,
    )  # fmt: skip
    assert done.seconds is not None
    assert done.first_token_s is not None
    assert 0 < done.first_token_s < done.seconds
    assert done.token_s == pytest.approx((done.seconds - done.first_token_s) / 3)


def test_answers_asked_together_or_for_a_run_are_not_streamed() -> None:
    done, asked = ask(
        lambda asked: asked.reply(completion()), [request(name="a"), request(name="b")], 2
    )
    assert [(c.seconds, c.first_token_s, c.token_s) for c in done] == [(None, None, None)] * 2
    [alone], [other] = ask(lambda asked: asked.reply(completion()), [request(timed=False)])
    assert alone.seconds is not None
    assert (alone.first_token_s, alone.token_s) == (None, None)
    assert [a.body["stream"] for a in (*asked, other)] == [False] * 3


def test_a_read_outs_only_token_is_there_with_the_answer() -> None:
    play: Play = lambda asked: asked.reply(read_out(("A", -0.1), ("B", -3.0), ("C", -4.0)))  # noqa: E731
    [done], [asked] = ask(play, [request("readout")])
    assert asked.body["stream"] is False
    assert done.error is None
    assert done.first_token_s == done.seconds is not None
    assert done.token_s is None


# -- servers that do not stream --------------------------------------------------------------------


def test_a_server_that_sends_it_whole_all_the_same_has_no_first_token() -> None:
    [done], _ = ask(lambda asked: asked.reply(completion("hello")))
    assert (done.text, done.retries, done.first_token_s, done.token_s) == ("hello", 0, None, None)
    assert done.seconds is not None


def test_a_server_that_refuses_to_stream_is_asked_for_the_whole_from_then_on() -> None:
    def play(asked: Asked) -> None:
        if asked.body["stream"]:
            asked.reply({"detail": "unknown field: stream_options"}, 422)
        else:
            asked.reply(completion("hello"))

    done, asked = ask(play, [request(name="a"), request(name="b")])
    assert [c.text for c in done] == ["hello", "hello"]
    assert [c.retries for c in done] == [1, 0], (
        "the refusal is in the first's time, which so does not count"
    )
    assert [a.body["stream"] for a in asked] == [True, False, False]


# -- streams that are none -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "said", "attempts"),
    [
        ([], CUT_OFF, 2),
        (pieces("hel", "lo", finish_reason=None)[:3], CUT_OFF, 2),
        ([*pieces("hel", finish_reason=None)[:2], b'data: {"choices":[{"del'], CUT_OFF, 2),
        ([b"data: {not json}\n\n", *pieces("hello")], 
            "a piece of the stream is "
            "no JSON: {not json}", 1),
        ([b"data: " + b"[" * 100_000 + b"\n\n"], 
            "a piece of the stream is "
            f"no JSON: {'[' * 165}…", 1),
        ([b"data: " + b"[" * 600 + b"]" * 600 + b"\n\n"],
            "a piece of the stream is "
            f"no JSON: {'[' * 165}…", 1),
        ([b"data: 3\n\n"], "a piece of the stream is no part of a chat completion", 1),
        ([{"choices": [{"delta": {"content": 3}}]}],
         "a piece of the stream is no part of a chat completion", 1),
        ([{"choices": "a"}], "a piece of the stream is no part of a chat completion", 1),
        ([b"data: [DONE]\n\n"], CUT_OFF, 2),
        ([{}, b"data: [DONE]\n\n"], CUT_OFF, 2),
        (pieces("hel", finish_reason=None), CUT_OFF, 2),
        ([{"choices": [{"text": "{}", "finish_reason": "stop"}]}],
         "a piece of the stream is no part of a chat completion", 1),
        ([*pieces("hel", finish_reason=None)[:2], {"error": {"message": 
            "out of\nmemory", "code": 500}}],
         "the stream broke off: out of memory", 2),
        ([event(pieces("x")[1])] * 90_000, "the answer is longer than 4194304 bytes", 1),
    ],
)  # fmt: skip
def test_a_stream_that_goes_wrong_is_an_error(sent: list[Any], said: str, attempts: int) -> None:
    def play(asked: Asked) -> None:
        with suppress(OSError):  # it may be read no further
            asked.stream(*sent)

    [done], asked = ask(play)
    assert (done.error, done.finish_reason, done.text) == (said, "error", "")
    assert (len(asked), done.retries) == (attempts, attempts - 1)
    assert (done.first_token_s, done.token_s) == (None, None)


@pytest.mark.parametrize("before", [[], pieces("hel", finish_reason=None)[:2]])
def test_a_whole_in_one_piece_is_the_answer(before: list[Any]) -> None:
    """As a proxy sends it that does not stream."""
    whole = completion("hello")
    [done], _ = ask(lambda asked: asked.stream(*before, whole, b"data: [DONE]\n\n"))
    assert (done.text, done.error, done.completion_tokens) == ("hello", None, 20)


def test_a_stream_that_is_cut_off_is_asked_for_again() -> None:
    def play(asked: Asked) -> None:
        asked.stream(*(pieces("hello") if asked.number else pieces("hel", finish_reason=None)[:2]))

    [done], _ = ask(play)
    assert (done.text, done.retries, done.error) == ("hello", 1, None)


def test_a_stream_without_a_count_of_tokens_has_no_time_per_token() -> None:
    [done], _ = ask(lambda asked: asked.stream(*pieces("hel", "lo", usage=False)[:-1]))
    assert (done.text, done.prompt_tokens, done.completion_tokens, done.token_s) == (
        "hello",
        None,
        None,
        None,
    )


def test_a_thought_beside_an_empty_field_of_a_thought_is_one() -> None:
    """The rename of the field: both are in each piece, one of them null or empty."""
    for old in (None, ""):
        sent = [
            {
                "choices": [
                    {"delta": {"reasoning_content": old, "reasoning": text}, "finish_reason": None}
                ]
            }
            for text in ("The gap ", "is short.")
        ]
        [done], _ = ask(lambda asked, sent=sent: asked.stream(*sent, *pieces("{}")))
        assert done.text == "<think>\nThe gap is short.\n</think>\n\n{}"


def test_a_key_that_is_cut_through_by_pieces_is_taken_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    [done], _ = ask(lambda asked: asked.stream(*pieces("I am ", KEY[:6], KEY[6:])))
    assert done.text == "I am [key]"
    [done], _ = ask(lambda asked: asked.stream({"error": f"{KEY} is no key"}))
    assert done.error == "the stream broke off: [key] is no key"


# -- any stream ------------------------------------------------------------------------------------


@given(
    st.lists(st.text(), min_size=1), st.sampled_from(["stop", "length"]), st.none() | st.text(),
    st.sampled_from(["\n", "\r\n"]), st.data(),
)  # fmt: skip
def test_pieces_cut_anywhere_say_what_the_whole_says(
    texts: list[str], finish: str, thought: str | None, newline: str, data: st.DataObject
) -> None:
    sent = pieces(*texts, finish_reason=finish, reasoning_content=thought)
    whole = b"".join(piece if isinstance(piece, bytes) else event(piece) for piece in sent)
    whole = whole.replace(b"\n", newline.encode())
    cuts = sorted(data.draw(st.lists(st.integers(0, len(whole)))))
    stream = Stream()
    for start, end in zip([0, *cuts], [*cuts, len(whole)], strict=True):
        stream.take(whole[start:end], 1.0)
    assert stream.fault is None
    one = completion(
        "".join(texts), finish, **({} if thought is None else {"reasoning_content": thought})
    )
    one["usage"]["completion_tokens"] = len(texts) + 1
    assert read(stream.payload(), request()) == read(one, request())


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(
        st.sampled_from(["choices", "delta", "content", "usage", "error", "message", "finish_reason",
                         "reasoning"]), inner),
)  # fmt: skip


SENT = given(st.lists(json_values | st.binary().map(lambda data: b"data: " + data + b"\n")))


@pytest.mark.slow
@settings(max_examples=10)
@SENT
def test_whatever_comes_is_an_answer_or_a_fault(sent: list[Any]) -> None:
    is_answer_or_fault(sent)


@pytest.mark.exhaustive
@SENT
def test_whatever_comes_of_more_is_an_answer_or_a_fault(sent: list[Any]) -> None:
    is_answer_or_fault(sent)


def is_answer_or_fault(sent: list[Any]) -> None:
    for wrapped in (
        sent,
        [p if isinstance(p, bytes) else {"choices": [{"delta": p}]} for p in sent],
    ):
        stream = taken(*wrapped)
        if stream.fault is None:
            assert read(json.loads(json.dumps(stream.payload())), request()).error is None
