"""A server that can tell what its model reads is asked first, and refused if it drops a text."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from misbehaving import Asked, completion, serving

from harness.backends import cards
from harness.backends.base import Request
from harness.backends.registry import open_backend
from harness.core.errors import UserError

LISTED = {"data": [{"id": "m", "owned_by": "tests"}]}
CHAT = (
    {"role": "system", "content": "You drive. \n"},
    {"role": "user", "content": "A lorry ahead."},
)
Tell = Callable[[list[Any]], Any]


def said(messages: list[Any]) -> str:
    return "".join(f"<|{m['role']}|>{m['content'].strip()}" for m in messages)


def users(messages: list[Any]) -> list[Any]:
    return [m for m in messages if m["role"] == "user"]


def asked_of(kind: Any, tell: Tell, system: Any = None) -> tuple[list[str], list[str]]:
    """Paths that a server of a kind was asked, and its answers;
    `tell` says what its model reads.
    """
    paths: list[str] = []

    def play(asked: Asked) -> None:
        if asked.body is None:
            asked.reply(LISTED)
            return
        paths.append(asked.path)
        asked.reply(
            completion() if asked.path.endswith("completions") else tell(asked.body["messages"])
        )

    with serving(play, play) as server:
        card = cards.load("openai-example")
        assert card.server
        there = replace(card.server, kind=kind, base_url=server.url, retries=0)
        backend = open_backend(
            replace(card, weights="m", server=there, system=system), batch_size=2
        )
        requests = [Request(f"{n}/v1", "ego", CHAT, ("A",), 9) for n in range(2)]
        texts = [answer.text for _ in range(2) for answer in backend.complete(requests)]
    return paths, texts


@pytest.mark.parametrize(
    ("kind", "tell", "path", "times"),
    [("llama-server", lambda messages: {"prompt": said(messages)}, "/apply-template", 1),
     ("vllm", lambda messages: {"count": len(said(messages))}, "/tokenize", 2),
     ("llama-server", lambda messages: {"error": "no such thing"}, "/apply-template", 1),
     ("vllm", lambda messages: [], "/tokenize", 2), ("generic", lambda messages: None, "/", 0)],
)  # fmt: skip
def test_a_server_is_asked_once_and_then_answers(
    kind: str, tell: Tell, path: str, times: int
) -> None:
    paths, texts = asked_of(kind, tell)
    assert paths == [path] * times + ["/v1/chat/completions"] * 4
    assert texts == ["hello"] * 4


@pytest.mark.parametrize(
    ("kind", "tell"),
    [("llama-server", lambda messages: {"prompt": said(users(messages))}),
     ("llama-server", lambda messages: {"prompt": said(messages).upper()}),
     ("vllm", lambda messages: {"count": len(said(users(messages)))})],
)  # fmt: skip
def test_a_server_that_drops_the_system_text_answers_nothing(kind: str, tell: Tell) -> None:
    with pytest.raises(
        UserError, match=r"leaves out or changes the system's text.*system = .first-user."
    ) as refused:
        asked_of(kind, tell)
    assert str(refused.value).isprintable()


def test_a_card_with_the_system_text_in_the_first_user_turn_is_served() -> None:
    _, texts = asked_of(
        "llama-server", lambda messages: {"prompt": said(users(messages))}, "first-user"
    )
    assert texts == ["hello"] * 4


@pytest.mark.parametrize(
    ("counts", "said_once"), [((40, 90), False), ((40, 40), True), ((40, 30), True)]
)
def test_it_is_said_once_if_longer_prompts_have_no_more_tokens(
    counts: tuple[int, int], said_once: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    def play(asked: Asked) -> None:
        if asked.body is None:
            asked.reply(LISTED)
            return
        long = len(asked.body["messages"][1]["content"]) > 100
        asked.reply(
            {**completion(), "usage": {"prompt_tokens": counts[long], "completion_tokens": 1}}
        )

    longer = (CHAT[0], {"role": "user", "content": "A lorry ahead. " * 10})
    with serving(play, play) as server:
        card = cards.load("openai-example")
        there = replace(card.server, kind="generic", base_url=server.url, retries=0)
        backend = open_backend(replace(card, weights="m", server=there), batch_size=1)
        for n, messages in enumerate((CHAT, longer, CHAT, longer)):
            backend.complete([Request(f"{n}/v1", "ego", messages, ("A",), 9)])
    told = capsys.readouterr().err.count(
        f"counts 40 tokens in a prompt of 26 characters and {counts[1]} in one"
    )
    assert told == said_once
