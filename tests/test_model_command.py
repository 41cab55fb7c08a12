"""`harness model list` and `harness model check`, as typed."""

import json
import re
import sys
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from misbehaving import Asked, completion, read_out, serving
from tiers import some

from harness import cli
from harness.backends import cards
from harness.backends.registry import open_backend
from harness.core.errors import UserError
from harness.core.files import sha256_file
from harness.core.plugins import say_once

CITED = """\
engine = "systemone"
description = "d"
weights = "a/b"
[server]
base_url = "http://127.0.0.1:8080/v1"
[latency]
source = "cited"
inference_s = 0.012
basis = "cited: b"
"""


def harness(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *args: str
) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command line."""
    monkeypatch.setattr(sys, "argv", ["harness", *args])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return (int(ended.value.code or 0), *capsys.readouterr())


def test_the_list_has_every_card_in_eighty_columns(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("swarmdrive.toml").touch()
    Path("models").mkdir()
    Path("models/cited.toml").write_text(CITED)
    code, out, _ = harness(monkeypatch, capsys, "model", "list")
    assert code == 0
    assert max(map(len, out.splitlines())) <= 80
    listed = {
        line.split()[0]: line for line in out.splitlines() if not line.startswith((" ", "name"))
    }
    assert sorted(listed) == cards.names()
    assert "card 145 ms" in listed["proxy"]
    assert listed["proxy"].endswith(" yes")
    assert listed["cited"].endswith(" if its server runs"), "nobody is asked whether it does"
    assert listed["qwen3-4b"].split()[3] == "paper"
    assert "cited 12 ms" in listed["cited"]
    assert "\n  Deterministic rule on what its viewer sees\n" in out
    lines = out.splitlines()
    other = lines[lines.index(next(line for line in lines if line.startswith("qwen3-4b"))) + 1 :]
    assert any(line.split()[:2] == ["llama-cpp", "switch"] for line in other[:3])


def test_the_json_list_is_the_cards_with_what_they_lack(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = harness(monkeypatch, capsys, "model", "list", "--json")
    assert code == 0
    rows = {row["name"]: row for row in json.loads(out)}
    assert rows["proxy"]["latency"]["inference_s"] == 0.145
    assert rows["proxy"]["missing"] is None
    assert rows["full-view"]["privileged"] is True
    assert rows["qwen3-4b:llama-cpp"]["quantisation"] == "Q4_K_M"


def test_a_model_free_engine_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = harness(monkeypatch, capsys, "model", "check", "proxy")
    assert (code, out) == (
        0,
        "proxy: engine proxy is model-free: no weights, no tokens, nothing to load\n",
    )
    code, out, _ = harness(monkeypatch, capsys, "model", "check", "brake", "--json")
    assert json.loads(out) == {"name": "brake", "engine": "driver", "model_free": True}


def test_a_misspelt_model_is_one_line_and_exit_code_two(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = harness(monkeypatch, capsys, "model", "check", "proxi")
    assert (code, out) == (2, "")
    assert err.startswith("harness: unknown model 'proxi'; did you mean 'proxy'?")
    assert err.count("\n") == 1


def test_without_the_extra_the_list_says_what_is_missing_and_a_check_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # as python sees a package that is not installed
    monkeypatch.setitem(sys.modules, "torch", None)
    code, out, _ = harness(monkeypatch, capsys, "model", "list")
    assert code == 0
    assert "no: torch" in out
    code, _, err = harness(monkeypatch, capsys, "model", "check", "qwen3-4b")
    assert code == 2
    assert "needs torch" in err
    assert "pip install 'swarmdrive-harness[transformers]'" in err


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real model with random weights, as a checkpoint and as a GGUF file in one directory."""
    pytest.importorskip("torch", reason="needs the transformers extra")
    import tiny_qwen3

    from harness.backends import gguf_export

    folder = tiny_qwen3.build(tmp_path_factory.mktemp("models") / "tiny", context_tokens=4096)
    gguf_export.export(folder, folder / "tiny-f32.gguf", "F32")
    return folder


