"""How far anything slower than two seconds is, on stderr:
a bar on a terminal, else a line every 30 s.
"""

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import partial
from itertools import count
from threading import Event, Thread
from typing import TYPE_CHECKING

from harness.core.progress import Progress

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as Columns

LINE_S = 30.0
SETTLE_S = 5.0  # by when what a killed command left is counted: it is no measure of the pace
MARKS = 5  # lines over which the pace is taken
# Characters of a label beside what is spent, on a terminal with fewer than so many columns.
SHORT, ROOMY = 16, 110


class Bar(Progress):
    """Count progress; it is called with the number of items that are newly done.

    Attributes:
        label: what is done.
        total: number of items, as far as is known; 0 if unknown.
        grows: whether finished items can add more, so that the time left is a least one.
        done: number of items done.
        spent: says what the work has cost so far; empty for nothing.
    """

    def __init__(self, label: str, total: int, grows: bool = False) -> None:
        self.label, self.total, self.grows, self.done = label, total, grows, 0
        self.spent: Callable[[], str] = lambda: ""
        self.changed: Callable[[], object] = lambda: None
        self.write: Callable[[str], None] = lambda text: None  # a line above the bar

    def __call__(self, done: int) -> None:
        """Add `done` to the count, and show it."""
        self.done += done
        self.changed()

    def more(self, count: int) -> None:
        """Add a number of items, which are still to do, to the bar's total."""
        self.total += count
        self.changed()

    def say(self, text: str) -> None:
        """Print a line of text above the progress bar."""
        self.write(text)


@contextmanager
def bar(label: str, total: int = 0, quiet: bool = False, grows: bool = False) -> Iterator[Bar]:
    """Show a progress bar with count, speed and time left on stderr, while the context is entered.

    The context's value is called with the number of items newly done. Off a terminal it is a line
    every `LINE_S` seconds; nothing if `quiet`. `total` is the number of items, 0 if unknown;
    `grows` says that finished items can add more.
    """
    progress = Bar(label, total, grows)
    if quiet:
        yield progress
        return
    if not sys.stderr.isatty():
        progress.write = partial(print, file=sys.stderr, flush=True)
        with _lines(progress):
            yield progress
        return
    from rich.console import Console

    with drawn(Console(stderr=True)) as bars:
        task = bars.add_task(
            label, total=total or None, grows=grows, spent=lambda: progress.spent()
        )
        progress.changed = lambda: bars.update(
            task, completed=progress.done, total=progress.total or None, description=progress.label
        )
        progress.write = partial(bars.console.print, markup=False, highlight=False)
        yield progress


@contextmanager
def _lines(progress: Bar) -> Iterator[None]:
    """Write a line every 30 s from a thread of its own, so also while nothing is finished."""
    over = Event()

    def write() -> None:
        begun_s = time.monotonic()
        over.wait(SETTLE_S)
        marks = deque([(time.monotonic(), progress.done)], maxlen=MARKS)
        for number in count(1):
            if over.wait(begun_s + number * LINE_S - time.monotonic()):
                return
            marks.append((time.monotonic(), progress.done))
            with suppress(OSError, ValueError):  # nobody listens any more
                print(line(progress, marks, marks[-1][0] - begun_s), file=sys.stderr, flush=True)

    thread = Thread(target=write, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def line(progress: Bar, marks: Sequence[tuple[float, int]], took_s: float) -> str:
    """Return a progress bar as a line of text: `asking proxy 812/1206 58.0/s 0:00:07 left`.

    What the work has cost so far, such as `31.2k tokens`, stands behind the count.

    It is for output that is no terminal. `progress` has what is counted. `marks` are pairs of a
    time in s and the number done by then, from which the speed is taken; `took_s` is the time since
    the start, s.
    """
    (since_s, before), (now_s, done) = marks[0], marks[-1]
    speed = (done - before) / (now_s - since_s)
    reached = f"{done}/{progress.total}" if progress.total else str(done or "")
    if speed:
        left_s = (progress.total - done) / speed if progress.total else None
        pace_text = pace(speed, left_s, None, progress.grows)
    else:
        pace_text = f"{timedelta(seconds=round(took_s))} so far"
    return " ".join(filter(None, (progress.label, reached, progress.spent(), pace_text)))


def drawn(console: "Console") -> "Columns":
    """Return Rich's progress display for a console: label, bar, count, what is spent, and pace."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
    )
    from rich.table import Column
    from rich.text import Text

    class Label(ProgressColumn):
        def render(self, task: Task) -> Text:
            label, spent = Text(task.description), task.fields.get("spent")
            if spent and spent() and console.width < ROOMY:
                label.truncate(SHORT, overflow="ellipsis")
            return label

    class Pace(ProgressColumn):
        max_refresh = 0.5

        def render(self, task: Task) -> Text:
            speed, grows = task.finished_speed or task.speed, bool(task.fields.get("grows"))
            return Text(pace(speed, task.time_remaining, task.finished_time, grows))

    class Spent(ProgressColumn):
        max_refresh = 0.5

        def render(self, task: Task) -> Text:
            spent: Callable[[], str] | None = task.fields.get("spent")
            return Text(spent() if spent else "")

    return Progress(
        Label(table_column=Column(no_wrap=True, overflow="ellipsis")),
        BarColumn(bar_width=None),
        *(
            column(table_column=Column(no_wrap=True))
            for column in (MofNCompleteColumn, Spent, Pace)
        ),
        console=console,
    )


def pace(
    speed: float | None, left_s: float | None, took_s: float | None, grows: bool = False
) -> str:
    """Return speed and time left, such as `61.3/s 0:00:06 left`; parts that are None are left out.

    Args:
        speed: items a second.
        left_s: seconds left.
        took_s: seconds that everything took, at the end; it replaces the time left.
        grows: whether the time left is a least one.
    """
    parts = []
    if speed:
        parts.append(f"{speed:.1f}/s" if speed >= 1 else f"{60 * speed:.1f}/min")
    if took_s is not None:
        parts.append(f"in {timedelta(seconds=round(took_s))}")
    elif left_s is not None:
        parts.append(f"{'at least ' * grows}{timedelta(seconds=round(left_s))} left")
    return " ".join(parts)
