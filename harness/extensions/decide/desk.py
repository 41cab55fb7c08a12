"""The queue before a model: one thread answers, in the order of arrival,
in batches of what waits.
"""

import asyncio
import queue
from collections.abc import Sequence
from concurrent.futures import Future
from threading import Thread

from harness.backends.base import Backend, Completion, Request
from harness.core.errors import UserError
from harness.core.strangers import strangers
from harness.extensions.decide.asked import Refusal

PLACES = 64  # questions that may wait
AGAIN_S = 1  # after which a client that found no place may ask again


class Desk:
    """Queue requests to a served model; a thread answers them in batches, in their order.

    Clients of one asyncio event loop wait for their answers with `ask`. `places` requests may wait,
    and at most `batch_size` are answered together.
    """

    def __init__(self, backend: Backend, batch_size: int, places: int = PLACES) -> None:
        self._backend, self._batch_size = backend, batch_size
        self._waiting: queue.Queue[tuple[Request, Future[Completion]]] = queue.Queue(places)
        Thread(target=self._work, daemon=True).start()  # no pool: Ctrl-C would wait for its threads

    async def ask(self, requests: Sequence[Request]) -> list[Completion]:
        """Wait until the model has answered some requests, and return the answers in their order.

        If the caller is cancelled, requests that still wait are dropped. Raises Refusal (status
        429) if the queue has too few places, and what the backend, which runs the model, raises.
        """
        futures: list[Future[Completion]] = [Future() for _ in requests]
        if self._waiting.qsize() + len(requests) > self._waiting.maxsize:
            raise Refusal("too many questions wait; ask again later", 429, "busy")
        for pair in zip(requests, futures, strict=True):
            self._waiting.put_nowait(pair)
        waiting = [asyncio.wrap_future(future) for future in futures]
        try:
            return await asyncio.gather(*waiting)
        finally:
            for future in futures:
                future.cancel()  # where another failed, or the client waits no more

    def _work(self) -> None:
        """Answer what waits, for ever."""
        while True:
            batch = [self._waiting.get()]
            while len(batch) < self._batch_size and not self._waiting.empty():
                batch.append(self._waiting.get_nowait())
            wanted = [pair for pair in batch if pair[1].set_running_or_notify_cancel()]
            if wanted and not self._answer(wanted) and len(wanted) > 1:
                for pair in wanted:  # one of them must not fail the others
                    self._answer([pair])

    def _answer(self, batch: Sequence[tuple[Request, "Future[Completion]"]]) -> bool:
        """Answer a batch; return False if it failed as a whole and is to be asked one by one."""
        try:
            with strangers():
                completions = self._backend.complete([request for request, _ in batch])
        except Exception as error:
            if len(batch) > 1 and isinstance(error, UserError):
                return False
            for _, future in batch:
                future.set_exception(error)
        else:
            for (_, future), completion in zip(batch, completions, strict=True):
                future.set_result(completion)
        return True
