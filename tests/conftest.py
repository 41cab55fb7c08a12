"""What tests share that takes seconds to make."""

import fcntl
import gc
import os
import re
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from _pytest.runner import runtestprotocol
from changes import stayed
from evaluating import run, spec_of
from former import SCENARIO
from hypothesis import settings
from shares import SHARES, share_of

from harness import cli
from harness.cli import scenario, shell
from harness.coordination import operating_point, parts, schedules
from harness.core import cores, extensions, resources
from harness.dataset import rebuilt
from harness.dataset.build import build
from harness.dataset.load import Dataset, load
from harness.dataset.rebuilt import Start
from harness.radio import profiles
from harness.runs import formats, role_agents
from harness.studies import axes

pytest_plugins = ["browsing", "relabelling", "studied"]
EPISODES, SEED = 4, 100
EXTENSIONS = Path(cli.__file__).parents[1] / "extensions"  # without them the core's own tests run
Once = Callable[[str, Callable[[Path], object]], Path]

# A loaded machine is no failure, and what CI finds must be there to be found again.
settings.register_profile("harness", deadline=None, derandomize="CI" in os.environ, max_examples=50)
settings.register_profile("quick", settings.get_profile("harness"), max_examples=20)
settings.load_profile("harness")

# Containers often set this: then every process that a test starts compiles the harness anew, and
# every worker rewrites all the tests.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Before anyone imports torch: threads of several workers that wait for each other make tiny models
# a hundred times slower.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Processors differ, and tests do not: by what they see, none multiplies in bfloat16.
cores.BFLOAT16 = ()


# What tests write need not outlast a power cut. Processes that they start are as they are.
os.fsync = lambda fd: None

# Collecting makes much and drops little: a search for cycles finds none, for a fifth of the time.
gc.disable()


text = cache(Path.read_text)


def pytest_addoption(parser: pytest.Parser) -> None:
    what = (
        "fail a test that takes more CPU seconds, with the fixtures that it alone has; name dear "
        "files"
    )
    parser.addoption("--cpu-limit", type=float, metavar="S", help=what)
    share = f"of the exhaustive tests, the K-th of {SHARES} shares"
    parser.addoption("--share", type=int, metavar="K", help=share)
    concerned = "leave out tests of an extension where neither it nor the core differs from main"
    parser.addoption("--changed", action="store_true", help=concerned)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files of which no test is run, with the packages that they import."""
    if collection_path.is_dir() and config.getoption("changed"):
        return True if stayed(collection_path, config.rootpath) else None
    if collection_path.suffix != ".py" or not collection_path.name.startswith("test_"):
        return None
    chosen, source = config.getoption("markexpr"), text(collection_path)
    whole = re.search(r"^pytestmark = \[?pytest\.mark\.(\w+)", source, re.MULTILINE)
    tier = whole[1] if whole else ""
    if chosen == "exhaustive":
        left_out = "exhaustive" not in source
    else:
        left_out = tier in ("slow", "exhaustive") and f"not {tier}" in chosen
    return True if left_out else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Choose a share; then sort files: of engines first, for one worker to import them;
    then with slow tests.

    The last tests are short then, and no worker waits long for another.
    """
    share = config.getoption("share")
    if share is not None:
        exhaustive = [item for item in items if item.get_closest_marker("exhaustive")]
        left_out = {item for item in exhaustive if share_of(item.nodeid) != share % SHARES}
        config.hook.pytest_deselected(items=list(left_out))
        items[:] = [item for item in items if item not in left_out]
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    needs = re.compile(r'importorskip\("(torch|llama)|tiny_')
    files = {item.path for item in items}
    engines = {file for file in files if needs.search(text(file))}
    items.sort(key=lambda item: (item.path not in engines, item.path not in slow))


def pytest_collection_finish() -> None:
    """What is imported by now stays: no search for cycles looks through it, and there are fewer."""
    gc.freeze()
    gc.set_threshold(50_000, 10, 10)
    gc.enable()


# what `slowness` works on takes on a core of a server of 2023 that does nothing else
ALONE_S = 0.01
SHARED = SimpleNamespace(cpu_s=0.0)  # what fixtures took which several tests have


