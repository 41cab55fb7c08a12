"""`harness model pull`, from a hub of our own:
what is fetched, what is not, and what a hub refuses.
"""

import os
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
from small_hub import COMMIT, serving
from tiers import some

from harness.backends.card import Card, Latency
from harness.backends.weights import check_digest, hub_commit
from harness.core.errors import UserError
from harness.core.files import sha256_bytes

CHECKPOINT: Mapping[str, bytes | None] = {
    "config.json": b"{}",
    "model.safetensors": b"weights " * 9000,
    "tokenizer.json": b"{ }",
    "chat_template.jinja": b"{{ messages }}",
    "pytorch_model.bin": b"the same weights",
    "README.md": b"# a model",
}


def harness(
    home: Path, endpoint: str, *arguments: str, cwd: Path | None = None
) -> subprocess.CompletedProcess[str]:
    """A command line in a process of its own,
    since the hub's package reads its address when it loads.
    """
    environment = {
        **os.environ,
        "HF_ENDPOINT": endpoint,
        "HF_HOME": str(home),
        "HF_HUB_DISABLE_XET": "1",
    }
    command = [sys.executable, "-m", "harness", "model", *arguments]
    return subprocess.run(
        command, env=environment, cwd=cwd, capture_output=True, text=True, check=False
    )


def snapshot(home: Path, repository: str) -> Path:
    return home / "hub" / f"models--{repository.replace('/', '--')}" / "snapshots" / COMMIT


@pytest.mark.slow
def test_a_checkpoint_is_fetched_once_without_what_nobody_loads(tmp_path: Path) -> None:
    with serving({"some/model": CHECKPOINT}) as hub:
        for _ in range(2):
            done = harness(tmp_path, hub.url, "pull", "some/model")
            assert (done.returncode, done.stderr) == (0, "")
            assert str(snapshot(tmp_path, "some/model")) in done.stdout
    assert sorted(hub.asked) == [
        "chat_template.jinja",
        "config.json",
        "model.safetensors",
        "tokenizer.json",
    ]
    fetched = snapshot(tmp_path, "some/model") / "model.safetensors"
    assert fetched.read_bytes() == CHECKPOINT["model.safetensors"]


@pytest.mark.exhaustive
def test_with_the_hub_gone_what_was_fetched_is_found(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="needs the transformers extra")
    pytest.importorskip("transformers", reason="needs the transformers extra")
    with serving({"some/model": CHECKPOINT}) as hub:
        harness(tmp_path, hub.url, "pull", "some/model")
    again = harness(tmp_path, hub.url, "check", "some/model")
    assert "does not load" in again.stderr, "these weights are none; but they are found"


@pytest.mark.slow
def test_of_a_repository_of_gguf_files_the_cards_one_is_fetched_and_held_to_its_digest(
    tmp_path: Path,
) -> None:
    files = {"Qwen3-4B-Q4_K_M.gguf": b"GGUF", "Qwen3-4B-Q8_0.gguf": b"GGUF too"}
    with serving({"Qwen/Qwen3-4B-GGUF": files}) as hub:
        done = harness(tmp_path, hub.url, "pull", "qwen3-4b", "--engine", "llama-cpp")
        assert (done.returncode, hub.asked) == (2, ["Qwen3-4B-Q4_K_M.gguf"])
    assert "model 'qwen3-4b:llama-cpp': " in done.stderr
    assert (
        f"is not what its card says: sha256 {sha256_bytes(b'GGUF')}, and the card has 7485"
        in done.stderr
    )
    assert done.stderr.count("\n") == 1


@pytest.mark.exhaustive
def test_a_projector_is_fetched_with_the_file_that_it_belongs_to(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "models" / "eyes.toml").write_text(
        'engine = "llama-cpp"\ndescription = "d"\nweights = "some/eyes"\nfile = "eyes.gguf"\n'
        'projector = "mmproj-eyes.gguf"\n[latency]\nsource = "paper"\nbasis = "b"\n'
        "[vision]\nwidth_px = 512\nheight_px = 256\npatch_px = 16\nmerge = 2\n"
    )
    files = {"eyes.gguf": b"GGUF", "mmproj-eyes.gguf": b"GGUF too", "mmproj-other.gguf": b"GGUF"}
    with serving({"some/eyes": files}) as hub:
        done = harness(tmp_path, hub.url, "pull", "eyes", cwd=tmp_path)
        assert (done.returncode, sorted(hub.asked)) == (0, ["eyes.gguf", "mmproj-eyes.gguf"])


def test_a_file_that_is_not_what_its_card_says_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "model.gguf"
    file.write_bytes(b"GGUF")
    latency = Latency("paper", None, "b")
    card = Card("mine", "llama-cpp", "d", latency, weights=str(file), sha256=sha256_bytes(b"GGUF"))
    assert check_digest(card, file) == file
    file.write_bytes(b"GGUX")
    with pytest.raises(
        UserError, match=r"is not what its card says: sha256 [0-9a-f]{64}, and the card has"
    ):
        check_digest(card, file)


@pytest.mark.parametrize(
    ("repositories", "said"),
    some(
        [({}, "there is no {url}/some/model, or it is private; see `hf auth login`")],
        exhaustive=[
            (
                {"some/model": {}},
                "{url}/some/model asks for its licence to be accepted; do so on that page",
            ),
            ({"some/model": {"config.json": b"{}"}}, "has no weights (*.safetensors)"),
            (
                {"some/model": {**CHECKPOINT, "model.safetensors": None}},
                "cannot fetch {url}/some/model: peer closed",
            ),
        ],
    ),
)
def test_what_a_hub_refuses_is_one_line(
    repositories: Mapping[str, Mapping[str, bytes | None]], said: str, tmp_path: Path
) -> None:
    with serving(repositories) as hub:
        done = harness(tmp_path, hub.url, "pull", "some/model")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("harness: model 'some/model'")
    assert said.format(url=hub.url) in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (snapshot(tmp_path, "some/model") / "model.safetensors").exists()


@pytest.mark.slow
def test_a_hub_that_is_not_reached_is_one_line_and_nothing_is_written(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # nobody listens, and nobody else can
        endpoint = f"http://127.0.0.1:{taken.getsockname()[1]}"
        done = harness(tmp_path / "home", endpoint, "pull", "qwen3-4b")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert f"cannot fetch {endpoint}/Qwen/Qwen3-4B: " in done.stderr
    assert "copy the weights here and give their path" in done.stderr
    assert not (tmp_path / "home").exists()


def test_only_a_folder_of_the_hubs_cache_has_its_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any other that is called so has its files' digests in the identity."""
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    ours = tmp_path / "hub/models--a--b/snapshots" / COMMIT
    assert hub_commit(ours) == COMMIT
    for other in (tmp_path / "snapshots" / COMMIT, ours.with_name("best"), ours / "part"):
        assert hub_commit(other) is None
