"""`harness model parity`: a tiny Qwen3 beside a GGUF of its weights or of others, and a Llama's."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="needs the transformers extra")
pytest.importorskip("transformers", reason="needs the transformers extra")
pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")

import tiny_llama
import tiny_qwen3
import torch
import transformers
from evaluating import scenes_of, spec_of
from typer.testing import CliRunner

from harness.backends import cards
from harness.backends.gguf_export import export
from harness.cli import app
from harness.dataset.load import Dataset
from harness.evaluate.requests import requests
from harness.extensions.checkups.parity import PASSES, Finding, compare

pytestmark = pytest.mark.slow  # a whole file, for `make quick` not to import torch

PROMPTS = 1


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
        # each token speaks for another
        model.lm_head.weight.copy_(model.lm_head.weight.roll(7, dims=0))
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
    found = compare(
        spec.ego.card, cards.resolve(str(folder), "llama-cpp"), asked, letters, passes.append
    )
    assert passes == [1] * PASSES
    assert found.left_out is None
    # Tokens are those of the questions for JSON and of those for a letter.
    counts = {f.what: 2 * PROMPTS if "token ids" in f.what else PROMPTS for f in found.findings}
    assert counts == {f.what: f.n for f in found.findings}
    return {finding.what: finding for finding in found.findings}


def test_the_engines_agree_on_the_same_weights(tiny: Path, small: Dataset) -> None:
    found = compared(tiny, small)
    # Random weights are often undecided between two tokens: what half the bits keep of their text
    # is chance.
    chance = found.pop("GGUF: greedy text equal")
    assert chance.holds == (chance.differences == ())
    assert [what for what, finding in found.items() if not finding.holds] == []
    assert found["F32: token ids equal"].measured == 1.0
    assert 0 < found["F32: largest difference of a logit"].measured < 1e-3
    # Half as many bits: farther off, and the figure shows it.
    exact, halved = (
        found[f"{kind}: largest difference of a logit"].measured for kind in ("F32", "GGUF")
    )
    assert halved > 10 * exact


def test_other_weights_are_found_to_differ_and_where_is_named(unlike: Path, small: Dataset) -> None:
    found = compared(unlike, small)
    failed = {what for what, finding in found.items() if not finding.holds}
    assert failed == {"GGUF: greedy text equal", "GGUF: largest difference of a read-out"}
    first = next(iter(requests(spec_of(small, str(unlike)), scenes_of(small))))
    assert found["GGUF: greedy text equal"].differences[0].startswith(f"{first.id}: ")
    # Against the checkpoint's own export in F32 nothing fails: the file is at fault, not the
    # engine.
    assert found["F32: greedy text equal"].holds


@pytest.mark.exhaustive
def test_the_command_says_each_finding_in_a_line_and_exits_with_1(
    unlike: Path, small_path: Path
) -> None:
    arguments = [
        "model",
        "parity",
        str(unlike),
        "--dataset",
        str(small_path),
        "--prompts",
        str(PROMPTS),
    ]
    said = CliRunner().invoke(app, arguments)
    assert said.exit_code == 1
    lines = said.stdout.splitlines()
    findings = [line for line in lines if line.startswith(("ok  ", "FAIL"))]
    assert len(findings) == 10
    assert [line.split("  ")[0] for line in findings if line.startswith("FAIL")] == [
        "FAIL GGUF: greedy text equal", "FAIL GGUF: largest difference of a read-out",
    ]  # fmt: skip
    assert lines[-1] == f"the engines differ: {PROMPTS} prompts; measured, and what is allowed"


@pytest.mark.exhaustive
def test_a_version_with_examples_is_compared_too(tiny: Path, small_path: Path) -> None:
    arguments = [
        "model",
        "parity",
        str(tiny),
        "--dataset",
        str(small_path),
        "--prompts",
        "1",
        "--prompt",
        "v6",
    ]
    said = CliRunner().invoke(app, [*arguments, "--json"])
    assert said.exception is None or isinstance(said.exception, SystemExit)
    assert len(json.loads(said.stdout)["findings"]) == 10


@pytest.fixture(scope="module")
def llama(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A GGUF file alone, of an architecture that is not exported."""
    return tiny_llama.build(tmp_path_factory.mktemp("llama") / "tiny.gguf", "Q8_0", context=4096)


def test_another_architecture_is_compared_but_for_its_export(
    llama: Path, small: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(tmp_path))
    here, there = (cards.resolve(str(llama), engine) for engine in ("transformers", "llama-cpp"))
    of = {}
    for answer in ("json", "readout"):
        spec = spec_of(small, str(llama), answer=answer)
        raw = replace(spec, ego=replace(spec.ego, card=here, letters="raw"))
        whole = list(requests(raw, scenes_of(small)))[:2]
        # The system text alone is long in a vocabulary of bytes, and says nothing of an
        # architecture.
        of[answer] = [
            replace(request, max_tokens=8, messages=request.messages[1:]) for request in whole
        ]
    passes: list[int] = []
    found = compare(here, there, of["json"], of["readout"], passes.append)
    assert sum(passes) == PASSES
    assert "LlamaForCausalLM" in (found.left_out or "")
    measured = {finding.what: finding.measured for finding in found.findings}
    assert list(measured) == [
        "GGUF: token ids equal", "GGUF: largest difference of a logit", "GGUF: greedy text equal",
        "GGUF: largest difference of a read-out", 
            "transformers: text equal in "
            "reversed batches of 8",
    ]  # fmt: skip
    assert measured["GGUF: token ids equal"] == 1.0
    # llama.cpp rounds what it multiplies
    assert 0 < measured["GGUF: largest difference of a logit"] < 0.1


def test_read_outs_alone_need_no_text_and_what_was_left_out_is_said(
    llama: Path, small_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(tmp_path))
    arguments = [
        "model",
        "parity",
        str(llama),
        "--dataset",
        str(small_path),
        "--prompts",
        "3",
        "--read-outs",
    ]
    said = CliRunner().invoke(app, arguments)
    assert said.exit_code == 0, said.output
    *found, left_out, verdict = said.stdout.splitlines()
    assert [line[:25].split(":")[0] for line in found] == ["ok   GGUF"] * 2
    assert left_out.startswith("left out: the same weights in F32 on llama.cpp: checkpoint ")
    assert verdict == "the engines agree: 3 prompts; measured, and what is allowed"
    report = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)
    assert "LlamaForCausalLM" in report["left_out"]
    assert [finding["n"] for finding in report["findings"]] == [3, 3]
