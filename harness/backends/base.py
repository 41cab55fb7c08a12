"""What a backend is: requests in, completions out, order kept.

A backend batches, threads or loops inside as suits its engine; nothing else in the program knows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

from harness.core.image import Image

if TYPE_CHECKING:
    from harness.runs.records import Latency
    from harness.world.scenario import Scenario

Role = Literal["ego", "helper"]
AnswerMode = Literal["json", "constrained", "readout"]
FinishReason = Literal["stop", "length", "error"]
AGAIN = "#2"  # behind the id of a repair turn's request


@dataclass(frozen=True)
class Request:
    """One question to a small language model.

    Attributes:
        id: unique in a run, `<scene>/<viewer>`; `AGAIN` stands behind that of a repair turn.
        role: which prompt of the version was rendered, and which schema the answer has.
        messages: chat messages, `{"role": "system" | "user" | "assistant", "content": text}`.
        actions: meta-action names, in the environment's order.
        max_tokens: most tokens the answer may have.
        form: what the prompt asks a helper for: `distribution`, or `recommendation` with a confidence.
        answer: how the model answers. `json`: it writes freely. `constrained`: it fills in numbers and
            choices of a fixed text. `readout`: the messages ask for one letter (see
            `harness.prompts.readout`), whose probabilities are the answer.
        thinking: whether the model was asked to think first (where its template can).
        reasons_first: whether the prompt asks for reasons before the answer.
        temperature: 0 takes the likeliest token each time; above, tokens are drawn from softmax(logits /
            temperature).
        sample: which of several answers to one question, and so the seed of its draws; 0 where one is asked
            for.
        timed: whether it is asked to measure its time: a server streams it then, which shows its first token.
        agent: which of the run's agents is asked: 0 is the ego's.
        image: the picture before the text of the user's message that asks; None where there is none.
        view: the viewer's own scene graph. Only backends that are no language model read it
            (`proxy`, the drivers); it holds nothing that the prompt's author could not see.
        truth: scene graph with everything in view; None unless the card is `privileged`.
        scenario: what the view is of; only backends that read the view read it.
    """

    id: str
    role: Role
    messages: tuple[Mapping[str, str], ...]
    actions: tuple[str, ...]
    max_tokens: int
    form: str = "distribution"
    answer: AnswerMode = "json"
    thinking: bool = False
    reasons_first: bool = False
    temperature: float = 0.0
    sample: int = 0
    timed: bool = False
    agent: int = 0
    image: Image | None = None
    view: Mapping[str, Any] | None = None
    truth: Mapping[str, Any] | None = None
    scenario: "Scenario | None" = None

    @property
    def image_sha256(self) -> str | None:
        """Digest of its picture's pixels; None where there is none."""
        return self.image.sha256 if self.image else None


@dataclass(frozen=True)
class Completion:
    """One answer.

    Attributes:
        request_id: the request's id.
        text: what the model said, untouched; empty on error.
        prompt_tokens: tokens in; None if the engine has no tokenizer.
        completion_tokens: tokens out; None if the engine has no tokenizer.
        finish_reason: `stop`, `length` (cut off by max_tokens) or `error`.
        seconds: time of this answer, only where its request was alone (batch_size 1), else None:
            a batch's wall time is no answer's latency.
        batch_size: how many requests went through the engine together.
        error: the engine's message when finish_reason is `error`.
        label_mass: probability on the letters together, of a `readout`; None otherwise.
        retries: attempts that failed before this one; their time is in `seconds`.
        cached: it comes from the cache, so it has no seconds.
        slow_s: seconds that this answer is declared to take beyond its card's latency: a proxy's slow tail.
        first_token_s: time to first token (TTFT), prefill included; None where `seconds` is, or not known.
        token_s: time per output token (TPOT, see `per_token_s`); None where there is none after the first.
    """

    request_id: str
    text: str
    prompt_tokens: int | None
    completion_tokens: int | None
    finish_reason: FinishReason
    seconds: float | None
    batch_size: int
    error: str | None = None
    label_mass: float | None = None
    retries: int = 0
    cached: bool = False
    slow_s: float = 0.0
    first_token_s: float | None = None
    token_s: float | None = None


def per_token_s(seconds: float, first_token_s: float | None, tokens: int | None) -> float | None:
    """Time per output token (TPOT): seconds after the first token, for each token after it.

    (seconds - first_token_s) / (tokens - 1), as `vllm bench serve` has it. Tokens are those that the model
    chose: the fixed ones of a constrained answer are read, and their time is in that of the next one chosen.
    """
    if first_token_s is None or tokens is None or tokens < 2:
        return None
    return (seconds - first_token_s) / (tokens - 1)


class Backend(Protocol):
    """An engine that answers."""

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """One completion per request, in the same order. A failed request is a completion with an error."""
        ...

    def identity(self) -> dict[str, Any]:
        """What decides the answers, as JSON: engine, versions, weights, settings. It goes in the manifest."""
        ...


class Rendering(Backend, Protocol):
    """A backend of a language model, which can say what its model is sent."""

    def rendered(self, requests: Sequence[Request]) -> list[str]:
        """The prompt of each request as the model reads it; as a server is sent it, where that renders it.

        Raises:
            UserError: the chat template refuses the messages.
        """
        ...


def window(backend: Backend) -> int:
    """Requests that a backend has under way at most, if several threads may call `complete` at once.

    0 for one that takes one call after the other, which has no `window`.
    """
    return getattr(backend, "window", 0)


class Timed(Backend, Protocol):
    """A backend whose answers were timed before, so that they are not timed again."""

    def latency(self) -> "Latency":
        """What the decisions of the replayed run were made with."""
        ...
