"""Measure conflicts of the ego with other vehicles in time:
time to collision and post-encroachment time.

*Time to collision* (TTC) is "the time required for two vehicles to collide if they continue at
their present speeds and on the same path" (Hayward 1972, Near-miss determination through use of a
scale of danger, Highway Research Record 384, 24-34). Here both go straight on from their pose in a
frame, at their speed: it is the time until their outlines touch, for crossing paths too, and
missing where they do not within `HORIZON_S`.

*Post-encroachment time* (PET; Allen, Shin and Cooper 1978, Analysis of traffic conflicts and
collisions, Transportation Research Record 667) is "the time between when the first vehicle last
occupied a position and the second vehicle subsequently arrived at the same position"
(FHWA-HRT-08-051, SSAM, chapter 2). Over all positions its least value is the least time between a
moment of one vehicle and a later one of the other in which their outlines overlap. So it is of what
was driven, and nothing is predicted; it is missing where the second does not arrive within
`HORIZON_S`.

Of both, the least counts, over all other vehicles and over ten moments a second, the step of the
trajectories that SSAM is used with (FHWA-HRT-10-038, section 3). A collision has 0. Numbers depend
neither on which worlds are measured together, nor on how an episode's frames are divided among
calls.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from harness.core.arrays import Bools, Floats, Ints
from harness.world.state import separation_m

# SSAM's default for the greatest PET of a conflict (FHWA-HRT-08-051); it also bounds what a TTC
# predicts.
HORIZON_S = 5.0
SHORT_TTC_S = 1.5  # SSAM's default for the greatest TTC of a conflict
# Below it an encroachment is critical by Peesapati and others 2018, as Westhofen and others list it
# in Criticality Metrics for Automated Driving, https://criticality-metrics.readthedocs.io.
SHORT_PET_S = 1.5
MOMENTS_HZ = 10
DECIMALS = 3  # decimals of both, s


@dataclass(frozen=True, eq=False)
class Conflicts:
    """Hold how near in time others came to an agent since a decision, and where all have been.

    An agent is a vehicle that decides for itself. Of V vehicles it is the first, and index v of an
    axis of length V is vehicle v. `observe` makes the next of these from one and the frames that
    follow.
    """

    # least time to collision, s: until two outlines touch if both vehicles drive straight on; inf
    # if nobody came near
    ttc_s: float = np.inf
    # least post-encroachment time, s: from when one vehicle leaves a place to when another arrives;
    # inf if nobody came near
    pet_s: float = np.inf
    # x and y, m, and heading, rad, of each vehicle at the last T moments at which all were
    # measured, oldest first, (T, V, 3)
    trail: Floats = field(default_factory=lambda: np.empty((0, 0, 3)))
    # bounds of the area that each vehicle's outline has covered so far, m, (4, V): rows are the
    # least x, the least y, and the negatives of the greatest x and the greatest y
    box: Floats = field(default_factory=lambda: np.empty((4, 0)))

    def anew(self) -> "Conflicts":
        """Return a copy that measures from now on: both times are inf, past poses are kept.

        It is for the next decision of the vehicle.
        """
        return replace(self, ttc_s=np.inf, pet_s=np.inf)

    def collided(self) -> "Conflicts":
        return replace(self, ttc_s=0.0, pet_s=0.0)

    def recast(self, places: Sequence[int]) -> "Conflicts":
        """Return a copy for another list of vehicles, as when one has come or gone.

        `places` has, for each vehicle of the new list, its index from 0 in the old one, -1 for one
        that was not in it. What is kept of a vehicle that has left is dropped.
        """
        at = np.array(places)
        trail = (
            np.where((at < 0)[:, None], np.nan, self.trail[:, at])
            if self.trail.size
            else self.trail
        )
        box = np.where(at < 0, np.inf, self.box[:, at]) if self.box.size else self.box
        return replace(self, trail=trail, box=box)


def rounded(measure_s: float) -> float | None:
    """Return a time to collision or post-encroachment time, s, rounded for a file.

    None if `measure_s` is not finite: nothing was near.
    """
    return round(measure_s, DECIMALS) if np.isfinite(measure_s) else None


def columns(ttc_s: Floats, pet_s: Floats) -> dict[str, Floats]:
    """Return the conflict times of n decisions as columns of a table, and whether each is short.

    The columns, each (n,), are by name `ttc_s` (time to collision, s), `pet_s` (post-encroachment
    time, s), `short_ttc` and `short_pet`. The first two are NaN where no vehicle came near. The
    `short_` ones are 1 below `SHORT_TTC_S` and `SHORT_PET_S`, else 0. The arguments, (n,), are inf
    where no vehicle came near in time, and NaN where nothing was measured; then all four are NaN.
    """
    ttc_s, pet_s = ttc_s.round(DECIMALS), pet_s.round(DECIMALS)
    return {
        "ttc_s": np.where(np.isfinite(ttc_s), ttc_s, np.nan),
        "pet_s": np.where(np.isfinite(pet_s), pet_s, np.nan),
        "short_ttc": np.where(np.isnan(ttc_s), np.nan, ttc_s < SHORT_TTC_S),
        "short_pet": np.where(np.isnan(pet_s), np.nan, pet_s < SHORT_PET_S),
    }


def observe(
    before: Sequence[Conflicts], poses: Floats, sizes_m: Floats, first_frame: Ints, hz: int
) -> list[Conflicts]:
    """Return the conflict times of each of W simulated episodes, after F more frames.

    Args:
        before: what is known of each episode until then, W of them, from the last call or
            `Conflicts()`.
        poses: x and y (m), heading (rad) and speed (m/s) of V vehicles in each frame, (W, F, V, 4),
            first the agent, the vehicle that decides; NaN where there is no vehicle.
        sizes_m: length and width of each vehicle, m, (W, V, 2).
        first_frame: number of each episode's first frame here, counted from its start, (W,).
        hz: frames a second.
    """
    every = max(1, round(hz / MOMENTS_HZ))
    numbers = first_frame[:, None] + np.arange(poses.shape[1])
    moments = (numbers % every == 0) & ~np.isnan(poses[:, :, 0, 0])
    seen = np.flatnonzero(moments.any(axis=1))
    after = list(before)
    if seen.size:
        measured = _measured(
            [before[n] for n in seen.tolist()],
            poses[seen],
            sizes_m[seen],
            moments[seen],
            every / hz,
        )
        for n, conflicts in zip(seen.tolist(), measured, strict=True):
            after[n] = conflicts
    return after


def _measured(
    before: Sequence[Conflicts], poses: Floats, sizes_m: Floats, moments: Bools, step_s: float
) -> list[Conflicts]:
    """Return the conflicts of each world after some moments, (W, frames),
    which are `step_s` apart.
    """
    counts, rows = np.count_nonzero(moments, axis=1), poses[moments]
    worlds = np.repeat(np.arange(len(before)), counts)
    x, y, heading, speed = (np.ascontiguousarray(rows[..., k]) for k in range(4))
    cos, sin = np.cos(heading), np.sin(heading)
    ttc_s = np.array([each.ttc_s for each in before])
    _lower_ttc(ttc_s, worlds, rows, sizes_m, (x, y, speed * cos, speed * sin))
    boxes = _boxes(x, y, np.abs(cos), np.abs(sin), sizes_m[worlds])
    starts = np.cumsum(counts) - counts
    arrived = np.fmin.reduceat(boxes, starts, axis=1)
    so_far = np.full_like(arrived, np.inf)
    for world, each in enumerate(before):
        so_far[:, world, : each.box.shape[1]] = each.box
    so_far = np.fmin(so_far, arrived)
    # moments within it: at 15 Hz they are 133 ms apart
    most = math.floor(HORIZON_S / step_s + 1e-9)
    lag = np.array([round(min(each.pet_s / step_s, most + 1)) for each in before])
    _lower_lag(
        lag, [each.trail for each in before], rows, counts, sizes_m, (boxes, arrived, so_far)
    )
    pets_s = np.where(lag <= most, lag * step_s, np.inf).tolist()
    vehicles = np.count_nonzero(~np.isnan(x[starts]), axis=1).tolist()
    ends = zip(
        before, starts.tolist(), counts.tolist(), vehicles, ttc_s.tolist(), pets_s, strict=True
    )
    after = []
    for world, (each, start, count, v, ttc, pet) in enumerate(ends):
        new = rows[start : start + count, :v, :3]
        trail = np.concatenate([each.trail, new]) if each.trail.size else new
        after.append(Conflicts(ttc, pet, trail[-most:], so_far[:, world, :v]))
    return after


def times_to_collision(
    poses: Floats, sizes_m: Floats, others: Floats, their_sizes_m: Floats
) -> Floats:
    """Return the time to collision of n pairs of vehicles that drive straight on, (n,) s.

    It is inf for never. `poses` and `others` are x and y (m), heading (rad) and speed (m/s) of the
    one and the other of each pair, (n, 4); `sizes_m` and `their_sizes_m` are their lengths and
    widths, m, (n, 2). Vehicles are rectangles, which touch when their extents overlap along all
    four of their axes.
    """
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    its_cos, its_sin = np.cos(others[:, 2]), np.sin(others[:, 2])
    speed, its_speed = poses[:, 3], others[:, 3]
    dx, dy = (others - poses)[:, :2].T
    vx, vy = its_speed * its_cos - speed * cos, its_speed * its_sin - speed * sin
    dot, cross = np.abs(cos * its_cos + sin * its_sin), np.abs(cos * its_sin - sin * its_cos)
    enter, leave = np.full(len(poses), -np.inf), np.full(len(poses), np.inf)
    # where none moves along an axis
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        for c, s, (length, width), (its_length, its_width) in (
            (cos, sin, sizes_m.T, their_sizes_m.T),
            (its_cos, its_sin, their_sizes_m.T, sizes_m.T),
        ):
            for ux, uy, reach in (
                (c, s, (length + its_length * dot + its_width * cross) / 2),
                (-s, c, (width + its_length * cross + its_width * dot) / 2),
            ):
                apart, rate = dx * ux + dy * uy, vx * ux + vy * uy
                begins, ends = (-reach - apart) / rate, (reach - apart) / rate
                enter = np.maximum(enter, np.fmin(begins, ends))
                leave = np.minimum(leave, np.fmax(begins, ends))
    return np.where((enter < leave) & (leave >= 0), np.maximum(enter, 0.0), np.inf)


def _lower_ttc(
    ttc_s: Floats, worlds: Ints, poses: Floats, sizes_m: Floats, motion: Sequence[Floats]
) -> None:
    """Lower the least time to collision of each world, (W,), by that in frames, (N,), of `worlds`.

    `poses` are (N, vehicles, 4), and `motion` positions and velocities in x and y,
    each (N, vehicles).
    """
    dx, dy, vx, vy = (v[:, 1:] - v[:, :1] for v in motion)
    reach = np.hypot(*np.moveaxis(sizes_m, -1, 0)) / 2
    reach = (reach[:, :1] + reach[:, 1:])[worlds]
    # The circles around two outlines come no nearer than their ways lead past each other.
    squared, past, apart = vx * vx + vy * vy, dx * vy - dy * vx, dx * dx + dy * dy
    may = past * past <= reach * reach * squared
    may &= (dx * vx + dy * vy < 0) | (apart <= reach * reach)
    may &= apart <= (reach + np.minimum(ttc_s, HORIZON_S)[worlds, None] * np.sqrt(squared)) ** 2
    rows, others = np.nonzero(may)
    world_of_row, others = worlds[rows], others + 1
    times_s = times_to_collision(
        poses[rows, 0], sizes_m[world_of_row, 0], poses[rows, others], sizes_m[world_of_row, others]
    )
    within = times_s <= HORIZON_S
    np.minimum.at(ttc_s, world_of_row[within], times_s[within])


def _boxes(x: Floats, y: Floats, cos: Floats, sin: Floats, sizes_m: Floats) -> Floats:
    """Return boxes around outlines (N, vehicles):
    least x and y, negative greatest, (4, N, vehicles).
    """
    half, across = sizes_m[..., 0] / 2, sizes_m[..., 1] / 2
    east, south = half * cos + across * sin, half * sin + across * cos
    return np.stack([x - east, y - south, -x - east, -y - south])


def _meet(box: Floats, other: Floats) -> Bools:
    """Return whether boxes (4, ...) overlap."""
    return np.asarray((box + other[[2, 3, 0, 1]] <= 0).all(axis=0))


def _lower_lag(
    lag: Ints,
    trails: Sequence[Floats],
    rows: Floats,
    counts: Ints,
    sizes_m: Floats,
    boxes: Sequence[Floats],
) -> None:
    """Lower the least post-encroachment time of each world, (W,) in moments,
    by arrivals in its moments.

    Each world has so many moments, (W,), whose poses follow each other in `rows`, (N, vehicles, 4).
    `boxes` are around each outline (4, N, vehicles), around all of these in each world, and around
    all since its start, (4, W, vehicles).
    """
    outlines, arrived, so_far = boxes
    most, starts = int(lag.max()), np.cumsum(counts) - counts
    ego_first = _meet(so_far[..., :1], arrived[..., 1:])
    ego_second = _meet(so_far[..., 1:], arrived[..., :1])
    worlds, others, order = np.nonzero(np.stack([ego_first, ego_second], axis=-1))
    if not worlds.size:
        return
    first, second = np.where(order, 1 + others, 0), np.where(order, 0, 1 + others)
    # where the first was, (K, most + moments, 3)
    passed = np.full((len(worlds), most + int(counts.max()), 3), np.nan)
    for pair, (world, vehicle) in enumerate(zip(worlds.tolist(), first.tolist(), strict=True)):
        if trails[world].size and most:
            trail = trails[world][-most:, vehicle]
            passed[pair, most - len(trail) : most] = trail
        start, count = starts[world], counts[world]
        passed[pair, most : most + count] = rows[start : start + count, vehicle, :3]
    size, its_size = sizes_m[worlds, first], sizes_m[worlds, second]
    # No corner moves farther from moment to moment than the centre and the turn take it.
    moves = np.abs(np.diff(passed, axis=1))
    step_m = np.hypot(moves[..., 0], moves[..., 1]) + np.hypot(*size.T)[:, None] / 2 * moves[..., 2]
    step_m = np.fmax.reduce(step_m, axis=1, initial=1e-9)
    pairs = np.repeat(np.arange(len(worlds)), counts[worlds])
    moment = np.arange(len(pairs)) - np.repeat(
        np.cumsum(counts[worlds]) - counts[worlds], counts[worlds]
    )
    row = starts[worlds[pairs]] + moment
    where = _meet(so_far[:, worlds[pairs], first[pairs]], outlines[:, row, second[pairs]])
    pairs, moment, row = pairs[where], moment[where], row[where]
    behind = np.zeros(len(pairs), dtype=int)
    while pairs.size:
        before = passed[pairs, most + moment - behind]
        apart_m = separation_m(before, size[pairs], rows[row, second[pairs], :3], its_size[pairs])
        np.minimum.at(lag, worlds[pairs[apart_m <= 0]], behind[apart_m <= 0])
        # Nothing nearer in time than it takes to come this far can overlap.
        behind += np.fmax(1.0, apart_m // step_m[pairs]).clip(1, passed.shape[1]).astype(int)
        is_open = (apart_m > 0) & (behind < lag[worlds[pairs]])
        pairs, moment, row, behind = pairs[is_open], moment[is_open], row[is_open], behind[is_open]
