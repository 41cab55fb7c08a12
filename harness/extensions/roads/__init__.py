"""Let recorded or simulated traffic be a scenario: CommonRoad, SUMO and tables of tracks."""

from harness.core.extensions import Extension

_HERE = "harness.extensions.roads"

EXTENSION = Extension(
    name="roads",
    commands={
        "dataset import": f"{_HERE}.importing:command",
        "study reaction": f"{_HERE}.reaction.command:command",
    },
    studies={"reaction": "reaction"},
    adds={
        "channel_models": {"transmissions": f"{_HERE}.transmissions:from_profile"},
        "families": {
            "recording": f"{_HERE}.family:RECORDINGS",
            "sumo": f"{_HERE}.sumo:FRESH",
        },
        "sections": {"recorded-driver": f"{_HERE}.page:section"},
    },
)
