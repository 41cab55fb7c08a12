"""A server in a process of its own: `python served.py [ANSWERS]` dies when it is asked for one more.

It prints its base URL. What it answers depends on the question alone.
"""

import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from misbehaving import Asked, completion, serving


def answer(asked: Asked) -> None:
    digest = hashlib.sha256(json.dumps(asked.body).encode()).digest()
    shares = [1 + byte for byte in digest[:3]]
    p = dict(zip(("SLOWER", "IDLE", "FASTER"), (share / sum(shares) for share in shares), strict=True))
    helper = {"evidence": "", "risk": "low"} if "evidence" in json.dumps(asked.body) else {}
    time.sleep(0.002)
    asked.reply(completion(json.dumps({**helper, "action_distribution": p})))


@contextmanager
def served(answers: int | None = None) -> Iterator[str]:
    """The base URL of such a process while it lives."""
    command = [sys.executable, __file__, *([] if answers is None else [str(answers)])]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        try:
            yield process.stdout.readline().strip()
        finally:
            process.kill()


def main(answers: float) -> None:
    def play(asked: Asked) -> None:
        if asked.number >= answers:
            os._exit(1)
        answer(asked)

    with serving(play) as there:
        print(there.url, flush=True)
        while True:
            time.sleep(60)


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else float("inf"))
