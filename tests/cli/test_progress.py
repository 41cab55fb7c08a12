"""The bar on stderr: how many, how fast, until when."""

import io
import sys

import pytest
from rich.console import Console

from harness.cli.progress import Bar, bar, drawn, pace


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


@pytest.mark.parametrize("label", ["asking proxy", "driving " + "x" * 30])
def test_a_line_fits_eighty_columns_and_tells_all(label: str) -> None:
    now = [0.0]
    out = io.StringIO()
    progress = drawn(Console(file=out, width=80, force_terminal=True, color_system=None))
    progress.get_time = lambda: now[0]
    task = progress.add_task(label, total=1206)
    for done in (0, 406, 406):
        now[0] += 7
        progress.advance(task, done)
    progress.console.print(progress.get_renderable())
    [line] = out.getvalue().splitlines()
    assert len(line.rstrip()) <= 80
    assert line.startswith(label)
    assert " 812/1206 " in line
    assert line.rstrip().endswith("58.0/s 0:00:07 left")
    assert "━━" in line


def test_nothing_is_drawn_where_nobody_watches(capsys: pytest.CaptureFixture[str]) -> None:
    assert not sys.stderr.isatty()
    with bar("asking", 3) as progress:
        progress(1)
        progress.more(2)
    assert (type(progress), capsys.readouterr()) == (Bar, ("", ""))
