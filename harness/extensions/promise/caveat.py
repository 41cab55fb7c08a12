"""What a page says of promises that a run's episodes are not of."""

from collections.abc import Iterator

from harness.core.errors import printable
from harness.dataset.select import pick
from harness.runs.records import Manifest


def caveats(manifest: Manifest) -> Iterator[str]:
    """Yield a sentence for each promise under which chosen episodes of a run were played.

    A promise is of all layouts, not of those of one danger, say. `manifest` is what the run's
    `run.json` has.
    """
    chosen = pick(manifest.world.selection)
    names = [condition.get("promise") for condition in manifest.conditions]
    for name in dict.fromkeys(names):
        if chosen and name:
            yield (
                f"Promise {printable(name, 40)} is of all layouts, and says nothing of those "
                f"chosen by {chosen}."
            )
