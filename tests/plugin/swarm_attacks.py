"""An attack that a package adds to the extension of attacks."""

from dataclasses import dataclass

from harness.extend import Attack, Intents, Turn


@dataclass(frozen=True)
class Mumble(Attack):
    """Is half as sure as it is: the mean of its intent and of all actions alike."""

    def act(self, said: Intents, turn: Turn) -> Intents:
        """From what attacks before it have made of the truth."""
        return self.intend(said, turn, (said.helpers + 1 / said.helpers.shape[-1]) / 2)


MUMBLE = Mumble()
