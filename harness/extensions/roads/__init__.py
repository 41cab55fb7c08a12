"""Let recorded or simulated traffic be a scenario: CommonRoad, SUMO and tables of tracks."""

from harness.core.extensions import Extension

_HERE = "harness.extensions.roads"

EXTENSION = Extension(name="roads")
