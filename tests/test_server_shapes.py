"""Answers of servers in shapes of their own:
why they end, refusals, contents in parts, packed bodies.
"""

import gzip
import json
import zlib
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from misbehaving import Asked, completion, event, pieces, serving

from harness.backends.base import AnswerMode, Completion, Request
from harness.backends.card import Card, Latency
from harness.backends.openai import backend as openai_backend
from harness.backends.openai import pool as openai_pool
from harness.backends.openai.http import MOST_BYTES
from harness.backends.openai.shapes import read
from harness.backends.openai.stream import Stream
from harness.backends.openai.unpacking import Packed, Unpacker
from harness.backends.servers import Server
from harness.parsing.parse import parse

ACTIONS = ("SLOWER", "IDLE", "FASTER")
GOOD = '{"action_distribution": {"SLOWER": 0.1, "IDLE": 0.8, "FASTER": 0.1}}'
THOUGHT = "The gap is short."
WHOLE = json.dumps(completion(GOOD)).encode()
STREAMED = b"".join(piece if isinstance(piece, bytes) else event(piece) for piece in pieces(GOOD))
SSE = "text/event-stream"


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(openai_pool, "FIRST_WAIT_S", 0.01)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")


def request(answer: AnswerMode = "json", timed: bool = False, **more: Any) -> Request:
    messages = ({"role": "user", "content": "?"},)
    return Request("s/v1", "ego", messages, ACTIONS, 64, answer=answer, timed=timed, **more)


def ask(*replies: Any, timed: bool = False, **headers: str) -> tuple[Completion, list[Asked]]:
    """Ask once; the server gives these replies one after the other,
    and the last one from then on.
    """

    def play(asked: Asked) -> None:
        asked.reply(replies[min(asked.number, len(replies) - 1)], **headers)

    with serving(play) as there:
        where = Server(there.url, key_env="NO_KEY", timeout_s=20.0, retries=2)
        card = Card("mine", "openai", "d", Latency("paper", None, "b"), "m", server=where)
        [done] = openai_backend.open(card, batch_size=1).complete([request(timed=timed)])
    return done, there.asked


def streamed(*deltas: dict[str, Any], finish_reason: str = "stop") -> Stream:
    stream = Stream()
    for delta in deltas:
        stream.take(event({"choices": [{"delta": delta, "finish_reason": None}]}), 1.0)
    stream.take(event({"choices": [{"delta": {}, "finish_reason": finish_reason}]}), 2.0)
    return stream


# -- why it ends -----------------------------------------------------------------------------------


@pytest.mark.parametrize("finish", ["error", "abort", "ABORTED", "insufficient_system_resource"])
def test_an_answer_that_its_server_broke_off_is_none_and_asked_for_again(finish: str) -> None:
    half = completion(GOOD[:20], finish)
    done, asked = ask(half)
    said = f"the answer was broken off (finish_reason {finish})"
    assert (done.text, done.error, len(asked)) == ("", f"an error with HTTP 200: {said}", 3)
    done, _ = ask(half, completion(GOOD))
    assert (done.text, done.retries) == (GOOD, 1)
    stream = streamed({"content": GOOD[:20]}, finish_reason=finish)
    assert (stream.fault, stream.again) == (f"the stream broke off: {said}", True)


def test_what_the_server_says_of_its_error_goes_before_the_reason() -> None:
    half = completion(GOOD[:20], "error")
    half["choices"][0]["error"] = {"message": "no such tool", "code": 400}
    done, asked = ask(half)
    assert (done.error, len(asked)) == ("error 400 with HTTP 200: no such tool", 1)


@pytest.mark.parametrize(
    "finish", ["length", "model_length", "max_tokens", "MAX_TOKENS", "max-output-tokens"]
)
def test_a_text_that_was_cut_off_is_so_by_any_name(finish: str) -> None:
    assert read(completion(GOOD[:20], finish), request()).finish_reason == "length"
    assert (
        read(streamed({"content": "{"}, finish_reason=finish).payload(), request()).finish_reason
        == "length"
    )


