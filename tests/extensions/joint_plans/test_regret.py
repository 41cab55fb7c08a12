"""What an agent's decisions cost it, had the others done exactly what they did."""

import numpy as np
import pytest

from harness.extensions.joint_plans import joint
from harness.extensions.joint_plans.joint import Options
from harness.extensions.joint_plans.regret import Regret, regret, soonest_s
from harness.world import reference, scenarios
from harness.world.world import World

TWO = "all-way-crossing:agent_share=1"
FAR, AWAY, HERE = (100.0, 0.0, 0.0), (-100.0, 0.0, 0.0), (0.0, 0.0, 0.0)


def option(actions: str, arrives_s: float, *places: tuple[float, float, float]) -> Options:
    """Return an agent's only option: a letter for each action,
    and where it is in each of four seconds.
    """
    return Options(
        [tuple(actions)], np.array([arrives_s]), np.array(places)[None, :, None], np.ones((1, 2)), 1
    )


def able(*options: Options) -> Options:
    """Return an agent that has these options."""
    actions = [each.actions[0] for each in options]
    arrives_s, poses = (
        np.concatenate([getattr(each, k) for each in options]) for k in ("arrives_s", "poses")
    )
    return Options(actions, arrives_s, poses, options[0].sizes_m, 1)


# The other agent is in the crossing in the second second, and arrives in the third.
OTHER = option("FF", 3.0, AWAY, HERE, AWAY, AWAY)
RUSH = option("FF", 2.0, FAR, HERE, FAR, FAR)  # meets it
WAIT = option("SF", 3.0, FAR, FAR, HERE, FAR)
WAIT_LONG = option("SS", 4.0, FAR, FAR, FAR, HERE)
DETOUR = option("FS", 3.5, FAR, FAR, FAR, HERE)


def test_regret_by_hand() -> None:
    own = able(RUSH, WAIT, DETOUR, WAIT_LONG)
    assert soonest_s(own, WAIT, [OTHER]).tolist() == [3.0, 3.0, 3.0]
    assert soonest_s(own, WAIT_LONG, [OTHER]).tolist() == [3.0, 3.0, 4.0]
    assert soonest_s(own, RUSH, [OTHER]).tolist() == [3.0, 3.5, np.inf]
    assert soonest_s(own, WAIT, []).tolist() == [2.0, 3.0, 3.0], "alone it would not have to wait"

    def of_both(course: Options) -> Regret:
        return regret({0: own, 1: able(OTHER)}, {0: course, 1: OTHER})

    assert of_both(WAIT) == Regret(best_decisions=1.0, gave_away=0.0, regret_s=0.0)
    assert of_both(WAIT_LONG) == Regret(
        best_decisions=3 / 4, gave_away=0.0, regret_s=(1.0 + 0.0) / 2
    )
    # Who rushes could have waited: its first decision cost half a second, its second the arrival.
    # The other could do nothing, so it is not judged.
    rushed = of_both(RUSH)
    assert (rushed.best_decisions, rushed.gave_away) == (0.0, 1.0)
    assert np.isnan(rushed.regret_s)


def test_how_an_agent_went_on_after_its_first_decisions_is_one_of_its_options() -> None:
    careful = option("FFFFFS", 4.0, FAR, FAR, FAR, HERE)
    rash = option("FFFFFF", 2.0, FAR, HERE, FAR, FAR)
    assert soonest_s(able(rash), careful, [OTHER]).tolist() == [4.0] * 6


@pytest.mark.exhaustive
def test_the_soonest_arrival_is_that_of_all_that_the_simulator_tries() -> None:
    scenario, seed = scenarios.get(TWO), 3
    [taken] = reference.turns([World.start(scenario, seed)], ["first-come"])
    able = joint.options(scenario, [seed])
    [courses] = joint.courses(scenario, able, [(seed, taken)])
    [agent, other] = able[seed]
    tries = [World.start(scenario, seed) for _ in able[seed][agent].actions]
    while going := [n for n, world in enumerate(tries) if not world.journeys[agent].outcome.ended]:
        step = tries[going[0]].step
        actions = [
            {place: of[step] for place, of in each.items() if step < len(of)}
            for each in ({agent: able[seed][agent].actions[n], other: taken[other]} for n in going)
        ]
        reference.take_turn([tries[n] for n in going], actions)
    ends = [world.journeys[agent].outcome for world in tries]
    soonest = soonest_s(able[seed][agent], courses[agent], [courses[other]])
    assert soonest[0] == min(end.time_s for end in ends if end.success and end.time_s)
    assert (np.diff(soonest) >= 0).all()
