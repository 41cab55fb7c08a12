"""A backend that does what its prompt says: answers, dies, fails or dawdles.
Opened in a child by tests.
"""

import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from harness.backends.base import Completion, Request
from harness.core.errors import UserError


def open(graves: Path, deaths: int = 0, complaint: str = "") -> "Mortal":
    """Dies while it loads, `deaths` times; who was born is written down in a file of its own."""
    (graves / str(os.getpid())).write_text("born")
    if len(list(graves.iterdir())) <= deaths:
        os.kill(os.getpid(), signal.SIGKILL)
    if complaint:
        raise UserError(complaint)
    return Mortal()


class Mortal:
    """Answers with its process id."""

    pid = os.getpid()

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        return [self._answer(request, len(requests)) for request in requests]

    def _answer(self, request: Request, company: int) -> Completion:
        said = request.messages[0]["content"]
        if said == "die":
            os.kill(os.getpid(), signal.SIGSEGV)
        if said == "die in company" and company > 1:
            os.kill(os.getpid(), signal.SIGKILL)
        if said == "stop":
            os.kill(os.getpid(), signal.SIGSTOP)
        if said == "exit":
            os._exit(3)
        if said == "dawdle":
            time.sleep(600)
        if said == "complain":
            raise UserError("the template refuses it; use another")
        if said == "fail":
            raise KeyError("a bug")
        return Completion(request.id, said, 1, 1, "stop", 0.25, company)

    def identity(self) -> dict[str, Any]:
        return {"engine": "mortal"}
