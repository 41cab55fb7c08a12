"""A server in a process of its own: `python served.py [ANSWERS]` dies when it is asked for one
more.

It prints its base URL. What it answers depends on the question alone.
"""

import hashlib
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from misbehaving import Asked, completion, serving


def answer(asked: Asked, prompt_tokens: int = 12) -> None:
    digest = hashlib.sha256(json.dumps(asked.body).encode()).digest()
    shares = [1 + byte for byte in digest[:3]]
    p = dict(
        zip(("SLOWER", "IDLE", "FASTER"), (share / sum(shares) for share in shares), strict=True)
    )
    helper = {"evidence": "", "risk": "low"} if "evidence" in json.dumps(asked.body) else {}
    time.sleep(0.002)
    reply = completion(json.dumps({**helper, "action_distribution": p}))
    reply["usage"]["prompt_tokens"] = prompt_tokens
    asked.reply(reply)


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


@contextmanager
def llama_cpp_server(gguf: Path, log: Path, **more: str) -> Iterator[str]:
    """The base URL of llama-cpp-python's server with a model, in a process of its own."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    options = {"model": str(gguf), "port": str(port), "n_threads": "1", "n_threads_batch": "1",
               "verbose": "false", **more}  # fmt: skip
    command = [sys.executable, "-m", "llama_cpp.server"]
    command += [part for name, value in options.items() for part in (f"--{name}", value)]
    with (
        log.open("w") as file,
        subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT) as server,
    ):
        try:
            until_s = time.monotonic() + 120
            while server.poll() is None and time.monotonic() < until_s:
                with socket.socket() as trial:
                    if trial.connect_ex(("127.0.0.1", port)) == 0:
                        break
                time.sleep(0.1)
            else:
                raise AssertionError(f"the server did not start: {log.read_text()[-2000:]}")
            yield f"http://127.0.0.1:{port}/v1"
        finally:
            server.terminate()


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
