"""Notes on decision points: they stay with the run, and nobody else writes them."""

import asyncio
import csv
import json
import os
import shutil
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.testclient import TestClient
from viewing import SECRET, TOKEN, said

from harness.extensions.view import app
from harness.extensions.view.access import cookie
from harness.extensions.view.app import View
from harness.extensions.view.notes import LONGEST, MOST, notes, write
from harness.report.page import render
from harness.report.runs import gather
from harness.runs.folder import read

HERE = {"Origin": "http://127.0.0.1:7654"}


def form(scene: str, text: str, path: str = "first", before: str = "") -> dict[str, str]:
    return {"path": path, "scene": scene, "text": text, "before": before}


@pytest.fixture
def scene(reports: Path) -> str:
    return read(reports / "first").decisions.labels("scene")[0]


@pytest.mark.slow
def test_a_note_stays_with_its_run_and_stands_on_its_page(
    client: TestClient, reports: Path, scene: str
) -> None:
    written = client.post(
        "/notes", data=form(scene, " it brakes <b>late</b>\r\nhere "), headers=HERE
    )
    assert (written.status_code, written.url.path) == (200, "/notes")
    assert "it brakes &lt;b&gt;late&lt;/b&gt;\nhere</p>" in written.text
    [note] = notes(reports / "first")
    assert (note.scene, note.text) == (scene, "it brakes <b>late</b>\nhere")
    assert f'value="{scene}"' in client.get(f"/notes?path=first&scene={scene}").text
    page = render(gather([reports / "first"]))
    assert f">{scene}</a>: it brakes &lt;b&gt;late&lt;/b&gt;\nhere</p>" in page
    assert "Noted on" not in render(gather([reports / "second"]))
    assert (
        f'name="before" value="{note.date}"' in client.get(f"/notes?path=first&scene={scene}").text
    )
    client.post("/notes", data=form(scene, "once more", before=note.date), headers=HERE)
    [note] = notes(reports / "first")
    assert note.text == "once more"
    client.post("/notes", data=form(scene, " ", before=note.date), headers=HERE)
    assert notes(reports / "first") == []


@pytest.mark.parametrize("began_with", ["", "2026-01-01T00:00:00+00:00"])
@pytest.mark.parametrize("text", ["of another tab", ""])
def test_a_note_that_its_form_did_not_show_is_not_lost(
    text: str, began_with: str, client: TestClient, reports: Path, scene: str
) -> None:
    client.post("/notes", data=form(scene, "first"), headers=HERE)
    answer = client.post("/notes", data=form(scene, text, before=began_with), headers=HERE)
    assert said(answer).startswith(f"{scene} has another note than this form began with")
    assert [note.text for note in notes(reports / "first")] == ["first"]


def test_a_page_that_was_written_before_a_note_is_drawn_anew(
    client: TestClient, reports: Path, scene: str
) -> None:
    (reports / "first/report.html").write_text("<body>written before")
    before = client.get("/run?path=first").text
    assert "written before" in before
    assert 'href="/notes?path=first"' in before
    client.post("/notes", data=form(scene, "new"), headers=HERE)
    later = (reports / "first/report.html").stat().st_mtime + 1
    os.utime(reports / "first/notes.json", (later, later))
    assert f">{scene}</a>: new</p>" in client.get("/run?path=first").text


@pytest.mark.parametrize(
    "headers",
    [{}, {"Origin": "http://evil.example"}, {"Origin": "null"}, {"Origin": "http://127.0.0.1:7655"},
     {**HERE, "Sec-Fetch-Site": "cross-site"}],
)  # fmt: skip
def test_no_other_site_and_no_page_of_a_run_writes_a_note(
    headers: dict[str, str], client: TestClient, reports: Path, scene: str
) -> None:
    assert client.post("/notes", data=form(scene, "evil"), headers=headers).status_code == 403
    assert not (reports / "first/notes.json").exists()


@pytest.mark.parametrize("given", ["", "wrong"])
def test_without_the_token_no_note_is_written(
    given: str, client: TestClient, reports: Path, scene: str
) -> None:
    client.cookies.set(cookie(7654), given)
    client.cookies.clear()
    sent = {**HERE, "Cookie": f"{cookie(7654)}={given}"}
    for address in ("/notes", f"/notes?token={TOKEN}x"):
        assert client.post(address, data=form(scene, "evil"), headers=sent).status_code == 403
    assert not (reports / "first/notes.json").exists()


def test_a_browser_says_which_site_sends_the_form(client: TestClient) -> None:
    answer = client.get("/notes?path=first")
    assert answer.headers["referrer-policy"] == "same-origin", (
        "without it a browser sends `Origin: null`"
    )
    assert "form-action 'self'" in answer.headers["content-security-policy"]