@pytest.mark.parametrize(
    "finish", ["stop", "eos", "COMPLETE", "end_turn", "tool_calls", "", 3, ["length"]]
)
def test_any_other_word_says_that_it_is_whole(finish: Any) -> None:
    assert read(completion(GOOD, finish), request()).finish_reason == "stop"


# -- refusals --------------------------------------------------------------------------------------

NO = "I cannot help with driving."


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (completion(None, refusal=NO), NO),
        (completion("", refusal=NO), NO),
        (completion(GOOD, refusal=NO), NO),
        (completion([{"type": "refusal", "refusal": NO}]), NO),
        (completion(NO, "refusal"), NO),
        (completion(None, "content_filter"), ""),
        (completion("", "SAFETY"), ""),
        (streamed({"refusal": NO[:9]}, {"refusal": NO[9:]}).payload(), NO),
        (streamed({"content": ""}, finish_reason="content_filter").payload(), ""),
    ],
)
@pytest.mark.parametrize("answer", ["json", "constrained", "readout"])
def test_a_refusal_is_an_answer_with_the_words_of_the_server(
    made: dict[str, Any], words: str, answer: AnswerMode
) -> None:
    said = read(made, request(answer))
    assert (said.finish_reason, said.text, said.error) == ("refusal", words, None)
    parsed = parse(said.text, role="ego", actions=ACTIONS, finish_reason=said.finish_reason)
    assert (parsed.status, parsed.intent) == ("refused", None)
    assert parsed.detail == "the model refused the question" + (f": {words}" if words else "")


@pytest.mark.parametrize("nothing", [None, "", " ", False, {}])
def test_a_field_for_refusals_with_nothing_in_it_is_none(nothing: Any) -> None:
    assert read(completion(GOOD, refusal=nothing), request()).text == GOOD


def test_a_refusal_in_one_of_several_orders_is_that_of_all() -> None:
    messages = ({"role": "user", "content": "?"},)
    orders = request("readout", orders=(messages, messages))
    with serving(lambda asked: asked.reply(completion(None, refusal=NO))) as there:
        card = Card(
            "mine", "openai", "d", Latency("paper", None, "b"), "m", server=Server(there.url)
        )
        [done] = openai_backend.open(card, batch_size=1).complete([orders])
    assert (done.finish_reason, done.text, done.request_id) == ("refusal", NO, "s/v1")


# -- contents in parts -----------------------------------------------------------------------------

TEXT = {"type": "text", "text": GOOD}
THINKS = {"type": "thinking", "thinking": [{"type": "text", "text": THOUGHT}]}
WITH_THOUGHT = f"<think>\n{THOUGHT}\n</think>\n\n{GOOD}"


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ([TEXT], GOOD),
        ([{"type": "text", "text": GOOD[:9]}, {"type": "text", "text": GOOD[9:]}], GOOD),
        ([{"type": "output_text", "text": GOOD}], GOOD),
        ([{"text": GOOD}], GOOD),
        ([THINKS, TEXT], WITH_THOUGHT),
        ([{"type": "thinking", "thinking": THOUGHT}, TEXT], WITH_THOUGHT),
        ([{"type": "reasoning", "text": THOUGHT}, TEXT], WITH_THOUGHT),
        ([], ""),
    ],
)
def test_the_parts_of_a_content_are_one_text(content: list[Any], text: str) -> None:
    assert read(completion(content), request()).text == text
    stream = streamed(*({"content": [part]} for part in content))
    assert (stream.fault, read(stream.payload(), request()).text) == (None, text)


def test_a_thought_in_a_field_goes_before_one_in_parts() -> None:
    made = completion([THINKS, TEXT], reasoning_content="Hm.")
    assert read(made, request()).text == f"<think>\nHm.\n</think>\n\n{GOOD}"


