"""Names that folders are known by."""

FORMAT = "swarmdrive-run/2"
READ_BY = {"swarmdrive-run/1": "0.1", "swarmdrive-drive/1": "0.1"}  # older formats, and the version for them
WORK = ".work"  # what a kill leaves
CONFIG = "config.json"  # the settings that work began with; it counts only once this is there
SUITE = "suite.json"  # what makes a folder that of a suite's runs
