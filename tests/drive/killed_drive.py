"""Live runs that kill themselves: `killed_drive.py FOLDER N...`.

That in FOLDER/at-N dies just before its N-th change of the disk.
"""

import os
import signal
import sys
from pathlib import Path

from driving import spec

from harness.evaluate import run

EPISODES, EPISODES_AT_ONCE = 5, 2  # three chunks

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from killed_run import forked

    run.EPISODES_AT_ONCE = EPISODES_AT_ONCE
    for n in sys.argv[2:]:
        child = forked(
            spec("cruise", seeds=(0,), episodes=EPISODES), Path(sys.argv[1], f"at-{n}"), before=int(n)
        )
        _, status = os.waitpid(child, 0)
        if not os.WIFSIGNALED(status) or os.WTERMSIG(status) != signal.SIGKILL:
            sys.exit(f"the run that dies before its change {n} ended with status {status}")
