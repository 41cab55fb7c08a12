"""One model behind several servers: who is asked, who is set aside,
and that no row depends on it.
"""

import gc
import json
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from heapq import heappop, heappush
from pathlib import Path
from typing import Any

import pytest
from evaluating import FILES, same_decisions, same_files, spec_of, with_ego
from hypothesis import given
from hypothesis import strategies as st
from misbehaving import Asked, Play, Server, completion, serving
from msgspec import structs
from served import answer, served
from tiers import some

from harness.backends.base import Request, Served
from harness.backends.card import Card, Latency
from harness.backends.openai import backend as openai_backend
from harness.backends.openai import pool as openai_pool
from harness.backends.openai.http import Client
from harness.backends.openai.pace import Pace
from harness.backends.openai.wire import CHAT
from harness.backends.servers import Kind
from harness.backends.servers import Server as Where
from harness.core import resources
from harness.core.at_once import AtOnce
from harness.core.errors import UserError
from harness.core.work import tidy
from harness.dataset.load import Dataset
from harness.evaluate import costs, servers
from harness.evaluate import run as run_module
from harness.evaluate.asking import Asker
from harness.evaluate.kept_answers import read_kept
from harness.evaluate.latency import PAPER
from harness.evaluate.run import evaluate
from harness.evaluate.spec import Spec
from harness.runs import folder

ACTIONS = ("SLOWER", "IDLE", "FASTER")


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(openai_pool, "FIRST_WAIT_S", 0.02)
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")


def card(*urls: str, kind: Kind = "generic", **server: Any) -> Card:
    where = Where(urls, kind, **{"timeout_s": 20.0, "retries": 2, **server})
    return Card("mine", "openai", "d", Latency("paper", None, "b"), "m", server=where)


def request(name: str) -> Request:
    return Request(name, "ego", ({"role": "user", "content": name},), ACTIONS, 64)


def decisions(count: int, viewers: int = 4) -> list[Request]:
    return [request(f"s{n}/v{v}") for n in range(count) for v in range(viewers)]


def said_back(asked: Asked) -> None:
    asked.reply(completion(asked.body["messages"][0]["content"]))


def names(server: Server) -> list[str]:
    return [asked.body["messages"][0]["content"] for asked in server.asked]


def opened(
    *servers: Server, batch_size: AtOnce = 4, **options: Any
) -> openai_backend.OpenAIBackend:
    return openai_backend.open(
        card(*(there.url for there in servers), **options), batch_size=batch_size
    )


# -- who is asked ----------------------------------------------------------------------------------


def test_requests_of_a_decision_go_to_one_server_and_each_server_has_some_decisions() -> None:
    with serving(said_back) as one, serving(said_back) as other:
        backend, asked = opened(one, other), decisions(24)
        # so few at a time that no server lacks work for the other
        for start in range(0, len(asked), 4):
            done = backend.complete(asked[start : start + 4])
            assert [c.text for c in done] == [r.id for r in asked[start : start + 4]]
        again = [c.text for r in asked for c in backend.complete([r])]
    assert again == [r.id for r in asked]
    of_one, of_other = ({name.partition("/")[0] for name in names(there)} for there in (one, other))
    assert not of_one & of_other
    # ports are drawn: one has all once in eight million
    assert min(len(of_one), len(of_other)) >= 1
    assert len(one.asked) + len(other.asked) == 2 * len(asked)


def test_a_server_without_work_of_its_own_takes_from_the_other() -> None:
    """All are of one decision; no answer comes before both servers have two."""
    four = threading.Barrier(4)

    def play(asked: Asked) -> None:
        four.wait(timeout=20)
        said_back(asked)

    asked = [request(f"s/v{n}") for n in range(16)]
    with serving(play) as one, serving(play) as other:
        done = opened(one, other, batch_size=2).complete(asked)
    assert [c.text for c in done] == [r.id for r in asked]
    assert len(one.asked) == len(other.asked) == 8
    assert {(c.batch_size, c.seconds, c.retries) for c in done} == {(2, None, 0)}


