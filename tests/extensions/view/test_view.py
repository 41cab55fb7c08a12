"""`harness view`: the list of runs, and what it opens."""

import asyncio
import json
import os
import re
import shutil
import threading
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import pytest
from reading import packed
from starlette.requests import Request
from starlette.testclient import TestClient
from tiers import some
from viewing import configure, names, said

from harness.extensions.view import pages
from harness.extensions.view.app import View
from harness.runs.folder import read


def test_the_list_tells_finished_unfinished_and_broken_runs_apart(
    client: TestClient, reports: Path
) -> None:
    manifest = json.loads((reports / "second/run.json").read_text())
    (reports / "killed/.work").mkdir(parents=True)
    begun = {"created": manifest["created"], "settings": manifest, "tags": ["half"]}
    (reports / "killed/.work/config.json").write_text(json.dumps(begun))
    shutil.copytree(reports / "second", reports / "spoilt")
    (reports / "spoilt/summary.csv").write_text("")
    page = client.get("/").text
    picked = set(re.findall(r'<input type="checkbox" name="path" value="([^"]+)"', page))
    opened = set(re.findall(r'<a href="/run\?path=([^"]+)"', page))
    assert picked == {"first", "second"}
    assert opened == {"first", "second", "first%2Fsweep-tau"}
    rows = {name: row for row in re.findall("<tr class.*?</tr>", page, re.S) for name in names(row)}
    assert all(
        word in rows["first"]
        for word in ("tag of first", "proxy", "v2", "json", "2026-01-01", " %")
    )
    shown = 'unfinished</strong> <small data-run="killed">stopped: 0 of '
    assert shown in rows["killed"]
    assert "the same command continues it" in rows["killed"]
    assert "half" in rows["killed"]
    assert 'class="bad">broken</strong> <small>summary.csv' in rows["spoilt"]


@pytest.mark.parametrize(
    ("query", "order"),
    [
        ("", ["second", "first"]),
        ("sort=date", ["first", "second"]),
        ("sort=name", ["first", "second"]),
        ("sort=-name", ["second", "first"]),
        ("sort=-success", ["first", "second"]),
        ("sort=nothing+known", ["second", "first"]),
        ("q=PROXY", ["first"]),
        ("q=tag+second", ["second"]),
        ("q=tag+of", ["second", "first"]),
        ("q=v2+nowhere", []),
    ],
)
def test_the_list_is_sorted_and_filtered_by_its_address(
    query: str, order: list[str], client: TestClient, reports: Path
) -> None:
    shutil.rmtree(reports / "first/sweep-tau")
    assert list(names(client.get(f"/?{query}").text)) == order


def test_a_click_on_a_head_turns_the_order_around_and_keeps_the_filter(client: TestClient) -> None:
    page = client.get("/?q=v2+json&sort=name").text
    links = dict(re.findall(r'<a href="/\?(sort=-?(\w+)[^"]*)"', page))
    assert {of: link for link, of in links.items()} == {
        of: f"sort={order}&amp;q=v2+json" for of, order in (
            ("name", "-name"), ("kind", "kind"), ("model", "model"), ("prompt", "prompt"),
            ("success", "-success"), ("date", "-date"),
        )
    }  # fmt: skip
    assert page.count('aria-sort="ascending"') == 1


@pytest.mark.slow
def test_a_run_opens_with_its_report_unless_that_is_older(
    client: TestClient, reports: Path
) -> None:
    report = reports / "first/report.html"
    shown = pages.with_way_back(report.read_text(), [("Notes", "/notes?path=first")])
    assert client.get("/run?path=first").text == shown
    report.write_text("an old one")
    os.utime(report, (1, 1))
    made = client.get("/run?path=first").text
    assert "Conditions side by side" in made
    assert "<h1>cruise · v2</h1>" in client.get("/run?path=second").text
    assert report.read_text() == "an old one", "nothing is written"


@pytest.mark.parametrize(
    "address",
    some(["/run?path=first"], exhaustive=["/run?path=second", "/report?path=first&path=second"]),
)
def test_one_decision_opens_with_what_its_page_leaves_out(
    address: str, client: TestClient, reports: Path
) -> None:
    scene = next(iter(read(reports / "first").decisions.scenes))
    links = '<p class="way-back">.*?</p>'
    whole = re.sub(links, "", client.get(f"{address}&scene={scene}").text)
    without = re.sub('<script [^>]*id="opened">.*?</script>\n', "", whole)
    assert re.sub(links, "", client.get(address).text) == without
    detail = json.loads(packed(whole, "opened"))[scene]
    assert list(detail["cameras"]) == list(detail["world"]["viewers"])
    assert all(
        detail["prompts"][a["prompt"]] for run in detail["runs"] if run for a in run["answers"]
    )
    refused = client.get(f"{address}&scene=none")
    assert (refused.status_code, "no run here has a decision none" in refused.text) == (400, True)


