"""What must be said before a run's numbers: that its answers were not read, or that it read no prompt."""

from collections.abc import Iterator, Sequence

from harness.backends.registry import find
from harness.core.errors import printable
from harness.runs.listing import UNREAD
from harness.runs.metrics import ALL
from harness.runs.records import Manifest, Score

# By role: whose answers, and what takes their place.
_FAILED = {
    "ego": ("the ego's", "it drives by the fallback, and success says little of the model"),
    "helper": ("the helpers'", "they send no message"),
    "merge": ("the fusion calls'", "the ego keeps the policy it had without them"),
}


def caveats(manifest: Manifest, scores: Sequence[Score]) -> list[str]:
    """Sentences for a run's headline; none for a language model that is understood."""
    return [*_unread(scores), *_no_prompt(manifest)]


def _unread(scores: Sequence[Score]) -> Iterator[str]:
    failed = {s.metric: s for s in scores if s.condition == ALL}
    for role, (whose, instead) in _FAILED.items():
        score = failed.get(f"failed_rate_{role}")
        if score is not None and score.value is not None and score.value >= UNREAD:
            share = "None" if score.value == 1 else f"Only {100 * (1 - score.value):.1f} %"
            yield f"{share} of {whose} {score.n} answers could be read: {instead}."


def _no_prompt(manifest: Manifest) -> Iterator[str]:
    engine = find(str(manifest.model.get("engine")))
    if engine is not None and not engine.capabilities.language_model:
        name, version = manifest.variant.model, manifest.variant.prompt
        yield (
            f"{printable(name, 30)} reads no prompt: it decides by the scene graph, "
            f"whatever {printable(version, 20)} says."
        )
