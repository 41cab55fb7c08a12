"""How many cores this process may use, and how many threads a model's engine computes with."""

import os


def usable() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads() -> int:
    """Return the number of threads of an engine: OMP_NUM_THREADS, or else half of the usable cores.

    Threads of an engine wait for each other after each layer: one that another program holds up
    holds up all, so that an engine with a thread on every core stalls as soon as anybody else
    computes.
    """
    asked = os.environ.get("OMP_NUM_THREADS", "")
    return int(asked) if asked.isdigit() and int(asked) else max(1, usable() // 2)
