"""Put an antenna beside the road, which sends helpers' replies once more, or fuses for the ego."""

from harness.core.extensions import Extension

EXTENSION = Extension(
    name="roadside", adds={"parts": {"roadside": "harness.extensions.roadside.part:Roadside"}}
)