def cpu_s() -> float:
    """CPU seconds of this process and of those that it started and that ended."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime


def slowness() -> float:
    """How many times as long a piece of work takes now as on a core of its own;
    other work shares caches.
    """

    def work_s() -> float:
        start = time.process_time()
        sorted(str(n) for n in range(100_000))
        return time.process_time() - start

    return max(1.0, min(work_s() for _ in range(3)) / ALONE_S)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[Any]) -> Generator[None, Any, Any]:
    start, shared_s = cpu_s(), SHARED.cpu_s
    try:
        return (yield)
    finally:
        if fixturedef.scope != "function":
            # With those that it asked for, which are in it.
            SHARED.cpu_s = shared_s + cpu_s() - start


@pytest.fixture(scope="session")
def shared_work() -> Callable[[], AbstractContextManager[None]]:
    """What is done within it is several tests' work,
    and not that of the one at which it is done.
    """

    @contextmanager
    def counted() -> Generator[None, None, None]:
        start = cpu_s()
        yield
        SHARED.cpu_s += cpu_s() - start

    return counted


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Fail who takes too long twice: the first may import packages and fill caches for all that
    follow.
    """
    limit = item.config.getoption("cpu_limit")
    if not limit:
        return None

    def run() -> tuple[list[pytest.TestReport], float]:
        start, shared_s = cpu_s(), SHARED.cpu_s
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
        took = cpu_s() - start
        reports[0].__dict__["cpu_s"] = took  # which a worker tells the process that prints
        return reports, took - (SHARED.cpu_s - shared_s)

    where = {"nodeid": item.nodeid, "location": item.location}
    item.ihook.pytest_runtest_logstart(**where)
    reports, took = run()
    unlimited = item.get_closest_marker("exhaustive")
    if not unlimited and took > limit and all(report.passed for report in reports):
        again = run()[1]
        if again > limit and again > limit * slowness():
            tier = "exhaustive" if item.get_closest_marker("slow") else "slow"
            reports[1].outcome = "failed"
            reports[1].longrepr = (
                f"{again:.2f} CPU s, allowed {limit}: make it cheaper (CONTRIBUTING.md), or mark "
                f"it {tier}"
            )
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(**where)
    return True


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Skip a test that needs an extension, where the folder of all of them is deleted."""
    report = yield
    if report.failed and not EXTENSIONS.is_dir():
        said = "\n".join([report.longreprtext, *(text for _, text in report.sections), *GONE])
        if gone := re.search(r"part of the extension \w+, which is not", said):
            report.outcome, report.longrepr = "skipped", (str(item.path), 0, gone[0])
    if report.when == "teardown":
        GONE.clear()
    return report


GONE = list[str]()  # what this test typed of extensions that are not here


def owner_noted(command: str) -> str | None:
    """Note that a command of an extension was typed."""
    extension = extensions.owner(command)
    if extension:
        GONE.append(f"{command} is part of the extension {extension}, which is not installed")
    return extension


def part_noted(extension: str) -> str:
    """Note that a setting of an extension was named."""
    GONE.append(f"part of the extension {extension}, which is not")
    return extensions.part_of(extension)


if not EXTENSIONS.is_dir():
    shell.__dict__["owner"] = owner_noted
    for module in (
        axes,
        cli,
        formats,
        operating_point,
        parts,
        profiles,
        role_agents,
        scenario,
        schedules,
    ):
        module.__dict__["part_of"] = part_noted


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    """Say where the time went: the ten dearest files."""
    if not config.getoption("cpu_limit"):
        return
    files = Counter[str]()
    for reports in terminalreporter.stats.values():
        for report in reports:
            if hasattr(report, "cpu_s"):
                files[report.nodeid.split("::")[0]] += report.cpu_s
    dearest = ", ".join(f"{file} {spent_s:.0f}" for file, spent_s in files.most_common(10))
    terminalreporter.write_line(
        f"CPU s of tests: {files.total():.0f}; the ten dearest files: {dearest}"
    )


@pytest.fixture(scope="session")
def workers_folder(
    tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Path:
    """The folder of all workers."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if hasattr(request.config, "workerinput") else base


