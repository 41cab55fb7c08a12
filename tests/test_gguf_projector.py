"""A saved Qwen3-VL as two GGUF files, its text part and its projector:
what is in them, what is refused.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("transformers", reason="needs the transformers extra")

import tiny_vl
from gguf import GGUFReader
from test_gguf_export import edit, remove, save_weights, tensors, weights_of

from harness.backends.gguf_export import export, projector_of
from harness.core.errors import UserError

pytestmark = pytest.mark.slow  # a whole file, for `make quick` not to import torch


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_vl.build(tmp_path_factory.mktemp("models") / "tiny", deepstack=[1])


def field(file: Path, key: str) -> Any:
    return GGUFReader(file).fields[key].contents()


def test_every_weight_is_in_one_of_the_two_to_the_bit(tiny: Path, tmp_path: Path) -> None:
    out = tmp_path / "tiny.gguf"
    export(tiny, out, "F32")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mmproj-tiny.gguf", "tiny.gguf"]
    theirs, text, seen = weights_of(tiny), tensors(out), tensors(projector_of(out))
    # a patch's weights are two, for a video's two frames
    assert len(text) + len(seen) == len(theirs) + 1
    for name, theirs_name in {
        "token_embd": "language_model.embed_tokens",
        "output_norm": "language_model.norm",
        "blk.1.attn_q": "language_model.layers.1.self_attn.q_proj",
    }.items():
        np.testing.assert_array_equal(
            text[f"{name}.weight"], theirs[f"model.{theirs_name}.weight"].numpy()
        )
    for name, theirs_name in {
        "v.blk.1.ln1.bias": "blocks.1.norm1.bias",
        "v.blk.0.attn_qkv.weight": "blocks.0.attn.qkv.weight",
        "v.blk.0.attn_out.bias": "blocks.0.attn.proj.bias",
        "v.blk.1.ffn_down.weight": "blocks.1.mlp.linear_fc2.weight",
        "v.post_ln.weight": "merger.norm.weight",
        "mm.0.weight": "merger.linear_fc1.weight",
        "mm.2.bias": "merger.linear_fc2.bias",
        "v.deepstack.1.norm.bias": "deepstack_merger_list.0.norm.bias",
        "v.deepstack.1.fc2.weight": "deepstack_merger_list.0.linear_fc2.weight",
        "v.patch_embd.bias": "patch_embed.proj.bias",
        "v.position_embd.weight": "pos_embed.weight",
    }.items():
        np.testing.assert_array_equal(seen[name], theirs[f"model.visual.{theirs_name}"].numpy())
    patch = theirs["model.visual.patch_embed.proj.weight"].numpy()
    np.testing.assert_array_equal(seen["v.patch_embd.weight"], patch[:, :, 0])
    np.testing.assert_array_equal(seen["v.patch_embd.weight.1"], patch[:, :, 1])


def test_the_two_say_what_llama_cpp_must_know(tiny: Path, tmp_path: Path) -> None:
    out = tmp_path / "tiny.gguf"
    export(tiny, out)
    assert field(out, "general.architecture") == "qwen3vl"
    assert field(out, "qwen3vl.rope.dimension_sections") == [3, 3, 2, 0]
    assert field(out, "qwen3vl.n_deepstack_layers") == 1
    seen = projector_of(out)
    assert field(seen, "general.architecture") == "clip"
    assert field(seen, "clip.projector_type") == "qwen3vl_merger"
    assert field(seen, "clip.vision.is_deepstack_layers") == [False, True]
    assert field(seen, "clip.vision.image_size") == 128  # 8 x 8 positions, 16 pixels each
    means = json.loads((tiny / "preprocessor_config.json").read_text())["image_mean"]
    assert field(seen, "clip.vision.image_mean") == pytest.approx(means)
    assert tensors(seen)["mm.0.weight"].dtype == np.float16
    assert tensors(seen)["v.position_embd.weight"].dtype == np.float32


@pytest.mark.parametrize(
    ("table", "key", "value", "said"),
    [
        ("vision_config", "spatial_merge_size", 4, 
            r"\[vision_config\]: "
            r"spatial_merge_size = 4; "
            r"only 2"),
        ("vision_config", "hidden_act", "gelu", "hidden_act = gelu; only gelu_pytorch_tanh"),
        ("text_config", "rope_parameters", {"rope_theta": 1e4, "mrope_section": [4, 2, 2]},
         r"mrope_section = \[4, 2, 2\]; only \[3, 3, 2\]"),
        ("text_config", "attention_bias", True, "attention_bias = True; only False"),
    ],
)  # fmt: skip
def test_what_llama_cpp_would_take_otherwise_is_refused(
    tiny: Path, tmp_path: Path, table: str, key: str, value: Any, said: str
) -> None:
    copy = Path(shutil.copytree(tiny, tmp_path / "copy"))
    edit(copy, "config.json", lambda c: c[table].update({key: value}))
    with pytest.raises(UserError, match=said) as caught:
        export(copy, tmp_path / "out.gguf")
    assert "\n" not in str(caught.value)


def test_what_is_missing_is_named_and_no_half_is_left(tiny: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(tiny, tmp_path / "copy"))
    weights = weights_of(copy)
    del weights["model.visual.merger.linear_fc2.bias"]
    save_weights(copy, weights)
    with pytest.raises(UserError, match=r"lacks model\.visual\.merger\.linear_fc2\.bias"):
        export(copy, tmp_path / "out" / "out.gguf")
    remove("preprocessor_config.json")(copy)
    with pytest.raises(
        UserError, match=r"has no preprocessor_config\.json; save its image processor"
    ):
        export(copy, tmp_path / "out" / "out.gguf")
    assert not list((tmp_path / "out").iterdir())
