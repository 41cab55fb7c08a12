"""`harness parity` on a tiny Qwen3: a GGUF file of the same weights, and one of others."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("transformers", reason="needs the transformers extra")
pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")

import tiny_qwen3
import torch
import transformers
from evaluating import scenes_of, spec_of
from typer.testing import CliRunner

from harness.backends import cards
from harness.cli import app
from harness.dataset.load import Dataset
from harness.evaluate.asking import requests
from harness.training.gguf_export import export
from harness.training.parity import PASSES, Finding, compare

PROMPTS = 4


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint with its own weights in a GGUF file."""
    folder = tiny_qwen3.build(tmp_path_factory.mktemp("models") / "tiny", context_tokens=2048)
    export(folder, folder / "tiny.gguf")
    return folder


@pytest.fixture(scope="module")
def unlike(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same checkpoint beside a GGUF file of other weights."""
    folder, other = (tmp_path_factory.mktemp(name) / name for name in ("unlike", "other"))
    shutil.copytree(tiny, folder)
    shutil.copytree(tiny, other)
    model = transformers.AutoModelForCausalLM.from_pretrained(tiny)
    with torch.no_grad():
        model.lm_head.weight.copy_(model.lm_head.weight.roll(7, dims=0))  # each token speaks for another
    model.save_pretrained(other)
    export(other, folder / "tiny.gguf")
    return folder


def compared(folder: Path, data: Dataset) -> dict[str, Finding]:
    spec = spec_of(data, str(folder))
    asked = list(requests(spec, scenes_of(data)))[:PROMPTS]
    read_out = spec_of(data, str(folder), answer="readout")
    raw = replace(read_out, ego=replace(read_out.ego, letters="raw"))  # as the command asks
    letters = list(requests(raw, scenes_of(data)))[:PROMPTS]
    passes: list[int] = []
    found = compare(spec.ego.card, cards.resolve(str(folder), "llama-cpp"), asked, letters, passes.append)
    assert passes == [1] * PASSES
    assert {finding.n for finding in found} == {PROMPTS}
    return {finding.what: finding for finding in found}


def test_the_engines_agree_on_the_same_weights(tiny: Path, small: Dataset) -> None:
    found = compared(tiny, small)
    # Random weights are often undecided between two tokens: what half the bits keep of their text is chance.
    chance = found.pop("GGUF: greedy text equal")
    assert chance.holds == (chance.differences == ())
    assert [what for what, finding in found.items() if not finding.holds] == []
    assert found["F32: token ids equal"].measured == 1.0
    assert 0 < found["F32: largest difference of a logit"].measured < 1e-3
    # Half as many bits: farther off, and the figure shows it.
    exact, halved = (found[f"{kind}: largest difference of a logit"].measured for kind in ("F32", "GGUF"))
    assert halved > 10 * exact


def test_other_weights_are_found_to_differ_and_where_is_named(unlike: Path, small: Dataset) -> None:
    found = compared(unlike, small)
    failed = {what for what, finding in found.items() if not finding.holds}
    assert failed == {"GGUF: greedy text equal", "GGUF: largest difference of a read-out"}
    first = next(iter(requests(spec_of(small, str(unlike)), scenes_of(small))))
    assert found["GGUF: greedy text equal"].differences[0].startswith(f"{first.id}: ")
    # Against the checkpoint's own export in F32 nothing fails: the file is at fault, not the engine.
    assert found["F32: greedy text equal"].holds


def test_the_command_says_each_finding_in_a_line_and_exits_with_1(unlike: Path, small_path: Path) -> None:
    arguments = ["parity", str(unlike), "--dataset", str(small_path), "--prompts", str(PROMPTS)]
    said = CliRunner().invoke(app, arguments)
    assert said.exit_code == 1
    lines = said.stdout.splitlines()
    findings = [line for line in lines if line.startswith(("ok  ", "FAIL"))]
    assert len(findings) == 10
    assert [line.split("  ")[0] for line in findings if line.startswith("FAIL")] == [
        "FAIL GGUF: greedy text equal", "FAIL GGUF: largest difference of a read-out",
    ]  # fmt: skip
    assert lines[-1] == f"the engines differ: {PROMPTS} prompts; measured, and what is allowed"


def test_a_version_with_examples_is_compared_too(tiny: Path, small_path: Path) -> None:
    arguments = ["parity", str(tiny), "--dataset", str(small_path), "--prompts", "2", "--prompt", "v6"]
    said = CliRunner().invoke(app, [*arguments, "--json"])
    assert said.exception is None or isinstance(said.exception, SystemExit)
    assert len(json.loads(said.stdout)["findings"]) == 10
