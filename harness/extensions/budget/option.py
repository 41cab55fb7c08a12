"""`--max-cost`: the most that the answers of one command may cost."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

from harness.evaluate.command_options import CommandOption, Guard

if TYPE_CHECKING:
    from harness.core.parallel import Workers
    from harness.evaluate.spec import Spec


class MaxCost(CommandOption):
    """Define the option `--max-cost AMOUNT`: a command asks no model once its answers cost so much.

    `guard` takes the amount, the evaluations and the number of processes, and returns the context
    in which these share the budget; if the amount is None, a context without a limit.
    """

    kind = float
    metavar = "AMOUNT"
    help = (
        "Ask no more once the answers of this command have cost so much, in the currency of the "
        "card's [price]. The same command goes on."
    )

    def guard(
        self, value: float | None, specs: "Sequence[Spec]", workers: "Workers"
    ) -> AbstractContextManager[Guard | None]:
        if value is None:
            return nullcontext()
        from harness.extensions.budget.limit import budget

        return budget(value, specs, workers)


MAX_COST = MaxCost()
