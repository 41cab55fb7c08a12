"""A live run that kills itself: `killed_drive.py FOLDER N` dies just before its N-th change of the disk."""

import sys
from pathlib import Path

from driving import spec
from evaluating import run

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from killed_run import die_before

    die_before(int(sys.argv[2]))
    run(spec("cruise", seeds=(0,), episodes=33), Path(sys.argv[1]))
