"""Draw driven episodes as videos: one of a run, or those of a new run that failed."""

from harness.core.extensions import Extension

FFMPEG = ("imageio-ffmpeg", "video")

EXTENSION = Extension(
    name="media",
    commands={"run video": "harness.extensions.media.command:command"},
    spellings={"video": "run video"},
    adds={
        "videos": {"failures": "harness.extensions.media.failures:FAILURES"},
        "extras": {"imageio_ffmpeg": "harness.extensions.media:FFMPEG"},
    },
)
