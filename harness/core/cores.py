"""How many cores this process may use, and how many threads a model's engine computes with."""

import os


def usable() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads() -> int:
    """Return the number of threads for a model's engine.

    It is the environment variable OMP_NUM_THREADS, or else half of the usable cores. With a thread
    on every core, an engine stalls as soon as any other program computes, since its threads wait
    for each other after each layer.
    """
    setting = os.environ.get("OMP_NUM_THREADS", "")
    return int(setting) if setting.isdigit() and int(setting) else max(1, usable() // 2)
