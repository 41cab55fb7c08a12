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

    `guard` returns the context in which evaluations share that budget; of None, one without a
    limit.
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
