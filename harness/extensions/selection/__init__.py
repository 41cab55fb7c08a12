"""Choose the episodes of a run: by number, by danger, drawn."""

from harness.core.extensions import Extension, Setting

_HERE = "harness.extensions.selection"

EXTENSION = Extension(
    name="selection",
    settings={
        "only": Setting(
            str,
            None,
            "Use only these episodes: 3,10:20 means 3 and 10 to 19.",
            behind=("world.limit",),
        ),
        "danger": Setting(
            str,
            None,
            "Use only episodes whose danger comes from this sector, such as left; none means "
            "episodes without a danger.",
            behind=("world.only",),
        ),
        "sample": Setting(
            int,
            None,
            "Draw this many of these episodes at random.",
            behind=("world.first_seed", "world.danger"),
        ),
        "sample_seed": Setting(
            int,
            0,
            "Seed of this draw; with the same seed, eval and drive draw the same episodes of as "
            "many.",
            behind=("world.sample",),
        ),
    },
    adds={"selections": {"selection": f"{_HERE}.episodes:SELECTION"}},
)
