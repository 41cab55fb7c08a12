"""What `harness view` keeps to itself:
files outside its folder, hidden ones, and all of it from others.
"""

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import quote

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from run_on_disk import made_up
from starlette.testclient import TestClient
from viewing import SECRET, laid_out, said, visitor

from harness.core.errors import UserError
from harness.extensions.view.folder import whole
from harness.runs.difficulty import FILE as DIFFICULTY

NOWHERE = [
    "..", "../secret", "first/..", "first/../../secret", "first/../second", "./first", "first/", "/first",
    "//first", "first//sweep-tau", "", "nowhere", "first\0", "\0", "..\\secret", "%2e%2e/secret",
    "..%2fsecret", ".work", ".hidden", "first/.work", "first/.hidden",
    "first/run.json", "~", "$HOME", "C:\\", "x" * 10_000,
    "．．/secret", "first\n", "FIRST ",
]  # fmt: skip
STRICT = "default-src 'none'; style-src 'self'; img-src 'self' data:; form-action 'self'"


def hide(reports: Path) -> Path:
    """Add folders that are hidden, one of a run's work and one that could be a run."""
    (reports / "first/.work").mkdir()
    (reports / "first/.work/answers.jsonl").write_text(SECRET)
    shutil.copytree(reports / "second", reports / ".hidden")
    (reports / ".hidden/report.html").write_text(SECRET)
    return reports


@pytest.fixture
def hiding(reports: Path) -> Path:
    return hide(reports)


