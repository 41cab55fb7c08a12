"""What tells the folder of a run: its format, and where it is made before it is finished. Imports nothing."""

EVAL = "swarmdrive-run/1"
DRIVE = "swarmdrive-drive/1"
WORK = ".work"
CONFIG = "config.json"  # in `WORK`: what the run was begun with; its work counts only once this is there
