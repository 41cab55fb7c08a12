"""Names of the files that identify a folder as a run, unfinished work, a suite or a study."""

WORK = ".work"  # folder of unfinished work
# in it, the settings that the work began with; without it there is nothing to resume
CONFIG = "config.json"
SOURCES = "sources"  # folder in a run's folder, of the files that it was made of
SUITE = "suite.json"  # marks a folder that holds a suite's runs
# Every kind of study, and what lists call it; `<kind>.json` marks its folder. Who makes a kind adds
# it here.
STUDIES = {"sweep": "sweep"}
