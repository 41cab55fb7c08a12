"""`--cpu-limit`: who is failed for taking too long."""

import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from shares import SHARES, share_of

TESTS = """
import functools
import time
import pytest

def busy():
    start = time.process_time()
    while time.process_time() - start < 0.1:
        pass

@pytest.fixture(scope="module")
def shared():
    busy()

@pytest.fixture
def own():
    busy()

def test_long():
    busy()

def test_with_a_long_fixture_of_its_own(own):
    pass

def test_with_a_long_fixture_that_is_shared(shared):
    pass

@pytest.mark.slow
def test_long_and_slow():
    busy()

@pytest.mark.exhaustive
def test_that_says_so():
    busy()

@functools.cache
def cached():
    busy()

def test_that_fills_a_cache():
    cached()

def test_short():
    pass
"""


@pytest.mark.exhaustive
def test_long_tests_fail_unless_they_say_so_or_others_share_what_takes_long(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(TESTS)
    here = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    command = (
        sys.executable,
        "-m",
        "pytest",
        "-p",
        "conftest",
        "-q",
        "--cpu-limit",
        "0.02",
        "test_it.py",
    )
    done = subprocess.run(
        command,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": here},
        capture_output=True,
        text=True,
    )
    failed = re.findall(r"FAILED test_it.py::(\w+)", done.stdout)
    expected = ["test_long", "test_with_a_long_fixture_of_its_own", "test_long_and_slow"]
    assert failed == expected, done.stdout + done.stderr
    for tier in ("slow", "exhaustive"):
        assert f"allowed 0.02: make it cheaper (CONTRIBUTING.md), or mark it {tier}" in done.stdout
    assert re.search(
        r"^CPU s of tests: \d+; the ten dearest files: test_it.py \d+$", done.stdout, re.M
    )


def test_the_shares_part_all_tests_and_a_function_is_in_one_with_all_its_parameters() -> None:
    shares = Counter(share_of(f"tests/test_it.py::test_{n}") for n in range(1000))
    assert set(shares) == set(range(SHARES))
    assert min(shares.values()) > 50
    assert share_of("tests/test_it.py::test_1[a]") == share_of("tests/test_it.py::test_1[b::c]")
