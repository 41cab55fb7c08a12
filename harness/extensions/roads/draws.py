"""Draw fresh traffic by the seed of a layout: a run of SUMO, and the moment at which it begins.

SUMO runs until the traffic is there (`warm_up_s`); then the episode begins at one of the next
seconds, at a moment that `moments` could choose of a recording. In layouts of even seeds it is a
decisive one, and in those of odd seeds one that is not. Where a run has none, SUMO runs again from
another seed, `ATTEMPTS` times at most; then any moment will do.
"""

from dataclasses import dataclass

from harness.core import noise
from harness.core.errors import UserError
from harness.extensions.roads.moments import Chooser
from harness.extensions.roads.replay import AHEAD_S
from harness.extensions.roads.scene import Scene
from harness.extensions.roads.simulation import Inputs, map_of, run
from harness.extensions.roads.tables import Moment

ATTEMPTS = 8
MOST_SEED = 2**31 - 1  # of SUMO
# Greatest post-encroachment time of a conflict: SUMO's drivers give way, and come nearer seldom.
GAP_S = 3.0
LATEST_S = 10.0  # after the warm-up, until which an episode begins


@dataclass(frozen=True, eq=False)
class Drawn:
    """Hold the start of a layout: which run of SUMO it is, and what happens if nobody decides."""

    inputs: Inputs
    seed: int  # of SUMO
    scene: Scene
    moment: Moment


def drawn(
    inputs: Inputs, seed: int, warm_up_s: float, window_m: float, horizon_s: float, limit_s: float
) -> Drawn:
    """Draw the traffic and the ego of a layout seed.

    Args:
        inputs: net, routes and buildings.
        seed: the layout seed.
        warm_up_s: time from which on an episode may begin, s.
        window_m: radius around the ego in which a conflict counts, m.
        horizon_s: time within which it counts, s; the ego is there so long.
        limit_s: longest time of an episode, s.

    Raises UserError if there is no moment at which an episode could begin.
    """
    spare: Drawn | None = None
    for attempt in range(ATTEMPTS):
        of_sumo = int(noise.generator("sumo", seed, attempt).integers(MOST_SEED))
        tracks = run(inputs, of_sumo, warm_up_s, warm_up_s + LATEST_S + limit_s + AHEAD_S)
        net = map_of(inputs)
        scene = Scene(
            f"seed-{seed}",
            "net",
            f"{inputs.digest}-{of_sumo}",
            net.lights,
            tracks,
            net.lanes,
            net.houses,
        )
        chooser = Chooser(window_m, horizon_s, GAP_S, by_file=True)  # which the seed gives
        chooser.look(scene)
        moments = [m for m in chooser.moments if m.time_s <= warm_up_s + LATEST_S]
        wanted = [m for m in moments if (m.hidden is not None) == (seed % 2 == 0)]
        if wanted:
            return Drawn(inputs, of_sumo, scene, wanted[0])
        if moments and spare is None:
            spare = Drawn(inputs, of_sumo, scene, moments[0])
    if spare is None:
        raise UserError(
            f"layout {seed}: in {ATTEMPTS} runs of SUMO no vehicle drives {horizon_s:g} s long "
            f"where there is no traffic light, {warm_up_s:g} s after the start; let more set off "
            "in the routes, or set warm_up_s"
        )
    return spare
