"""Work on a Ray cluster of two nodes: the same bytes, whatever dies, and no two kinds of node."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from harness.core.errors import Unfinished, UserError
from harness.core.parallel import TRIES, Ray, each, spread
from harness.core.versions import node_versions

ray = pytest.importorskip("ray", reason="needs the ray extra")

from chores import counted, dies, stays, where, wrong  # noqa: E402
from evaluating import FILES  # noqa: E402
from typer.main import get_command  # noqa: E402

from harness.cli import app  # noqa: E402
from harness.core import ray_tasks  # noqa: E402

pytestmark = pytest.mark.exhaustive
Typed = Callable[..., tuple[int, str, str]]
DRIVE = ("drive", "--model", "cruise", "--episodes", "65", "--seeds", "0", "--quiet")
NODE = {"num_cpus": 1, "object_store_memory": 80 << 20}


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    from ray.cluster_utils import Cluster

    before = {name: os.environ.get(name) for name in ("PYTHONPATH", "RAY_ADDRESS")}
    os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)  # of the nodes' workers
    made = Cluster(initialize_head=True, head_node_args={**NODE, "include_dashboard": False})
    made.add_node(**NODE)
    os.environ["RAY_ADDRESS"] = made.address
    try:
        yield made
    finally:
        ray.shutdown()
        made.shutdown()
        for name, value in before.items():
            os.environ.pop(name, None)
            os.environ |= {name: value} if value else {}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run by one process."""
    out = tmp_path_factory.mktemp("whole") / "run"
    get_command(app)([*DRIVE, "--workers", "1", "--out", str(out)], standalone_mode=False)
    return out


def test_a_run_has_the_bytes_of_one_process_where_its_command_is_killed_and_goes_on(
    cluster: Any, whole: Path, harness: Typed, tmp_path: Path
) -> None:
    command = [*DRIVE, "--workers", "ray", "--out", "killed"]
    process = subprocess.Popen([sys.executable, "-m", "harness", *command], cwd=tmp_path)
    work = tmp_path / "killed/.work"
    while not list(work.glob("episodes-*")):
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "killed/run.json").exists()
    assert harness(*command) == (0, "", "")
    for name in FILES:
        assert (tmp_path / "killed" / name).read_bytes() == (whole / name).read_bytes(), name


def test_a_command_that_is_terminated_while_it_connects_says_so(
    cluster: Any, tmp_path: Path
) -> None:
    """Ray has a handler of its own until it is connected:
    here the connection waits, and then it comes.
    """
    waits = (
        "import os, signal, ray\nray.init = lambda **options: (signal.signal(signal.SIGTERM, "
        "lambda number, frame: exit(number)), os.kill(os.getpid(), 15))\nfrom harness.__main__ "
        "import main\nmain()\n"
    )
    command = [*DRIVE, "--workers", "ray", "--out", "run"]
    done = subprocess.run(
        [sys.executable, "-c", waits, *command],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (done.returncode, done.stderr) == (143, "harness: terminated\n")


def test_both_nodes_work(cluster: Any) -> None:
    found = spread(where, range(8), Ray(), lambda done: None, repeatable=False)
    assert len(set(found)) == 2


def test_nodes_that_disagree_are_named(cluster: Any) -> None:
    with pytest.raises(UserError) as raised:
        spread(where, range(8), Ray(), lambda done: None, lambda number: f"episode {number}")
    said = str(raised.value)
    assert " came out differently on node " in said
    assert said.startswith("episode ")
    assert all(one["NodeID"][:8] in said for one in ray.nodes() if one["Alive"])


def test_what_kills_its_worker_three_times_is_named_and_the_rest_is_done(
    cluster: Any, tmp_path: Path
) -> None:
    taken: dict[int, int] = {}
    with pytest.raises(
        Unfinished, match=r"^2: the worker was killed 3 times, .*; the other 5 are done$"
    ):
        each(partial(dies, tmp_path), range(6), Ray(), taken.__setitem__)
    assert taken == {n: n for n in (0, 1, 3, 4, 5)}
    assert len(list(tmp_path.iterdir())) == TRIES


def test_an_error_of_the_works_own_is_raised_and_never_tried_again(
    cluster: Any, tmp_path: Path
) -> None:
    for name, kind, said in (
        ("user", UserError, r"^node 127\.0\.0\.1 \(\w{8}\): the weights are missing$"),
        ("bug", ZeroDivisionError, "^a bug$"),
    ):
        (tmp_path / name).mkdir()
        with pytest.raises(kind, match=said.replace(r"127\.0\.0\.1", r"[\d.]+")):
            spread(partial(wrong, tmp_path / name), range(4), Ray(), lambda done: None)
        assert len(list((tmp_path / name).glob("1-*"))) == 1


def test_another_version_is_named_with_its_node(
    cluster: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = node_versions()
    for changed, said in (
        ({**ours, "numpy": "1.0"}, rf"numpy {ours['numpy']}, not 1\.0"),
        (
            {**ours, "source of harness": "0" * 12},
            rf"source of harness {ours['source of harness']}, not 0+",
        ),
        ({**ours, "torch-of-mine": "3"}, "torch-of-mine missing, not 3"),
    ):
        monkeypatch.setattr(ray_tasks, "node_versions", lambda changed=changed: changed)
        with pytest.raises(
            UserError, match=rf"^node [\d.]+ \(\w{{8}}\) has {said}; install the same on every"
        ):
            spread(abs, range(2), Ray(), lambda done: None)


def test_a_node_that_is_killed_costs_nothing(
    cluster: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Its raylet says a lot on stderr as it dies."""
    third, taken = cluster.add_node(**NODE), Counter[int]()

    def took(place: int, number: int) -> None:
        assert place == number
        taken[number] += 1
        if list(tmp_path.glob(f"*-{third.node_id}")) and third in cluster.worker_nodes:
            cluster.remove_node(third, allow_graceful=False)

    each(partial(counted, tmp_path), range(20), Ray(), took)
    assert taken == dict.fromkeys(range(20), 1)
    assert third not in cluster.worker_nodes, "it was killed while it worked"
    capfd.readouterr()


def test_what_is_still_worked_on_ends_with_an_error(cluster: Any, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="enough"):
        spread(partial(stays, tmp_path), range(2), Ray(), lambda done: None)
    [left] = tmp_path.glob("0-*")
    until_s = time.monotonic() + 20
    while Path(f"/proc/{left.name[2:]}").exists():
        assert time.monotonic() < until_s, "a worker is still at it"
        time.sleep(0.01)


def test_no_cluster_at_an_address_is_one_line(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "harness",
        *DRIVE,
        "--workers",
        "ray:127.0.0.1:1",
        "--out",
        "none",
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "--workers ray: no cluster at 127.0.0.1:1" in done.stderr
