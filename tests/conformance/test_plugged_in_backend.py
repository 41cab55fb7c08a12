"""A backend of another package, registered by an entry point: it runs as one that is built in."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from packaged import register

from harness.backends import cards, registry
from harness.core.errors import UserError

MODULE = """
from dataclasses import replace
from harness.backends.registry import Capabilities, Registration
from swarm_extras import CAUTIOUS, answer

ECHO = replace(
    CAUTIOUS,
    capabilities=replace(CAUTIOUS.capabilities, language_model=True),
    packages={"json": "json"},
)
BARE = Registration(
    "echoing:opened", Capabilities(), packages={"no_such_module": "a-package"}, install="pip install it"
)
"""
ENTRIES = """[swarmdrive.backends]
echo = echoing:ECHO
bare = echoing:BARE
gone = no_such_module:ECHO
odd = echoing:answer
"""
CARD = """engine = "echo"
description = "Slows down where it sees a conflict"
revision = "2"
[latency]
source = "card"
inference_s = 0.01
basis = "declared: none"
"""


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project with a card, and on the path a package that registers its engine."""
    site = tmp_path / "site"
    register(site, ENTRIES, echoing=MODULE)
    (tmp_path / "swarmdrive.toml").touch()
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "echo-1.toml").write_text(CARD)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(site)
    monkeypatch.setattr(registry.ENGINES, "_loaded", dict(registry.BUILT_IN))
    return tmp_path


@pytest.mark.slow
def test_a_card_names_it_and_it_is_listed_and_run(
    project: Path, small_path: Path, harness: Callable[..., tuple[int, str, str]]
) -> None:
    assert list(registry.ENGINES) == [*registry.BUILT_IN, "bare", "echo", "gone", "odd"]
    _, out, _ = harness("model", "list", "--json")
    [listed] = [card for card in json.loads(out) if card["name"] == "echo-1"]
    assert (listed["engine"], listed["missing"]) == ("echo", None)
    code, _, err = harness(
        "eval", "--model", "echo-1", "--dataset", small_path, "--limit", "1", "--out", "run"
    )
    assert (code, err.count("harness: ")) == (0, 0), err
    manifest = json.loads((project / "run" / "run.json").read_text())
    assert manifest["identity"] == {"engine": "cautious", "answers": 1, "version": 1}


def test_what_it_cannot_do_is_refused_by_its_capabilities(
    project: Path, small_path: Path, harness: Callable[..., tuple[int, str, str]]
) -> None:
    asked = ("eval", "--model", "echo-1", "--dataset", small_path, "--out", "run")
    assert (
        "--answer readout: echo-1 cannot answer so; use json"
        in harness(*asked, "--answer", "readout")[2]
    )
    assert "--thinking: echo-1 cannot think" in harness(*asked, "--thinking")[2]
    assert "--device cpu: echo-1 has no weights here" in harness(*asked, "--device", "cpu")[2]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (('"echo"', '"ecko"'), "unknown engine in model card .* 'ecko'; did you mean 'echo'?"),
        (
            ('revision = "2"', "gated = true"),
            "gated goes with engine = transformers or llama-cpp, and only with",
        ),
        (
            ('"echo"', '"gone"'),
            r"plug-in 'gone' \(swarmdrive.backends\): no_such_module:ECHO does not load",
        ),
        (
            ('"echo"', '"odd"'),
            "plug-in 'odd' .*: echoing:answer is of type function and no Registration",
        ),
    ],
)
def test_a_mistake_is_one_line(project: Path, change: tuple[str, str], said: str) -> None:
    (project / "models" / "echo-1.toml").write_text(CARD.replace(*change))
    with pytest.raises(UserError, match=said):
        cards.load("echo-1")


def test_a_package_that_it_needs_is_named_with_the_command_that_installs_it(project: Path) -> None:
    text = CARD.replace('"echo"', '"bare"').replace('revision = "2"\n', "")
    (project / "models" / "echo-1.toml").write_text(text)
    card = cards.load("echo-1")
    assert registry.missing(card) == "a-package"
    with pytest.raises(
        UserError, match="needs a-package, which is not installed; run `pip install it`"
    ):
        registry.open_backend(card)