@pytest.fixture(scope="session", autouse=True)
def _own_cache(workers_folder: Path) -> None:
    """No test reads or writes the completions that whoever runs the tests keeps."""
    os.environ["SWARMDRIVE_CACHE"] = str(workers_folder / "cache")


@pytest.fixture(scope="session", autouse=True)
def _shipped_once() -> Generator[None, None, None]:
    """What ships, which layouts are held against, is read once by each worker."""
    reported, starts = rebuilt._reported, rebuilt._starts
    known, begun = dict[tuple[Path, str], list[Dataset]](), dict[tuple[str, int], list[Start]]()

    def reported_once(scenario: str) -> list[Dataset]:
        place = resources.folder("datasets"), scenario
        if place not in known:
            known[place] = list(reported(scenario))
        return known[place]

    def starts_once(dataset: Dataset) -> list[Start]:
        key = dataset.sha256, len(dataset.episodes)
        if not dataset.trusted:
            return starts(dataset)
        if key not in begun:
            begun[key] = starts(dataset)
        return begun[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rebuilt, "_reported", reported_once)
        patch.setattr(rebuilt, "_starts", starts_once)
        yield


@pytest.fixture(scope="session")
def once(workers_folder: Path) -> Once:
    """A folder by name, filled once, by whoever of several workers comes first;
    tests leave it as it is.
    """

    def filled(name: str, fill: Callable[[Path], object]) -> Path:
        done = workers_folder / f"{name}.done"
        with (workers_folder / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                fill(workers_folder / name)
                done.touch()
        return workers_folder / name

    return filled


@pytest.fixture(scope="session")
def small_path(once: Once) -> Path:
    """Folder of a real dataset of four episodes."""
    return once("small", lambda out: build(SCENARIO, out, EPISODES, SEED, 1, lambda done: None))


@pytest.fixture(scope="session")
def small(small_path: Path) -> Dataset:
    return load(small_path)


@pytest.fixture(scope="session")
def two_path(once: Once) -> Path:
    """Folder of a real dataset of two episodes."""
    return once("two", lambda out: build(SCENARIO, out, 2, 5, 1, lambda done: None))


@pytest.fixture(scope="session")
def two_run(once: Once, two_path: Path) -> Path:
    """Folder of a run of the proxy on the two episodes, which are not of the scenes of `small`."""
    return once("two-run", lambda out: run(spec_of(load(two_path)), out))


@pytest.fixture(scope="session")
def proxy_run(once: Once, small: Dataset) -> Path:
    """Folder of a run of the proxy on every episode of `small`."""
    return once("proxy-run", lambda out: run(spec_of(small), out))


@pytest.fixture
def unrebuilt(monkeypatch: pytest.MonkeyPatch) -> None:
    """Build no layouts again, which takes seconds each time;
    test_tune_is_a_fact.py is about that.
    """
    monkeypatch.setattr(rebuilt, "differences", lambda dataset: iter(()))
    monkeypatch.setattr(rebuilt, "_reported", lambda scenario: iter(()))


@pytest.fixture
def svg_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Studies draw no PDF and no PNG, which take longest:
    which kinds a folder has, a few tests look at.
    """
    monkeypatch.setattr("harness.studies.study.DRAWN", ("svg",))


@pytest.fixture
def harness(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[..., tuple[int, str, str]]:
    """The command as typed, in a folder of its own:
    its exit code, and what it said on stdout and stderr.
    """
    monkeypatch.chdir(tmp_path)

    def typed(*args: str | Path) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["harness", *map(str, args)])
        capsys.readouterr()
        with pytest.MonkeyPatch.context() as own:
            # A command adds the module of its --env, for its own process.
            own.setenv("SWARMDRIVE_IMPORTS", os.environ.get("SWARMDRIVE_IMPORTS", ""))
            with pytest.raises(SystemExit) as ended:
                cli.main()
        return int(ended.value.code or 0), *capsys.readouterr()

    return typed