@pytest.mark.slow
def test_connections_stay_open_between_calls_and_are_closed_with_the_backend() -> None:
    ports = set()

    def play(asked: Asked) -> None:
        ports.add(asked.handler.client_address)
        said_back(asked)

    before = set(threading.enumerate())  # threads of earlier tests may still be ending
    with serving(play) as there:
        backend = opened(there)
        for _ in range(5):
            backend.complete(decisions(4))
        assert len(there.asked) == 80
        assert len(ports) <= 4
        del backend
        gc.collect()
    until_s = time.monotonic() + 20
    # the server's end as these do
    while set(threading.enumerate()) - before and time.monotonic() < until_s:
        time.sleep(0.01)
    assert not set(threading.enumerate()) - before


def test_a_chunk_does_not_wait_for_the_last_answer_of_the_one_before(
    small: Dataset, tmp_path: Path
) -> None:
    """The first request of many is answered only when one of the second chunk has come."""
    second = threading.Event()

    def play(asked: Asked) -> None:
        if asked.number == 1:
            assert second.wait(20)
        if asked.number > 64:
            second.set()
        said_back(asked)

    with serving(play) as there:
        spec = with_ego(spec_of(small, batch_size=4), card=card(there.url))
        backend, asked, counts = opened(there), decisions(32), []
        asker = Asker(
            spec, lambda: backend, PAPER, tmp_path / "answers.jsonl", progress=counts.append
        )
        asked += [request(f"t/v{v}") for v in range(3)]
        asker.ask([request("t/v9")])  # until something is answered, only a few are asked
        asker.ask(asked)
    assert list(asker.answers) == ["t/v9", *(r.id for r in asked)]
    assert sorted(counts) == [1, 64, 67], (
        "the last is too few to fill a batch, and goes with the others"
    )
    assert {a.batch_size for a in list(asker.answers.values())[1:]} == {4}


def test_an_answer_that_had_company_has_no_time() -> None:
    two = threading.Barrier(2)

    def play(asked: Asked) -> None:
        two.wait(timeout=20)
        said_back(asked)

    with serving(play) as there:
        backend, done = opened(there), []
        calls = [
            threading.Thread(
                target=lambda name=name: done.extend(backend.complete([request(name)]))
            )
            for name in "ab"
        ]
        for call in calls:
            call.start()
        for call in calls:
            call.join()
    assert [(c.seconds, c.batch_size) for c in done] == [(None, 4), (None, 4)]


@given(st.sets(st.integers(1, 65535), min_size=2, max_size=8), st.text(), st.data())
def test_a_server_that_is_gone_moves_no_decision_but_its_own(
    ports: set[int], decision: str, data: st.DataObject
) -> None:
    def ranked(urls: list[str]) -> list[str]:
        where = Where(tuple(urls))
        pool = openai_pool.ServerPool(Client(where), where, "mine", "m", 4, "/chat/completions")
        return [server.url for server in pool._rank(decision)]

    urls = [f"http://127.0.0.1:{port}/v1" for port in ports]
    gone = data.draw(st.sampled_from(urls))
    left = [url for url in urls if url != gone]
    assert ranked(left) == ranked(left[::-1]) == [url for url in ranked(urls) if url != gone]


# -- how many at a time ----------------------------------------------------------------------------


Load = Callable[
    [int], tuple[float, bool]
]  # of requests at a time: an answer's s, and is it refused
AT_ONCE: dict[str, tuple[Load, int, int]] = {  # and how many there may be at the end
    "one that takes all": (lambda n: (1.0, False), 256, 256),
    "one that refuses above 20": (lambda n: (1.0, n > 20), 10, 21),
    "one where others wait above 16": (lambda n: (max(1.0, n / 16), False), 16, 48),
    "one that is slower with each": (lambda n: (1 + n / 50, False), 30, 120),
    "one of which all wait": (lambda n: (float(n), False), 1, 10),
    "one that refuses all": (lambda n: (0.0, True), 1, 1),
}


