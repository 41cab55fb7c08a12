"""Who `harness view` answers: whoever has its token, and no other site."""

import shutil
from pathlib import Path

import pytest
from starlette.testclient import TestClient
from viewing import TOKEN, said

from harness.extensions.view.access import cookie
from harness.extensions.view.app import app

PAGES = ["/", "/progress", "/style.css", "/run?path=first", "/picture?path=first/sweep-tau&name=sweep.svg",
         "/compare?path=first&path=second", "/report?path=first", "/notes?path=first",
         "/nowhere"]  # fmt: skip


@pytest.fixture
def stranger(kept_reports: Path) -> TestClient:
    """Another user of the machine, without the token."""
    return TestClient(app(kept_reports, TOKEN), base_url="http://127.0.0.1:7654")


@pytest.mark.parametrize("page", PAGES)
@pytest.mark.parametrize("given", ["", "wrong", TOKEN[:-1], TOKEN + "x", TOKEN.upper(), "tök\xe9n"])
def test_without_the_token_nothing_is_read(page: str, given: str, stranger: TestClient) -> None:
    sent = {b"Cookie": f"{cookie(7654)}={given}".encode("latin-1")}
    asked = f"{page}{'&' if '?' in page else '?'}token={given}"
    for answer in (stranger.get(page), stranger.get(page, headers=sent), stranger.get(asked)):
        assert answer.status_code == 403
        assert said(answer) == "open the address that `harness view` printed, with its token"
        assert "set-cookie" not in answer.headers
        assert answer.headers["content-security-policy"].startswith("default-src 'none'")


@pytest.mark.slow
def test_the_printed_address_gives_a_cookie_and_leaves_the_token_out(stranger: TestClient) -> None:
    answer = stranger.get(f"/run?path=second&token={TOKEN}", follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (
        303,
        "http://127.0.0.1:7654/run?path=second",
    )
    assert answer.headers["set-cookie"] == f"{cookie(7654)}={TOKEN}; HttpOnly; Path=/; SameSite=lax"
    assert stranger.get("/run?path=second").status_code == 200
    assert stranger.get("/?token=wrong").status_code == 403, "although the cookie is right"
    away = stranger.get(
        f"http://127.0.0.1:7654//evil.example/?token={TOKEN}", follow_redirects=False
    )
    assert away.headers["location"].startswith("http://127.0.0.1:7654//")


@pytest.mark.parametrize("page", PAGES)
@pytest.mark.parametrize(
    "headers",
    [
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},  # another port of this machine
        {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"},
        {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "iframe"},
        {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "cors", "Sec-Fetch-Dest": "empty"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:7655"},
    ],
)
def test_other_sites_get_nothing_although_the_browser_has_the_cookie(
    page: str, headers: dict[str, str], reader: TestClient
) -> None:
    for asked in (page, f"{page}{'&' if '?' in page else '?'}token={TOKEN}"):
        answer = reader.get(asked, headers=headers, follow_redirects=False)
        assert answer.status_code == 403
        assert said(answer) == "another site asked for this page; open it from the list of runs"


@pytest.mark.parametrize(
    "headers",
    [
        {"Sec-Fetch-Site": "same-origin", "Origin": "http://127.0.0.1:7654"},
        {"Sec-Fetch-Site": "none", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"},
        # A link in a run's page, which lies in a sandbox, opens another one.
        {
            "Sec-Fetch-Site": "cross-site",
            "Sec-Fetch-Mode": "navigate",
            "Sec-Fetch-Dest": "document",
        },
    ],
)
def test_its_own_pages_and_links_are_answered(headers: dict[str, str], reader: TestClient) -> None:
    assert reader.get("/", headers=headers).status_code == 200


def test_two_viewers_on_two_ports_keep_their_cookies_apart(reports: Path, tmp_path: Path) -> None:
    other = shutil.copytree(reports / "second", tmp_path / "others/second").parent
    cookies = {cookie(7654): TOKEN, cookie(7655): "another"}
    for folder, port, token in ((reports, 7654, TOKEN), (other, 7655, "another")):
        client = TestClient(
            app(folder, token), base_url=f"http://127.0.0.1:{port}", cookies=cookies
        )
        assert client.get("/").status_code == 200
