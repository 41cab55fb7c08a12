"""A look at a language model before any run: what it reads, token by token, and how fast it answers."""

from dataclasses import dataclass
from typing import Any

from harness.backends.base import Completion, Request
from harness.backends.language_model import LanguageModel
from harness.cards import Thinking

MESSAGES = (
    {"role": "system", "content": "You drive the ego vehicle. Answer with one word."},
    {"role": "user", "content": "A truck hides the crossing lane. SLOWER, IDLE or FASTER?"},
)
ACTIONS = ("SLOWER", "IDLE", "FASTER")
MAX_TOKENS = 8


@dataclass(frozen=True)
class Checkup:
    """What was seen.

    Attributes:
        prompt: the rendered chat, just as the model reads it.
        prompt_tokens: its length.
        bos_tokens: how many of them begin a sequence; more than one harms most models.
        thinking: what the model's own template can do, whatever its card says.
        completion: one answer, asked alone after a warm-up; its seconds are batch-1 seconds.
        identity: as in a run's manifest.
    """

    prompt: str
    prompt_tokens: int
    bos_tokens: int
    thinking: Thinking
    completion: Completion
    identity: dict[str, Any]


def check(backend: LanguageModel, *, thinking: bool) -> Checkup:
    """Render one tiny chat and answer it. `thinking` asks the model to think first, where it can."""
    request = Request("check/ego", "ego", MESSAGES, ACTIONS, MAX_TOKENS, thinking=thinking)
    prompt = backend.chat.render(MESSAGES, thinking=thinking)
    ids = backend.chat.encode(prompt)
    backend.complete([request])  # the first call of a process pays for kernels and caches
    [completion] = backend.complete([request])
    bos = backend.chat.bos
    return Checkup(
        prompt=prompt,
        prompt_tokens=len(ids),
        bos_tokens=0 if bos is None else ids.count(bos),
        thinking=backend.chat.thinking,
        completion=completion,
        identity=backend.identity(),
    )
