"""A progress bar on stderr for anything slower than two seconds."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress


@dataclass(frozen=True)
class Bar:
    """Called with how many are newly done; `more` is called with how many more turn out to be owed."""

    advance: Callable[[int], None] = lambda done: None
    more: Callable[[int], None] = lambda count: None

    def __call__(self, done: int) -> None:
        """So many are newly done."""
        self.advance(done)


@contextmanager
def bar(label: str, total: int, quiet: bool = False) -> Iterator[Bar]:
    """A bar: how many are done, how fast, time left. None is drawn unless stderr is a terminal."""
    if quiet or not sys.stderr.isatty():
        yield Bar()
        return
    from rich.console import Console

    with drawn(Console(stderr=True)) as progress:
        task = progress.add_task(label, total=total)
        owed = total

        def more(count: int) -> None:
            nonlocal owed
            owed += count
            progress.update(task, total=owed)

        yield Bar(lambda done: progress.advance(task, done), more)


def drawn(console: "Console") -> "Progress":
    """The bar's columns. The bar itself gives way where the line is narrow."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn
    from rich.table import Column
    from rich.text import Text

    class Pace(ProgressColumn):
        max_refresh = 0.5

        def render(self, task: Task) -> Text:
            return Text(pace(task.finished_speed or task.speed, task.time_remaining, task.finished_time))

    return Progress(
        TextColumn("{task.description}", table_column=Column(no_wrap=True, overflow="ellipsis")),
        BarColumn(bar_width=None),
        *(column(table_column=Column(no_wrap=True)) for column in (MofNCompleteColumn, Pace)),
        console=console,
    )


def pace(speed: float | None, left_s: float | None, took_s: float | None) -> str:
    """`61.3/s 0:00:06 left`: what is known of how many a second (or minute), and of the seconds to go.

    At the end, `took_s`, it is `in` how long all was done.
    """
    parts = []
    if speed:
        parts.append(f"{speed:.1f}/s" if speed >= 1 else f"{60 * speed:.1f}/min")
    if took_s is not None:
        parts.append(f"in {timedelta(seconds=round(took_s))}")
    elif left_s is not None:
        parts.append(f"{timedelta(seconds=round(left_s))} left")
    return " ".join(parts)