def test_a_study_opens_with_its_page_or_its_pictures(client: TestClient, reports: Path) -> None:
    page = client.get("/run?path=first/sweep-tau").text
    pictures = re.findall(r'<img src="(/picture[^"]+)"', page)
    assert [link.rpartition("=")[2] for link in pictures] == ["more.png", "sweep.svg"], (
        "one of each figure"
    )
    found = client.get(pictures[1].replace("&amp;", "&"))
    assert (found.text, found.headers["content-type"]) == ("<svg>sweep.svg</svg>", "image/svg+xml")
    (reports / "paper").mkdir()
    (reports / "paper/study.json").write_text("{}")
    (reports / "paper/index.html").write_text("<p>the paper's numbers")
    assert client.get("/run?path=paper").text == "<p>the paper's numbers"


@pytest.mark.slow
def test_two_runs_are_compared_and_the_older_is_a(client: TestClient) -> None:
    for query in ("path=first&path=second", "path=second&path=first"):
        page = client.get(f"/compare?{query}").text
        assert "A: proxy · prompt v2 · json<br>B: cruise · prompt v2 · json" in page
        assert "latency_p95_ms" in page


@pytest.mark.slow
def test_a_comparison_leads_to_the_same_with_a_and_b_swapped_and_to_all_answers(
    client: TestClient,
) -> None:
    page = client.get("/compare?path=first&path=second").text
    links = {
        text: unescape(href) for href, text in re.findall('<a href="([^"]+)">([^<]+)</a>', page)
    }
    swapped = client.get(links["Swap A and B"]).text
    assert "A: cruise · prompt v2 · json<br>B: proxy · prompt v2 · json" in swapped
    assert 'href="/compare?path=second&amp;path=first&amp;a=first">Swap A and B' in swapped
    side_by_side, _, where = links["Answers side by side"].partition("#")
    assert (side_by_side, where) == ("/report?path=first&path=second", "decisions=&differ=answers")


@pytest.mark.parametrize(
    "page",
    [
        "/run?path=first",
        "/run?path=first%2Fsweep-tau",
        pytest.param("/report?path=first", marks=pytest.mark.slow),
        "/compare?path=first&path=second",
    ],
)
def test_every_page_leads_back_to_the_list(page: str, client: TestClient) -> None:
    text = client.get(page).text
    assert text.index('<a href="/"') < text.index("<h1")


