"""The bar on stderr: how many, how fast, until when."""

import io
import subprocess
import sys

import pytest
from rich.console import Console

from harness.cli.progress import Bar, drawn, line, pace


@pytest.mark.parametrize(
    ("speed", "left_s", "took_s", "said"),
    [
        (None, None, None, ""),
        (61.34, 6.4, None, "61.3/s 0:00:06 left"),
        (1206.0, 3661, None, "1206.0/s 1:01:01 left"),
        (0.05, 90_000, None, "3.0/min 1 day, 1:00:00 left"),
        (61.34, 0, 19.7, "61.3/s in 0:00:20"),
        (None, 0, 0.0, "in 0:00:00"),
    ],
)
def test_pace_is_a_second_or_a_minute_and_time_is_left_or_over(
    speed: float | None, left_s: float | None, took_s: float | None, said: str
) -> None:
    assert pace(speed, left_s, took_s) == said


def test_where_more_follows_the_time_left_is_the_least() -> None:
    assert pace(61.34, 6.4, None, grows=True) == "61.3/s at least 0:00:06 left"
    assert pace(61.34, 0, 19.7, grows=True) == "61.3/s in 0:00:20"
    progress = Bar("asking proxy", 1206, grows=True)
    assert (
        line(progress, [(0.0, 0), (10.0, 100)], 10.0)
        == "asking proxy 100/1206 10.0/s at least 0:01:51 left"
    )
    progress.spent = lambda: "31.2k tokens"
    marks = [(0.0, 0), (10.0, 100)]
    assert (
        line(progress, marks, 10.0)
        == "asking proxy 100/1206 31.2k tokens 10.0/s at least 0:01:51 left"
    )


@pytest.mark.parametrize("grows", [False, True])
@pytest.mark.parametrize("label", ["asking proxy", "driving " + "x" * 30])
@pytest.mark.parametrize("spent", ["", "31.2k tokens, 0.243 USD"])
def test_a_line_fits_eighty_columns_and_tells_all(label: str, grows: bool, spent: str) -> None:
    now = [0.0]
    out = io.StringIO()
    progress = drawn(Console(file=out, width=80, force_terminal=True, color_system=None))
    progress.get_time = lambda: now[0]
    task = progress.add_task(label, total=1206, grows=grows, spent=lambda: spent)
    for done in (0, 406, 406):
        now[0] += 7
        progress.advance(task, done)
    progress.console.print(progress.get_renderable())
    [line] = out.getvalue().splitlines()
    assert len(line.rstrip()) <= 80
    assert line.startswith(label[:7])
    assert line.startswith(label) or spent  # which is not cut short
    assert f" 812/1206 {spent}" in line
    assert line.rstrip().endswith(f"58.0/s {'at least ' * grows}0:00:07 left")
    assert "━━" in line or spent or (grows and "x" in label)  # the bar gives way


TYPED = """
import sys, time
from harness.cli import progress
progress.LINE_S, progress.SETTLE_S = 0.2, 0.1
with progress.bar("asking", 30, quiet="quiet" in sys.argv) as bar:
    bar(10)
    bar.more(10)
    time.sleep({0})
"""


def said(seconds: float, *options: str) -> str:
    """What a process says on its stderr, no terminal, that takes so long and finishes nothing."""
    command = [sys.executable, "-c", TYPED.format(seconds), *options]
    return subprocess.run(command, capture_output=True, text=True, check=True).stderr


def test_without_a_terminal_lines_say_how_far_it_is_also_while_nothing_is_finished() -> None:
    lines = said(1.0).splitlines()
    assert len(lines) >= 2
    assert set(lines) <= {f"asking 10/40 0:00:0{s} so far" for s in (0, 1)}


def test_what_is_over_before_the_first_line_is_due_or_is_quiet_says_nothing() -> None:
    assert said(0.0) == said(1.0, "quiet") == ""


@pytest.mark.parametrize(
    ("total", "done", "told"),
    [
        (1206, 812, "asking 812/1206 10.0/s 0:00:39 left"),
        (1206, 512, "asking 512/1206 0:01:00 so far"),
        (0, 812, "asking 812 10.0/s"),
        (0, 512, "asking 512 0:01:00 so far"),
    ],
)
def test_a_line_has_the_pace_since_the_oldest_mark_whatever_was_done_before(
    total: int, done: int, told: str
) -> None:
    assert line(Bar("asking", total), [(5.0, 512), (20.0, 600), (35.0, done)], 60.0) == told
