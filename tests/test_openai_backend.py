"""The openai backend against a server that misbehaves on purpose;
a real one is in test_openai_server.py.
"""

import csv
import json
import math
import re
import socket
import sys
import threading
import time
import tomllib
from base64 import b64decode
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from email.utils import formatdate
from functools import partial
from pathlib import Path
from time import sleep
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from misbehaving import Asked, Play, completion, read_out, serving

from harness import cli
from harness.backends.base import AnswerMode, Completion, Request
from harness.backends.card import Card, Latency, Thinking
from harness.backends.openai import backend as openai_backend
from harness.backends.openai import pool as openai_pool
from harness.backends.openai.shapes import body, read
from harness.backends.servers import KINDS, Kind, Server
from harness.core import resources
from harness.core.config import convert
from harness.core.errors import UserError
from harness.core.image import Image
from harness.parsing.parse import parse

ACTIONS = ("SLOWER", "IDLE", "FASTER")
KEY = "sk-5ecret/+very"
MESSAGES = (
    {"role": "system", "content": "You drive."},
    {"role": "user", "content": "The zone is clear."},
)
CLOUD = """
engine = "openai"
description = "A large model in a cloud, at the paper's round trip"
weights = "gpt-4"

[server]
base_url = "{url}"
key_env = "CLOUD_LLM_KEY"

[latency]
source = "card"
inference_s = 0.510
basis = "cited: SwarmDrive paper, cloud reference, 510 ms a decision"
"""
GOOD = '{"action_distribution":{"SLOWER":0.10,"IDLE":0.80,"FASTER":0.10}}'


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Retries come soon, and no key of whoever runs the tests is sent anywhere."""
    monkeypatch.setattr(openai_pool, "FIRST_WAIT_S", 0.01)
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")


def card(url: str, kind: Kind = "generic", thinking: Thinking = "none", **server: Any) -> Card:
    where = Server(url, kind, **{"timeout_s": 20.0, "retries": 2, **server})
    return Card(
        "mine", "openai", "d", Latency("paper", None, "b"), "m", thinking=thinking, server=where
    )


def request(
    name: str = "s/v1", answer: AnswerMode = "json", thinking: bool = False, **more: Any
) -> Request:
    return Request(name, "ego", MESSAGES, ACTIONS, 64, answer=answer, thinking=thinking, **more)


def ask(play: Play, requests: Sequence[Request] = (request(),), **server: Any) -> list[Completion]:
    with serving(play) as there:
        return openai_backend.open(card(there.url, **server), batch_size=1).complete(requests)


def ask_one(play: Play, **server: Any) -> Completion:
    [done] = ask(play, **server)
    return done


# -- what is asked ---------------------------------------------------------------------------------


def test_a_plain_question_is_asked_greedily_and_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(lambda asked: asked.reply(completion(GOOD))) as there:
        backend = openai_backend.open(card(there.url + "/"), batch_size=1)
        [done] = backend.complete([request()])
    [asked] = there.asked
    assert asked.path == "/v1/chat/completions"
    assert asked.body == {
        "model": "m", "messages": list(MESSAGES), "max_tokens": 64, "temperature": 0, "seed": 0,
        "stream": False,
    }  # fmt: skip
    assert "Authorization" not in asked.headers
    assert (done.request_id, done.text, done.finish_reason, done.error) == (
        "s/v1",
        GOOD,
        "stop",
        None,
    )
    assert (done.prompt_tokens, done.completion_tokens, done.retries, done.batch_size) == (
        12,
        20,
        0,
        1,
    )
    assert done.seconds is not None
    assert done.seconds > 0
    assert backend.identity() == {
        "engine": "openai", "answers": 3, "server": "generic", "base_url": there.url + "/", "model": "m",
        "listed": {"id": "m", "owned_by": "tests"},
    }  # fmt: skip


SHOWN = (MESSAGES[0], {**MESSAGES[1], "image": "camera"})
PICTURE = Image(np.arange(96, dtype=np.uint8).reshape(4, 8, 3))


@pytest.mark.parametrize("answer", get_args(AnswerMode))
def test_a_picture_is_sent_before_the_text_of_its_message_and_shown_by_its_digest(
    answer: AnswerMode,
) -> None:
    asking = replace(request(answer=answer), messages=SHOWN, image=PICTURE)
    with serving(lambda asked: asked.reply(completion(GOOD))) as there:
        backend = openai_backend.open(card(there.url), batch_size=1)
        backend.complete([asking])
        [shown] = backend.rendered([asking])
        plain = json.loads(backend.rendered([request(answer=answer)])[0])
    [asked] = there.asked
    system, user = asked.body["messages"]
    assert system == MESSAGES[0]
    assert user.keys() == {"role", "content"}
    [picture, text] = user["content"]
    assert text == {"type": "text", "text": MESSAGES[1]["content"]}
    kind, _, data = picture["image_url"]["url"].partition("base64,")
    assert (picture["type"], kind) == ("image_url", "data:image/png;")
    assert b64decode(data, validate=True) == PICTURE.png()
    assert shown == json.dumps(asked.body, sort_keys=True, separators=(",", ":")).replace(
        picture["image_url"]["url"], f"sha256:{PICTURE.sha256}"
    )
    # Nothing else of the question is another's than of one without a picture.
    assert {**asked.body, "messages": None} == {**plain, "messages": None}


@pytest.mark.parametrize("thinking", [True, False])
def test_a_server_that_can_be_told_is_told_whether_to_think(thinking: bool) -> None:
    for kind in ("vllm", "llama-server"):
        mine = card("http://a/v1", kind, "switch")
        assert mine.server is not None
        asked = body(mine, mine.server, request(thinking=thinking))
        assert asked["chat_template_kwargs"] == {"enable_thinking": thinking}


def constraint(kind: Kind, role: str = "ego", form: str = "distribution") -> dict[str, Any]:
    """What a constrained request says beside what every request does."""
    mine = card("http://a/v1", kind)
    assert mine.server is not None
    asking = Request("s/v1", role, MESSAGES, ACTIONS, 64, form, "constrained")  # type: ignore[arg-type]
    asked = body(mine, mine.server, asking)
    plain = body(mine, mine.server, request())
    return {key: value for key, value in asked.items() if key not in plain}


def test_no_server_that_can_be_told_punishes_repetition() -> None:
    asked = {
        kind: body(card("http://a/v1", kind), Server("http://a/v1", kind), request())
        for kind in KINDS
    }
    told = {kind: [name for name in made if "penalty" in name] for kind, made in asked.items()}
    assert told == {
        "generic": [], "ollama": [], "vllm": ["repetition_penalty"], "llama-server": ["repeat_penalty"],
        "lm-studio": ["repeat_penalty"], "llama-cpp-python": ["repeat_penalty"],
    }  # fmt: skip
    assert all(made[name] == 1.0 for kind, made in asked.items() for name in told[kind])


HELPER = '{"evidence":"","risk":"low",'


@pytest.mark.parametrize(
    ("role", "form", "good"),
    [
        ("ego", "distribution", GOOD),
        ("helper", "distribution", HELPER + GOOD[1:]),
        ("helper", "recommendation", HELPER + '"recommended_maneuver":"IDLE","confidence":1.00}'),
    ],
)
def test_a_constrained_answer_of_every_role_and_form_is_one_the_parser_takes(
    role: str, form: str, good: str
) -> None:
    assert parse(good, role=role, actions=ACTIONS).verdict == "strict"
    regex = constraint("vllm", role, form)["structured_outputs"]["regex"]
    assert re.fullmatch(regex, good)
    spoilt = (good[:-1], good + " ", good.replace(":", ": "), good.replace("IDLE", "STOP"),
              good.replace(".", "1."), good.replace("0", "-0"), good.replace('""', '"a"'))  # fmt: skip
    for bad in spoilt:
        assert bad == good or not re.fullmatch(regex, bad), bad
    asked = constraint("generic", role, form)["response_format"]
    assert (asked["type"], asked["json_schema"]["strict"]) == ("json_schema", True)
    import jsonschema

    judge = jsonschema.Draft202012Validator(asked["json_schema"]["schema"])
    assert judge.is_valid(json.loads(good))
    assert not judge.is_valid({**json.loads(good), "more": 1})


def test_each_kind_of_server_is_asked_for_a_constrained_answer_in_its_own_words() -> None:
    asked = {kind: [*constraint(kind)] for kind in KINDS}
    assert asked == {
        "generic": ["response_format"], "ollama": ["response_format"], "lm-studio": ["response_format"],
        "vllm": ["structured_outputs"], "llama-server": ["grammar"], "llama-cpp-python": ["grammar"],
    }  # fmt: skip


# -- retries ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("as_date", [False, True])
def test_what_breaks_down_for_a_moment_is_asked_again_and_the_time_is_charged(
    as_date: bool,
) -> None:
    """Two failures, each with a wait that the server asked for, as seconds or as a date."""
    wait_s = 1.5 if as_date else 0.1  # a date has whole seconds: up to one is cut off

    def play(asked: Asked) -> None:
        if asked.number < 2:
            until = formatdate(time.time() + wait_s, usegmt=True) if as_date else f"{wait_s}"
            asked.reply({"error": "busy"}, (503, 429)[asked.number], retry_after=until)
        else:
            asked.reply(completion(GOOD))

    done = ask_one(play)
    assert (done.text, done.retries, done.error) == (GOOD, 2, None)
    assert done.seconds is not None
    assert 2 * (wait_s - as_date) <= done.seconds < 2 * wait_s + 1


def test_a_wait_that_would_never_end_is_cut_short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(openai_pool, "LONGEST_WAIT_S", 0.02)
    done = ask_one(lambda asked: asked.reply({"error": "busy"}, 429, retry_after="86400"))
    assert (done.retries, done.error) == (2, "HTTP 429: busy")


@pytest.mark.parametrize(
    "text", ["soon", "", "nan", "Wed, 99 Foo", "-5", "Wed, 21 Oct 2015 07:28:00 GMT"]
)
def test_a_retry_after_that_says_nothing_or_lies_behind_is_no_wait(text: str) -> None:
    done = ask_one(lambda asked: asked.reply({"error": "busy"}, 429, retry_after=text))
    assert (done.retries, done.error) == (2, "HTTP 429: busy")


@pytest.mark.parametrize("retries", [0, 3])
def test_a_server_that_always_breaks_down_gives_an_error_and_the_next_request_its_chance(
    retries: int,
) -> None:
    def play(asked: Asked) -> None:
        asked.reply(
            *(({"error": {"message": "boom"}}, 500) if asked.number <= retries else (completion(),))
        )

    first, second = ask(play, [request("a"), request("b")], retries=retries)
    assert (first.finish_reason, first.text, first.error) == ("error", "", "HTTP 500: boom")
    assert first.retries == retries
    assert (second.text, second.retries) == ("hello", 0)


@pytest.mark.parametrize("status", [400, 403, 404, 422])
def test_what_the_server_refuses_is_not_asked_again(status: int) -> None:
    done = ask_one(
        lambda asked: asked.reply({"detail": "no such\nmodel \x1b[31m" + "x" * 5000}, status)
    )
    assert done.retries == 0
    assert done.error is not None
    assert done.error.startswith(f"HTTP {status}: no such model \\x1b[31mxxx")
    assert len(done.error) < 300


def test_a_server_that_hangs_up_halfway_is_asked_again() -> None:
    def play(asked: Asked) -> None:
        if asked.number == 0:
            asked.raw(b"HTTP/1.1 200 OK\r\nContent-Length: 4000\r\n\r\n{")
        elif asked.number == 1:
            asked.raw(b"")
        else:
            asked.reply(completion(GOOD))

    done = ask_one(play)
    assert (done.text, done.retries) == (GOOD, 2)
    done = ask_one(lambda asked: asked.raw(b"no HTTP at all\r\n\r\n"), retries=1)
    assert (done.retries, done.finish_reason) == (1, "error")
    assert done.error is not None
    assert done.error.startswith("ClientResponseError: 400")


@pytest.mark.parametrize(
    "head", [b"HTTP/1.1 200 OK\r\nX: ", b"HTTP/1.1 200 OK\r\nContent-Length: 4000\r\n\r\n"]
)
def test_an_answer_that_drips_is_given_up_when_its_time_is_over(head: bytes) -> None:
    def play(asked: Asked) -> None:
        with suppress(OSError):
            asked.raw(head)
            for _ in range(200):  # four seconds, then it hangs up, which would be another error
                asked.raw(b"x")
                sleep(0.02)

    done = ask_one(play, timeout_s=0.3, retries=1)
    assert (done.error, done.retries) == ("no whole answer within 0.3 s", 1)
    assert done.seconds is not None
    assert done.seconds >= 0.6


# -- garbage ---------------------------------------------------------------------------------------


def one(message: Any) -> bytes:
    return json.dumps({"choices": [{"message": message}]}).encode()


NULL = "the answer's content is no text but null"


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (b"", "the answer is no JSON: it is empty"),
        (
            b"<html>502 Bad Gateway</html>",
            "the answer is no JSON: it begins '<html>502 Bad Gateway</html>'",
        ),
        (
            b"\x1f\x8b\x08\x00garbage",
            "the answer is no JSON: it begins '\\x1f\ufffd\\x08\\x00garbage'",
        ),
        (b"\xff\xfe{", "the answer is no JSON: it begins '\ufffd\ufffd{'"),
        (b"[" * 600 + b"]" * 600, f"the answer is no JSON: it begins '{'[' * 39}\u2026'"),
        (b"[" * 100_000, f"the answer is no JSON: it begins '{'[' * 39}\u2026'"),
        (b"null", "the answer is no chat completion"),
        (b"[]", "the answer is no chat completion"),
        (b"{}", "the answer is no chat completion"),
        (b'{"choices":[]}', "the answer is no chat completion"),
        (b'{"choices":{"0":1}}', "the answer is no chat completion"),
        (b'{"choices":["text"]}', "the answer is no chat completion"),
        (b'{"choices":[{"text":"hello"}]}', "the answer is no chat completion"),
        (b'{"usage":[1],' + one({"content": "a"})[1:], "the answer is no chat completion"),
        (one({"role": "assistant"}), "the answer is no chat completion"),
        (one({"content": None}), NULL),
        (one({"content": None, "tool_calls": [{}]}), f"{NULL}, and it calls a tool"),
        (one({"content": 3}), "the answer's content is no text but int"),
        (one({"content": "x" * (4 * 2**20)}), "the answer is longer than 4194304 bytes"),
    ],
)
def test_an_answer_that_is_none_is_an_error_and_not_asked_for_again(
    answer: bytes, said: str
) -> None:
    done = ask_one(lambda asked: asked.reply(answer))
    assert (done.error, done.finish_reason, done.text, done.retries) == (said, "error", "", 0)
    assert parse(done.text, role="ego", actions=ACTIONS, error=done.error).status == "engine_error"


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(
        st.sampled_from(["choices", "message", "content", "usage", "logprobs", "top_logprobs", "token",
                         "logprob", "prompt_tokens", "reasoning_content", "finish_reason"]), inner),
)  # fmt: skip


@pytest.mark.slow
@given(json_values, st.sampled_from(["json", "readout"]))
def test_whatever_json_comes_is_an_answer_or_an_error(payload: Any, answer: AnswerMode) -> None:
    choice = {"message": payload, "logprobs": payload}
    for made in (payload, {"choices": [payload]}, {"choices": [choice]}):
        said = read(made, request(answer=answer))
        if said.error is not None:
            assert (said.finish_reason, said.text) == ("error", "")
            assert said.error.isprintable()
        else:
            assert said.finish_reason in ("stop", "length")
            assert isinstance(said.text, str)


@pytest.mark.parametrize(
    ("theirs", "ours"),
    [
        ("stop", "stop"),
        ("length", "length"),
        ("content_filter", "length"),
        ("tool_calls", "stop"),
        (None, "stop"),
    ],
)
def test_the_reason_to_finish_is_cut_off_or_not(theirs: Any, ours: str) -> None:
    assert read(completion("a", theirs), request()).finish_reason == ours


@pytest.mark.parametrize(
    "count",
    [-1, True, 1e300, 10**300, 10**7 + 1, 2.0, float("nan"), float("inf"), "26", [26], {}, None],
)
def test_tokens_that_are_no_counts_are_unknown(count: Any) -> None:
    made = {**completion("a"), "usage": {"prompt_tokens": count, "completion_tokens": count}}
    said = ask_one(lambda asked: asked.reply(made))
    assert (said.text, said.prompt_tokens, said.completion_tokens, said.token_s) == (
        "a",
        None,
        None,
        None,
    )


def test_tokens_that_are_counts_are_known() -> None:
    made = {**completion("a"), "usage": {"prompt_tokens": 10**7, "completion_tokens": 1}}
    said = read(made, request())
    assert (said.prompt_tokens, said.completion_tokens) == (10**7, 1)


@pytest.mark.parametrize(
    ("written", "tokens"), [(160, 10), (160, 9), (161, 10), (0, 0), (1, 0), (150, 1)]
)
def test_a_text_has_a_token_for_each_sixteen_characters_at_least(written: int, tokens: int) -> None:
    """Who counts fewer has not counted, and latency and joules do not follow from it."""
    usage = {"prompt_tokens": 12, "completion_tokens": tokens}
    said = read({**completion("a" * written), "usage": usage}, request())
    assert said.completion_tokens == (tokens if 16 * tokens >= written else None)


@pytest.mark.parametrize(
    ("made", "written"),
    [
        (completion("a", reasoning_content="Hm. " * 200), 800 + len("<think>\n\n</think>\n\na")),
        (completion(None, reasoning="Hm. " * 200), 800 + len("<think>\n\n</think>\n\n")),
        (completion("a", refusal="I will not. " * 10), 120 + len("a")),
    ],
)
def test_what_a_server_took_out_of_a_text_has_tokens_too(
    made: dict[str, Any], written: int
) -> None:
    for tokens in (1, math.ceil(written / 16) - 1, math.ceil(written / 16)):
        usage = {"prompt_tokens": 12, "completion_tokens": tokens}
        said = read({**made, "usage": usage}, request())
        assert said.completion_tokens == (tokens if 16 * tokens >= written else None)


# -- thoughts --------------------------------------------------------------------------------------


def without_content(finish_reason: str, **message: Any) -> dict[str, Any]:
    made = completion("", finish_reason, **message)
    del made["choices"][0]["message"]["content"]
    return made


@pytest.mark.parametrize(
    ("made", "thinking", "status"),
    [
        (completion(GOOD, reasoning_content="Clear."), True, "strict"),
        (completion(GOOD, reasoning="Clear."), True, "strict"),
        (completion(GOOD, reasoning_content=""), True, "strict"),
        (completion(GOOD, reasoning_content=None, reasoning="Clear."), True, "strict"),
        (completion(GOOD, reasoning_content="", reasoning="Clear."), True, "strict"),
        (completion(GOOD, reasoning_content="Clear.", reasoning=None), True, "strict"),
        (
            completion(GOOD, reasoning_content={"text": "Clear."}, reasoning="Clear."),
            True,
            "strict",
        ),
        (without_content("length", reasoning=f"Maybe {GOOD}, but"), True, "truncated_reasoning"),
        (
            without_content("length", reasoning_content=None, reasoning="Hm"),
            True,
            "truncated_reasoning",
        ),
        (without_content("stop", reasoning=f"So {GOOD}"), True, "empty"),
        (completion(f"<think>Clear.</think>{GOOD}"), True, "strict"),
        (completion(f"<think>Clear.</think>{GOOD}", reasoning_content=None), True, "strict"),
        (completion(GOOD, reasoning_content=None), True, "truncated_reasoning"),
        (completion(GOOD), True, "truncated_reasoning"),
        (
            completion(None, "length", reasoning_content=f"Maybe {GOOD}, but"),
            True,
            "truncated_reasoning",
        ),
        (
            completion("", "length", reasoning_content=f"Maybe {GOOD}, but"),
            True,
            "truncated_reasoning",
        ),
        (completion("", reasoning_content=f"So {GOOD}"), True, "empty"),
        (completion(GOOD[:-9], "length", reasoning_content="Clear."), True, "truncated_json"),
        (completion(GOOD, reasoning_content="Clear."), False, "recovered"),
        (completion(GOOD, reasoning_content=""), False, "strict"),
    ],
)
def test_a_thought_that_the_server_took_out_is_put_back_and_judged_like_any(
    made: dict[str, Any], thinking: bool, status: str
) -> None:
    said = read(made, request(thinking=thinking))
    parsed = parse(
        said.text, role="ego", actions=ACTIONS, thinking=thinking, finish_reason=said.finish_reason,
        error=said.error,
    )  # fmt: skip
    assert (parsed.status, said.error) == (status, None)


# -- read-out --------------------------------------------------------------------------------------

HALF, QUARTER, EIGHTH, SIXTEENTH = -0.693147181, -1.386294361, -2.079441542, -2.772588722


def shares(*likeliest: tuple[str, float]) -> tuple[list[float], float | None]:
    said = read(read_out(*likeliest), request(answer="readout"))
    assert (said.error, said.finish_reason) == (None, "stop")
    assert parse(said.text, role="ego", actions=ACTIONS).status == "strict"
    p = json.loads(said.text)["action_distribution"]
    return [p[action] for action in ACTIONS], said.label_mass


def test_a_read_out_is_the_letters_probabilities_among_themselves() -> None:
    """A 1/2, B 1/4, C 1/8: 4/7, 2/7, 1/7 of a mass of 7/8."""
    p, mass = shares(
        ("A", HALF), ("B", QUARTER), ("C", EIGHTH), ("a", SIXTEENTH), ("the", SIXTEENTH)
    )
    assert p == pytest.approx([4 / 7, 2 / 7, 1 / 7], abs=1e-6)
    assert mass == pytest.approx(7 / 8)


@pytest.mark.parametrize("blank", [" ", "\u2581", "\u0120", "\n"])
def test_a_letter_counts_in_both_of_its_spellings(blank: str) -> None:
    """A 1/4 + 1/4, B 1/8 + 1/8, C 1/16: 8, 4 and 1 parts of 13/16;
    then each in the second spelling alone.
    """
    p, mass = shares(
        ("A", QUARTER), (f"{blank}A", QUARTER), ("B", EIGHTH), (f"{blank}B", EIGHTH),
        (f"{blank}C", SIXTEENTH), ("the", SIXTEENTH),
    )  # fmt: skip
    assert p == pytest.approx([8 / 13, 4 / 13, 1 / 13], abs=1e-6)
    assert mass == pytest.approx(13 / 16)
    p, mass = shares(
        *(
            (f"{blank}{x}", logprob)
            for x, logprob in zip("ABC", (HALF, QUARTER, EIGHTH), strict=True)
        )
    )
    assert p == pytest.approx([4 / 7, 2 / 7, 1 / 7], abs=1e-6)
    assert mass == pytest.approx(7 / 8)


def test_a_letter_that_is_not_listed_gets_the_most_that_it_can_have() -> None:
    """C is no likelier than the last listed token, 1/8;
    A and B are 6/8, so that C is 1/7 of 7/8.
    """
    p, mass = shares(("A", HALF), ("B", QUARTER), ("the", EIGHTH))
    assert p == pytest.approx([4 / 7, 2 / 7, 1 / 7], abs=1e-6)
    assert mass == pytest.approx(6 / 8), "only what was listed"
    # B and C share what is left, 1/4, since that is less than the last listed token's for each.
    p, mass = shares(("A", HALF), ("the", QUARTER))
    assert p == pytest.approx([4 / 6, 1 / 6, 1 / 6], abs=1e-6)
    assert mass == pytest.approx(1 / 2)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (completion("A"), "the server gives no log-probabilities"),
        (read_out(("A", float("nan"))), "the server's log-probabilities are none"),
        (read_out(("A", 0.5)), "the server's log-probabilities are none"),
        (read_out(("A", 1e6)), "the server gives no log-probabilities"),
        (
            read_out(("the", HALF), ("a", QUARTER)),
            "none of the letters ABC is among the 2 likeliest tokens",
        ),
        (
            read_out(("A", -9999.0), ("the", 0.0)),
            "none of the letters ABC is among the 2 likeliest tokens",
        ),
    ],
)
def test_a_read_out_without_the_letters_is_an_error(made: dict[str, Any], said: str) -> None:
    got = read(made, request(answer="readout"))
    assert (got.error, got.finish_reason) == (said, "error")


def test_a_read_out_asks_for_one_token_and_the_likeliest() -> None:
    with serving(
        lambda asked: asked.reply(read_out(("A", HALF), ("B", QUARTER), ("C", EIGHTH)))
    ) as there:
        openai_backend.open(card(there.url), batch_size=1).complete([request(answer="readout")])
    asked = there.asked[0].body
    assert (asked["max_tokens"], asked["logprobs"], asked["top_logprobs"]) == (1, True, 20)


# -- fields that a card changes --------------------------------------------------------------------


def sent(
    fields: str = "", answer: AnswerMode = "json", kind: Kind = "vllm", **more: Any
) -> dict[str, Any]:
    """What a server is sent by a card with these lines under [server]."""
    table = tomllib.loads(f'base_url = "http://a/v1"\nkind = "{kind}"\n{fields}')
    mine = replace(card("http://a/v1"), server=convert(table, Server, "model card"))
    assert mine.server is not None
    return body(mine, mine.server, request(answer=answer, **more))


def test_a_card_leaves_out_and_renames_fields_and_limits_log_probabilities() -> None:
    plain = sent()
    made = sent(
        'fields = { max_tokens = "max_completion_tokens", seed = false, repetition_penalty = false '
        "}"
    )
    assert made == {
        "model": "m", "messages": list(MESSAGES), "max_completion_tokens": 64, "temperature": 0,
        "stream": False,
    }  # fmt: skip
    assert {*plain} - {*made} == {"max_tokens", "seed", "repetition_penalty"}
    assert sent("fields = { max_tokens = true }") == plain
    drawn = sent('fields = { top_k = false, seed = "random_seed" }', temperature=0.5, sample=3)
    assert (drawn["random_seed"], drawn["top_p"], "top_k" in drawn, drawn["min_p"]) == (
        3,
        1,
        False,
        0,
    )
    assert sent(answer="readout")["top_logprobs"] == 20
    limited = sent('top_logprobs = 5\nfields = { max_tokens = "max_completion_tokens" }', "readout")
    assert (limited["top_logprobs"], limited["max_completion_tokens"], limited["logprobs"]) == (
        5,
        1,
        True,
    )


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ('fields = { seed = "messages" }', "seed is sent as messages, the name of another field"),
        ('fields = { max_tokens = "model" }', 
            "max_tokens is sent as model, "
            "the name of another field"),
        ('fields = { max_tokens = "seed", seed = false }', 
            "max_tokens is sent as "
            "seed, the name of another"),
        ('fields = { top_p = "x", top_k = "x" }', "top_p is sent as x, the name of another field"),
        ('fields = { seed = "a b" }', 
            "[fields]: seed = 'a b'; allowed: "
            "true, false or another name"),
        ("fields = { seed = 3 }", "seed = 3; allowed: true or false or a text"),
        ("fields = { messages = false }", "unknown key in model card [fields] 'messages'"),
        ("fields = { model = false }", "unknown key in model card [fields] 'model'"),
        ("fields = { grammar = false }", "unknown key in model card [fields] 'grammar'"),
        ("top_logprobs = 0", "top_logprobs = 0; allowed: 1 to 20"),
        ("top_logprobs = 21", "top_logprobs = 21; allowed: 1 to 20"),
        ("top_logprobs = true", "top_logprobs = True; allowed: a whole number"),
    ],
)  # fmt: skip
def test_no_field_overrides_what_is_asked(fields: str, said: str) -> None:
    with pytest.raises(UserError) as caught:
        sent(fields)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_temperature_that_is_never_sent_is_refused() -> None:
    assert "temperature" not in sent("fields = { temperature = false }")
    with pytest.raises(
        UserError, match=r"'mine': its card sends no temperature, and 0\.7 is asked for"
    ):
        sent("fields = { temperature = false }", temperature=0.7)


def test_a_card_with_fields_is_recorded_and_read_again_and_one_without_as_ever() -> None:
    table = {"base_url": "http://a/v1", "fields": {"seed": False}, "top_logprobs": 5}
    mine = replace(card("http://a/v1"), server=convert(table, Server, "model card"))
    record = json.loads(json.dumps(mine.record()))
    assert record["server"]["fields"] == {"seed": False}
    assert convert(record, Card, "run") == mine
    assert hash(mine)
    plain = card("http://a/v1")
    assert plain.record()["server"] == {
        "base_url": "http://a/v1", "kind": "generic", "key_env": "OPENAI_API_KEY", "timeout_s": 20.0,
        "retries": 2,
    }  # fmt: skip
    assert convert(plain.record(), Card, "run") == plain


@pytest.mark.parametrize(
    ("refusal", "hint"),
    [
        ("top_logprobs may be 5 at most", "; set top_logprobs under [server] in its card"),
        (
            "unknown field: seed",
            "; its card can leave seed out or rename it: fields under [server]",
        ),
        (
            "use max_completion_tokens in place of max_tokens",
            "; its card can leave max_tokens out or rename it",
        ),
        ("no", ""),
    ],
)
def test_a_refused_field_says_what_a_card_can_do(refusal: str, hint: str) -> None:
    done = ask_one(lambda asked: asked.reply({"error": {"message": refusal}}, 400))
    assert done.error is not None
    assert done.error.startswith(f"HTTP 400: {refusal}{hint}")
    assert hint or done.error == f"HTTP 400: {refusal}"


# -- who answered ----------------------------------------------------------------------------------


def named(*models: Any) -> Play:
    def play(asked: Asked) -> None:
        asked.reply({**completion(GOOD), "model": models[asked.number % len(models)]})

    return play


def test_a_server_that_answers_as_another_model_is_said_once_and_kept(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with serving(named("m", "other\x1b", None, "third", 7)) as there:
        backend = openai_backend.open(card(there.url), batch_size=1)
        done = backend.complete([request(f"s/v{n}") for n in range(5)])
        assert {c.text for c in done} == {GOOD}
        served = backend.served()
        assert [(each.id, each.model) for each in served] == [
            ("s/v0", "m"), ("s/v1", "other\\x1b"), ("s/v2", None), ("s/v3", "third"), ("s/v4", None),
        ]  # fmt: skip
        assert {each.server for each in served} == {there.url}
        assert backend.served() == []
    said = (
        f"harness: model 'mine': server {there.url} was asked for m, and says that other\\x1b "
        "answers\n"
    )
    assert capfd.readouterr().err == said


@pytest.mark.parametrize("name", ["m", "m:latest", "qwen.gguf"])
def test_a_name_that_the_server_lists_is_no_other(
    name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    listed: Play = lambda asked: asked.reply({"data": [{"id": "qwen.gguf"}]})  # noqa: E731
    with serving(named(name), listed) as there:
        openai_backend.open(card(there.url), batch_size=1).complete([request()])
    assert capfd.readouterr().err == ""


# -- several at a time -----------------------------------------------------------------------------


def test_requests_of_a_batch_are_asked_at_the_same_time_and_answered_in_order() -> None:
    """Four must be there before the first is answered; the last comes back first."""
    four, waiting, most = threading.Barrier(4), [], []

    def play(asked: Asked) -> None:
        waiting.append(asked)
        most.append(len(waiting))
        four.wait(timeout=20)
        sleep(0.01 * (3 - asked.number % 4))
        waiting.remove(asked)
        asked.reply(completion(asked.body["messages"][0]["content"]))

    asked = [
        Request(f"s/v{i}", "ego", ({"role": "user", "content": str(i)},), ACTIONS, 64)
        for i in range(12)
    ]
    with serving(play) as there:
        done = openai_backend.open(card(there.url), batch_size=4).complete(asked)
    assert [(c.request_id, c.text) for c in done] == [(f"s/v{i}", str(i)) for i in range(12)]
    assert max(most) == 4
    assert {(c.batch_size, c.seconds) for c in done} == {(4, None)}, (
        "a batch's time is nobody's latency"
    )


# -- opening ---------------------------------------------------------------------------------------


def test_a_server_that_nobody_listens_at_is_one_line() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{free.getsockname()[1]}/v1"
    with pytest.raises(UserError) as caught:
        openai_backend.open(card(url), batch_size=1)
    assert f"no server answers at {url} (ClientConnectorError" in str(caught.value)
    assert "start the server" in str(caught.value)
    with pytest.raises(UserError, match="no server answers at"):
        openai_backend.open(card("http://a..b/v1"), batch_size=1)


@pytest.mark.parametrize(
    "listed",
    [
        lambda asked: asked.reply({"error": "x"}, 500),
        lambda asked: asked.reply(b"<html>"),
        lambda asked: asked.reply({"data": [3, {"id": ["m"]}, {"id": "other"}]}),
        lambda asked: asked.reply({"data": "m"}),
        lambda asked: asked.raw(b""),
        lambda asked: asked.reply(b"", 307, location="http://127.0.0.1:9/v1/models"),
    ],
)
def test_a_server_without_a_list_of_models_is_asked_all_the_same(listed: Play) -> None:
    with serving(lambda asked: asked.reply(completion()), listed) as there:
        backend = openai_backend.open(card(there.url), batch_size=1)
        assert backend.identity()["listed"] is None
        assert backend.complete([request()])[0].text == "hello"


def test_a_server_with_one_model_answers_to_any_name() -> None:
    entry = {"id": "qwen.gguf\x1b", "owned_by": "llamacpp", "created": 17, "max_model_len": 4096}
    with serving(lambda asked: None, lambda asked: asked.reply({"data": [entry]})) as there:
        backend = openai_backend.open(card(there.url), batch_size=1)
    assert backend.identity()["listed"] == {
        "id": "qwen.gguf\\x1b",
        "owned_by": "llamacpp",
        "max_model_len": 4096,
    }


# -- the key ---------------------------------------------------------------------------------------


def test_the_key_is_read_from_the_variable_that_the_card_names(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SWARMDRIVE_KEYS", "OTHER_SECRET, MY_KEY")
    monkeypatch.setenv("MY_KEY", f" {KEY}\n")
    monkeypatch.setenv("OPENAI_API_KEY", "not-this-one")
    with serving(lambda asked: asked.reply(completion())) as there:
        openai_backend.open(card(there.url, key_env="MY_KEY"), batch_size=1).complete([request()])
    assert there.asked[0].headers["Authorization"] == f"Bearer {KEY}"


@pytest.mark.parametrize(
    "name",
    ["AWS_SECRET_ACCESS_KEY", "GITHUB_TOKEN", "HF_TOKEN", "MY_CLOUD_SECRET", "STRIPE_API_KEY", "HOME", "KEY",
     "OPENAI", "OPENAI_SECRET"],
)  # fmt: skip
def test_a_card_may_not_have_any_variable_sent(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(name, KEY)
    with serving(lambda asked: asked.reply(completion())) as there:
        with pytest.raises(
            UserError, match=f"key_env {name} is no name of a key of models"
        ) as caught:
            openai_backend.open(card(there.url, key_env=name), batch_size=1)
        assert there.asked == []
        assert "5ecret" not in str(caught.value)
        monkeypatch.delenv(name)
        openai_backend.open(card(there.url, key_env=name), batch_size=1).complete([request()])
    assert "Authorization" not in there.asked[0].headers


@pytest.mark.parametrize(
    "name", ["OPENAI_API_KEY", "AZURE_OPENAI_API_KEY", "VLLM_KEY", "LAB_LLM_TOKEN"]
)
def test_a_variable_named_for_a_key_of_models_needs_no_listing(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, KEY)
    with serving(lambda asked: asked.reply(completion())) as there:
        openai_backend.open(card(there.url, key_env=name), batch_size=1).complete([request()])
    assert there.asked[0].headers["Authorization"] == f"Bearer {KEY}"


def test_a_key_that_no_header_can_hold_is_refused_and_not_repeated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for bad in ("sk-5ecret\nX-Header: 1", "sk-5ecret é", "sk-5ecret x"):
        monkeypatch.setenv("OPENAI_API_KEY", bad)
        with pytest.raises(UserError, match="OPENAI_API_KEY holds characters") as caught:
            openai_backend.open(card("http://127.0.0.1:9/v1"), batch_size=1)
        assert "5ecret" not in str(caught.value)


def test_a_server_that_refuses_the_key_is_one_line_without_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", KEY)

    def refuse(asked: Asked) -> None:
        asked.reply({"error": {"message": f"no such key: {KEY}"}}, 401)

    with serving(refuse, refuse) as there, pytest.raises(UserError) as caught:
        openai_backend.open(card(there.url), batch_size=1)
    said = str(caught.value)
    assert (
        "refuses the key (HTTP 401: no such key: [key]); set OPENAI_API_KEY in the environment"
        in said
    )
    assert "5ecret" not in said


def test_an_error_without_words_says_so() -> None:
    said = ask_one(lambda asked: asked.reply(b"", 204))
    assert said.error == "HTTP 204: an empty reply"


def test_a_redirect_is_not_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    with serving(lambda asked: asked.reply(completion())) as other:
        done = ask_one(
            lambda asked: asked.reply(b"", 307, location=other.url + "/chat/completions")
        )
    assert (done.error, done.retries) == ("HTTP 307: a redirect, which is not followed", 0)
    assert other.asked == []


@pytest.mark.parametrize("location", ["javascript:1", "http://[::1", "//\u00e9\u00e9.xn--a"])
def test_a_redirect_to_what_is_no_address_is_the_answers_error(location: str) -> None:
    done = ask_one(lambda asked: asked.reply(b"", 302, location=location))
    assert done.error
    assert done.text == ""


def echo(asked: Asked, most: int = 9) -> None:
    """Say the Authorization header back, another way each time;
    the first four of them are answers.
    """
    header = asked.headers["Authorization"]
    spelt = "".join(f"\\u{ord(c):04x}" for c in header)
    ways = [
        lambda: asked.reply(completion(f"You said {header}.")),
        lambda: asked.reply(completion(None, reasoning_content=header)),
        lambda: asked.reply(json.dumps(completion("HEADER")).replace("HEADER", spelt).encode()),
        lambda: asked.reply(json.dumps(completion(header)).replace("/", "\\/").encode()),
        lambda: asked.reply({"error": {"message": "x" * 185 + header}}, 400),
        lambda: asked.reply({header: header}, 400),
        lambda: asked.reply(header.encode(), 404),
        lambda: asked.raw(header.encode() + b"\r\n\r\n"),
        lambda: asked.reply(
            {**completion(), "choices": [{"message": {"content": {header: header}}}]}
        ),
    ]
    ways[asked.number % most]()


def test_a_key_that_the_server_says_back_stands_in_no_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    done = ask(echo, [request(f"s/v{i}") for i in range(9)], retries=0)
    assert "5ecret" not in repr(done)
    assert done[0].text == "You said Bearer [key]."
    assert done[2].text == done[3].text == "Bearer [key]"
    assert done[6].error == "HTTP 404: Bearer [key]"


def test_a_short_key_is_no_secret_and_changes_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """`x` is what local servers are given; it may stand in any text."""
    monkeypatch.setenv("OPENAI_API_KEY", "0")
    assert ask_one(lambda asked: asked.reply(completion(GOOD))).text == GOOD


@pytest.mark.slow
def test_after_a_run_the_key_is_nowhere(
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    tmp_path: Path,
    small_path: Path,
) -> None:
    """A whole `harness eval` against a server that says the key back in every way,
    then in answers.
    """
    monkeypatch.setenv("SWARMDRIVE_KEYS", "MY_KEY")
    monkeypatch.setenv("MY_KEY", KEY)
    monkeypatch.chdir(tmp_path)
    shipped = resources.folder
    monkeypatch.setattr(
        resources, "folder", lambda kind: tmp_path if kind == "models" else shipped(kind)
    )
    with serving(echo) as there:
        (tmp_path / "served.toml").write_text(
            'engine = "openai"\ndescription = "d"\nweights = "m"\n'
            f'[server]\nbase_url = "{there.url}"\nkey_env = "MY_KEY"\nretries = 1\n'
            '[latency]\nsource = "paper"\nbasis = "b"\n'
        )
        options = [
            "--model",
            "served",
            "--dataset",
            str(small_path),
            "--limit",
            "1",
            "--out",
            "run",
        ]
        monkeypatch.setattr(sys, "argv", ["harness", "eval", *options])
        for code, made in (
            (3, {"unanswered.txt"}),
            (0, {"run.json", "answers.jsonl", "decisions.parquet"}),
        ):
            with pytest.raises(SystemExit) as ended:
                cli.main()
            assert (ended.value.code or 0) == code
            printed = capfd.readouterr()
            files = [path for path in (tmp_path / "run").rglob("*") if path.is_file()]
            texts = [path.read_bytes().decode("utf-8", "replace") for path in files]
            assert made <= {path.name for path in files}
            for text in (printed.out, printed.err, *texts):
                assert "5ecret" not in text
            assert any("[key]" in text for text in texts)
            there.play = partial(echo, most=4)
    assert len(there.asked) > 9
    assert "MY_KEY" in (tmp_path / "run" / "run.json").read_text()


@pytest.mark.slow
def test_the_papers_cloud_comparator_is_a_card_with_its_round_trip_declared(
    harness: Callable[..., tuple[int, str, str]],
    small_path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its server here answers at once: every decision takes 510 ms."""
    (tmp_path / resources.MARKER).touch()
    (tmp_path / "models").mkdir()
    monkeypatch.setenv("CLOUD_LLM_KEY", KEY)
    with serving(lambda asked: asked.reply(completion(GOOD))) as there:
        (tmp_path / "models/cloud.toml").write_text(CLOUD.format(url=there.url))
        options = (
            "--dataset",
            small_path,
            "--limit",
            "2",
            "--condition",
            "single-local",
            "--out",
            "run",
        )
        code, _, err = harness("eval", "--model", "cloud", *options, "--no-cache")
    assert (code, err) == (0, "")
    rows = csv.DictReader((tmp_path / "run/summary.csv").read_text().splitlines())
    means = {row["metric"]: row["value"] for row in rows}
    assert (float(means["latency_proxy_ms"]), float(means["deadline_miss_rate"])) == (510.0, 1.0)