@pytest.mark.parametrize(
    ("sent", "line"),
    [
        (form("nowhere", "x"), "first has no decision point 'nowhere'; copy one from its page"),
        (form("", "x"), "first has no decision point ''"),
        (form("SCENE", "x" * (LONGEST + 1)), f"a note has {LONGEST} characters at most"),
        (form("SCENE", "x", "../secret"), "no run '../secret' in "),
        (form("SCENE", "x", "first/sweep-tau"), "first/sweep-tau is no finished run of a model"),
        ({}, "no run '' in "),
        (form("SCENE", "\U0001f697" * 10_000), "this is longer than a note may be"),
    ],
)
def test_what_cannot_be_noted_is_one_line(
    sent: dict[str, str], line: str, client: TestClient, reports: Path, scene: str
) -> None:
    sent = {key: value.replace("SCENE", scene) for key, value in sent.items()}
    answer = client.post("/notes", data=sent, headers=HERE)
    assert answer.status_code in (400, 404, 413)
    assert said(answer).startswith(line)
    assert not list(reports.rglob("notes.json"))


def test_the_longest_note_of_any_characters_can_be_kept(
    client: TestClient, reports: Path, scene: str
) -> None:
    text = "\U0001f697" * LONGEST
    assert client.post("/notes", data=form(scene, text), headers=HERE).status_code == 200
    assert notes(reports / "first")[0].text == text


def test_a_run_has_so_many_notes_and_no_more(client: TestClient, reports: Path, scene: str) -> None:
    full = [{"scene": f"s{n:04d}", "text": "x", "date": ""} for n in range(MOST)]
    (reports / "first/notes.json").write_text(json.dumps(full))
    assert said(client.post("/notes", data=form(scene, "x"), headers=HERE)).startswith("a note has")
    assert "Noted on" not in render(gather([reports / "first"])), (
        "they are on no decision point of the run"
    )


def test_a_link_in_the_place_of_notes_is_neither_read_nor_written_through(
    client: TestClient, reports: Path, tmp_path: Path, scene: str
) -> None:
    (reports / "first/notes.json").symlink_to(tmp_path / "secret/secret.txt")
    for answer in (
        client.get("/notes?path=first"),
        client.post("/notes", data=form(scene, "x"), headers=HERE),
    ):
        assert said(answer) == "first has no notes.json of its own; delete it"
    assert (tmp_path / "secret/secret.txt").read_text() == SECRET


@pytest.mark.parametrize("text", ["", "{}", "[1]", '[{"scene": 1}]', "[" * 100_000])
def test_broken_notes_are_one_line(text: str, client: TestClient, reports: Path) -> None:
    (reports / "first/notes.json").write_text(text)
    answer = client.get("/notes?path=first")
    assert answer.status_code == 400
    assert "notes.json is broken (" in said(answer)


def posted(receive: Callable[[], Awaitable[Any]]) -> Request:
    """A note that is being sent."""
    headers = [(b"origin", b"x")]
    return Request(
        {"type": "http", "method": "POST", "path": "/notes", "headers": headers}, receive
    )


def test_a_browser_that_leaves_while_it_sends_a_note_is_no_bug(reports: Path) -> None:
    async def receive() -> dict[str, object]:
        return next(messages)

    first = {"type": "http.request", "body": b"path=first", "more_body": True}
    messages: Iterator[dict[str, object]] = iter([first, {"type": "http.disconnect"}])
    with pytest.raises(HTTPException, match="the browser is gone") as gone:
        asyncio.run(View(reports).note(posted(receive)))
    assert gone.value.status_code == 400
    assert not (reports / "first/notes.json").exists()


def test_a_note_that_never_comes_is_not_waited_for(
    reports: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def receive() -> dict[str, object]:
        await asyncio.sleep(60)
        return {}

    monkeypatch.setattr(app, "SENT_S", 0.05)
    with pytest.raises(HTTPException, match=r"a note did not come within 0.05 s"):
        asyncio.run(View(reports).note(posted(receive)))


def test_notes_leave_as_csv_where_a_run_has_any(
    harness: Callable[..., tuple[int, str, str]], two_run: Path, tmp_path: Path
) -> None:
    run, here = tmp_path / "run", tmp_path / "here"
    shutil.copytree(two_run, run)
    assert harness("run", "export", run, "--csv", "--out", here)[0] == 0
    assert sorted(path.name for path in here.iterdir()) == ["answers.csv", "decisions.csv"]
    first, second = read(run).decisions.labels("scene")[:2]
    texts = {first: "=1+1, it brakes", second: "two\nlines"}
    for scene, text in texts.items():
        write(run, scene, text, "")
    code, said, _ = harness("run", "export", run, "--csv", "--out", here)
    assert (code, "notes.csv" in said) == (0, True)
    with (here / "notes.csv").open(newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["scene", "text", "date"]
    assert {scene: text for scene, text, _ in rows} == {
        first: "'=1+1, it brakes",
        second: "two\nlines",
    }
    (run / "notes.json").write_text("{")
    code, _, error = harness("run", "export", run, "--csv", "--out", tmp_path / "none")
    assert (code, error.count("\n"), (tmp_path / "none").exists()) == (2, 1, False)
    assert "notes.json is broken" in error
