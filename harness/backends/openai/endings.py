"""Read why a model stopped, which each server and provider says in a word of its own."""

from typing import Any, Literal

Ending = Literal["done", "cut", "filtered", "refused", "broken"]

# By the APIs of OpenAI, Mistral, Anthropic, Gemini, Cohere, Bedrock and DeepSeek, which gateways
# pass on, and those of vLLM and SGLang. A word that is not among them says that the model was done.
_WORDS: dict[Ending, tuple[str, ...]] = {
    "cut": (
        "length",
        "max_tokens",
        "max_output_tokens",
        "model_length",
        "model_context_window_exceeded",
    ),
    "filtered": (
        "content_filter",
        "content_filtered",
        "guardrail_intervened",
        "safety",
        "recitation",
        "blocklist",
        "prohibited_content",
        "spii",
        "error_toxic",
    ),
    "refused": ("refusal",),
    "broken": (
        "error",
        "abort",
        "aborted",
        "cancelled",
        "canceled",
        "user_cancel",
        "timeout",
        "error_limit",
        "insufficient_system_resource",
    ),
}
_ENDINGS = {word: ending for ending, words in _WORDS.items() for word in words}


def ending(finish_reason: Any) -> Ending:
    """Return what a server's `finish_reason` means, in one of five words.

    They are `done`, `cut` (by a token limit), `filtered`, `refused`, and `broken` (not finished by
    the server). An unknown reason counts as `done`.
    """
    return _ENDINGS.get(str(finish_reason).casefold().replace("-", "_"), "done")
