"""What the workers of a Ray cluster are given to do in tests:
they import this, and little with it.
"""

import os
import time
from pathlib import Path

import ray

from harness.core.errors import UserError


def node() -> str:
    return str(ray.get_runtime_context().get_node_id())


def where(number: int) -> str:
    time.sleep(0.2)
    return node()


def dies(graves: Path, number: int) -> int:
    if number == 2:
        (graves / str(os.getpid())).touch()
        os._exit(9)
    return number


def wrong(tried: Path, number: int) -> int:
    (tried / f"{number}-{time.monotonic_ns()}").touch()
    if number == 1:
        raise (
            UserError("the weights are missing")
            if tried.name == "user"
            else ZeroDivisionError("a bug")
        )
    return number


def counted(begun: Path, number: int) -> int:
    (begun / f"{number}-{node()}").touch()
    time.sleep(0.15)
    return number


def stays(begun: Path, number: int) -> int:
    (begun / f"{number}-{os.getpid()}").touch()
    if number == 1:
        while not list(begun.glob("0-*")):
            time.sleep(0.01)
        raise UserError("enough")
    time.sleep(600)
    return number
