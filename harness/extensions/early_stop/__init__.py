"""Stop a run once success is known well enough: interim looks, and intervals that hold at each."""

from harness.core.extensions import Extension, Setting

_HERE = "harness.extensions.early_stop"
_PLACES = ("world.sample_seed", "world.first_seed", "world.limit")

EXTENSION = Extension(
    name="early_stop",
    settings={
        "until_width": Setting(
            float,
            None,
            "Stop as soon as the 95 % interval of success is so narrow, in points, in every "
            "condition; it is one that holds at every look.",
            behind=_PLACES,
        ),
        "until_decided": Setting(
            str,
            None,
            "Stop as soon as success differs from that of the finished run in this folder in "
            "every condition, by such an interval.",
            behind=_PLACES,
        ),
    },
    adds={"stopping_rules": {"looks": f"{_HERE}.rule:RULE"}},
)
