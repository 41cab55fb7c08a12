"""A live run's model: its backend in each process, its identity, and how long its decisions take."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from harness.backends.base import Backend
from harness.backends.cache import cached
from harness.backends.cards import Card
from harness.backends.registry import open_backend
from harness.core.errors import UserError, printable
from harness.evaluate import merging
from harness.evaluate.asking import answer_of, requests
from harness.evaluate.intents import intents
from harness.evaluate.live import P, look, start
from harness.evaluate.live_spec import Drive
from harness.evaluate.timing import SAMPLE, measure, merge_latency


def begin(spec: Drive) -> tuple[dict[str, Any], dict[str, Any]]:
    """Identity of the model and latency of its decisions.

    An answer's own seconds depend on what else the machine does, so a measured latency is always the median
    of a sample: the same in every episode, with any number of workers.
    """
    backend = opened(spec.card, spec.device, spec.dtype, spec.batch_size, None)
    if (spec.latency or spec.card.latency.source) != "measured":
        declared = measure(spec, backend, Path())
        return backend.identity(), {"merge_s": declared["inference_s"]["ego"], **declared}
    scenes = []
    for number in range(min(SAMPLE, spec.episodes)):
        trajectory = start(spec, number)
        trajectory.world.advance(round(number * P.decision_period_s * P.simulation_hz / 2))
        scenes.append(look(spec.card.engine, trajectory, 0))
    sample = replace(spec, dataset=replace(spec.dataset, scenes=tuple(scenes)), batch_size=2)
    with TemporaryDirectory() as folder:
        latency = measure(sample, backend, Path(folder) / "latency.json")
    if None in latency["inference_s"].values():
        raise UserError(
            f"--model {printable(spec.card.name)}: none of {len(scenes)} trial answers could be timed, and "
            "no episode goes on without a latency; see what `harness model check` says"
        )
    if any(point.asks_again for point in spec.points):
        asked = list(requests(sample, scenes))
        by_id = {r.id: answer_of(r, c) for r, c in zip(asked, backend.complete(asked), strict=True)}
        known = intents(sample.dataset, by_id, spec.answer, spec.thinking)
        heard = merging.codes_of(known.valid)[known.valid.any(axis=1)]
        second = list(merging.requests(sample, known, heard))
        latency = {
            "merge_s": latency["inference_s"]["ego"],
            **merge_latency(sample, backend, latency, second, {}),
        }
    return backend.identity(), latency


@lru_cache(maxsize=2)
def opened(card: Card, device: str | None, dtype: str | None, batch_size: int, cache: Path | None) -> Backend:
    """This process's backend, with the cache in front of a language model's."""
    if cache is not None:
        backend = opened(card, device, dtype, batch_size, None)
        return cached(backend, card, cache)
    return open_backend(card, device=device, dtype=dtype, batch_size=batch_size)
