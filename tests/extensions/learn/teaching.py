"""What layouts teach: few decision points of each level, drawn once for all workers."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from harness.core.files import canonical_json, sha256_bytes
from harness.extensions.learn.training import lessons
from harness.world.scenario import Scenario

# of the first layout; it and the next have a point at the start, and several at a level
SEED = 100_001
PER_LEVEL, MOST_TRIED = 2, 4
drawing = lessons.decision_points


def few_points(scenario: Scenario, seed: int, number: int) -> list[lessons.Point]:
    """Draw a layout's decision points as a training does, but fewer, which takes half as long."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lessons, "PER_LEVEL", PER_LEVEL)
        patch.setattr(lessons, "MOST_TRIED", MOST_TRIED)
        return drawing(scenario, seed, number)


def drawn_by(once: Any) -> Callable[[Scenario, int, int], list[lessons.Point]]:
    """What stands in for the drawing of a layout: it reads what whoever came first has drawn."""

    def points(scenario: Scenario, seed: int, number: int) -> list[lessons.Point]:
        def fill(file: Path) -> None:
            file.write_bytes(msgspec.json.encode(few_points(scenario, seed, number)))

        # A scenario's name does not tell its settings.
        settings = sha256_bytes(canonical_json(scenario.parameters.stated()).encode())[:16]
        file = once(f"lessons-{scenario.name}-{settings}-{seed}-{number}", fill)
        return msgspec.json.decode(file.read_bytes(), type=list[lessons.Point])

    return points
