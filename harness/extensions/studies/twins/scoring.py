"""Whether what twins declare holds of a model's answers, with intervals, and gates on it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.core.arrays import Ints
from harness.core.errors import UserError, printable, unknown
from harness.core.figures import some_of
from harness.core.statistics import Estimate, rate_interval, units_of
from harness.extensions.studies.twins.declared import Twin
from harness.report.compare.gate import OPERATORS, Gate, Verdict

ROLES = ("ego", "helper", "fusion")
METRICS = ("invariance_rate", "tv_distance", "failed_rate")
SCALE = (0.0, 1.0)  # their least and greatest value
ROUNDING = 1e-9


@dataclass(frozen=True)
class Pair:
    """Hold the answers to a question and to its twin, the same question put another way.

    An answer is a distribution over A actions, (A,). The twin says how both must be related: the
    same likeliest action, or a total variation distance of at most so much.
    """

    twin: str  # name of the twin
    role: str  # `ego`, `helper`, or `fusion` for the ego's fusion call
    episode: int  # number of the episode
    scene: str  # id of the decision point
    viewer: str  # id of the vehicle that was asked
    # distribution of the question's answer over the actions; None where it failed
    p: tuple[float, ...] | None
    # the same of the twin's answer, with its actions named as the question names them
    q: tuple[float, ...] | None
    distance: float | None  # total variation distance of both, 0 to 1; None where one failed
    holds: bool  # whether both answers agree as the twin demands; false where one failed
    said: tuple[str, str]  # raw text of both answers
    status: tuple[str, str]  # parsing status of both answers
    messages: tuple[str, str]  # the text of both questions


@dataclass(frozen=True)
class Row:
    """Hold how often answers stay the same if a question is put another way, for one such change.

    The change is a twin, and a role who was asked. A pair has the answers to both versions, and
    holds if they are related as the twin demands, such as by the same likeliest action.
    """

    twin: Twin  # how the questions were changed
    role: str  # `ego`, `helper`, or `fusion`
    episodes: int  # how many episodes the pairs are of
    invariance_rate: Estimate  # share of pairs that hold; n is the pairs
    # mean total variation distance, 0 to 1; n is the pairs whose two answers were parsed
    tv_distance: Estimate
    failed_rate: Estimate  # share of pairs in which an answer failed
    # pairs that do not hold, the farthest apart first, those that failed last
    broken: tuple[Pair, ...]


def distance(p: Sequence[float] | None, q: Sequence[float] | None) -> float | None:
    """Return the total variation distance of two answers, 0 to 1; None if one is missing.

    An answer is a distribution over A actions, (A,): `p` to a question, and `q` to it put another
    way.
    """
    return float(np.abs(np.subtract(p, q)).sum() / 2) if p and q else None


def held(twin: Twin, p: Sequence[float] | None, q: Sequence[float] | None) -> bool:
    """Return whether two answers (A,) are related as a twin demands; false if one is missing.

    A twin is a question put another way. `p` is the answer to the question and `q` that to the
    twin, distributions over A actions; they must be within a total variation distance of each
    other, or have the same likeliest action.
    """
    if not p or not q:
        return False
    if twin.within is not None:
        return (distance(p, q) or 0.0) <= twin.within + ROUNDING
    return int(np.argmax(p)) == int(np.argmax(q))


def rows(
    pairs: Sequence[Pair],
    twins: Sequence[Twin],
    episodes: Sequence[int] = (),
    clusters: Ints | None = None,
) -> list[Row]:
    """Return the results of a study of twins: a row for each twin and role, in their order.

    A twin is a question put another way, a role is who was asked, and a pair has the answers to
    both versions. Twins without a pair have no row. Intervals are over episodes, or over the
    `clusters`, (E,), of the E `episodes` asked about, if they have some.
    """
    by_place: dict[tuple[str, str], list[Pair]] = {}  # by twin and role
    for pair in pairs:
        by_place.setdefault((pair.twin, pair.role), []).append(pair)
    rows = []
    for twin in twins:
        for role in ROLES:
            if (twin.name, role) in by_place:
                here = by_place[twin.name, role]
                numbers = np.array([pair.episode for pair in here])
                rows.append(_row(twin, role, here, units_of(numbers, episodes, clusters)))
    return rows


def _row(twin: Twin, role: str, pairs: Sequence[Pair], units: Ints) -> Row:
    episodes = {pair.episode for pair in pairs}
    apart = np.array([np.nan if pair.distance is None else pair.distance for pair in pairs])
    broken = [pair for pair in pairs if not pair.holds]
    broken.sort(key=lambda pair: -(pair.distance or 0.0))
    return Row(
        twin,
        role,
        len(episodes),
        rate_interval(np.array([float(pair.holds) for pair in pairs]), units),
        rate_interval(apart, units),  # a distance is from 0 to 1, too
        rate_interval(np.isnan(apart).astype(float), units),
        tuple(broken),
    )


def headline(table: Sequence[Row]) -> str:
    """Return a sentence on how many twins hold in every question, and which holds least often.

    A twin, a question put another way, holds if both answers are related as it demands.
    """
    whole = sum(not row.broken for row in table)
    least = min(table, key=lambda row: row.invariance_rate.value)
    if not least.broken:
        return f"All {len(table)} pairs of twin and role hold in every question."
    rate = least.invariance_rate
    share = f"{100 * rate.value:.1f} % [{100 * rate.low:.1f}, {100 * rate.high:.1f}], n = {rate.n}"
    text = f"{whole} of {len(table)} pairs of twin and role hold in every question."
    close = [row for row in table if row is not least and not row.invariance_rate.low > rate.high]
    if not close:
        return f"{text} Least often holds {least.twin.name}, {least.role}: {share}."
    names = [f"{row.twin.name}, {row.role}" for row in (least, *close)]
    return (
        f"{text} No pair clearly holds least often: it is {share}, and the intervals of these "
        f"overlap: {some_of([f'({name})' for name in names])}."
    )


def judge(gate: Gate, table: Sequence[Row]) -> Verdict:
    """Test a gate, a limit that the user typed with `--fail-if`, on a study of twins' results.

    A twin is a question put another way, and a row the result of one twin in one role (who was
    asked). The gate names a figure and a limit, and perhaps a twin; without one, all rows of
    `table` are tested. The verdict says whether the gate fails, and in which rows.

    Raises:
        UserError: the named twin has no row, or the number that is tested is unknown.
    """
    option = f"--fail-if {printable(gate.text)!r}"
    judged = [row for row in table if gate.condition in (None, row.twin.name)]
    if not judged:
        raise unknown(f"twin of {option}", gate.condition or "", {row.twin.name for row in table})
    places, failed = list[str](), []
    for row in judged:
        value = float(getattr(getattr(row, gate.metric), gate.end))
        where = f"{row.twin.name} {row.role}"
        places.append(where)
        if np.isnan(value):
            # A gate that passes because nothing is known would guard nothing.
            raise UserError(f"{option}: {where} has no such number; ask about more episodes")
        if OPERATORS[gate.op](round(value, 9), gate.number):
            failed.append((where, value))
    return Verdict(gate.text, tuple(places), tuple(failed))
