"""What is read in pages, and a run changed by hand."""

import json
import os
import re
import shutil
from collections.abc import Iterator
from html import unescape
from pathlib import Path

from httpx import Response
from run_on_disk import digested, name_answerers
from starlette.testclient import TestClient

from harness.extensions.view.access import cookie
from harness.extensions.view.app import app

TOKEN = "a-token-of-these-tests"
SECRET = "what lies outside, or is hidden"


def configure(run: Path, **values: object) -> None:
    """Change run.json, and its digests of that; the report is as new as before."""
    file = run / "run.json"
    then = file.stat().st_mtime
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))
    digested(run)
    if {"model", "prompt", "answer"} & values.keys():
        name_answerers(run)
    os.utime(file, (then, then))


def visitor(reports: Path) -> TestClient:
    """Who has opened the address that `harness view` printed."""
    return TestClient(
        app(reports, TOKEN), base_url="http://127.0.0.1:7654", raise_server_exceptions=False,
        cookies={cookie(7654): TOKEN},
    )  # fmt: skip


def laid_out(made: Path, base: Path) -> Path:
    """A copy of the runs, one a day after the other, and secrets beside it."""
    folder = Path(shutil.copytree(made, base / "reports"))
    for name, day in (("first", 1), ("second", 2)):
        configure(folder / name, created=f"2026-01-0{day}T12:00:00+00:00")
    (base / "secret").mkdir()
    for file in ("run.json", "report.html", "index.html", "sweep.svg", "secret.txt"):
        (base / "secret" / file).write_text(SECRET)
    return folder


def names(page: str) -> Iterator[str]:
    """The runs of a list, in order."""
    for head in re.findall(r'<th scope="row">(.*?)</th>', page, re.S):
        yield unescape(re.sub("<[^>]+>", "", head.partition(" <span")[0]))


def said(answer: Response) -> str:
    """The line of a page about what is wrong."""
    [line] = re.findall('<p class="headline">(.*?)</p>', answer.text, re.S)
    return unescape(line)
