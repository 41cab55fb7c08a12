"""`harness view` as typed."""

import re
import shutil
import signal
import socket
import stat
import subprocess
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import pytest
import uvicorn

from harness.extensions.view.access import cookie
from harness.report.document import Chart, Section, document
from harness.report.words import cell
from harness.runs.folder import read
from harness.runs.headline import headline_of
from harness.runs.metric_names import GAINS

Said = tuple[int, str, str]
LISTENS = "0A"  # of /proc/net/tcp


def raw(port: int, head: str) -> bytes:
    """The answer to a request that no client would tidy up."""
    with socket.create_connection(("127.0.0.1", port), timeout=60) as sent:
        sent.sendall(f"{head}Connection: close\r\n\r\n".encode())
        return b"".join(iter(lambda: sent.recv(1 << 16), b""))


@pytest.fixture
def served(reports: Path) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """The real command, and what it says first."""
    command = [sys.executable, "-m", "harness", "view", str(reports), "--port", "0"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout
        try:
            yield process, process.stdout.readline()
        finally:
            process.kill()


@pytest.mark.slow
def test_the_command_serves_on_loopback_alone_until_it_is_interrupted(
    served: tuple["subprocess.Popen[str]", str],
) -> None:
    process, line = served
    found = re.fullmatch(
        r"(http://127\.0\.0\.1:(\d+)/\?token=([\w-]{43})) shows them until Ctrl-C\n", line
    )
    assert found, line
    port, owner = int(found[2]), f"Cookie: {cookie(int(found[2]))}={found[3]}\r\n"
    page = httpx.get(found[1], timeout=60, follow_redirects=True)
    assert page.status_code == 200
    assert str(page.url) == f"http://127.0.0.1:{port}/"
    assert "tag of first" in page.text
    assert "server" not in page.headers
    assert httpx.get(page.url, timeout=60).status_code == 403
    for path in (
        "/../secret/secret.txt",
        "/%2e%2e/secret/secret.txt",
        "/run?path=../secret",
        "/run?path=%00",
    ):
        answer = raw(port, f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n{owner}")
        assert answer.startswith(b"HTTP/1.1 404")
        assert raw(port, f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n").startswith(b"HTTP/1.1 403")
    assert raw(port, "GET / HTTP/1.1\r\nHost: evil.example\r\n").startswith(b"HTTP/1.1 400")
    # 4 MiB of path, a request cut short and no HTTP at all end no server.
    for sent in (b"GET /" + b"x" * (1 << 22), b"GET / HTT", b"\x16\x03\x01\x00"):
        with socket.create_connection(("127.0.0.1", port)) as cut, suppress(ConnectionError):
            cut.sendall(sent)
    assert httpx.get(found[1], timeout=60, follow_redirects=True).status_code == 200
    if Path("/proc/net/tcp").is_file():
        assert listeners(port) == [f"0100007F:{port:04X}"]
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (0, "", "")


def listeners(port: int) -> list[str]:
    """Addresses that are listened on at a port, as the kernel writes them."""
    return [
        local for table in ("tcp", "tcp6") if (file := Path("/proc/net", table)).is_file()
        for _, local, _, state, *_ in map(str.split, file.read_text().splitlines()[1:])
        if state == LISTENS and local.endswith(f":{port:04X}")
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["--port", "-1"], "--port -1 is out of range; give 0 to 65535"),
        (["--port", "65536"], "--port 65536 is out of range; give 0 to 65535"),
        (
            ["nowhere"],
            "nowhere is no folder; give one that holds runs, or make a run with `harness eval`",
        ),
        (["--host", "0.0.0.0"], "No such option: --host"),
        (["--export", "reports"], "--export reports is there already; give a new folder"),
        (
            ["--export", "site"],
            "reports has no run that can be shown; make one with `harness eval`",
        ),
        (["--export", "site", "--open"], "--export and --open: give one of them"),
    ],
)
def test_bad_input_is_one_line(args: list[str], said: str, harness: Callable[..., Said]) -> None:
    Path("reports").mkdir()
    code, out, err = harness("view", *args)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err


@pytest.mark.slow
def test_an_exported_folder_has_a_list_and_a_page_of_each_run_and_no_path_of_this_machine(
    reports: Path, harness: Callable[..., Said], tmp_path: Path
) -> None:
    (reports / "second/report.html").write_text(f"<body>{tmp_path} is not for others")
    code, out, err = harness("view", str(reports), "--export", str(tmp_path / "site"))
    assert (code, out) == (0, f"wrote {tmp_path / 'site/index.html'}\n")
    assert (
        "left out first/sweep-tau: a sweep without a page that this version wrote; make it again"
        in err
    )
    site = {
        str(file.relative_to(tmp_path / "site")): file.read_text()
        for file in (tmp_path / "site").rglob("*.html")
    }
    assert set(site) == {"index.html", "first/report.html", "second/report.html"}
    assert re.findall('<a href="([^"]+)"', site["index.html"]) == [
        "second/report.html",
        "first/report.html",
    ]
    assert all(
        '<a href="../index.html">← All runs</a>' in site[name]
        for name in site
        if name != "index.html"
    )
    run = read(reports / "first")
    lead = headline_of(run)
    figures = [cell(run.score("6g", metric)) for metric in (lead, GAINS[lead], "unsafe_rate")]
    assert "".join(f"<td>{figure}</td>" for figure in figures) in site["index.html"]
    assert not any(str(tmp_path) in page for page in site.values())


def test_a_run_that_has_the_name_of_a_page_is_left_out_and_all_others_are_exported(
    reports: Path, harness: Callable[..., Said], tmp_path: Path
) -> None:
    (reports / "second").rename(reports / "index.html")
    (reports / "first/report.html").unlink()
    shutil.copytree(reports / "index.html", reports / "first/report.html")
    code, _, err = harness("view", str(reports), "--export", str(tmp_path / "site"))
    assert code == 0
    for name in ("index.html", "first/report.html"):
        assert f"left out {name}: a page would have its name; rename it" in err
    assert (tmp_path / "site/first/report.html").is_file()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("<meta", "<script></script><meta"),
        ("</body>", '<meta http-equiv="refresh" content="0; url=http://evil"></body>'),
        ("</body>", "<META content='0;http://evil' HTTP-Equiv=refresh></body>"),
        ("<title>", "<meta\nhttp-equiv\n=\nrefresh content=0><title>"),
    ],
)
@pytest.mark.parametrize("charts", [{}, {"loss": Chart("Success over loss", {})}])
def test_an_exported_folder_has_studies_whose_page_runs_no_other_script_and_leads_nowhere(
    old: str,
    new: str,
    charts: dict[str, Chart],
    reports: Path,
    harness: Callable[..., Said],
    tmp_path: Path,
) -> None:
    page = document([Section("A sweep of many points", charts=charts)])
    (reports / "first/sweep-tau/index.html").write_text(page)
    spy = reports / "second/sweep-tau"
    spy.mkdir()
    (spy / "sweep.json").write_text('{"sources": []}')
    (spy / "index.html").write_text(page.replace(old, new, 1))
    code, _, err = harness("view", str(reports), "--export", str(tmp_path / "site"))
    assert (code, err.count("left out")) == (0, 1)
    assert "left out second/sweep-tau: a sweep without a page that this version wrote" in err
    assert "A sweep of many points" in (tmp_path / "site/first/sweep-tau/report.html").read_text()
    assert '<a href="first/sweep-tau/report.html">' in (tmp_path / "site/index.html").read_text()


