"""How far work is, for whoever watches."""


class Progress:
    """Counts what is done, and what is still to do; this one shows nothing."""

    def __call__(self, done: int) -> None:
        """Add to what is done."""

    def more(self, count: int) -> None:
        """Add to what there is to do."""

    def say(self, text: str) -> None:
        """Write a line."""
