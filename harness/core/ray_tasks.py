"""Run items as tasks on the nodes of a Ray cluster.
Imported only if `--workers` names a cluster.
"""

import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray reads it on import
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray warns where it is not set

import ray
from ray import exceptions
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from harness.core.errors import Unanswered, UserError, printable
from harness.core.parallel import WorkerDied, done
from harness.core.process import Stop
from harness.core.versions import differing, node_versions

DEAD = (
    exceptions.WorkerCrashedError,
    exceptions.NodeDiedError,
    exceptions.OutOfMemoryError,
    exceptions.ObjectLostError,
    exceptions.TaskUnschedulableError,  # its node is gone
)
REACHED_S = 10.0  # a cluster must answer within this time
COUNT_S = 2.0  # cores are counted again after this time, since nodes come and go


class Tasks:
    """Run items of work as tasks on a Ray cluster, which chooses the nodes: an `Executor`.

    Ray does not retry a task, so that the caller can count deaths of workers. The first item of
    every further node is run again on the first node, and must give the same result.
    """

    def __init__(
        self,
        work: Callable[[Any], Any],
        address: str | None,
        label: Callable[[int], str],
        repeatable: bool,
    ) -> None:
        """`label` gives the name of the item at a place;
        `repeatable` says whether nodes are compared.
        """
        _connect(address)
        self._label, self._repeatable = label, repeatable
        self._run = ray.remote(num_cpus=1, max_retries=0)(_on_node)
        self._work = ray.put((work, node_versions(), os.getcwd()))
        self._busy: dict[Any, tuple[int, Any]] = {}
        # repeated items: place, first node, its result
        self._again: dict[Any, tuple[int, str, str]] = {}
        self._nodes: dict[str, str] = {}  # names by id of the nodes that have answered
        self._cores, self._counted_s = 1, -COUNT_S

    def room(self) -> bool:
        if time.monotonic() >= self._counted_s + COUNT_S:
            self._cores = max(1, int(ray.cluster_resources().get("CPU", 1)))
            self._counted_s = time.monotonic()
        return len(self._busy) < 2 * self._cores  # so that a free core has its next item at once

    def give(self, place: int, item: Any) -> None:
        self._busy[self._run.remote(self._work, item)] = place, item

    def take(self) -> tuple[int, Any]:
        while True:
            [ready], _ = ray.wait([*self._busy, *self._again], num_returns=1)
            if ready in self._busy:
                break
            self._compare(ready)
        place, item = self._busy.pop(ready)
        answer = _result(ready)
        if answer is None:
            return place, WorkerDied()
        node, name, result = answer
        if self._repeatable and node not in self._nodes:
            if self._nodes:
                first_node = NodeAffinitySchedulingStrategy(next(iter(self._nodes)), soft=False)
                again = self._run.options(scheduling_strategy=first_node).remote(self._work, item)
                self._again[again] = place, name, repr(result)
            self._nodes[node] = name
        while self._again and not self._busy:  # `take` may not be called again
            self._compare(next(iter(self._again)))
        return place, result

    def _compare(self, task: Any) -> None:
        place, name, before = self._again.pop(task)
        again = _result(task)
        if again is None:  # the first node is gone
            self._nodes.pop(next(iter(self._nodes)))
        elif repr(again[2]) != before:
            raise UserError(
                f"{printable(self._label(place))} came out differently on node {name} than on node "
                f"{again[1]}; find out which is right, and leave out the other"
            )

    def close(self) -> None:
        for task in (*self._busy, *self._again):
            with suppress(exceptions.RayError, ConnectionError):
                ray.cancel(task, force=True)


def _connect(address: str | None) -> None:
    """Connect this process to a cluster, once."""
    if ray.is_initialized():
        return
    target = address or os.environ.get("RAY_ADDRESS")
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    if not target:
        quiet["include_dashboard"] = False
    try:
        if target and ":" in target:  # if nobody listens there, Ray would end this process
            host, _, port = target.rpartition("/")[2].rpartition(":")
            socket.create_connection((host.strip("[]"), int(port)), REACHED_S).close()
        handler = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(address=address, **quiet)
        except SystemExit as ended:  # what Ray's own handler raises
            raise (Stop(signal.SIGTERM) if ended.code == signal.SIGTERM else ended) from None
        finally:
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGTERM, handler)
    # A version of Ray or Python other than the cluster's raises one of these, too.
    except (OSError, RuntimeError, ValueError, ImportError) as error:
        raise UserError(
            f"--workers ray: no cluster at {printable(target or 'this machine')} "
            f"({printable(error)}); start "
            "one with `ray start --head`, and give its address"
        ) from None


def _result(task: Any) -> tuple[str, str, Any] | None:
    """Return a node's id, its name and a task's result; None if the worker or the node died."""
    try:
        answer: tuple[str, str, Any] = ray.get(task)
    except DEAD:
        return None
    except exceptions.RayError as error:
        cause = getattr(error, "cause", None)
        if isinstance(cause, Exception) and not isinstance(cause, exceptions.RayError):
            raise cause from error
        # such as a package that a node lacks
        reason = printable(str(cause or error).partition("\n")[0])
        raise UserError(
            f"--workers ray: {reason}; fix the cluster's nodes, or use processes"
        ) from None
    return answer


def _on_node(
    job: tuple[Callable[[Any], Any], dict[str, str], str], item: Any
) -> tuple[str, str, Any]:
    """Run an item on this node, if the versions here are the same as on the calling machine."""
    work, versions, folder = job
    node = ray.get_runtime_context().get_node_id()
    name = f"{ray.util.get_node_ip_address()} ({node[:8]})"
    if differs := differing(versions):
        raise UserError(f"node {name} has {differs}; install the same on every node")
    with suppress(OSError):  # a project's own files are looked up from its folder
        os.chdir(folder)
    try:
        return node, name, done(work, item)
    except Unanswered:  # the words of its server come first
        raise
    except UserError as error:
        raise UserError(f"node {name}: {error}") from None
