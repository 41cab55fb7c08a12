"""What the documents list is what the program has."""

import re
from dataclasses import asdict
from pathlib import Path
from typing import get_args

import pytest
from reference import pages

from harness.backends.base import AnswerMode
from harness.backends.card import Failures
from harness.coordination.rules import EGO_PROMPT, POOLS
from harness.coordination.schedules import SCHEDULES

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("mode", get_args(AnswerMode))
def test_every_way_of_answering_is_documented(mode: str) -> None:
    assert f"| `{mode}` |" in (ROOT / "docs/answers.md").read_text()


def test_every_failure_on_purpose_is_documented() -> None:
    documented = (ROOT / "docs/answers.md").read_text().partition("## Failures on purpose")[2]
    for name in asdict(Failures()):
        assert f"`{name}`" in documented


@pytest.mark.parametrize("name", [*POOLS, EGO_PROMPT])
def test_every_consensus_is_documented(name: str) -> None:
    assert f"| `{name}` |" in (ROOT / "docs/operating-points.md").read_text()


@pytest.mark.parametrize("name", [name for name in SCHEDULES if SCHEDULES.is_ours(name)])
def test_every_schedule_is_documented(name: str) -> None:
    assert f"| `{name}` |" in (ROOT / "docs/scheduling.md").read_text()


def test_the_overview_for_language_models_leads_to_pages_that_exist_under_their_titles() -> None:
    docs = ROOT / "docs"
    links = re.findall(r"^- \[(.+)\]\((.+)\): ", (docs / "llms.txt").read_text(), re.MULTILINE)
    assert {"commands.md", "files.md", "first-evaluation.md"} <= {page for _, page in links}
    for title, page in links:
        assert (docs / page).read_text().startswith(f"# {title}\n"), page


def test_the_gains_of_the_six_families_are_those_of_the_claims_page() -> None:
    claims = (ROOT / "docs/claims.md").read_text().replace(" points [", " [")
    results = (ROOT / "docs/scenarios.md").read_text().partition("## What models gain there\n")[2]
    block = results.partition("```\n")[2].partition("```")[0]
    gains = [
        found[2]
        for line in block.splitlines()
        if len(found := re.findall(r"-?\d+\.\d \[[^]]+\]", line)) == 3
    ]
    assert len(gains) == 6
    for gain in gains:
        assert gain in claims, gain


HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)
BLOCK = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)


def headings(page: Path) -> set[str]:
    """What a link behind # may name on a page, as GitHub and the site call its headings."""
    texts = HEADING.findall(BLOCK.sub("", page.read_text()))
    bare = [re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", text).replace("`", "").lower() for text in texts]
    return {re.sub(r"[^\w\- ]", "", text).replace(" ", "-") for text in bare}


@pytest.mark.parametrize(
    "page", [*pages(), ROOT / "CHANGELOG.md", ROOT / "SECURITY.md"], ids=lambda page: page.name
)
def test_every_link_leads_to_a_file_and_a_heading(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", BLOCK.sub("", page.read_text())):
        path, _, heading = link.partition("#")
        if ":" in path:
            continue
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), link
        assert not heading or heading in headings(there), link


def test_the_front_door_is_short() -> None:
    readme = (ROOT / "README.md").read_text()
    assert len(readme.split()) <= 600
    assert len(readme.splitlines()) <= 100
    assert (ROOT / "docs/pictures/lost-episode.gif").stat().st_size <= 1e6


def test_the_documentation_grows_by_what_it_lets_go() -> None:
    """The pages that people write, of 38 and 30 000 words at most; a new one pays by another's."""
    mark = re.compile("Written by `|`make results` writes")
    programs = [
        page for page in (ROOT / "docs").glob("*.md") if mark.search(page.read_text()[:400])
    ]
    written = set((ROOT / "docs").glob("*.md")) - set(programs)
    assert {"commands.md", "fields.md", "results.md"} <= {page.name for page in programs}
    assert len(written) <= 38
    assert sum(len(page.read_text().split()) for page in written) <= 30_000


def test_every_decision_stands_once_in_the_index() -> None:
    folder = ROOT / "docs/decisions"
    listed = re.findall(r"\b(0\d{3}-[\w-]+)", (folder / "index.md").read_text())
    assert sorted(listed) == sorted(path.stem for path in folder.glob("0*.md"))


ROOMS = sorted(path.parent for path in (ROOT / "harness").glob("*/__init__.py"))


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: room.name)
def test_every_room_says_where_to_start_at_files_that_are_there(room: Path) -> None:
    text = (room / "README.md").read_text()
    assert len(text.splitlines()) <= 16
    for name in re.findall(r"`(\w+(?:\.py|/))`", text):
        assert (room / name).exists() or (ROOT / name).exists(), name