@pytest.mark.parametrize("load", AT_ONCE)
def test_a_pace_finds_how_many_a_server_takes_well(load: str) -> None:
    """In a time of its own: as many are sent as may be, and each takes what it is told then."""
    takes, least, most = AT_ONCE[load]
    pace, under_way, now_s = Pace("auto"), list[tuple[float, float, int, bool]](), 0.0
    for _ in range(6000):
        while len(under_way) < pace.limit:
            seconds, refused = takes(len(under_way) + 1)
            heappush(under_way, (now_s + (0.01 if refused else seconds), now_s, pace.turn, refused))
        full = len(under_way) >= pace.limit
        now_s, sent_s, turn, refused = heappop(under_way)
        if refused:
            pace.refused(turn)
        elif full:
            pace.answered(turn, now_s - sent_s)
    assert least <= pace.limit <= most


def test_longer_answers_do_not_end_in_one_at_a_time() -> None:
    """Ten times as long from one moment on, whatever the load: the measure begins anew."""
    pace = Pace("auto")
    for seconds in (1.0, 10.0):
        for _ in range(5000):
            pace.answered(pace.turn, seconds)
        assert pace.limit == 256


def test_a_server_that_refuses_is_asked_less_and_answers_all() -> None:
    """No refusal counts as an attempt, of which there is one; nothing is asked while it rests."""
    busy, most, lock = [0], [0], threading.Lock()
    refused_s, came_s = list[float](), list[float]()

    def play(asked: Asked) -> None:
        with lock:
            busy[0] += 1
            most[0], now = max(most[0], busy[0]), busy[0]
        if now > 6:
            refused_s.append(time.monotonic())
            asked.reply({"error": "too many"}, 429, retry_after="0.2")
        else:
            came_s.append(time.monotonic())
            time.sleep(0.005)
            said_back(asked)
        with lock:
            busy[0] -= 1

    asked = decisions(30)
    with serving(play) as there:
        done = opened(there, batch_size="auto", retries=0).complete(asked)
    assert [(c.text, c.error) for c in done] == [(r.id, None) for r in asked]
    assert refused_s
    assert most[0] <= 8, "4 are doubled once"
    assert sum(c.retries for c in done) == len(refused_s)
    rests = [(at + 0.1, at + 0.19) for at in refused_s]  # what was on its way may come before
    assert not any(begin < at < end for at in came_s for begin, end in rests)


# -- who is set aside ------------------------------------------------------------------------------


def broken(asked: Asked) -> None:
    asked.reply({"error": "out of memory"}, 503)


