"""The picture of an image prompt at the command line: its tokens, its looks, what is refused."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rich.color_triplet import ColorTriplet
from rich.style import Style
from tokenizers import Tokenizer, models

from harness.cli.pictures import half_blocks
from harness.dataset.load import load
from harness.world.perception.camera import frame

Harness = Callable[..., tuple[int, str, str]]
CARD = """\
engine = "transformers"
description = "d"
weights = "{weights}"
[vision]
width_px = 448
height_px = 224
patch_px = {patch_px}
merge = 2
[latency]
source = "paper"
basis = "b"
"""


@pytest.fixture
def one_word(tmp_path: Path) -> Path:
    """A tokenizer to which a message is one token."""
    Tokenizer(models.WordLevel({"?": 0}, unk_token="?")).save(str(tmp_path / "words.json"))
    return tmp_path / "words.json"


@pytest.fixture
def mine(tmp_path: Path) -> None:
    """A card of a model that sees, whose weights are not here."""
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "models").mkdir()
    (tmp_path / "models/mine.toml").write_text(CARD.format(weights="a/b", patch_px=16))


# -- how it looks ----------------------------------------------------------------------------------


def test_a_character_shows_the_means_of_two_parts_of_a_picture() -> None:
    pixels = np.zeros((256, 512, 3), dtype=np.uint8)
    pixels[:8] = (255, 0, 0)
    pixels[8:16:2] = (0, 0, 200)  # every other line: half of it
    drawn = half_blocks(pixels)
    lines = drawn.split("\n")
    assert (len(lines), {line.plain for line in lines}) == (16, {"▀" * 64})
    first, then = (
        next(s.style for s in line.spans if isinstance(s.style, Style)) for line in lines[:2]
    )
    assert first.color
    assert first.bgcolor
    assert then.color
    assert first.color.triplet == ColorTriplet(255, 0, 0)
    assert first.bgcolor.triplet == ColorTriplet(0, 0, 100)
    assert then.color.triplet == ColorTriplet(0, 0, 0)


@pytest.mark.parametrize(
    ("size_px", "cells"), [((448, 224), (64, 16)), ((500, 250), (64, 16)), ((20, 10), (20, 5))]
)
def test_a_picture_of_any_size_has_its_shape(
    size_px: tuple[int, int], cells: tuple[int, int]
) -> None:
    width, height = size_px
    lines = half_blocks(np.zeros((height, width, 3), dtype=np.uint8)).split("\n")
    assert (len(lines[0].plain), len(lines)) == cells


@pytest.mark.slow
def test_a_terminal_with_colours_is_shown_the_picture_and_any_other_is_told_how(
    harness: Harness, small_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    show = ("prompt", "show", "v8", "--scene", "00001-0", "--viewer", "v1", "--dataset", small_path)
    code, out, _ = harness(*show)
    picture, told, *text = out[out.index("picture:") :].splitlines()
    assert (code, text[-1]) == (0, "Distribution:")
    scene = load(small_path).scene("00001-0")
    seen = frame(load(small_path).scenario, scene.state, "v1")
    assert picture == (
        "picture: 512 x 256 pixels, front above rear; 128 tokens with swarm-tiny-vl, sha256 "
        + seen.sha256[:8]
    )
    assert told == "not drawn: no terminal with colours here; --out FOLDER writes PNG files"
    for name, value in (
        ("FORCE_COLOR", "1"),
        ("COLORTERM", "truecolor"),
        ("TERM", "xterm-256color"),
    ):
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("NO_COLOR", raising=False)
    _, out, _ = harness(*show)
    assert out.count("▀") == 64 * 16
    assert "not drawn" not in out
    r, g, b = np.rint(seen.pixels[:8, :8].reshape(-1, 3).mean(0)).astype(int)
    assert f"\x1b[38;2;{r};{g};{b};48;2;" in out[: out.index("▀")]


@pytest.mark.usefixtures("mine")
def test_pictures_are_written_in_the_size_of_a_model(harness: Harness, small_path: Path) -> None:
    show = ("prompt", "show", "v7", "--scene", "00001-0", "--dataset", small_path)
    code, out, _ = harness(*show, "--model", "mine", "--out", "new/shots")
    assert code == 0
    data = load(small_path)
    scene = data.scene("00001-0")
    for viewer in scene.viewers:
        file = Path("new/shots") / f"{scene.id}-{viewer}.png"
        assert file.read_bytes() == frame(data.scenario, scene.state, viewer, (448, 224)).png()
        assert f"wrote {file}" in out
    Path("taken").touch()
    assert harness(*show, "--out", "taken")[::2] == (
        2, "harness: --out taken cannot be written (File exists); give another folder\n",
    )  # fmt: skip


def test_what_says_json_has_the_digest_and_no_pixels(harness: Harness, small_path: Path) -> None:
    show = ("prompt", "show", "v7", "--scene", "00001-0", "--dataset", small_path, "--json")
    told = json.loads(harness(*show)[1])
    data = load(small_path)
    for viewer, (system, user) in told.items():
        assert system.keys() == {"role", "content"}
        seen = frame(data.scenario, data.scene("00001-0").state, viewer)
        assert user["image"] == {
            "model": "swarm-tiny-vl", "width_px": 512, "height_px": 256, "tokens": 128, "sha256": seen.sha256,
        }  # fmt: skip


# -- how many tokens it has ------------------------------------------------------------------------


@pytest.mark.usefixtures("mine")
@pytest.mark.parametrize(("model", "tokens"), [("swarm-tiny-vl", 128), ("mine", 98)])
def test_a_picture_counts_in_every_prompt(
    harness: Harness, small_path: Path, one_word: Path, model: str, tokens: int
) -> None:
    args = ("v7", "--dataset", small_path, "--tokenizer", one_word, "--model", model)
    told = json.loads(harness("prompt", "check", *args, "--json")[1])
    assert {role: {n["least"], n["most"]} for role, n in told["tokens"].items()} == {
        role: {2 + tokens} for role in ("ego", "helper", "fusion")
    }
    assert (told["picture"]["tokens"], told["picture"]["checked"]) == (tokens, False)
    _, out, _ = harness("prompt", "check", *args)
    assert f"{tokens} tokens with {model}, its processor is not here to ask\n" in out
    eval_v7 = (
        "eval",
        "--prompt",
        "v7",
        "--dataset",
        small_path,
        "--tokenizer",
        one_word,
        "--model",
        model,
    )
    for image, counted in (("own", 2 + tokens), ("blank", 2 + tokens), ("none", 2)):
        told = json.loads(
            harness(*eval_v7, "--limit", "1", "--image", image, "--dry-run", "--json")[1]
        )
        assert {(n["least"], n["most"]) for n in told["prompt_tokens"].values()} == {
            (counted, counted)
        }


@pytest.mark.exhaustive
def test_a_processor_that_is_here_is_asked_and_a_difference_ends_with_one(
    harness: Harness, small_path: Path, tmp_path: Path
) -> None:
    pytest.importorskip("torch", reason="needs the transformers extra")
    import tiny_vl

    folder = tiny_vl.build(tmp_path / "vl", "qwen2.5-vl")
    args = ("prompt", "check", "v8", "--dataset", small_path, "--model")
    _, out, err = harness(*args, folder)
    assert err == ""
    assert "448 x 224 pixels, front above rear; 128 tokens with vl, as its processor says\n" in out
    harness("init", "mine")
    for name, patch_px in (("agrees", 14), ("differs", 16)):
        Path(f"mine/models/{name}.toml").write_text(CARD.format(weights=folder, patch_px=patch_px))
    with pytest.MonkeyPatch.context() as there:
        there.chdir("mine")
        assert "128 tokens with agrees, as its processor says\n" in harness(*args, "agrees")[1]
        assert harness(*args, "differs") == (
            1, 
                "model 'differs': its processor makes 128 tokens of 448 x 224 pixels, and its "
                "card says 98; fix [vision]\n", "",
        )  # fmt: skip


# -- what is refused -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (("show", "v7", "--scene", "00001-0", "--model", "qwen3-4b"), 
            "--model qwen3-4b: prompt v7 shows a picture, and this model reads texts alone (its "
            "card has no [vision]); give another"),
        (("check", "v8", "--model", "proxy"), "--model proxy: prompt v8 shows a picture"),
        (("check", "v2", "--model", "proxy"), 
            "--model proxy: it reads no "
            "prompt; give a language model"),
        (("show", "v2", "--scene", "00001-0", "--out", "x"), "--out: prompt v2 shows no picture"),
    ],
)  # fmt: skip
def test_a_picture_that_cannot_be_is_one_line(
    harness: Harness, small_path: Path, args: tuple[str, ...], said: str
) -> None:
    code, out, err = harness("prompt", *args, "--dataset", small_path)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err
