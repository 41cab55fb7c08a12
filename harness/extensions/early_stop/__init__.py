"""Stop a run once success is known well enough: interim looks, and intervals that hold at each."""

from harness.core.extensions import Extension, Setting

_HERE = "harness.extensions.early_stop"

EXTENSION = Extension(
    name="early_stop",
    settings={
        "until_width": Setting(
            float,
            0.0,
            "Stop as soon as the 95 % interval of success is so narrow, in points, in every "
            "condition; it is one that holds at every look.",
            behind="world.sample_seed",
        ),
        "until_decided": Setting(
            str,
            "",
            "Stop as soon as success differs from that of the finished run in this folder in "
            "every condition, by such an interval.",
            behind="world.sample_seed",
        ),
    },
    adds={"stopping_rules": {"looks": f"{_HERE}.rule:RULE"}},
)