def test_what_one_server_cannot_answer_another_does_at_once(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Three failures set it aside, so that it is asked no more."""
    with serving(broken) as one, serving(said_back) as other:
        asked = decisions(40)
        done = opened(one, other, batch_size=1, retries=0).complete(asked)
        url = one.url
    assert [(c.text, c.retries, c.error) for c in done] == [(r.id, 0, None) for r in asked]
    assert 3 <= len(one.asked) < 40, "three, and one each time that it is there again"
    said = capfd.readouterr().err
    assert f"harness: model 'mine': server {url} is set aside (HTTP 503: out of memory)\n" in said
    assert f"server {url} is there again" in said or len(one.asked) == 3


def test_a_server_that_recovers_is_asked_again() -> None:
    down = threading.Event()
    down.set()

    def play(asked: Asked) -> None:
        (broken if down.is_set() else said_back)(asked)

    def listed(asked: Asked) -> None:
        broken(asked) if down.is_set() and recovering.asked else asked.reply(
            {"data": [{"id": "m"}]}
        )

    with serving(play, listed) as recovering, serving(
        said_back, lambda asked: asked.reply({"data": [{"id": "m"}]})
    ) as other:  # fmt: skip
        backend = opened(recovering, other, batch_size=1)
        backend.complete(decisions(10))
        assert len(recovering.asked) == 3
        down.clear()
        until_s = time.monotonic() + 20
        while len(recovering.asked) < 10 and time.monotonic() < until_s:
            assert {c.error for c in backend.complete(decisions(10))} == {None}
    assert len(recovering.asked) >= 10


@pytest.mark.parametrize("entry", [{"id": "m", "root": "/other"}, None])
def test_a_server_that_comes_back_with_another_model_ends_the_run(entry: Any) -> None:
    def play(asked: Asked) -> None:
        (broken if asked.number < 3 else said_back)(asked)

    def listed(asked: Asked) -> None:
        now = entry if there.asked else {"id": "m"}
        asked.reply({"data": [now]} if now else b"no list")

    with serving(play, listed) as there:
        backend = opened(there, batch_size=1)
        if entry is None:
            match = (
                r"no server is left: http://127\.0\.0\.1:\d+/v1 \(the answer is no JSON: .*\); "
                r"start one"
            )
        else:
            match = (
                r"server http\S+ has id=m, and server http\S+ id=m root=/other; serve the same "
                r"model"
            )
        with pytest.raises(UserError, match=match):
            backend.complete(decisions(10))


def test_a_request_that_no_server_can_answer_is_an_error_and_the_others_are_answered() -> None:
    def play(asked: Asked) -> None:
        (broken if names_of(asked) == "s3/v1" else said_back)(asked)

    def names_of(asked: Asked) -> str:
        return str(asked.body["messages"][0]["content"])

    with serving(play) as one, serving(play) as other:
        done = opened(one, other).complete(decisions(10))
    errors = {c.request_id: c.error for c in done if c.error}
    assert errors == {"s3/v1": "HTTP 503: out of memory"}
    assert sum(name == "s3/v1" for there in (one, other) for name in names(there)) == 3


def test_a_server_that_is_not_there_yet_is_waited_for(capfd: pytest.CaptureFixture[str]) -> None:
    with serving(said_back) as gone:
        url = gone.url
    with serving(said_back) as there:
        done = openai_backend.open(card(url, there.url), batch_size=4).complete(decisions(5))
    assert {c.error for c in done} == {None}
    assert f"server {url} is set aside (ClientConnectorError" in capfd.readouterr().err


def test_a_server_is_looked_for_as_long_as_the_run_lasts() -> None:
    pauses_s = [openai_pool.pause_s(times) for times in (0, 1, 2, 10, 5000)]
    assert pauses_s == [0.02, 0.04, 0.08, 20.48, openai_pool.LONGEST_WAIT_S]


def test_a_bug_is_a_crash_and_no_wait_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    def bug(*_: Any) -> Any:
        raise ZeroDivisionError

    with serving(said_back) as there:
        backend = opened(there)
        monkeypatch.setattr(backend, "_wire", CHAT._replace(body=bug))
        with pytest.raises(ZeroDivisionError):
            backend.complete(decisions(2))


@pytest.mark.parametrize(
    "header",
    [
        "Set-Cookie: \x1b[31m=;;=",
        "Content-Type: ;;;",
        "Content-Type: text/event-stream;=",
        "X: " + "y" * 9000,
    ],
)
def test_a_header_that_is_none_says_nothing_on_the_terminal(
    header: str, caplog: pytest.LogCaptureFixture
) -> None:
    data = json.dumps(completion("a")).encode()

    def play(asked: Asked) -> None:
        asked.raw(
            b"HTTP/1.1 200 OK\r\n%b\r\nContent-Length: %d\r\n\r\n%b"
            % (header.encode(), len(data), data)
        )

    with serving(play) as there:
        [done] = opened(there).complete(decisions(1, 1))
    assert done.text == "a" or done.error
    assert caplog.records == []


# -- the same model --------------------------------------------------------------------------------


def lists(entry: Any, version: str | None = None) -> Play:
    def listed(asked: Asked) -> None:
        asked.reply({"version": version} if asked.path == "/version" else {"data": [entry]})

    return listed


@pytest.mark.parametrize(
    ("entries", "versions", "said"),
    [
        (({"id": "m", "max_model_len": 1}, {"id": "m", "max_model_len": 2}), ("1", "1"),
         "has id=m max_model_len=1 version=1, and server {1} id=m max_model_len=2 version=1; "
         "serve the same"),
        (({"id": "m"}, {"id": "m"}), ("1", "2"),
         "server {0} has id=m version=1, and server {1} id=m version=2; serve the same model, by "
         "the same"),
        (({"id": "m"}, "m"), ("1", "1"), "server {1} lists no m at {1}/models"),
    ],
)  # fmt: skip
def test_servers_with_different_models_are_one_line_that_names_two(
    entries: Any, versions: Any, said: str
) -> None:
    with ExitStack() as stack:
        there = [
            stack.enter_context(serving(said_back, lists(*each)))
            for each in zip(entries, versions, strict=True)
        ]
        with pytest.raises(UserError) as caught:
            opened(*there, kind="vllm")
        assert said.format(*(server.url for server in there)) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_which_servers_answer_is_no_part_of_the_models_identity() -> None:
    with (
        serving(said_back, lists({"id": "m"}, "1")) as one,
        serving(said_back, lists({"id": "m"}, "1")) as other,
    ):
        identities = [opened(*there, kind="vllm").identity() for there in ((one,), (other, one))]
    expected = {
        "engine": "openai", "answers": 3, "server": "vllm", "model": "m", "listed": {"id": "m"},
        "version": "1",
    }  # fmt: skip
    assert identities == [expected, expected]


# -- whole runs ------------------------------------------------------------------------------------


def served_spec(small: Dataset, *urls: str) -> Spec:
    """An evaluation of a card that names another server, at these."""
    mine = replace(card("http://127.0.0.1:9/v1"), server=Where("http://127.0.0.1:9/v1", retries=2))
    return with_ego(spec_of(small, seeds=(0,), batch_size=4), card=mine).changed(server=urls)


def evaluated(spec: Spec, out: Path, cache: Path | None = None, workers: int = 1) -> Path:
    done = evaluate(spec, out, lambda done: None, cache, workers=workers)
    tidy(out)
    return done.out


@pytest.fixture(scope="module")
def whole(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of one server that nobody kills."""
    with served() as url:
        return evaluated(served_spec(small, url), tmp_path_factory.mktemp("served") / "whole")


@pytest.mark.parametrize("answers", some([1], exhaustive=[0, 40]))
def test_a_server_killed_in_mid_run_loses_nothing(
    whole: Path, small: Dataset, tmp_path: Path, answers: int, capfd: pytest.CaptureFixture[str]
) -> None:
    """Its process ends when it is asked for one more;
    of what it had then, each is answered elsewhere.
    """
    with served(answers) as one, served() as other:
        out = evaluated(served_spec(small, one, other), tmp_path / "run")
    assert f"server {one} is set aside" in capfd.readouterr().err
    assert same_files(out, whole)
    ids = [answer.id for answer in folder.read(out).answers]
    assert len(ids) == len(set(ids)) > 100
    manifest = folder.read(out).manifest
    assert (manifest.engine_errors, manifest.retries) == (0, 0)
    assert f"--server {one} --server {other}" in manifest.command


@pytest.mark.slow
def test_with_no_server_left_the_run_stops_and_goes_on_at_others(
    whole: Path, small: Dataset, tmp_path: Path
) -> None:
    with served(40) as one, served(30) as other, pytest.raises(UserError) as caught:
        evaluated(served_spec(small, one, other), tmp_path / "run")
    said = str(caught.value)
    assert f"model 'mine': no server is left: {one} (" in said
    assert said.endswith("; start one again")
    assert "\n" not in said
    with served() as url:
        assert same_files(evaluated(served_spec(small, url), tmp_path / "run"), whole)


@pytest.mark.slow
def test_no_row_depends_on_a_number_that_adapts(
    whole: Path, small: Dataset, tmp_path: Path
) -> None:
    with served() as url:
        out = evaluated(served_spec(small, url).changed(batch_size="auto"), tmp_path / "run")
    assert same_decisions(out, whole)
    for name in ("episodes.csv", "summary.csv"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()
    assert same_but_alone(out, whole)
    adapted, fixed = (folder.read(run).manifest for run in (out, whole))
    assert (adapted.batch_size, fixed.batch_size) == ("auto", 4)
    assert adapted.identity.keys() == fixed.identity.keys()


@pytest.fixture
def parted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A part of a run is one layout."""
    monkeypatch.setattr(run_module, "TREES_AT_ONCE", 1)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    "cached",
    [False, True],
)
def test_workers_ask_what_one_process_asks(
    parted: None, small: Dataset, tmp_path: Path, cached: bool
) -> None:
    with served() as one, served() as other:
        spec, runs = served_spec(small, one, other), {}
        for workers in (1, 3):
            runs[workers] = evaluated(
                spec,
                tmp_path / f"{workers}",
                tmp_path / f"{workers}.sqlite" if cached else None,
                workers,
            )
    assert same_decisions(runs[1], runs[3])
    for name in ("episodes.csv", "summary.csv"):
        assert (runs[1] / name).read_bytes() == (runs[3] / name).read_bytes()
    assert same_but_alone(runs[1], runs[3])
    ids = [[line["id"] for line in lines(out)] for out in runs.values()]
    assert ids[0] == ids[1] == sorted(answer.id for answer in folder.read(runs[1]).answers)


@pytest.mark.exhaustive
def test_workers_together_have_no_more_at_a_server_than_one_process_may(
    parted: None, small: Dataset, tmp_path: Path
) -> None:
    busy, lock = [0], threading.Lock()

    def play(asked: Asked) -> None:
        with lock:
            busy.append(busy[-1] + 1)
        time.sleep(0.003)
        with lock:
            busy.append(busy[-1] - 1)
        answer(asked)

    with serving(play) as there:
        evaluated(served_spec(small, there.url), tmp_path / "run", None, 3)
    assert 2 < max(busy) <= 4, "the batch size"


@pytest.mark.parametrize(
    ("before", "after"),
    [
        pytest.param(1, 3, marks=pytest.mark.exhaustive),
        pytest.param(3, 1, marks=pytest.mark.exhaustive),
        pytest.param(3, 2, marks=pytest.mark.exhaustive),
    ],
)
def test_a_run_that_workers_began_or_go_on_with_asks_nothing_twice(
    parted: None, small: Dataset, tmp_path: Path, before: int, after: int
) -> None:
    def stop(done: int) -> None:
        raise KeyboardInterrupt

    with served() as url, pytest.raises(KeyboardInterrupt):
        evaluate(served_spec(small, url), tmp_path / "run", stop, workers=before)
    work = tmp_path / "run/.work"
    kept = {
        name
        for file in work.rglob("*.jsonl")
        if file.name not in (servers.FILE, costs.FILE)
        for name in read_kept(file)
    }
    assert kept
    with served() as other:
        out = evaluated(served_spec(small, other), tmp_path / "run", None, after)
        whole = evaluated(served_spec(small, other), tmp_path / "whole")
    asked = {line["id"] for line in lines(out) if line["server"] == other}
    assert asked == {answer.id for answer in folder.read(whole).answers} - kept
    assert same_decisions(out, whole)
    assert same_but_alone(out, whole)


@pytest.mark.slow
def test_servers_that_fail_workers_are_one_line(
    parted: None, small: Dataset, tmp_path: Path
) -> None:
    with served(40) as url, pytest.raises(UserError) as caught:
        evaluated(served_spec(small, url), tmp_path / "run", None, 3)
    assert url.removeprefix("http://").partition(":")[0] in str(caught.value)
    assert "\n" not in str(caught.value)


def same_but_alone(one: Path, other: Path) -> bool:
    """Whether runs have the same answers but for times: no process knows that it asks alone."""
    answers = [
        [structs.replace(answer, seconds=None, batch_size=1) for answer in folder.read(run).answers]
        for run in (one, other)
    ]
    return answers[0] == answers[1]


def lines(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / servers.FILE).read_bytes().splitlines()]


@pytest.mark.slow
def test_which_server_gave_each_answer_stands_beside_the_tables(
    whole: Path, small: Dataset, tmp_path: Path
) -> None:
    """One of two servers dies in mid-run:
    the tables are those of one server, and the file tells of both.
    """
    with served(20) as one, served() as other:
        out = evaluated(served_spec(small, one, other), tmp_path / "run")
        again = evaluated(served_spec(small, other), tmp_path / "again")
    assert same_files(out, whole)
    asked, of_one = lines(out), [line for line in lines(out) if line["server"] == one]
    assert {line["server"] for line in asked} == {one, other}
    assert 0 < len(of_one) <= 20, "it was asked about tokens of prompts, too"
    assert [line["id"] for line in asked] == sorted(
        answer.id for answer in folder.read(out).answers
    )
    assert {line["server"] for line in lines(again)} == {other}
    assert {*map(str, asked[0])} == {"id", "server", "model"}
    assert not any(one.encode() in (out / name).read_bytes() for name in FILES)


@pytest.mark.exhaustive
def test_a_run_that_is_stopped_and_goes_on_still_says_who_answered(
    small: Dataset, tmp_path: Path
) -> None:
    with served(70) as one, pytest.raises(UserError):
        evaluated(served_spec(small, one), tmp_path / "run")
    kept = (tmp_path / "run/.work/answers.jsonl").read_bytes().count(b"\n")
    with served() as other:
        out = evaluated(served_spec(small, other), tmp_path / "run")
    counts = Counter(line["server"] for line in lines(out))
    assert counts[one] == kept > 0, "what was kept is not asked again"
    assert counts[one] + counts[other] == len(folder.read(out).answers)


def test_a_run_without_servers_has_no_such_file(small: Dataset, tmp_path: Path) -> None:
    assert not (evaluated(spec_of(small, seeds=(0,)), tmp_path / "run") / servers.FILE).exists()


def test_the_shards_lines_are_put_together_and_a_torn_one_is_left_out(tmp_path: Path) -> None:
    for n in (0, 1):
        (tmp_path / f"{n}").mkdir()
        asked = [Served(f"s{n}/v{v}", f"http://{n}/v1", None) for v in range(2)]
        servers.keep(tmp_path / f"{n}", asked)
        servers.keep(tmp_path / f"{n}", [Served("twice/v0", f"http://{n}/v1", "m")])
        servers.keep(tmp_path / f"{n}", [])
    servers.keep(tmp_path / "1", b'{"id":"torn/v0","serv')
    servers.write(tmp_path, [tmp_path / "0", tmp_path / "1", tmp_path / "missing"])
    assert [(line["id"], line["server"][7]) for line in lines(tmp_path)] == [
        ("s0/v0", "0"), ("s0/v1", "0"), ("s1/v0", "1"), ("s1/v1", "1"), ("twice/v0", "1"),
    ]  # fmt: skip


@pytest.mark.exhaustive
def test_an_answer_of_one_server_is_kept_for_all_that_serve_the_same(
    small: Dataset, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second run has other servers, of which none is asked anything, since the user says so."""
    monkeypatch.setenv("SWARMDRIVE_SAME_SERVERS", "http://127.0.0.1:*")
    for answers in (None, 0):
        with served(answers) as url, served(answers) as beside:
            spec, out = served_spec(small, url, beside), tmp_path / f"run-{answers}"
            done = evaluate(spec, out, lambda done: None, tmp_path / "kept")
    assert done.manifest.cached_answers == len(folder.read(whole).answers)
    assert same_decisions(done.out, whole)


@pytest.mark.exhaustive
def test_an_interrupted_run_ends_at_once_and_goes_on(small_path: Path, project: Path) -> None:
    """Each answer takes a minute."""

    def play(asked: Asked) -> None:
        came.set()
        time.sleep(60)

    came = threading.Event()
    with serving(play) as there:
        command = [
            sys.executable,
            "-m",
            "harness",
            "eval",
            "--model",
            "mine",
            "--server",
            there.url,
        ]
        command += ["--dataset", str(small_path), "--no-cache", "--out", "run"]
        # a background job may ignore it
        restored = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
        with subprocess.Popen(
            command, cwd=project, stderr=subprocess.PIPE, text=True, preexec_fn=restored
        ) as process:
            assert came.wait(60)
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert f"to continue: harness eval --model mine --server {there.url}" in err


# -- what is typed ---------------------------------------------------------------------------------


@pytest.fixture
def project(tmp_path: Path) -> Path:
    (tmp_path / resources.MARKER).touch()
    (tmp_path / "models").mkdir()
    for name in ("mine", "another"):
        (tmp_path / f"models/{name}.toml").write_text(
            'engine = "openai"\ndescription = "d"\nweights = "m"\n[server]\nbase_url = '
            '"http://127.0.0.1:9/v1"\n'
            f'[latency]\nsource = "paper"\nbasis = "{name}"\n'
        )
    return tmp_path


Typed = Callable[..., tuple[int, str, str]]


@pytest.mark.slow
def test_servers_are_named_on_the_command_line(
    harness: Typed, project: Path, small_path: Path
) -> None:
    with served() as one, served() as other:
        options = ("--model", "mine", "--server", one, "--server", other + "/", "--no-cache")
        code, _, err = harness(
            "eval", *options, "--dataset", small_path, "--limit", "2", "--out", "run"
        )
        assert (code, err) == (0, "")
        code, _, err = harness(
            "drive",
            *options,
            "--episodes",
            "1",
            "--seeds",
            "0:1",
            "--condition",
            "6g",
            "--out",
            "driven",
        )
        assert (code, err) == (0, "")
    manifest = json.loads((project / "run/run.json").read_text())
    assert manifest["model"]["server"]["base_url"] == "http://127.0.0.1:9/v1", "the card's own"
    assert manifest["identity"]["listed"] == {"id": "m", "owned_by": "tests"}
    assert manifest["engine_errors"] == 0
    for run in ("run", "driven"):
        asked, answers = lines(project / run), folder.read(project / run).answers
        assert {line["server"] for line in asked} <= {one, other}
        assert {line["id"] for line in asked} >= {answer.id for answer in answers}
        assert len(asked) >= len(answers) > 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--model", "proxy", "--server", "http://a/v1"],
         "--server: proxy is asked at none; leave it out, and give base_url in a card"),
        (["--model", "mine", "--helper-model", "another", "--server", "http://a/v1"],
         "--server: another and mine are asked at servers of their own; leave it out"),
        (["--model", "mine", "--server", "http://me:5ecret@a/v1"], 
            "--server: base_url "
            "holds credentials"),
        (["--model", "mine", "--server", "http://a/v1", "--server", "http://a/v1/"],
         "--server: base_url names a server twice"),
    ],
)  # fmt: skip
def test_servers_that_cannot_be_are_one_line(
    harness: Typed, project: Path, small_path: Path, options: list[str], said: str
) -> None:
    code, _, err = harness("eval", *options, "--dataset", small_path, "--out", "run")
    assert code == 2
    assert err.startswith(f"harness: {said}")
    assert err.count("\n") == 1
    assert "5ecret" not in err
