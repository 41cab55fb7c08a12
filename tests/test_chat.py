"""What a model reads is what it was to be told: no chat template drops, changes or moves a text."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from gguf_words import Words

from harness.backends import cards
from harness.backends.base import Request
from harness.backends.chat import Chat
from harness.backends.chat_template import lost_message, needs_first_user, with_system
from harness.backends.openai.shapes import body
from harness.core.errors import UserError
from harness.core.resources import find
from harness.dataset.load import Dataset

Harness = Callable[..., tuple[int, str, str]]
TURNS = (
    "{% for m in messages %}<|im_start|>{{ m.role }}\n{{ m.content | trim }}<|im_end|>\n{% endfor "
    "%}"
)
OPENING = "{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
REFUSES = (
    "{% if messages[0].role == 'system' %}{{ raise_exception('no system role') }}{% endif %}"
    + TURNS
    + OPENING
)
DROPS = TURNS.replace("<|im_start|>", "{% if m.role != 'system' %}<|im_start|>").replace(
    "<|im_end|>\n", "<|im_end|>\n{% endif %}"
)
LAST = "{{ messages[1].content }}{{ messages[0].content }}"
CUTS = TURNS.replace("| trim", "| truncate(20, true)")
CHAT = (
    {"role": "system", "content": "  You drive car v1. Answer with JSON only.\n"},
    {"role": "user", "content": "Scene 1: nothing in sight."},
    {"role": "assistant", "content": "<think>\nhm\n</think>\n\n{}"},
    {"role": "user", "content": "Scene 2: a lorry ahead."},
)


def test_all_is_said_whatever_white_space_is_around_it() -> None:
    chat = Chat("good", Words(TURNS + OPENING))
    prompt = chat.render(CHAT, thinking=False)
    assert prompt.endswith("a lorry ahead.<|im_end|>\n<|im_start|>assistant\n")
    assert lost_message(CHAT, prompt) is None


def test_a_thought_of_an_earlier_turn_may_be_left_out() -> None:
    forgets = TURNS.replace("| trim", ".split('</think>')[-1] | trim").replace(
        "m.content .", "m.content."
    )
    assert "hm" not in Chat("forgets", Words(forgets)).render(CHAT, thinking=False)


@pytest.mark.parametrize(
    ("template", "said"),
    [(DROPS, "message 1 of 4, the system's"), (CUTS, "message 1 of 4"),
     (LAST, 
         "message 2 of 4, the "
         "user's"), (TURNS.replace("messages", "messages[:3]"), "message 4 of 4"),
     (TURNS.replace("| trim", "| upper"), "message 1 of 4"), ("", "message 1 of 4")],
)  # fmt: skip
def test_a_template_that_leaves_out_changes_or_moves_a_text_is_refused(
    template: str, said: str
) -> None:
    with pytest.raises(
        UserError, match="model 'bad': its chat template leaves out or changes the text"
    ) as refused:
        Chat("bad", Words(template)).render(CHAT, thinking=False)
    assert said in str(refused.value)
    assert str(refused.value).isprintable()


@pytest.mark.parametrize(
    ("template", "helps"), [(REFUSES, True), (DROPS, True), ("", False), (CUTS, False)]
)
def test_the_way_out_is_named_where_it_helps(template: str, helps: bool) -> None:
    with pytest.raises(UserError) as refused:
        Chat("bad", Words(template)).render(CHAT, thinking=False)
    assert ('a card with system = "first-user"' in str(refused.value)) == helps


@pytest.mark.parametrize("template", [REFUSES, DROPS])
def test_the_system_text_begins_the_first_user_turn_where_the_card_says_so(template: str) -> None:
    prompt = Chat("old", Words(template), system="first-user").render(CHAT, thinking=False)
    text = (
        "user\nYou drive car v1. Answer with JSON only.\n\n\nScene 1: nothing in sight.<|im_end|>"
    )
    assert prompt.startswith(f"<|im_start|>{text}")
    assert with_system(CHAT[1:], "first-user") == CHAT[1:]
    assert with_system(CHAT, None) == CHAT


def test_a_server_is_sent_it_the_same_way(tmp_path: Path) -> None:
    card = cards.load("openai-example")
    assert card.server
    request = Request("0/v1", "ego", CHAT[:2], ("A",), 9)
    asked = body(replace(card, system="first-user"), card.server, request)["messages"]
    assert [m["role"] for m in asked] == ["user"]
    assert asked[0]["content"].startswith("  You drive car v1.")
    assert [m["role"] for m in body(card, card.server, request)["messages"]] == ["system", "user"]


def test_only_a_template_that_refuses_is_given_it_unasked() -> None:
    assert needs_first_user(REFUSES)
    assert not any(
        map(needs_first_user, (TURNS + OPENING, DROPS, "{{ raise_exception('x') }}", "{% for", ""))
    )


@pytest.mark.parametrize(
    ("template", "end"),
    [(TURNS, "<|im_end|>"), (TURNS.replace("<|im_end|>", "</s>"), "</s>"), (OPENING, None),
     (TURNS.replace("<|im_end|>", ""), None), ("{{ raise_exception('x') }}", None)],
)  # fmt: skip
def test_an_answer_ends_at_the_token_that_the_template_writes_after_it(
    template: str, end: str | None
) -> None:
    class Marked(Words):
        def encode(self, text: str) -> list[int]:
            marks = [mark for mark in ("<|im_end|>", "</s>") if text.startswith(mark)]
            return [7] if marks else list(text.encode())

        def pieces(self, ids: Sequence[int]) -> list[str]:
            return [end or "?" if i == 7 else chr(i) for i in ids]

    assert Chat("m", Marked(template)).turn_end == (7 if end else None)


# -- real weights ----------------------------------------------------------------------------------


def with_template(folder: Path, template: str) -> Path:
    """The GGUF file that ships, with another chat template."""
    made = folder / "other.gguf"
    (folder / "template.jinja").write_text(template)
    shipped = find("models", "swarm-tiny") / "swarm-tiny-f16.gguf"
    options = ["--force", "--chat-template-file", str(folder / "template.jinja")]
    program = "from gguf.scripts.gguf_new_metadata import main; main()"
    subprocess.run(
        [sys.executable, "-c", program, *options, str(shipped), str(made)],
        check=True,
        capture_output=True,
    )
    return made


@pytest.mark.exhaustive
def test_a_gguf_file_without_a_system_role_is_run_and_said_to_be(
    harness: Harness, small: Dataset, small_path: Path, tmp_path: Path
) -> None:
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    model = with_template(tmp_path, REFUSES)
    assert cards.resolve(str(model)).system == "first-user"
    args = (
        "--model",
        model,
        "--dataset",
        small_path,
        "--limit",
        "1",
        "--answer",
        "readout",
        "--out",
        "RUN",
    )
    code, out, err = harness("eval", *args)
    assert code == 0, err
    assert "reads the system text at the beginning of the first" in " ".join(out.split())
    assert json.loads(Path("RUN/run.json").read_text())["model"]["system"] == "first-user"
    assert (
        "reads the system text at the beginning of the first user turn"
        in Path("RUN/report.html").read_text()
    )
    scene = next(iter(small.forest.place))
    shown = ("prompt", "show", "v2", "--scene", scene, "--dataset", small_path, "--viewer", "v1")
    assert harness(*shown)[1].count("--- v1 ") == 2
    code, out, err = harness(*shown, "--model", model)
    assert (code, out.count("--- v1 "), out.count("--- v1 user")) == (0, 1, 1), err


@pytest.mark.slow
def test_a_gguf_file_that_drops_the_system_text_is_refused(
    harness: Harness, small_path: Path, tmp_path: Path
) -> None:
    pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    model = with_template(tmp_path, DROPS + OPENING)
    args = ("--model", model, "--dataset", small_path, "--limit", "1", "--out", "RUN")
    code, _, err = harness("eval", *args)
    assert (code, err.count("\n")) == (2, 1)
    assert "message 1 of 2, the system's" in err


@pytest.mark.exhaustive
def test_a_checkpoint_whose_end_is_another_token_ends_where_its_template_says(
    harness: Harness, tmp_path: Path
) -> None:
    pytest.importorskip("torch", reason="needs the transformers extra")
    pytest.importorskip("transformers", reason="needs the transformers extra")
    copy = tmp_path / "copy"
    shutil.copytree(find("models", "swarm-tiny"), copy, ignore=shutil.ignore_patterns("*.gguf"))
    changes: dict[str, dict[str, Any]] = {
        "config.json": {"eos_token_id": 765}, "generation_config.json": {"eos_token_id": 765},
        "tokenizer_config.json": {"eos_token": "<|endoftext|>"},
    }  # fmt: skip
    for name, change in changes.items():
        file = copy / name
        file.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    code, out, err = harness("model", "check", copy, "--json")
    seen = json.loads(out)
    assert (code, seen["turn_end"]) == (0, "<|im_end|>"), err
    assert seen["answers"]["json"]["finish_reason"] == "stop"
