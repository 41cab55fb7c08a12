"""Work spread over processes: each item's result once,
and what becomes of the rest when a worker dies.
"""

import os
import time
from functools import partial
from pathlib import Path

import pytest

from harness.core import extras
from harness.core.errors import Unfinished, UserError
from harness.core.parallel import TRIES, Ray, each, share, spread, workers_of


def squared(number: int) -> int:
    return number * number


@pytest.mark.parametrize("workers", [1, 2, 7])
@pytest.mark.parametrize("n", [0, 1, 5])
def test_results_stand_as_their_items_do(workers: int, n: int) -> None:
    done: list[int] = []
    assert spread(squared, range(n), workers, done.append) == [i * i for i in range(n)]
    assert done == [1] * n


def later(first: Path, number: int) -> int:
    """The first item waits for the last."""
    while number == 0 and not first.exists():
        time.sleep(0.01)
    if number == 3:
        first.touch()
    return number


def test_a_result_is_taken_as_soon_as_it_is_there_by_who_asks(tmp_path: Path) -> None:
    taken: list[int] = []
    each(partial(later, tmp_path / "last"), range(4), 2, lambda place, result: taken.append(place))
    assert sorted(taken) == [0, 1, 2, 3]
    assert taken[0] == 1, "the first item waits, and nobody for it"


def shared(arrived: Path, total: int, number: int) -> tuple[int, int]:
    """The share of a worker while all are at work; and, of the last item, once it works alone."""
    first = share(total)
    (arrived / str(number)).touch()
    while len(list(arrived.iterdir())) < 3:
        time.sleep(0.01)
    until = time.monotonic() + 10
    while number == 2 and share(total) < total and time.monotonic() < until:
        time.sleep(0.01)
    return first, share(total)


@pytest.mark.parametrize("total", [9, 10, 11, 2])
def test_workers_at_work_divide_what_may_be_used_and_the_last_one_has_all(
    total: int, tmp_path: Path
) -> None:
    first, last = zip(
        *spread(partial(shared, tmp_path, total), range(3), 3, lambda done: None), strict=True
    )
    assert sum(first) == max(total, 3)
    assert max(first) - min(first) <= 1
    assert last[2] == total
    assert share(total) == total, "no worker"


def deadly(graves: Path, poison: int, deaths: int, number: int) -> int:
    """Kills its worker at one item, so many times."""
    if number == poison and len(list(graves.iterdir())) < deaths:
        (graves / str(os.getpid())).touch()
        os._exit(9)
    return number


@pytest.mark.parametrize("deaths", [1, TRIES - 1])
def test_who_dies_is_tried_again(deaths: int, tmp_path: Path) -> None:
    assert spread(partial(deadly, tmp_path, 1, deaths), range(5), 2, lambda done: None) == [
        0,
        1,
        2,
        3,
        4,
    ]


def test_what_kills_its_worker_three_times_is_named_and_the_rest_is_done(tmp_path: Path) -> None:
    taken: dict[int, int] = {}
    with pytest.raises(
        Unfinished, match=r"^episode 2: the worker was killed 3 times, .*; the other 5 are done$"
    ):
        each(
            partial(deadly, tmp_path, 2, 99),
            range(6),
            2,
            taken.__setitem__,
            lambda number: f"episode {number}",
        )
    assert taken == {n: n for n in (0, 1, 3, 4, 5)}
    assert len(list(tmp_path.iterdir())) == TRIES


def die(graves: Path, number: int) -> None:
    (graves / f"{number}-{os.getpid()}").touch()
    os._exit(number)


@pytest.mark.slow
def test_where_every_item_kills_its_worker_not_all_are_tried(tmp_path: Path) -> None:
    with pytest.raises(Unfinished, match="the other 0 are done"):
        spread(partial(die, tmp_path), range(50), 2, lambda done: None)
    tried = {path.name.partition("-")[0] for path in tmp_path.iterdir()}
    assert len(tried) <= TRIES + 1, "those that were given up, and the other worker's"


def fail_at(tried: Path, wrong: int, number: int) -> int:
    (tried / f"{number}-{time.monotonic_ns()}").touch()
    if number == wrong:
        raise UserError(f"item {number} is wrong")
    return number


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_of_the_works_own_is_raised_and_never_tried_again(
    workers: int, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match="item 1 is wrong"):
        spread(partial(fail_at, tmp_path, 1), range(9), workers, lambda done: None)
    assert len(list(tmp_path.glob("1-*"))) == 1


def test_without_ray_its_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda module: None)
    with pytest.raises(
        UserError,
        match=r"^--workers ray needs ray, .*; run `pip install 'swarmdrive-harness\[ray\]'`$",
    ):
        spread(squared, [1], Ray(), lambda done: None)


@pytest.mark.parametrize(
    ("text", "who"),
    [
        ("1", 1),
        ("256", 256),
        ("ray", Ray()),
        ("ray://head:10001", Ray("ray://head:10001")),
        ("ray:10.0.0.1:6379", Ray("10.0.0.1:6379")),
        ("ray:[::1]:6379", Ray("[::1]:6379")),
    ],
)
def test_who_works_is_read_from_a_number_or_an_address(text: str, who: object) -> None:
    assert workers_of(text) == who


@pytest.mark.parametrize(
    "text",
    ["0", "257", "-1", "", "two", "1.5", "٣", "9" * 5000, "Ray", "ray:", "ray://", "ray:head", "ray\n",
             "ray://head:10001/x\x1b[31m", "http://head:1"],
)  # fmt: skip
def test_who_cannot_work_is_one_line(text: str) -> None:
    with pytest.raises(
        UserError, match=r"^--workers .*: give 1 to 256 processes, or ray for"
    ) as raised:
        workers_of(text)
    assert str(raised.value).isprintable()
    assert len(str(raised.value)) < 400
