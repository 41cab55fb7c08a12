"""`--tracker`: hooks that follow the runs of a command."""

from collections.abc import Sequence
from functools import partial

from harness.core.errors import UserError, printable
from harness.evaluate.command_options import CommandOption, Follow
from harness.extensions.interop import hooks


class Tracker(CommandOption):
    """Define the option `--tracker NAME`, repeatable: trackers that follow a command's runs.

    A tracker is a program that records experiments. `follow` takes the typed names, and a text that
    names what the command does in place of one run, if it does. It returns a function that makes
    the trackers follow a run; None if none are chosen. Raises UserError if trackers cannot follow
    the command.
    """

    kind = list[str]
    metavar = "NAME"
    follows = True
    help = (
        "Tracker that keeps the run as well; a wrong name lists those that are installed. "
        "Repeatable. Default: those in SWARMDRIVE_TRACKERS."
    )

    def follow(self, value: Sequence[str] | None, instead: str) -> Follow | None:
        if value and instead:
            raise UserError(
                f"--tracker {printable(value[0])}: {instead} are no run of one; leave it out"
            )
        chosen = hooks.chosen(value or ())
        return partial(hooks.following, chosen) if chosen else None


TRACKER = Tracker()
