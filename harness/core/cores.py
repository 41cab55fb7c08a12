"""How many cores this process may use, how many threads a model's engine computes with,
and whether the processor multiplies in bfloat16.
"""

import os
from pathlib import Path

from harness.core.files import LARGEST, opened

# products of bfloat16, the fastest first, as Linux names what a processor has
BFLOAT16: tuple[str, ...] = ("amx_bf16", "avx512_bf16")
CPU_INFO = Path("/proc/cpuinfo")  # where Linux says it


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


def bfloat16_products() -> str | None:
    """Return the name of the processor's products in bfloat16, such as `avx512_bf16`.

    None if it has none and would emulate them, or if the system does not say, as only Linux does.
    """
    try:
        with opened(CPU_INFO, "text") as file:  # its size is stated as 0
            words = file.read(LARGEST["text"]).decode("utf-8", "replace").split()
    except OSError:
        return None
    return next((name for name in BFLOAT16 if name in words), None)
