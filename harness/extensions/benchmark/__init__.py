"""Run editions of a benchmark, pack results into one file, and compute,
check and rank those of others.
"""

from harness.core.extensions import Extension

EXTENSION = Extension(
    name="benchmark",
    commands={
        "benchmark run": "harness.extensions.benchmark.commands:run",
        "benchmark pack": "harness.extensions.benchmark.commands:pack",
        "benchmark verify": "harness.extensions.benchmark.commands:verify",
        "benchmark board": "harness.extensions.benchmark.commands:board",
        "benchmark seeds": "harness.extensions.benchmark.commands:seeds",
    },
    groups={"benchmark": "Run an edition of the benchmark; check and rank results."},
    panels={"benchmark": "More"},
)
