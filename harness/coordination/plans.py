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
    """Hold what agents, vehicles that decide for themselves, say of their own motion.

    Arrays are of decisions of any shape `(...)`, each of one agent that hears H others. On an axis
    of length 1+H index 0 is that agent and 1+h is the other h. Every value is stated by its sender,
    so all who hear it compare the same numbers.
    """

    # index of the decision that each other agent makes itself now, among the decisions made
    # together, `(..., H)`; -1 where it makes none. H is 0 until it is known whom an agent hears.
    row: Ints
    # each agent's number among the vehicles of its world, `(..., 1+H)`; -1 for one without a plan
    vehicle: Ints
    # seconds until each is at the centroid of the conflict zone if it keeps its speed,
    # `(..., 1+H)`; inf for one that stands or has passed it, NaN without a plan
    reaches_s: Floats
    # seconds by which each is later than at the speed that it had in the beginning, `(..., 1+H)`,
    # at least 0; NaN without a plan
    lost_s: Floats

    def take(self, at: Any) -> "Plans":
        """Return what agents say of their motion in some decisions: those at `at`.

        `at` is an array of indices, or a mask, of the leading axis.
        """
        return Plans(self.row[at], self.vehicle[at], self.reaches_s[at], self.lost_s[at])

    def of_helpers(self, places: Ints) -> "Plans":
        """Return what agents say of their motion, with the senders reordered, chosen or repeated.

        `places`, `(..., H')`, says for each decision which of the H others here, by index from 0,
        stands at each of H' places. The agent's own plan stays first.
        """
        at = np.insert(places + 1, 0, 0, axis=-1)

        def of(array: Any) -> Any:
            return np.take_along_axis(array, at, axis=-1)

        row = np.take_along_axis(self.row, places, axis=-1)
        return Plans(row, of(self.vehicle), of(self.reaches_s), of(self.lost_s))

    def among(self, senders: Ints) -> "Plans":
        """Return what n agents hear of each other's motion, `(n, 1+H)`.

        This object has what each says of itself alone, `(n, 1)`. `senders`, `(n, H)`, has the row
        of each of the H others that an agent hears, among these n agents; -1 for one without a
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