@pytest.fixture(scope="module")
def kept_hiding(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As `hiding`, for tests that change nothing of it;
    with pictures that are none of the study's.
    """
    kept = hide(laid_out(made, tmp_path_factory.mktemp("hiding")))
    study = kept / "first/sweep-tau"
    (study / "lent.svg").symlink_to(kept.parent / "secret/sweep.svg")
    (study / ".hidden.svg").write_text(SECRET)
    (study / "folder.svg").mkdir()
    os.mkfifo(study / "pipe.svg")
    Path(os.fsdecode(os.fsencode(study) + b"/not \xff.svg")).write_text("<svg>")
    return kept


@pytest.fixture(scope="module")
def seeker(kept_hiding: Path) -> TestClient:
    return visitor(kept_hiding)


@pytest.mark.parametrize("name", NOWHERE)
def test_a_name_that_is_not_in_the_list_names_nothing(
    name: str, seeker: TestClient, kept_hiding: Path
) -> None:
    for page in ("/run", "/compare", "/report", "/picture"):
        answer = seeker.get(page, params={"path": name, "name": "sweep.svg"})
        assert answer.status_code == 404, page
        assert said(answer).startswith("no run ")
        assert SECRET not in answer.text
        if page in ("/compare", "/report"):
            assert seeker.get(f"{page}?path=first&path={quote(name)}").status_code == 404
    outside = kept_hiding.parent / "secret"
    for name in (str(outside), str(kept_hiding / "first"), outside.as_uri()):
        assert seeker.get("/run", params={"path": name}).status_code == 404


@pytest.mark.parametrize(
    "name",
    ["../../../secret/sweep.svg", "../../report.html", "../run.json", "sweep.json", "sweep.csv", "sweep.pdf",
     "sweep", "", ".", "..", "./sweep.svg", "sweep.svg\0", "sweep.svg/", "%73weep.svg", "/etc/passwd",
     "lent.svg", ".hidden.svg", "folder.svg", "pipe.svg"],
)  # fmt: skip
def test_a_picture_is_one_of_the_studys_own(name: str, seeker: TestClient) -> None:
    answer = seeker.get("/picture", params={"path": "first/sweep-tau", "name": name})
    assert answer.status_code == 404
    assert said(answer).startswith("first/sweep-tau has no picture ")
    page = seeker.get("/run?path=first/sweep-tau").text
    assert [word in page for word in ("lent", "hidden", "folder.svg", "pipe")] == [False] * 4


@pytest.mark.parametrize(
    "path",
    ["/../secret/secret.txt", "/..%2f", "/%2e%2e/secret/secret.txt", "/..%2fsecret%2fsecret.txt",
     "/secret.txt", "/first/report.html", "/static/../../secret/secret.txt", "/run/first", "/%00",
     "//etc/passwd", "/etc/passwd", "/.work", "/style.css/../../secret/secret.txt", "/openapi.json"],
)  # fmt: skip
def test_no_address_is_a_path(path: str, reader: TestClient) -> None:
    answer = reader.get(f"http://127.0.0.1:7654{path}", follow_redirects=False)
    assert answer.status_code == 404
    assert SECRET not in answer.text


@pytest.mark.slow
@settings(max_examples=30, suppress_health_check=[HealthCheck.too_slow])
@given(
    parts=st.lists(
        st.sampled_from(["..", ".", "", "first", "second", "sweep-tau", "secret", "secret.txt", ".work",
                         ".hidden", "report.html", "run.json", "answers.jsonl", "sweep.svg", "%2e%2e", "\0"])
        | st.text(max_size=3), max_size=6,
    ),
    name=st.sampled_from(["sweep.svg", "../sweep.svg", "../../../secret/sweep.svg", ".work/answers.jsonl"])
    | st.text(max_size=5),
    sep=st.sampled_from(["/", "\\", "%2f", "//"]),
)  # fmt: skip
def test_whatever_is_asked_for_nothing_outside_is_read(
    parts: list[str], name: str, sep: str, seeker: TestClient
) -> None:
    path = sep.join(parts)
    listed = path in ("first", "second", "first/sweep-tau")
    for page in ("/picture", "/run") if not listed else ("/picture",):
        answer = seeker.get(page, params={"path": path, "name": name})
        shown = listed and (path, name) == ("first/sweep-tau", "sweep.svg")
        assert answer.status_code == (200 if shown else 404), (page, path, name)
        assert SECRET not in answer.text
    try:
        answer = seeker.get("http://127.0.0.1:7654/" + quote(path), follow_redirects=False)
    except ValueError:  # no address at all, as the client says
        return
    assert SECRET not in answer.text


@pytest.mark.slow
def test_links_that_lead_out_are_not_followed(client: TestClient, reports: Path) -> None:
    outside = reports.parent / "secret"
    (reports / "lent").symlink_to(outside)
    report = reports / "first/report.html"
    report.unlink()
    report.symlink_to(outside / "report.html")
    assert client.get("/run?path=lent").status_code == 404
    made = client.get("/run?path=first")
    assert made.status_code == 200
    assert SECRET not in made.text
    assert "Conditions side by side" in made.text
    for file in ("decisions.parquet", "answers.jsonl", "episodes.csv"):
        (reports / "second" / file).rename(outside / file)
        (reports / "second" / file).symlink_to(outside / file)
        for page in ("/run?path=second", "/report?path=second", "/compare?path=first&path=second"):
            answer = client.get(page)
            assert (answer.status_code, said(answer)) == (
                400, f"second has no {file} of its own; make the run again",
            )  # fmt: skip
        (reports / "second" / file).unlink()
        (outside / file).rename(reports / "second" / file)
    (reports / "paper").mkdir()
    (reports / "paper/study.json").write_text("{}")
    (reports / "paper/index.html").symlink_to(outside / "index.html")
    assert "This folder has no page and no picture to show" in client.get("/run?path=paper").text


def test_links_within_are_followed_but_not_to_what_is_hidden(
    client: TestClient, hiding: Path
) -> None:
    (hiding / "latest").symlink_to(hiding / "first")
    (hiding / "shown").symlink_to(hiding / ".hidden")
    assert client.get("/run?path=latest").status_code == 200
    answer = client.get("/run?path=shown")
    assert answer.status_code == 400
    assert SECRET not in answer.text


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:7654",
        "127.0.0.1.evil.example",
        "",
        "[::1]:7654",
        "0.0.0.0:7654",
    ],
)
def test_only_this_machines_own_names_are_answered(host: str, reader: TestClient) -> None:
    answer = reader.get("/", headers={"host": host})
    assert (answer.status_code, answer.text) == (400, "Invalid host header")


@pytest.mark.parametrize("host", ["127.0.0.1:7654", "localhost:7654"])
def test_both_names_of_this_machine_are_answered(host: str, reader: TestClient) -> None:
    assert reader.get("/", headers={"host": host}).status_code == 200


@pytest.mark.parametrize(
    "page", ["/", "/run?path=first", "/picture", "/compare", "/report", "/progress"]
)
def test_nothing_can_be_sent_to_it(page: str, reader: TestClient) -> None:
    for method in ("POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE"):
        assert reader.request(method, page).status_code == 405
    answer = reader.head("/")
    assert (answer.status_code, answer.content) == (200, b"")


@pytest.mark.parametrize(
    ("page", "status"),
    [("/", 200), ("/progress", 200), ("/style.css", 200), ("/run?path=first/sweep-tau", 200),
     ("/run?path=nowhere", 404), ("/nowhere", 404), ("/compare", 400)],
)  # fmt: skip
def test_every_page_of_the_list_has_the_strict_policy(
    page: str, status: int, reader: TestClient
) -> None:
    answers = [reader.get(page)]
    assert answers[0].status_code == status
    answers += [reader.post(page), reader.get(page, headers={"host": "evil.example"})]
    for answer in answers:
        assert answer.headers["content-security-policy"].startswith(STRICT)
        assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
        assert "base-uri 'none'" in answer.headers["content-security-policy"]
        assert answer.headers["cross-origin-opener-policy"] == "same-origin"
        common(answer.headers)


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    ["/run?path=first", "/run?path=second", "/report?path=first", "/compare?path=first&path=second",
     "/picture?path=first/sweep-tau&name=sweep.svg"],
)  # fmt: skip
def test_what_a_run_holds_is_shown_in_a_sandbox(page: str, reader: TestClient) -> None:
    answer = reader.get(page)
    policy = answer.headers["content-security-policy"].split("; ")
    assert answer.status_code == 200
    assert "default-src 'none'" in policy
    [sandbox] = [rule for rule in policy if rule.startswith("sandbox")]
    assert "allow-same-origin" not in sandbox
    assert (
        ("allow-scripts" in sandbox)
        is ("script-src 'unsafe-inline'" in policy)
        is ("picture" not in page)
    )
    assert answer.headers["cross-origin-opener-policy"] == "unsafe-none", (
        "browsers show nothing else sandboxed"
    )
    common(answer.headers)


def common(headers: Mapping[str, str]) -> None:
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"
    assert headers["cross-origin-resource-policy"] == "same-origin"
    assert headers["cache-control"] == "no-store"
    assert not {"server", "access-control-allow-origin", "set-cookie"} & set(headers)


def test_a_view_follows_no_link_out_of_its_folder(tmp_path: Path) -> None:
    made_up(tmp_path / "reports/run")
    assert whole(tmp_path / "reports", "run")
    (tmp_path / "secret.csv").write_text("episode\n")
    (tmp_path / "reports/run" / DIFFICULTY).symlink_to(tmp_path / "secret.csv")
    with pytest.raises(UserError, match=f"run has no {DIFFICULTY} of its own; delete it"):
        whole(tmp_path / "reports", "run")
