"""Runs of a folder: in a browser on this machine, with notes on decision points, as a site,
and by date.
"""

from harness.core.extensions import Extension

_HERE = "harness.extensions.view"

EXTENSION = Extension(
    name="view",
    commands={"view": f"{_HERE}.commands:view", "run history": f"{_HERE}.commands:history"},
    panels={"view": "Look at results"},
    spellings={"history": "run history"},
    adds={
        "csv_rows": {"notes": f"{_HERE}.csv_rows:NOTES"},
        "remarks": {"notes": f"{_HERE}.remarks:REMARKS"},
    },
)
