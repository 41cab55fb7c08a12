"""Work as tasks on the nodes of a Ray cluster. Who names none does not load it."""

import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray reads it where it is imported
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # of which it warns otherwise

import ray
from ray import exceptions
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from harness.core.errors import UserError, printable
from harness.core.parallel import Lost
from harness.core.versions import differing, of_node

DEAD = (
    exceptions.WorkerCrashedError,
    exceptions.NodeDiedError,
    exceptions.OutOfMemoryError,
    exceptions.ObjectLostError,
    exceptions.TaskUnschedulableError,  # on a node that is gone
)
REACHED_S = 10.0  # by when a cluster answers
COUNT_S = 2.0  # after which cores are counted again: nodes come and go


class Tasks:
    """An executor of tasks that Ray places.

    Ray tries none again, so that what kills its worker is counted. The first result of every further node is
    worked out again on the first one, and has to come out the same.
    """

    def __init__(
        self, work: Callable[[Any], Any], address: str | None, named: Callable[[int], str], repeatable: bool
    ) -> None:
        """`named` says what the item at a place is called; `repeatable` whether nodes are compared."""
        _connect(address)
        self._named, self._repeatable = named, repeatable
        self._run = ray.remote(num_cpus=1, max_retries=0)(_on_node)
        self._work = ray.put((work, of_node(), os.getcwd()))
        self._busy: dict[Any, tuple[int, Any]] = {}
        self._again: dict[Any, tuple[int, str, str]] = {}  # place, and what came out on which node
        self._nodes: dict[str, str] = {}  # names of those that answered, by id
        self._cores, self._counted_s = 1, -COUNT_S

    def room(self) -> bool:
        if time.monotonic() >= self._counted_s + COUNT_S:
            self._cores = max(1, int(ray.cluster_resources().get("CPU", 1)))
            self._counted_s = time.monotonic()
        return len(self._busy) < 2 * self._cores  # so that a core that is free has one at once

    def give(self, place: int, item: Any) -> None:
        self._busy[self._run.remote(self._work, item)] = place, item

    def take(self) -> tuple[int, Any]:
        while True:
            [ready], _ = ray.wait([*self._busy, *self._again], num_returns=1)
            if ready in self._busy:
                break
            self._compare(ready)
        place, item = self._busy.pop(ready)
        found = _got(ready)
        if found is None:
            return place, Lost()
        node, name, result = found
        if self._repeatable and node not in self._nodes:
            if self._nodes:
                there = NodeAffinitySchedulingStrategy(next(iter(self._nodes)), soft=False)
                again = self._run.options(scheduling_strategy=there).remote(self._work, item)
                self._again[again] = place, name, repr(result)
            self._nodes[node] = name
        while self._again and not self._busy:  # this may be the last that is taken
            self._compare(next(iter(self._again)))
        return place, result

    def _compare(self, task: Any) -> None:
        place, name, before = self._again.pop(task)
        found = _got(task)
        if found is None:  # the first node is gone
            self._nodes.pop(next(iter(self._nodes)))
        elif repr(found[2]) != before:
            raise UserError(
                f"{printable(self._named(place))} came out differently on node {name} than on node "
                f"{found[1]}; find out which is right, and leave out the other"
            )

    def close(self) -> None:
        for task in (*self._busy, *self._again):
            with suppress(exceptions.RayError, ConnectionError):
                ray.cancel(task, force=True)


def _connect(address: str | None) -> None:
    """Connect this process to a cluster, once."""
    if ray.is_initialized():
        return
    there = address or os.environ.get("RAY_ADDRESS")
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    if not there:
        quiet["include_dashboard"] = False
    try:
        if there and ":" in there:  # where nobody listens, Ray would end this process
            host, _, port = there.rpartition("/")[2].rpartition(":")
            socket.create_connection((host.strip("[]"), int(port)), REACHED_S).close()
        before = signal.getsignal(signal.SIGTERM)
        ray.init(address=address, **quiet)
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)  # Ray takes it, and would end without a word
    # Among them: another Ray or another Python than the cluster's.
    except (OSError, RuntimeError, ValueError, ImportError) as error:
        raise UserError(
            f"--workers ray: no cluster at {printable(there or 'this machine')} ({printable(error)}); start "
            "one with `ray start --head`, and give its address"
        ) from None


def _got(task: Any) -> tuple[str, str, Any] | None:
    """A node's id, its name and a task's result; None where a worker or a node died."""
    try:
        found: tuple[str, str, Any] = ray.get(task)
    except DEAD:
        return None
    except exceptions.RayError as error:
        cause = getattr(error, "cause", None)
        if isinstance(cause, Exception) and not isinstance(cause, exceptions.RayError):
            raise cause from error
        said = printable(str(cause or error).partition("\n")[0])  # such as a package that a node lacks
        raise UserError(f"--workers ray: {said}; fix the cluster's nodes, or use processes") from None
    return found


def _on_node(given: tuple[Callable[[Any], Any], dict[str, str], str], item: Any) -> tuple[str, str, Any]:
    """Work on an item here, where this is the same as on the machine that asks."""
    work, versions, folder = given
    node = ray.get_runtime_context().get_node_id()
    name = f"{ray.util.get_node_ip_address()} ({node[:8]})"
    if differs := differing(versions):
        raise UserError(f"node {name} has {differs}; install the same on every node")
    with suppress(OSError):  # a project's own files are found from its folder
        os.chdir(folder)
    try:
        return node, name, work(item)
    except UserError as error:
        raise UserError(f"node {name}: {error}") from None
