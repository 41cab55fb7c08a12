"""What an agent's decisions cost it, had the others done exactly what they did.

An agent's courses are those of `joint`: its first `HORIZON` decisions are free, then it takes
`FASTER`. The others take the actions that they took, whatever it does: who would have reacted does
not, and who was hit by it drives on. So the times of the others stay, and a second that it loses is
one that all lose together. What it could have been is exact, but for other traffic, which brakes
for it and for nobody else.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from harness.core.arrays import Bools, Floats
from harness.extensions.joint_plans.joint import HORIZON, Options, near
from harness.world.outcome import ROUNDING_S


@dataclass(frozen=True)
class Regret:
    """Hold what the first decisions of a layout's agents cost; NaN where none could arrive.

    Agents are vehicles that decide for themselves. A cost is how much later (s) an agent can arrive
    at the soonest after its decisions than before, if all others do what they did. `best_decisions`
    is the share of decisions that cost nothing, `gave_away` the share of agents that by one of
    theirs lost every way to arrive, and `regret_s` the mean cost of all other agents, s.
    """

    best_decisions: float  # share of decisions after which an agent can arrive as soon as before
    # share of agents after one of whose decisions they could no longer arrive, but before it
    gave_away: float
    regret_s: float  # how much later the others arrive at the soonest after their decisions, mean


def regret(able: Mapping[int, Options], courses: Mapping[int, Options]) -> Regret:
    """Return what agents' decisions in a layout cost, against each one's best response to others.

    An agent is a vehicle that decides for itself, and a layout a start situation. Both arguments
    are by the agent's index among the layout's vehicles: `able` has all sequences of actions that
    it could have taken, `courses` the single one that it took. The others are held to what they
    did. A decision counts only while its agent can still reach its goal.
    """
    delays, spent_s = list[Floats](), list[float]()
    for agent, options in able.items():
        others = [course for other, course in courses.items() if other != agent]
        arrives_s = soonest_s(options, courses[agent], others)
        possible = int(np.isfinite(arrives_s).sum())
        if np.isfinite(arrives_s[0]):
            delays.append(np.diff(arrives_s[: possible + 1]))
            spent_s.append(arrives_s[-1] - arrives_s[0])
    if not delays:
        return Regret(np.nan, np.nan, np.nan)
    lost = np.isinf(spent_s)
    seconds = np.array(spent_s)[~lost]
    best = float(np.mean(np.concatenate(delays) <= ROUNDING_S))
    return Regret(best, float(lost.mean()), float(seconds.mean()) if len(seconds) else np.nan)


def soonest_s(able: Options, course: Options, others: Sequence[Options]) -> Floats:
    """Return when an agent can arrive at the soonest, s, before and after each of k decisions.

    An agent is a vehicle that decides for itself. The result has shape (k + 1,). Entry i assumes
    the agent's first i actual decisions; inf means never. `able` has its possible sequences of
    actions, `course` the one that it took, and `others` those that the other agents took, which are
    held fixed. k is at most `HORIZON`.
    """
    arrives_s = np.where(passes(able, others), able.arrives_s, np.inf)
    course_s = np.where(passes(course, others), course.arrives_s, np.inf)
    first = tuple(course.actions[0][:HORIZON])
    soonest = []
    for decisions in range(len(first) + 1):
        alike = [tuple(actions[:decisions]) == first[:decisions] for actions in able.actions]
        open_s = arrives_s[np.array(alike, dtype=bool)]
        soonest.append(open_s.min(initial=course_s[0]))
    return np.array(soonest)


def passes(able: Options, others: Sequence[Options]) -> Bools:
    """Return which of an agent's n options touch no other agent before it reaches its goal, (n,).

    An agent is a vehicle that decides for itself. An option is a sequence of actions. Each of
    `others` holds one: that which this other agent took.
    """
    frame = np.arange(1, able.poses.shape[1] + 1)
    under_way = frame <= np.minimum(able.arrives_s * able.hz, len(frame))[:, None] + 0.5
    free = np.ones(len(able.actions), dtype=bool)
    poses, size_m = able.poses[:, :, :1], able.sizes_m[:1]
    for other in others:
        free &= ~near(other.poses[:, :, :1], other.sizes_m[:1], poses, size_m, 0.0, under_way)
    return free
