"""Counting tokens: the tokenizer that is given, the one beside the weights, or none and said so."""

import json
from pathlib import Path
from typing import Any

import pytest

from harness.backends.base import Request
from harness.backends.cards import resolve
from harness.backends.registry import capabilities
from harness.backends.token_counts import too_few
from harness.backends.tokens import counter, tokenizer
from harness.core.errors import UserError
from harness.core.resources import find

MESSAGES = ({"role": "system", "content": "ab"}, {"role": "user", "content": "ba 17"})


def refused(source: Path) -> str:
    with pytest.raises(UserError) as caught:
        tokenizer(source)
    message = str(caught.value)
    assert message.isprintable(), message
    return message


@pytest.mark.parametrize("name", ["absent.gguf", "absent", "with\nline.json"])
def test_no_file_is_one_line_that_says_what_to_give(name: str, tmp_path: Path) -> None:
    message = refused(tmp_path / name)
    assert message.startswith("no tokenizer at ")
    assert message.endswith("give a tokenizer.json, its folder, or a GGUF file")


def test_a_folder_without_one_is_one_line(tmp_path: Path) -> None:
    assert refused(tmp_path).startswith("no tokenizer at ")


@pytest.mark.parametrize(
    "content", [b"", b"{}", b"[1", b"\xff\x00", b"GGUF", b"GGUF\x03\x00\x00\x00" + b"\xff" * 64]
)
@pytest.mark.parametrize("name", ["t.gguf", "tokenizer.json"])
def test_a_file_that_is_something_else_is_one_line(
    name: str, content: bytes, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    assert "is no readable tokenizer: " in refused(tmp_path / name)


def gguf(file: Path, pre: str = "qwen2", **left_out: bool) -> Path:
    """A GGUF file with a vocabulary of bytes and one merge."""
    from gguf import GGUFWriter
    from tokenizers.pre_tokenizers import ByteLevel

    tokens = [*sorted(ByteLevel.alphabet()), "ab", "ĠĠ", "17", "<|im_end|>"]
    writer = GGUFWriter(file, "qwen2")
    writer.add_tokenizer_model("gpt2")
    writer.add_tokenizer_pre(pre)
    writer.add_token_list(tokens)
    writer.add_token_types([1] * (len(tokens) - 1) + [3])
    if not left_out.get("merges"):
        writer.add_token_merges(["a b", "Ġ Ġ", "1 7"])
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.close()
    return file


def test_a_gguf_file_is_read_as_its_model_reads_it(tmp_path: Path) -> None:
    """`a b` is merged, digits stand alone, and a special token is one."""
    made = tokenizer(gguf(tmp_path / "tiny.gguf"))
    assert made.encode("ab17<|im_end|>").tokens == ["ab", "1", "7", "<|im_end|>"]
    text = 'Überholt: {"SLOWER":0.70}\n\t17 m/s 🚗'
    assert made.decode(made.encode(text).ids) == text


@pytest.mark.slow
def test_a_gguf_file_that_nobody_knows_or_without_merges_is_one_line(tmp_path: Path) -> None:
    pytest.importorskip("transformers", reason="needs the transformers extra")
    message = refused(gguf(tmp_path / "odd.gguf", pre="of-my-own"))
    assert (
        "has the pre-tokeniser of-my-own, which is not known here; give the model's tokenizer"
        in message
    )
    assert "is no readable tokenizer" in refused(gguf(tmp_path / "bare.gguf", merges=True))


@pytest.mark.parametrize(
    ("pre", "tokens"),
    [
        ("smollm", ["a", "ĠĠ", "1", "7", "Ġ", "ab"]),
        ("gpt-2", ["a", "Ġ", "Ġ", "17", "Ġ", "ab"]),
        ("llama-bpe", ["a", "Ġ", "Ġ", "17", "Ġ", "ab"]),
        ("qwen2", ["a", "Ġ", "Ġ", "1", "7", "Ġ", "ab"]),
    ],
)
def test_text_is_split_as_the_file_says(pre: str, tokens: list[str], tmp_path: Path) -> None:
    made = tokenizer(gguf(tmp_path / "tiny.gguf", pre=pre))
    assert made.encode("a  17 ab").tokens == tokens


def test_the_gguf_file_of_a_model_counts_for_it(tmp_path: Path) -> None:
    file = gguf(tmp_path / "tiny.gguf")
    given, own = counter(file), counter(None, resolve(str(file)))
    assert given(MESSAGES) == own(MESSAGES) == 1 + 5


def tokenizer_json(folder: Path) -> Path:
    from tokenizers import Tokenizer, models, pre_tokenizers

    folder.mkdir()
    made = Tokenizer(models.WordLevel({"ab": 0, "ba": 1, "17": 2, "?": 3}, unk_token="?"))
    made.pre_tokenizer = pre_tokenizers.Whitespace()
    made.save(str(folder / "tokenizer.json"))
    return folder


def test_messages_are_counted_with_a_tokenizer_json_or_its_folder(tmp_path: Path) -> None:
    folder = tokenizer_json(tmp_path / "model")
    for source in (folder, folder / "tokenizer.json"):
        count = counter(source)
        assert count is not None
        assert count(MESSAGES) == 3


def test_the_tokenizer_beside_the_weights_counts_where_none_is_given(tmp_path: Path) -> None:
    folder = tokenizer_json(tmp_path / "model")
    (folder / "config.json").write_text(json.dumps({}))
    count: Any = counter(None, resolve(str(folder)))
    assert count(MESSAGES) == 3
    assert counter(None, resolve("proxy")) is None
    assert counter(None) is None


SHIPPED = find("models", "swarm-tiny") / "tokenizer.json"
BOS = "<|endoftext|>"


def saved(folder: Path, **changes: Any) -> Path:
    """The tokenizer that ships, saved with other settings."""
    folder.mkdir(exist_ok=True)
    (folder / "tokenizer.json").write_text(
        json.dumps({**json.loads(SHIPPED.read_text()), **changes})
    )
    return folder


def test_a_saved_limit_or_padding_changes_no_count(tmp_path: Path) -> None:
    long = [{"role": "user", "content": "v2 vehicle 63 17 89 6.0 exit-left ?\n" * 40}]
    cut = {"direction": "Right", "max_length": 16, "strategy": "LongestFirst", "stride": 0}
    padded = {"strategy": {"Fixed": 4096}, "direction": "Right", "pad_to_multiple_of": None, "pad_id": 0,
              "pad_type_id": 0, "pad_token": BOS}  # fmt: skip
    counts = [
        counted(long)
        for source in (SHIPPED, saved(tmp_path, truncation=cut, padding=padded))
        if (counted := counter(source))
    ]
    assert counts[0] == counts[1] > 400


def test_a_token_around_a_whole_prompt_is_not_counted_for_each_message(tmp_path: Path) -> None:
    from tokenizers import Tokenizer, processors

    shipped = Tokenizer.from_file(str(SHIPPED))
    begins = processors.TemplateProcessing(
        single=f"{BOS} $A", pair=f"{BOS} $A $B", special_tokens=[(BOS, shipped.token_to_id(BOS))]
    )
    shipped.post_processor = begins
    shipped.save(str(tmp_path / "tokenizer.json"))
    assert len(tokenizer(tmp_path).encode("a").ids) == 2
    counts = [counted(MESSAGES) for source in (SHIPPED, tmp_path) if (counted := counter(source))]
    assert counts[0] == counts[1]


@pytest.mark.parametrize(
    ("engine", "answer", "counts", "said"),
    [
        ("transformers", "json", (5, 2), None),
        ("transformers", "json", (4, 2), "4 tokens of a prompt with 80 characters"),
        ("transformers", "json", (5, 1), "1 tokens of a text with 17 characters"),
        ("transformers", "readout", (5, 1), None),  # whose text is made here
        ("openai", "json", (1, 2), None),  # a server may have cut its prompt
        ("openai", "json", (5, 1), "1 tokens of a text with 17 characters"),
        ("transformers", "json", (None, None), None),
        ("proxy", "json", (None, 0), None),
    ],
)
def test_a_text_has_a_token_in_sixteen_characters(
    engine: str, answer: Any, counts: tuple[int | None, int | None], said: str | None
) -> None:
    messages: Any = ({"role": "system", "content": "s" * 30}, {"role": "user", "content": "u" * 50})
    actions = ("IDLE", "FASTER")
    request = Request("s/v1", "ego", messages, actions, max_tokens=9, answer=answer)
    assert too_few(request, capabilities(engine), "a" * 17, *counts) == said
