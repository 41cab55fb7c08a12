"""How many requests one server has at a time: a fixed number, or as many as it takes well."""

from statistics import fmean

from harness.core.at_once import AUTO, AtOnce, first_at_once, most_at_once
from harness.core.parallel import share

SLOW = 2.0  # the mean time of answers over the least mean, above which there are too many at a time
EASED = 0.75  # of a mean time: if half as many at a time take longer, their number is not the cause
BUSY = (429, 503)  # HTTP statuses by which a server refuses what is too much for it


class Pace:
    """Say how many requests one server may have at a time.

    A number is kept. With `auto` it adapts: it begins at `FIRST`, and grows after as many answers,
    to twice as many until it falls for the first time, and then by 1. It falls to half at a refusal
    (`BUSY`), and where answers took more than `SLOW` times as long, in the mean, as they once did.
    Only what was sent since the number last doubled or fell is counted.

    Attributes:
        adapts: whether the number adapts.
        turn: how often it has doubled or fallen; it tells what was sent since.
    """

    def __init__(self, at_once: AtOnce) -> None:
        self.adapts, self.turn = at_once == AUTO, 0
        self._most = most_at_once(at_once)
        self._limit = first_at_once(at_once)
        self._doubles = True
        self._seconds: list[float] = []  # of the answers since the number last changed
        self._least_s = float("inf")  # the least mean so far
        self._slow_s: float | None = None  # the mean for which the number fell last

    @property
    def limit(self) -> int:
        """Return how many requests there may be now; workers divide the most that there may be."""
        return min(self._limit, share(self._most))

    def answered(self, turn: int, seconds: float) -> bool:
        """Count an answer that came while there were as many requests as may be.

        `turn` is the pace's when it was asked, `seconds` the time that it took. Returns whether
        there may be more requests now.
        """
        if not self.adapts or turn != self.turn:
            return False
        self._seconds.append(seconds)
        if len(self._seconds) < self._limit:
            return False
        before = self._limit
        mean_s = fmean(self._seconds)
        self._seconds.clear()
        if self._slow_s is not None and mean_s > EASED * self._slow_s:
            self._least_s, self._doubles = mean_s, True  # these answers are longer, or the server
        self._slow_s, self._least_s = None, min(self._least_s, mean_s)
        if mean_s > SLOW * self._least_s:
            self._slow_s = mean_s
            self._fall()
        elif self._doubles:
            self._change(2 * self._limit)
        else:
            self._limit = min(self._limit + 1, self._most)
        return self._limit > before

    def refused(self, turn: int) -> bool:
        """Take note that the server refused a request; return whether it had too many at a time.

        `turn` is the pace's when it was asked.
        """
        if not self.adapts:
            return False
        if turn != self.turn:
            return True
        had_several = self._limit > 1
        self._fall()
        return had_several

    def _fall(self) -> None:
        self._doubles = False
        self._change(self._limit // 2)

    def _change(self, limit: int) -> None:
        self._limit = max(1, min(limit, self._most))
        self._seconds.clear()
        self.turn += 1
