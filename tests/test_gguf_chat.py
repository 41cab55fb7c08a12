"""A GGUF's chat template, rendered without transformers as transformers renders it."""

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("transformers", reason="needs the transformers extra")

import tiny_qwen3
from gguf_words import Words

from harness.backends.chat import Chat, HubTokenizer
from harness.backends.chat_template import ChatTemplate
from harness.core.errors import UserError

pytestmark = pytest.mark.slow  # a whole file, for `make quick` not to import torch

MESSAGES = (
    {"role": "system", "content": "You drive.\n <b>é</b> & 'don't' 日本"},
    {"role": "user", "content": "  Scene 1: truck 14 m "},
)


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory: pytest.TempPathFactory) -> Any:
    from transformers import AutoTokenizer

    return AutoTokenizer.from_pretrained(
        tiny_qwen3.build(tmp_path_factory.mktemp("models") / "tiny")
    )


TEMPLATES = {
    "Qwen3's switch": tiny_qwen3.TEMPLATE,
    "blocks on lines of their own": """
    {% for m in messages %}
      {% if m.role == 'user' %}
        {{ m.content | trim }}
      {% endif %}
    {% endfor %}
    {{- eos_token }}
""",
    "loop controls": "{% for m in messages %}{% if loop.index == 2 "
    "%}{% break %}{% endif %}x{% endfor %}",
    "JSON as it is": "{{ messages | tojson }}{{ messages[0] | tojson(indent=2) }}",
    "what it said": "{% for m in messages %}{% generation %}{{ "
    "m.content }}{% endgeneration %};{% endfor %}",
    "the day": "{{ strftime_now('%Y') }}",
    "nothing given": "{% if tools is none and documents is none "
    "%}none{% endif %}{{ bos_token }}{{ x }}",
    "namespaces and slices": "{% set ns = namespace(n=0) %}{% for m in messages[::-1] %}"
    "{% set ns.n = ns.n + 1 %}{{ ns.n }}{{ m.content[:4] }}{% endfor %}",
    "Python's own methods": "{{ "
    "messages[0].content.split('.')[0].upper() "
    "}}{{ 'x'.startswith('u') }}",
}


@pytest.mark.parametrize("template", TEMPLATES.values(), ids=TEMPLATES)
@pytest.mark.parametrize("thinking", [True, False])
def test_a_template_renders_as_in_transformers(
    tokenizer: Any, template: str, thinking: bool
) -> None:
    theirs = tokenizer.apply_chat_template(
        list(MESSAGES), chat_template=template, tokenize=False, add_generation_prompt=True,
        enable_thinking=thinking,
    )  # fmt: skip
    values = {**tokenizer.special_tokens_map, "enable_thinking": thinking}
    assert ChatTemplate("tiny", template).render(list(MESSAGES), **values) == theirs


def test_a_checkpoint_and_a_gguf_file_have_one_prompt(tokenizer: Any) -> None:
    tokenizer.chat_template = tiny_qwen3.TEMPLATE
    theirs, ours = Chat("tiny", HubTokenizer(tokenizer)), Chat("tiny", Words(tiny_qwen3.TEMPLATE))
    assert ours.render(MESSAGES, thinking=False) == theirs.render(MESSAGES, thinking=False)
    assert (ours.thinking, ours.template) == (theirs.thinking, theirs.template)


def test_a_template_that_refuses_the_messages_says_so() -> None:
    chat = Chat("gruff", Words("{{ raise_exception('System role not supported') }}"))
    with pytest.raises(
        UserError, match=r"'gruff': .*refuses the messages \(System role not supported\)"
    ):
        chat.render(MESSAGES, thinking=False)


def test_a_template_cannot_reach_out_of_its_sandbox() -> None:
    chat = Chat("sly", Words("{{ messages.__class__.__mro__[1].__subclasses__() }}"))
    with pytest.raises(UserError, match="refuses the messages"):
        chat.render(MESSAGES, thinking=False)


def test_a_template_that_is_no_jinja_is_known_at_once() -> None:
    with pytest.raises(UserError, match=r"'torn': its chat template is no Jinja \(.*endfor"):
        Chat("torn", Words("{% for m in messages %}"))


def test_tokens_and_bos_are_the_files(tmp_path: Path) -> None:
    every = "{% for m in messages %}{{ m.content }}{% endfor %}"
    chat = Chat("words", Words("{{ bos_token }}" + every, {"bos_token": "<s>"}, bos=1))
    assert (chat.bos, chat.encode("ab"), chat.decode([97, 98])) == (1, [97, 98], "ab")
    assert chat.spellings("Ba") == {"B": [66], "a": [97]}
    assert chat.render(MESSAGES[1:], thinking=False) == f"<s>{MESSAGES[1]['content']}"