@pytest.mark.parametrize("engine", some(["transformers"], exhaustive=["llama-cpp"]))
def test_a_check_shows_prompt_tokens_thinking_and_a_decision_in_each_way_of_answering(
    engine: str, tiny: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if engine == "llama-cpp":
        pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    capsys.readouterr()
    code, out, err = harness(
        monkeypatch, capsys, "model", "check", str(tiny), "--engine", engine, "--device", "cpu"
    )
    assert code == 0
    assert not err or "dtype auto is float32 here: this processor" in err
    for part in (
        f"{engine}  F32 on cpu" if engine == "llama-cpp" else f"{engine}  float32 on cpu",
        "0 of them BOS",
        "switch; not asked here; card: switch",
        "  | <|im_start|>system",
        "  | EGO speed 14.0 target 14 m/s",
        "  # 1 '<|im_start|>'",
    ):
        assert part in out
    assert all(line.isprintable() for line in out.splitlines())
    answers = [line.split(maxsplit=3) for line in out.splitlines() if " ms, " in line]
    assert [a[0] for a in answers] == ["json", "constrained", "readout"]
    assert all(float(a[1]) > 0 for a in answers)
    assert ["first token after" in " ".join(a) for a in answers] == [True, True, False]
    assert answers[2][3].startswith('1 token, stop: \'{"action_distribution":')


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["transformers", "llama-cpp"])
def test_weights_are_held_to_the_digest_of_their_card_whenever_they_are_loaded(
    engine: str, tiny: Path
) -> None:
    if engine == "llama-cpp":
        pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    file = tiny / ("tiny-f32.gguf" if engine == "llama-cpp" else "model.safetensors")
    card = replace(cards.resolve(str(tiny), engine), sha256=sha256_file(file))
    assert open_backend(card, device="cpu").identity()["engine"] == engine
    with pytest.raises(
        UserError, match=rf"{file.name} is not what its card says: sha256 {card.sha256}"
    ):
        open_backend(replace(card, sha256="0" * 64), device="cpu")


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model whose context has room for one letter behind the prompt, and for no JSON."""
    pytest.importorskip("torch", reason="needs the transformers extra")
    import tiny_qwen3

    return tiny_qwen3.build(tmp_path_factory.mktemp("models") / "short", context_tokens=680)


@pytest.mark.slow
def test_a_way_that_a_model_cannot_answer_in_is_said_and_the_others_are_timed(
    short: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    code, out, _ = harness(monkeypatch, capsys, "model", "check", str(short), "--device", "cpu")
    assert code == 0
    assert "json         no answer: context overflow: " in out
    assert " ms, 1 token, stop: " in out


def test_a_check_as_json_has_every_token_and_asks_for_a_thought_in_json_only(
    short: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    code, out, _ = harness(
        monkeypatch, capsys, "model", "check", str(short), "--device", "cpu", "--thinking", "--json"
    )
    seen = json.loads(out)
    assert code == 3  # its context is too short for a thought, and that is the only way it is asked
    assert (seen["thinking_asked"], seen["thinking"]) == (True, "switch")
    assert seen["prompt"].endswith("<|im_start|>assistant\n")
    assert "".join(piece for _, piece in seen["tokens"]) == seen["prompt"]
    assert list(seen["answers"]) == ["json"]
    assert seen["identity"]["engine"] == "transformers"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("check", "qwen3-4b", "--engine", "openai"), "unknown engine of model qwen3-4b 'openai'"),
        (
            ("check", "openai-example", "--device", "cpu"),
            "--device cpu: openai-example has no weights",
        ),
        (("pull", "proxy"), "'proxy' runs on proxy: it has no weights to pull"),
    ],
)
def test_what_a_model_has_not_is_one_line(
    arguments: tuple[str, ...],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    code, out, err = harness(monkeypatch, capsys, "model", *arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err


# -- models that see -------------------------------------------------------------------------------

SERVED = """\
engine = "openai"
description = "d"
weights = "m"
[vision]
width_px = 64
height_px = 32
patch_px = 16
merge = 2
[latency]
source = "paper"
basis = "b"
[server]
base_url = "{url}"
retries = 0
"""
ANSWER = '{"action_distribution":{"SLOWER":0.%02d,"IDLE":0.20,"FASTER":0.%02d}}'


def pictures_of(body: Any) -> list[str]:
    """The pictures of a request, as they were sent."""
    return [
        part["image_url"]["url"]
        for message in body["messages"] if isinstance(message["content"], list)
        for part in message["content"] if part["type"] == "image_url"
    ]  # fmt: skip


def looks(asked: Asked) -> None:
    """A server that answers by what it is shown, and counts its tokens."""
    pictures = pictures_of(asked.body)
    share = zlib.crc32("".join(pictures).encode()) % 70 + 5
    made = completion(ANSWER % (share, 80 - share))
    made["usage"]["prompt_tokens"] = 300 + 2 * len(pictures)
    asked.reply(made)


def ignores(asked: Asked) -> None:
    """One whose program leaves the picture out."""
    letters = asked.body.get("logprobs")
    asked.reply(
        read_out(("A", -0.5), ("B", -1.5), ("C", -2.0))
        if letters
        else completion(ANSWER % (70, 10))
    )


def ignores_uncounted(asked: Asked) -> None:
    asked.reply({**completion(ANSWER % (70, 10)), "usage": None})


def answers_all_alike(asked: Asked) -> None:
    """One whose model reads pictures, and always says the same."""
    made = completion(ANSWER % (70, 10))
    made["usage"]["prompt_tokens"] = 300 + 2 * len(pictures_of(asked.body))
    asked.reply(made)


def counts(asked: Asked) -> None:
    """One that reads texts, and says how many characters a prompt has."""
    letters = "logprobs" in asked.body
    said = (
        read_out(("A", -0.5), ("B", -1.5), ("C", -2.0))
        if letters
        else completion(ANSWER % (70, 10))
    )
    size = sum(len(message["content"]) for message in asked.body["messages"])
    asked.reply({**said, "usage": {"prompt_tokens": size, "completion_tokens": 1}})


def refuses(asked: Asked) -> None:
    if pictures_of(asked.body):
        asked.reply({"error": {"message": "image input is not supported"}}, 400)
    else:
        ignores(asked)


@pytest.mark.parametrize(
    ("play", "fault"),
    [
        (looks, None),
        (answers_all_alike, None),
        (ignores, 
            "ignores pictures: the same answers to a frame and "
            "to a blank one, and as many prompt "
         "tokens as without any; start it with its projector, or leave [vision] out of its card"),
        (ignores_uncounted, 
            "ignores pictures: the same answers to a "
            "frame and to a blank one; start it"),
        (refuses, "answers no prompt with a picture: "),
    ],
)  # fmt: skip
def test_a_server_that_ignores_pictures_is_told_from_one_that_looks(
    play: Any,
    fault: str | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.chdir(tmp_path)
    harness(monkeypatch, capsys, "init", "mine")
    monkeypatch.chdir("mine")
    with serving(play) as there:
        Path("models/served.toml").write_text(SERVED.format(url=there.url))
        code, out, err = harness(monkeypatch, capsys, "model", "check", "served")
    assert code == (fault is not None)
    assert "picture      v7 of the same scene, 64 x 32 pixels, 2 tokens by the card\n" in out
    if fault is None:
        assert err == ""
    else:
        assert err.count("\n") == 1
        assert err.startswith(f"harness: the server of served {fault}")
    sent = {url for asked in there.asked for url in pictures_of(asked.body)}
    assert len(sent) == 2  # a frame and a blank one


def test_a_model_of_texts_is_asked_no_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.chdir(tmp_path)
    harness(monkeypatch, capsys, "init", "mine")
    monkeypatch.chdir("mine")
    texts = re.sub(r"\[vision\].*?(?=\[latency)", "", SERVED, flags=re.S)
    with serving(counts) as there:
        Path("models/served.toml").write_text(texts.format(url=there.url))
        code, out, err = harness(monkeypatch, capsys, "model", "check", "served")
    assert (code, err) == (0, "")
    assert "picture" not in out
    # Letter A is the likeliest whatever it stands for.
    assert (
        "letters      100 % of a read-out follows the letter; the likeliest action does in 12 of 12"
        in out
    )
    assert "it does not read the scene" in out
    # Three orders of the actions, two of yes and no; and the pairs of scenes with letters read
    # once.
    examined = 3 * (12 + 2 * 8) + 2 * (2 * 8) + 2 * 8
    assert len(there.asked) == 2 * 3 + examined


@pytest.mark.exhaustive
def test_a_checkpoint_that_sees_is_shown_a_picture_and_a_blank_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch", reason="needs the transformers extra")
    import tiny_vl

    folder = tiny_vl.build(tmp_path / "vl")
    capsys.readouterr()
    say_once.cache_clear()  # a test before it may have opened one of that name
    code, out, err = harness(
        monkeypatch, capsys, "model", "check", str(folder), "--device", "cpu", "--json"
    )
    assert code == 0
    assert err.startswith("harness: model 'vl': dtype auto is float32 here: ")
    seen = json.loads(out)["looks"]
    own, blank = seen["answers"]["readout"], seen["blank"]["readout"]
    assert own["text"] != blank["text"]
    # Two markers of the template stand around the picture's tokens.
    assert own["prompt_tokens"] == blank["prompt_tokens"] == seen["text"]["prompt_tokens"] + 128 + 2
