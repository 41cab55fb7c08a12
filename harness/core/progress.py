"""How far work is, for whoever watches."""


class Progress:
    """Receive counts of work that is done and still to do; this base class shows nothing.

    Subclasses show a bar. It is called with the number of things just done.
    """

    def __call__(self, done: int) -> None:
        """Add to what is done."""

    def more(self, count: int) -> None:
        """Add `count` to the number of things that there are to do."""

    def say(self, text: str) -> None:
        """Show a line of text beside the counts, as above a bar."""
