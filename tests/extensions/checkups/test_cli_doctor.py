"""`harness model doctor`: what is here to run with."""

import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest

from harness.backends.cards import load_all

Said = tuple[int, str, str]
DOCTOR = (
    "import harness.cli as c; sys.argv = ['harness', 'model', 'doctor', *sys.argv[1:]]\ntry: "
    "c.main()\n"
)


def apart(before: str, *args: str, after: str = "raise") -> str:
    """What it prints in a process of its own."""
    code = f"import sys; {before}\n{DOCTOR}except SystemExit as end: {after}"
    return subprocess.check_output([sys.executable, "-c", code, *args], text=True)


def test_it_tells_versions_machine_models_and_cache(
    harness: Callable[..., Said], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("SWARMDRIVE_CACHE", str(tmp_path))
    (tmp_path / "completions.sqlite").write_bytes(b"1234567")
    code, out, err = harness("model", "doctor", "--json")
    told = json.loads(out)
    assert (code, err) == (0, "")
    assert told["versions"]["python"] == platform.python_version()
    assert told["versions"]["numpy"] == version("numpy")
    assert told["cores"] == len(os.sched_getaffinity(0))
    assert told["memory_gib"] > 0
    assert [(m["name"], m["engine"]) for m in told["models"]] == [
        (c.name, c.engine) for c in load_all()
    ]
    assert told["cache"] == {"file": str(tmp_path / "completions.sqlite"), "bytes": 7}


def test_people_read_it_in_eighty_columns(harness: Callable[..., Said]) -> None:
    code, out, err = harness("model", "doctor")
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= 80
    heads = [line.split()[0] for line in out.splitlines() if not line.startswith(" ")]
    assert heads == [
        "harness",
        "packages",
        "machine",
        "GPU",
        "meters",
        "cache",
        "engines",
        "models",
    ]
    assert "openai-example: needs a server at http://127.0.0.1:8080/v1 (not tried)" in out


@pytest.mark.slow
def test_what_is_not_installed_is_named_with_the_command_that_installs_it() -> None:
    absent = (
        "sys.modules['torch'] = sys.modules['llama_cpp'] = sys.modules['sparrow_decider'] = None"
    )
    told = json.loads(apart(absent, "--json"))
    lacks = {m["name"]: (m["missing"], m["remedy"]) for m in told["models"]}
    assert lacks["qwen3-4b"] == ("torch", "pip install 'swarmdrive-harness[transformers]'")
    assert lacks["swarm-tiny"] == (
        "llama-cpp-python",
        "pip install 'swarmdrive-harness[llama-cpp]'",
    )
    assert lacks["proxy"] == (None, None)
    lacking = {engine for engine, lack in told["engines"].items() if lack}
    assert lacking - {"openvino"} == {"transformers", "llama-cpp", "sparrow"}


@pytest.mark.exhaustive
def test_no_gpu_is_no_error_where_torch_is_asked_either() -> None:
    alone = "import os; os.environ['PATH'] = os.environ['CUDA_VISIBLE_DEVICES'] = ''"
    assert json.loads(apart(alone, "--json", "--gpu"))["gpu"] == []


def test_no_gpu_is_no_error(harness: Callable[..., Said], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert json.loads(harness("model", "doctor", "--json")[1])["gpu"] == []


@pytest.mark.slow
def test_a_gpu_is_what_nvidia_smi_says_and_one_that_fails_says_nothing(
    harness: Callable[..., Said], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    program = tmp_path / "nvidia-smi"
    monkeypatch.setenv("PATH", str(tmp_path))
    for script, gpus in (
        ("echo 'A 100, 80 GB'", ["A 100, 80 GB"]),
        ("exit 9", []),
        ("exec /bin/sleep 60", []),
    ):
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
        assert json.loads(harness("model", "doctor", "--json")[1])["gpu"] == gpus


@pytest.mark.slow
def test_torch_is_not_loaded_unless_asked() -> None:
    last = (
        "print('torch' in sys.modules, 'transformers' in sys.modules, 'llama_cpp' in sys.modules)"
    )
    assert apart("", after=last).splitlines()[-1] == "False False False"
