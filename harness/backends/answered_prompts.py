"""What a model card says of the prompts that its model was seen to answer."""

from collections.abc import Sequence
from dataclasses import dataclass

from harness.core.config import Count


@dataclass(frozen=True)
class Readable:
    """Hold how many of a model's answers to a prompt could be read, as a model card states it.

    Of `asked` fixed questions by the prompt `version`, `read` answers say what to do.
    """

    version: str  # the prompt version
    read: Count  # answers that say what to do
    asked: Count  # fixed questions, in all roles

    def __post_init__(self) -> None:
        if self.read > self.asked:
            raise ValueError(f"read {self.read} of {self.asked} asked; give as many at most")


def prompt_for(usual: str, prompts: Sequence[Readable]) -> str:
    """Return the prompt version to take where none is typed: `usual`, unless a card knows better.

    `prompts` are those that a model was seen to answer, by its card; the first is taken where the
    usual one is not among them.
    """
    versions = [prompt.version for prompt in prompts] or [usual]
    return usual if usual in versions else versions[0]