def test_nothing_is_drawn_for_who_left_while_others_pages_were_drawn(
    reports: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[int] = []

    def draw(folders: list[Path], *_: object) -> str:
        drawn.append(len(folders))
        return "<body>"

    monkeypatch.setattr(pages, "report", draw)
    view = View(reports)

    async def asked(gone: bool) -> int:
        async def receive() -> dict[str, str]:
            return {"type": "http.disconnect" if gone else "http.request"}

        scope = {"type": "http", "method": "GET", "query_string": b"path=first&path=second"}
        return (await view.report(Request(scope, receive))).status_code

    assert asyncio.run(asked(gone=True)) == 204
    assert drawn == []
    assert asyncio.run(asked(gone=False)) == 200
    assert drawn == [2]


@pytest.mark.slow
def test_a_report_is_of_what_is_picked(client: TestClient) -> None:
    assert "<h1>cruise · v2</h1>" in client.get("/report?path=second").text
    assert "<h1>2 runs</h1>" in client.get("/report?path=second&path=first").text


@pytest.mark.parametrize(
    ("address", "line"),
    [
        ("/compare", "0 runs are picked; pick two to compare them"),
        ("/compare?path=first", "1 runs are picked; pick two to compare them"),
        ("/compare?path=first&path=first", "1 runs are picked"),
        (
            "/compare?path=first&path=first/sweep-tau",
            "first/sweep-tau is no finished run of a model",
        ),
        ("/compare?path=first&path=killed", "killed is no finished run of a model; pick others"),
        pytest.param("/compare?path=first&path=other", "first and ", marks=pytest.mark.slow),
        ("/report", "no run is picked"),
        pytest.param("/report?path=first&path=other", "first and ", marks=pytest.mark.slow),
        (
            "/run?path=killed",
            "killed is unfinished (the same command continues it); it has no page yet",
        ),
        ("/run?path=cut", "cut has no decisions.parquet of its own; make the run again"),
        ("/run?path=garbled", "decisions.parquet is broken ("),
    ],
)
def test_what_cannot_be_shown_is_one_readable_line(
    address: str, line: str, client: TestClient, reports: Path, request: pytest.FixtureRequest
) -> None:
    manifest = json.loads((reports / "second/run.json").read_text())
    (reports / "killed/.work").mkdir(parents=True)
    begun = {"created": manifest["created"], "settings": manifest, "tags": []}
    (reports / "killed/.work/config.json").write_text(json.dumps(begun))
    for name in ("cut", "garbled"):
        shutil.copytree(reports / "second", reports / name)
    (reports / "cut/decisions.parquet").unlink()
    (reports / "garbled/decisions.parquet").write_text("{")
    if "other" in address:
        shutil.copytree(request.getfixturevalue("two_run"), reports / "other")
    answer = client.get(address)
    assert answer.status_code == 400
    assert line in said(answer)
    assert "other" not in address or "are not of the same scenes (" in said(answer)
    assert "\n" not in said(answer)


def test_a_bug_is_a_page_too_and_the_terminal_has_its_trace(
    client: TestClient, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(pages, "report", lambda *_: 1 / 0)
    answer = client.get("/report?path=second")
    assert (answer.status_code, said(answer)) == (
        500,
        "this page cannot be made; the terminal says why",
    )
    assert "ZeroDivisionError" in capsys.readouterr().err


@pytest.mark.slow
def test_hostile_text_stays_text(client: TestClient, reports: Path) -> None:
    name = '<img src=x onerror="a()"> & ?#%2e'
    (reports / "second").rename(reports / name)
    configure(
        reports / name,
        tags=["<script>tag</script>", "\u202egat"],
        model={"name": "</table><script>", "engine": "proxy"},
        settings={},  # which would have to say the same
    )
    page = client.get('/?q="><script>').text + (listed := client.get("/").text)
    tags: list[tuple[str, dict[str, str | None]]] = []

    class Parser(HTMLParser):
        def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
            tags.append((tag, dict(attributes)))

    Parser().feed(page)
    assert not {"script", "img"} & {tag for tag, _ in tags}
    assert "\u202e" not in page
    assert "⟨U+202E⟩gat" in page
    [link] = re.findall(r'href="(/run\?path=%3Cimg[^"]+)"', listed)
    assert client.get(link).status_code == 200
    [value] = [
        a["value"] for tag, a in tags if a.get("type") == "checkbox" and a["value"] != "first"
    ]
    assert value == name
    assert client.get("/report", params={"path": value}).status_code == 200


@pytest.mark.parametrize("name", [b"not \xff UTF-8", b"two\nlines", b"\x1b[31m"])
def test_a_name_that_cannot_be_sent_is_listed_and_not_opened(
    name: bytes, client: TestClient, reports: Path
) -> None:
    os.rename(reports / "second", os.path.join(os.fsencode(reports), name))
    page = client.get("/")
    assert page.status_code == 200
    assert page.text.count('type="checkbox"') == 1
    assert "cruise" in page.text


def test_a_long_report_does_not_keep_the_list_waiting(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def slow(folders: list[Path], *_: object) -> str:
        begun.set()
        assert go_on.wait(60)
        return "slow"

    monkeypatch.setattr(pages, "report", slow)
    answers: list[str] = []
    with client:
        drawing = threading.Thread(
            target=lambda: answers.append(client.get("/report?path=second").text)
        )
        drawing.start()
        assert begun.wait(60)
        assert "tag of first" in client.get("/").text
        assert answers == []
        go_on.set()
        drawing.join(60)
    assert answers == ["slow"]


def test_it_works_without_scripts_and_from_the_keyboard(client: TestClient) -> None:
    for address in ("/", "/run?path=first/sweep-tau", "/run?path=nowhere"):
        page = client.get(address).text
        assert "<script" not in page
        assert not re.search(r"\son\w+=|style=|tabindex", page)
        assert not re.findall(r'(?:href|src|action)="(?!/|data:,)', page), (
            "nothing is fetched from elsewhere"
        )
    page = client.get("/").text
    labelled = re.findall(r'<label for="(\w+)"', page)
    assert labelled == ["q"]
    assert page.count('type="checkbox"') == page.count('aria-label="Pick ')
