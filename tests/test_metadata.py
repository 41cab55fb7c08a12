"""What is said of the project outside its code:
version, licence and authors are the same everywhere.
"""

import importlib.util
import re
import tomllib
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import yaml

from harness.backends import cards
from harness.core.errors import UserError
from harness.report import library

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {key: citation[key] for key in ("version", "license", "authors")} == {
        key: PROJECT[key] for key in ("version", "license", "authors")
    }
    assert [paper["url"] for paper in citation["references"]] == [PROJECT["urls"]["Paper"]]


def test_the_readme_cites_as_the_citation_file_does() -> None:
    """In BibTeX: the harness in its version, and the paper with all its authors."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    [bibtex] = re.findall(r"```bibtex\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    software, paper = (
        dict(re.findall(r"^  (\w+) += \{+(.*?)\}+,?$", entry, re.MULTILINE))
        for entry in bibtex.split("@misc")
    )
    assert [software[key] for key in ("title", "version", "license")] == [
        citation[key] for key in ("title", "version", "license")
    ]
    assert software["author"] == citation["authors"][0]["name"]
    [cited] = citation["references"]
    authors = [f"{each['family-names']}, {each['given-names']}" for each in cited["authors"]]
    assert (paper["title"], paper["author"]) == (cited["title"], " and ".join(authors))
    assert (paper["year"], f"arXiv:{paper['eprint']}") == (
        str(cited["year"]),
        cited["identifiers"][0]["value"],
    )


def test_code_dataset_and_weights_have_one_licence() -> None:
    licence = PROJECT["license"]
    assert "Apache License" in (ROOT / "LICENSE").read_text()
    for model in (
        "swarm-tiny",
        "swarm-tiny-six",
        "swarm-tiny-six-v2",
        "swarm-tiny-vl",
        "swarm-smol",
    ):
        assert cards.load(model).licence == licence
        assert f"Licence: {licence}" in (ROOT / "models" / model / "README.md").read_text()
    for manifest in (ROOT / "datasets").glob("*/manifest.json"):
        [row] = [
            line for line in (ROOT / "datasets/README.md").read_text().splitlines()
            if line.startswith(f"| `{manifest.parent.name}` |")
        ]  # fmt: skip
        assert licence in row


def test_a_release_lists_locked_packages_with_digests_and_names_what_is_not_locked() -> None:
    release = _module("release")
    text = release.locked(["Jinja2", "typing_extensions"])
    assert re.findall(r"^(\S+)==", text, re.MULTILINE) == ["jinja2", "typing-extensions"]
    assert text.count("--hash=sha256:") >= 4
    with pytest.raises(SystemExit, match=r"not in requirements\.lock: no-such; write it again"):
        release.locked(["jinja2", "No.Such"])


def _module(name: str) -> Any:
    """A program of the checkout, which is in no package."""
    spec = importlib.util.spec_from_file_location(name, ROOT / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize("install", ["base", "test", "dev"])
def test_the_lock_has_all_that_an_install_needs_with_digests(install: str) -> None:
    if install == "dev":
        pytest.importorskip("torch")
        pytest.importorskip("llama_cpp")
    requirements = _module("requirements")
    groups = re.split(r"^# (.*)\n", requirements.LOCK.read_text(), flags=re.MULTILINE)[1:]
    text = "".join(
        lines for head, lines in zip(groups[::2], groups[1::2], strict=True)
        if {"base", install} & {*head.split()}
    )  # fmt: skip
    blocks = re.findall(
        r"^([\w.-]+)==(\S+) \\\n((?: +--hash=sha256:[0-9a-f]{64}(?: \\)?\n)+)", text, re.MULTILINE
    )
    assert {name for name, *_ in blocks} == requirements.needed(requirements.INSTALLS[install]) - {
        "torch"
    }
    assert {name: release for name, release, _ in blocks} == {
        name: version(name) for name, *_ in blocks
    }


def test_no_other_charting_library_runs_in_a_page(monkeypatch: pytest.MonkeyPatch) -> None:
    library.vega.cache_clear()
    assert len(library.vega()) > 500_000
    library.vega.cache_clear()
    monkeypatch.setattr(library, "BUNDLE_SHA256", "0" * 64)
    with pytest.raises(
        UserError,
        match=r"^the charting library of .* has sha256 b6f62605c995[0-9a-f]{52}, not 0{64}",
    ):
        library.vega()