@pytest.mark.parametrize(
    ("part", "what"),
    [
        ({"type": "image_url", "image_url": {}}, "part that is no text but image_url"),
        ({"type": 3}, "part that is no text but 3"),
        (GOOD, "part that is no text but str"),
        ({"type": "text"}, "part of type text without a text"),
        ({"type": "thinking", "thinking": [{}]}, "part of type thinking without a text"),
    ],
)
def test_another_part_is_an_error_that_names_it(part: Any, what: str) -> None:
    said = f"the answer's content has a {what}"
    assert read(completion([TEXT, part]), request()).error == said
    stream = streamed({"content": [part]})
    assert (stream.fault, stream.again) == (said, False)


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(
        st.sampled_from(["type", "text", "thinking"]), inner | st.sampled_from(["text", "thinking"])
    ),
)  # fmt: skip


@pytest.mark.slow
@settings(max_examples=15)
@given(st.lists(json_values))
def test_whatever_parts_come_are_texts_or_an_error(parts: list[Any]) -> None:
    said = read(completion(parts), request())
    assert (said.error is None) == (said.finish_reason != "error")
    assert said.error is None or said.error.isprintable()


# -- packed bodies ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("packed", "coding"),
    [
        (gzip.compress(WHOLE), "gzip"),
        (zlib.compress(WHOLE), "deflate"),
        (gzip.compress(b"\xef\xbb\xbf" + WHOLE), "X-GZIP"),
        (WHOLE, "identity"),
        (b"\xef\xbb\xbf" + WHOLE, ""),
    ],
)
def test_a_packed_answer_and_one_after_a_mark_are_read(packed: bytes, coding: str) -> None:
    done, _ = ask(packed, content_encoding=coding)
    assert (done.text, done.error) == (GOOD, None)


@pytest.mark.parametrize(
    ("packed", "coding"),
    [(gzip.compress(STREAMED), "gzip"), (b"\xef\xbb\xbf" + STREAMED, ""), (STREAMED, "")],
)
def test_so_is_a_stream(packed: bytes, coding: str) -> None:
    done, _ = ask(packed, timed=True, content_encoding=coding, content_type=SSE)
    assert (done.text, done.error) == (GOOD, None)


def test_a_mark_that_comes_in_pieces_is_no_text() -> None:
    stream = Stream()
    for byte in b"\xef\xbb\xbf" + event({"error": "full"}):
        stream.take(bytes([byte]), 1.0)
    assert stream.fault == "the stream broke off: full"


@pytest.mark.parametrize(
    ("packed", "coding", "said"),
    [
        (WHOLE, "br", 
            "the answer is compressed (Content-Encoding: br), "
            "though it was asked for as it is; "
         "have the server, or the proxy before it, leave it so"),
        (WHOLE, "gzip", "the answer is no gzip, though its Content-Encoding says so"),
        (gzip.compress(WHOLE), "", "the answer is no JSON: it begins '\\x1f"),
        (gzip.compress(b" " * (MOST_BYTES + 1)), "gzip", 
            "the answer is longer "
            f"than {MOST_BYTES} bytes"),
    ],
)  # fmt: skip
def test_what_cannot_be_unpacked_is_an_error_that_names_the_cause(
    packed: bytes, coding: str, said: str
) -> None:
    done, asked = ask(packed, content_encoding=coding)
    assert done.error is not None
    assert done.error.startswith(said)
    assert len(asked) == 1


def test_a_packed_error_has_its_words() -> None:
    done, _ = ask(
        gzip.compress(b'{"error": {"message": "too long", "code": 400}}'), content_encoding="gzip"
    )
    assert done.error == "error 400 with HTTP 200: too long"


def test_a_little_that_unpacks_to_much_is_unpacked_no_further_than_asked() -> None:
    bomb = gzip.compress(b" " * 10**6)
    assert len(Unpacker("gzip").take(bomb, 1000)) == 1000
    with pytest.raises(Packed):
        Unpacker("zstd")
