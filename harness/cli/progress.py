"""A progress bar on stderr for anything slower than two seconds."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

QUIET = "Print nothing but errors, and what --json asks for."


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
    """A bar to tell how many are done. Nothing is drawn where nobody watches."""
    if quiet or not sys.stderr.isatty():
        yield Bar()
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as TimeLeft

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeLeft(),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(label, total=total)
        owed = total

        def more(count: int) -> None:
            nonlocal owed
            owed += count
            progress.update(task, total=owed)

        yield Bar(lambda done: progress.advance(task, done), more)
