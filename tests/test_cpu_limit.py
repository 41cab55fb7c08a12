"""`--cpu-limit`: who is failed for taking too long."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = """
import functools
import time
import pytest

def busy():
    start = time.process_time()
    while time.process_time() - start < 0.3:
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


@pytest.mark.slow
def test_long_tests_fail_unless_they_say_so_or_others_share_what_takes_long(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(TESTS)
    here = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    command = (sys.executable, "-m", "pytest", "-p", "conftest", "-q", "--cpu-limit", "0.02", "test_it.py")
    done = subprocess.run(
        command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": here}, capture_output=True, text=True
    )
    failed = re.findall(r"FAILED test_it.py::(\w+)", done.stdout)
    assert failed == ["test_long", "test_with_a_long_fixture_of_its_own"], done.stdout + done.stderr
    assert "make it smaller, or mark it slow" in done.stdout
