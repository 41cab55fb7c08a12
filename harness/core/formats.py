"""Names of the files and formats that identify a folder as a run, unfinished work or a suite."""

FORMAT = "swarmdrive-run/2"
# Older formats, and the version of the harness that reads each.
READ_BY = {"swarmdrive-run/1": "0.1", "swarmdrive-drive/1": "0.1"}
WORK = ".work"  # folder of unfinished work
CONFIG = "config.json"  # in it, the settings that the work began with; without it there is nothing to resume
SOURCES = "sources"  # folder in a run's folder, of the files that it was made of
SUITE = "suite.json"  # marks a folder that holds a suite's runs
