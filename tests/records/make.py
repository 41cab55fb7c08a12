"""Make the runs of a commit that tests/test_records.py reads:
`python tests/records/make.py COMMIT`.

The commit is checked out beside this repository and its own program makes the runs, with the
packages of this environment. Run it for a commit whose files later versions must read, before that
commit is forgotten.
"""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent
FROZEN = "--limit 2 --seeds 0,1"
# The words of each run, by its folder; a command that a commit does not know is left out.
COMMANDS = {
    "proxy": f"eval --model proxy {FROZEN} --condition single-local --condition v2x --condition 6g",
    "attack": f"eval --model proxy {FROZEN} --condition 6g "
    "--condition 6g:consensus=trust --attack liar",
    "tiny": "eval --model swarm-tiny --limit 2 --seeds 0 --condition 6g --condition "
    "6g:consensus=ego-prompt",
    "mixed": "eval --model swarm-tiny --helper-model proxy --limit 2 --seeds 0 --condition 6g",
    "drive": "drive --model proxy --episodes 2 --seeds 0,1 --condition single-local --condition 6g",
    "sweep": "sweep {out}/proxy --over loss --grid 0,0.5 --seeds 0 --no-model --out {out}/sweep",
    "trust": "trust {out}/proxy --attacks liar --rules linear,median --seeds 0 --share 1/3 --out "
    "{out}/trust",
}
BEGUN = "drive --model local-view --episodes 40 --seeds 0 --workers 1 --condition single-local"


def main(commit: str) -> None:
    """Make the runs of a commit under its name."""
    root = HERE.parent.parent
    with tempfile.TemporaryDirectory() as folder:
        clone, out = Path(folder, "clone"), Path(folder, "out")
        subprocess.run(
            ["git", "-C", root, "worktree", "add", "--detach", "-q", clone, commit], check=True
        )
        try:
            environment = {
                **os.environ,
                "PYTHONPATH": str(clone),
                "SWARMDRIVE_CACHE": f"{folder}/cache",
            }

            def start(words: str) -> subprocess.Popen[bytes]:
                command = [sys.executable, "-m", "harness", *words.split(), "--quiet"]
                return subprocess.Popen(command, cwd=clone, env=environment, start_new_session=True)

            for name, words in COMMANDS.items():
                whole = words.format(out=out) + ("" if "--out" in words else f" --out {out}/{name}")
                print(name, "made" if start(whole).wait() == 0 else "left out", flush=True)
            begun = start(f"{BEGUN} --out {out}/begun")
            while not list(out.glob("begun/.work/*/episodes.csv")):
                time.sleep(0.05)
            os.killpg(begun.pid, signal.SIGKILL)
            begun.wait()
        finally:
            subprocess.run(["git", "-C", root, "worktree", "remove", "--force", clone], check=True)
        for path in out.rglob("*.*"):
            if path.suffix in (".pdf", ".png", ".svg", ".html", ".lock"):
                path.unlink()
        shutil.rmtree(HERE / commit, ignore_errors=True)
        shutil.copytree(out, HERE / commit)


if __name__ == "__main__":
    main(sys.argv[1])