def test_a_port_in_use_is_one_line(harness: Callable[..., Said]) -> None:
    Path("reports").mkdir()
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        said = f"harness: --port {port} is in use; give another, or 0 for a free one\n"
        assert harness("view", "--port", str(port)) == (2, "", said)


def test_it_opens_the_browser_when_asked_to(
    harness: Callable[..., Said], monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("reports").mkdir()
    opened: list[str] = []
    modes: list[int] = []
    asks_to_open: list[bool] = []
    shown = threading.Event()

    def interrupted(self: uvicorn.Server, sockets: list[socket.socket]) -> None:
        [listener] = sockets
        assert listener.getsockname()[0] == "127.0.0.1"
        if asks_to_open:
            assert shown.wait(10)
        raise KeyboardInterrupt

    monkeypatch.setattr(uvicorn.Server, "run", interrupted)

    def opens(url: str) -> None:
        page = Path(url.removeprefix("file://"))
        modes.append(stat.S_IMODE(page.parent.stat().st_mode))
        opened.append(page.read_text())
        shown.set()

    monkeypatch.setattr(webbrowser, "open", opens)
    code, out, err = harness("view", "--port", "0")
    assert (code, err, opened) == (0, "", [])
    asks_to_open.append(True)
    code, out, err = harness("view", "--port", "0", "--open")
    assert (code, err) == (0, "")
    # The address of a page, whose folder no other user can read: all users see a browser's
    # arguments.
    assert f'content="0; url={out.split()[0]}"' in opened[0]
    assert modes == [0o700]
