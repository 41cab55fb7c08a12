"""Define `Plans`: what agents say about themselves beside the intents that they are going to act
by.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.core.arrays import Floats, Ints

STANDING_MPS = 1.0  # a slower vehicle stands, or is about to


@dataclass(frozen=True)
class Plans:
    """Hold what an agent and the H others say of their own motion, `(..., 1+H)`, the agent first.

    Agents are vehicles that decide for themselves. Every value is stated by its sender, so all who
    hear it compare the same numbers.
    """

    # the row of the decision that each other makes itself now, among those made together, `(...,
    # H)`; -1 where it makes none. H is 0 until it is known whom an agent hears
    row: Ints
    vehicle: Ints  # the vehicle's number in its world; -1 for one without a plan
    # seconds until it is at the centroid of the conflict zone at its speed; inf for one that
    # stands, or has passed it. NaN without a plan
    reaches_s: Floats
    # how much later it is than at the speed that it had in the beginning, at least 0; NaN without a
    # plan
    lost_s: Floats

    def take(self, at: Any) -> "Plans":
        """Return the plans of the decisions at indices `at` of the leading dimension."""
        return Plans(self.row[at], self.vehicle[at], self.reaches_s[at], self.lost_s[at])

    def of_helpers(self, places: Ints) -> "Plans":
        """Return the plans with the others at indices `places`, `(..., H')`, from 0.

        The agent's own stays first. An index may be repeated.
        """
        at = np.insert(places + 1, 0, 0, axis=-1)

        def of(array: Any) -> Any:
            return np.take_along_axis(array, at, axis=-1)

        row = np.take_along_axis(self.row, places, axis=-1)
        return Plans(row, of(self.vehicle), of(self.reaches_s), of(self.lost_s))

    def among(self, senders: Ints) -> "Plans":
        """Return the plans `(n, 1+H)` that n agents hear, from their own, `(n, 1)`.

        `senders`, `(n, H)`, has the row of each sender among these agents, -1 for one without a
        plan.
        """

        def heard(values: Any, unknown: float) -> Any:
            return np.concatenate(
                [values, np.where(senders >= 0, values[senders, 0], unknown)], axis=1
            )

        return Plans(
            senders,
            heard(self.vehicle, -1),
            heard(self.reaches_s, np.nan),
            heard(self.lost_s, np.nan),
        )
