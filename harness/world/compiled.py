"""The frame of many worlds of `lockstep`, compiled by numba: the same numbers to the last bit, in less time.

A frame is a few loops over vehicles, and between them NumPy's functions of whole arrays. Loops have only what
IEEE 754 fixes to the last bit: + - * /, square roots, remainders and comparisons. numba neither reorders nor
fuses them, as long as nobody asks for `fastmath`. Everything else stays with NumPy, since its last bit varies
with the machine: with AVX-512, NumPy's arcsin, tan, arctan and arctan2 are its own and not libm's, and its
`vecdot` is OpenBLAS's, which fuses the product into the sum on some processors and not on others.

Two vehicles that touch are left to `Fleet`. Importing this module compiles it, or loads it from numba's
cache.
"""

from collections.abc import Callable, Sequence
from math import pi, sqrt
from typing import Any, TypeVar

import numpy as np
from highway_env.road.lane import AbstractLane
from highway_env.vehicle.controller import ControlledVehicle
from numba import boolean, float64, int64, njit, void

from harness.core.arrays import Bools, Floats, Ints
from harness.world.lockstep import SLOW_MPS, Fleet, Lanes
from harness.world.simulator import BRAKES_OFF_HZ, LAMPS_MPS2, NEAR_M, Traffic
from harness.world.world import World

# Types of arguments, by their dimensions. Other modules' constants are arguments as well: numba's cache keeps
# what it compiled until this file changes.
F, F1, F2, F3 = float64, float64[::1], float64[:, ::1], float64[:, :, ::1]
I1, I2, B1, B2 = int64[::1], int64[:, ::1], boolean[::1], boolean[:, ::1]
Loop = TypeVar("Loop", bound=Callable[..., Any])


def _loop(*types: Any, result: Any = void) -> Callable[[Loop], Loop]:
    """Compile a function for arguments of these types, or load it."""
    compiled: Callable[[Loop], Loop] = njit(result(*types), cache=True, error_model="numpy")
    return compiled


_inner: Callable[[Loop], Loop] = njit(error_model="numpy")  # compiled into the loops that call it


class CompiledFleet(Fleet):
    """A fleet whose frames are compiled; what it holds, and every number, is that of `Fleet`.

    It also holds the direction `way` in which each vehicle last moved, rad, with its cosine and sine, and the
    lanes that the ego may change between, `ego_lanes`, (B, L).
    """

    def __init__(self, lanes: Lanes, worlds: Sequence[World]) -> None:
        super().__init__(lanes, worlds)
        self.way, self.cos, self.sin = (np.full_like(self.speed, np.nan) for _ in range(3))
        self.ego_lanes = np.tile(self.ways, (len(worlds), 1))

    def _act(self) -> None:
        car, speed = ControlledVehicle, self.speed
        xy, lane, section = self.xy.reshape(-1, 2), self.lane.reshape(-1), self.section.reshape(-1)
        route, speeds = self.route.reshape(len(lane), -1), speed.reshape(-1)
        ahead, turn, on = self._turn(xy, lane, section, route, speeds)
        if on.size:  # in copies: whoever is on its next lane now does not go on to the one after it
            ahead[on], turn[on], _ = self._turn(xy[on], lane[on], section[on], route[on], speeds[on])
        turn, slip = np.arcsin(turn).reshape(speed.shape), np.empty_like(speed)
        _set_slip(
            ahead.reshape(speed.shape), turn, self.heading, speed, self.size, SLOW_MPS, car.KP_HEADING, slip
        )
        self.steering = np.arctan(2 * np.tan(np.arcsin(slip)))
        self.acceleration = np.zeros_like(speed)
        self._keep_apart()
        _set_controls(
            self.frame, self.target, speed, self.crashed, self.brakes_at, self.brakes_mps2, self.brakes_to,
            self.scenario.parameters.simulation_hz, BRAKES_OFF_HZ, LAMPS_MPS2, car.KP_A, self.limits[0],
            self.limits[1], car.MAX_SPEED, car.MIN_SPEED, self.most_steering,
            self.steering, self.acceleration, self.braking,
        )  # fmt: skip

    def _turn(
        self, xy: Floats, lane: Ints, section: Ints, route: Ints, speed: Floats
    ) -> tuple[Floats, Floats, Ints]:
        """Return where vehicles' lanes (N,) head for, sines of turns, and who is on its next lane now."""
        lanes, car = self.lanes, ControlledVehicle
        dots, angle = self._dots(xy, lane)
        ahead, turn, on = np.empty_like(speed), np.empty_like(speed), np.empty_like(lane)
        count = _set_turn(
            dots, angle, speed, route, lanes.arc, lanes.radius, lanes.phase, lanes.sign, lanes.heading,
            lanes.length, AbstractLane.VEHICLE_LENGTH / 2, car.TAU_PURSUIT, -car.KP_LATERAL, SLOW_MPS,
            lane, section, ahead, turn, on,
        )  # fmt: skip
        return ahead, turn, on[:count]

    def _dots(self, xy: Floats, lane: Ints) -> tuple[Floats, Floats]:
        """Return what `_place` needs of points (N, 2) in lanes (N,): products (2, N), and angles on arcs."""
        lanes, away, ways, arcs = self.lanes, np.empty_like(xy), np.empty((2, *xy.shape)), np.empty_like(xy)
        count = _set_away(xy, lane, lanes.base, lanes.along, lanes.across, lanes.arc, away, ways, arcs)
        return np.vecdot(away, ways), np.arctan2(arcs[:count, 1], arcs[:count, 0])

    def _keep_apart(self) -> None:
        """Set the acceleration of vehicles that have to brake for another in their lane."""
        most, speed = self.speed.size * (self.speed.shape[1] - 1), self.speed
        pairs, away, heading = np.empty((most, 3), dtype=int), np.empty((most, 2)), np.empty(most)
        count = _list_faster(self.lane_now, speed, self.xy, self.heading, pairs, away, heading)
        if count:
            ways = np.stack([np.cos(heading[:count]), np.sin(heading[:count])], axis=-1)
            ahead = np.vecdot(away[:count], ways)
            gap_m, braking_mps2 = Traffic.standoff_m, Traffic.braking_mps2
            _set_brakes(ahead, pairs, speed, self.size, gap_m, braking_mps2, self.acceleration)

    def _move(self) -> None:
        slip = np.arctan(1 / 2 * np.tan(self.steering))
        sin_slip, way = slip.copy(), self.heading + slip
        np.sin(slip, out=sin_slip, where=slip != 0)  # most drive straight on
        turned = way != self.way
        np.cos(way, out=self.cos, where=turned)
        np.sin(way, out=self.sin, where=turned)
        self.way = way
        _set_motion(
            self.cos, self.sin, sin_slip, self.acceleration, self.impact, self.size, self.lane, self.there,
            self.dt, self.xy, self.heading, self.speed, self.pushed, self.crashed, self.lane_now,
        )  # fmt: skip

    def _place_ego(self) -> Bools:
        lanes, ways = self.lanes, self.ego_lanes if self.ways.size else self.lane_now[:, :1].copy()
        dots, angle = self._dots(np.repeat(self.xy[:, 0], ways.shape[1], axis=0), ways.reshape(-1))
        on_road = np.empty(len(ways), dtype=bool)
        _set_ego_lane(
            dots, angle, ways, lanes.arc, lanes.radius, lanes.phase, lanes.sign, lanes.length, lanes.width,
            AbstractLane.VEHICLE_LENGTH, self.lane_now, on_road,
        )  # fmt: skip
        return on_road

    def _near(self) -> Ints:
        most, speed = self.speed.size * (self.speed.shape[1] - 1) // 2, self.speed
        pairs, headings = np.empty((most, 3), dtype=int), np.empty((most, 2))
        count = _list_near(
            self.xy, self.heading, speed, self.reach, self.there, self.dt, NEAR_M, pairs, headings
        )
        if count:
            cos, sin = np.cos(headings[:count]), np.sin(headings[:count])
            count = _keep_near(cos, sin, self.xy, speed, self.size, self.dt, NEAR_M, pairs)
        return pairs[:count]


@_inner
def _turned(angle: float) -> float:
    """Wrap an angle to -pi to pi."""
    rest = angle + pi
    if not 0 <= rest < 2 * pi:  # else it is its own remainder
        rest %= 2 * pi
    return rest - pi


@_inner
def _not_zero(speed: float, least: float) -> float:
    return speed if abs(speed) > least else least if speed >= 0 else -least


@_inner
def _within(limit: float, value: float) -> float:
    return -limit if value < -limit else limit if value > limit else value


@_loop(F2, I1, F2, F2, F2, B1, F2, F3, F2, result=int64)
def _set_away(
    xy: Floats, lane: Ints, base: Floats, along: Floats, across: Floats, arc: Bools,
    away: Floats, ways: Floats, arcs: Floats,
) -> int:  # fmt: skip
    """Set vectors from where lanes begin, and those to multiply them by; list and count those on arcs."""
    count = 0
    for i in range(len(lane)):
        k = lane[i]
        for c in range(2):
            away[i, c] = arcs[count, c] = xy[i, c] - base[k, c]
            ways[0, i, c] = away[i, c] if arc[k] else along[k, c]
            ways[1, i, c] = across[k, c]
        count += arc[k]
    return count


@_inner
def _place(
    dots: Floats, i: int, angle: Floats, n: int, arc: bool, radius: float, phase: float, sign: float
) -> tuple[float, float]:
    """Return the position of point `i` along and to the right of a lane; on an arc it has angle `n`."""
    if not arc:
        return dots[0, i], dots[1, i]
    phi = phase + _turned(angle[n] - phase)
    return sign * (phi - phase) * radius, sign * (radius - sqrt(dots[0, i]))


@_loop(F2, F1, F1, I2, B1, F1, F1, F1, F1, F1, F, F, F, F, I1, I1, F1, F1, I1, result=int64)
def _set_turn(
    dots: Floats, angle: Floats, speed: Floats, route: Ints, arc: Bools, radius: Floats, phase: Floats,
    sign: Floats, heading: Floats, length: Floats, margin_m: float, tau_s: float, gain: float, slow: float,
    lane: Ints, section: Ints, ahead: Floats, turn: Floats, on: Ints,
) -> int:  # fmt: skip
    """Set where lanes head for and sines of turns to their middle; move on and list who is at an end."""
    count = arcs = 0
    for i in range(len(lane)):
        k = lane[i]
        along, lateral = _place(dots, i, angle, arcs, arc[k], radius[k], phase[k], sign[k])
        arcs += arc[k]
        ahead[i] = heading[k]
        if arc[k]:
            ahead[i] = sign[k] * (along + speed[i] * tau_s) / radius[k] + phase[k] + pi / 2 * sign[k]
        turn[i] = _within(1.0, gain * lateral / _not_zero(speed[i], slow))
        if along > length[k] - margin_m and route[i, section[i] + 1] >= 0:
            section[i] += 1
            lane[i] = route[i, section[i]]
            on[count] = i
            count += 1
    return count


@_loop(F2, F2, F2, F2, F3, F, F, F2)
def _set_slip(
    ahead: Floats, turn: Floats, heading: Floats, speed: Floats, size: Floats, slow: float, gain: float,
    slip: Floats,
) -> None:  # fmt: skip
    """Set sines of the slip angles that turn vehicles to where they should head for."""
    for b in range(speed.shape[0]):
        for n in range(speed.shape[1]):
            rate = gain * _turned(ahead[b, n] + _within(pi / 4, turn[b, n]) - heading[b, n])
            slip[b, n] = _within(1.0, size[b, n, 0] / 2 / _not_zero(speed[b, n], slow) * rate)


@_loop(I2, F2, F3, F2, I2, F2, F1, result=int64)
def _list_faster(
    lane: Ints, speed: Floats, xy: Floats, heading: Floats, pairs: Ints, away: Floats, headings: Floats
) -> int:
    """List and count vehicles that are faster than another in their lane: world, number and number."""
    count = 0
    for b in range(speed.shape[0]):
        for n in range(speed.shape[1]):
            for other in range(speed.shape[1]):
                if lane[b, n] == lane[b, other] and speed[b, n] > speed[b, other]:
                    pairs[count, 0], pairs[count, 1], pairs[count, 2] = b, n, other
                    away[count, 0] = xy[b, other, 0] - xy[b, n, 0]
                    away[count, 1] = xy[b, other, 1] - xy[b, n, 1]
                    headings[count] = heading[b, n]
                    count += 1
    return count


@_loop(F1, I2, F2, F3, F, F, F2)
def _set_brakes(
    ahead: Floats, pairs: Ints, speed: Floats, size: Floats, standoff_m: float, braking_mps2: float,
    acceleration: Floats,
) -> None:  # fmt: skip
    for i in range(len(ahead)):
        b, n, other = pairs[i, 0], pairs[i, 1], pairs[i, 2]
        room = ahead[i] - (size[b, n, 0] + size[b, other, 0]) / 2 - standoff_m
        closing = speed[b, n] - speed[b, other]
        if ahead[i] > 0 and closing * closing > 2 * braking_mps2 * room:
            acceleration[b, n] = -2 * braking_mps2


@_loop(I1, F2, F2, B2, F2, F2, F2, F, F, F, F, F, F, F, F, F, F2, F2, B2)
def _set_controls(
    frame: Ints, target: Floats, speed: Floats, crashed: Bools, brakes_at: Floats, brakes_mps2: Floats,
    brakes_to: Floats, hz: float, brakes_off_hz: float, lamps_mps2: float, gain: float, least: float,
    most: float, fastest: float, slowest: float, most_steering: float,
    steering: Floats, acceleration: Floats, braking: Bools,
) -> None:  # fmt: skip
    """Finish acceleration, brake lamps and steering: plans, the ego, wrecks, and limits of speed."""
    for b in range(speed.shape[0]):
        time_s = frame[b] / hz
        for n in range(speed.shape[1]):
            v, a = speed[b, n], acceleration[b, n]
            above = v - brakes_to[b, n]
            if time_s >= brakes_at[b, n] and above > 0:
                a = -min(brakes_mps2[b, n], above * brakes_off_hz)
            if n == 0:
                a = min(max(gain * (target[b, 0] - v), least), most)
            braking[b, n] = a < -lamps_mps2
            steering[b, n] = _within(most_steering, steering[b, n])
            if crashed[b, n]:
                steering[b, n], a = 0.0, -1.0 * v
            if v > fastest:
                a = min(a, 1.0 * (fastest - v))
            elif v < slowest:
                a = max(a, 1.0 * (slowest - v))
            acceleration[b, n] = a


@_loop(F2, F2, F2, F2, F3, F3, I2, B2, F, F3, F2, F2, B2, B2, I2)
def _set_motion(
    cos: Floats, sin: Floats, sin_slip: Floats, acceleration: Floats, impact: Floats, size: Floats,
    lane: Ints, there: Bools, dt: float, xy: Floats, heading: Floats, speed: Floats, pushed: Bools,
    crashed: Bools, lane_now: Ints,
) -> None:  # fmt: skip
    for b in range(speed.shape[0]):
        for n in range(speed.shape[1]):
            v = speed[b, n]
            xy[b, n, 0] += v * cos[b, n] * dt
            xy[b, n, 1] += v * sin[b, n] * dt
            if pushed[b, n]:
                xy[b, n, 0] += impact[b, n, 0]
                xy[b, n, 1] += impact[b, n, 1]
                crashed[b, n], pushed[b, n] = True, False
            heading[b, n] += v * sin_slip[b, n] / (size[b, n, 0] / 2) * dt
            speed[b, n] = v + acceleration[b, n] * dt
            if there[b, n]:
                lane_now[b, n] = lane[b, n]


@_loop(F2, F1, I2, B1, F1, F1, F1, F1, F1, F, I2, B1)
def _set_ego_lane(
    dots: Floats, angle: Floats, ways: Ints, arc: Bools, radius: Floats, phase: Floats, sign: Floats,
    length: Floats, width: Floats, room_m: float, lane_now: Ints, on_road: Bools,
) -> None:  # fmt: skip
    i = arcs = 0
    for b in range(len(on_road)):
        nearest_m = np.inf
        for k in ways[b]:
            along, lateral = _place(dots, i, angle, arcs, arc[k], radius[k], phase[k], sign[k])
            i, arcs, off_m = i + 1, arcs + arc[k], abs(lateral)
            if off_m < nearest_m:
                nearest_m, lane_now[b, 0] = off_m, k
                on_road[b] = off_m <= width[k] / 2 and -room_m <= along and along < length[k] + room_m


@_loop(F3, F2, F2, F2, B2, F, F, I2, F2, result=int64)
def _list_near(
    xy: Floats, heading: Floats, speed: Floats, reach: Floats, there: Bools, dt: float, near_m: float,
    pairs: Ints, headings: Floats,
) -> int:  # fmt: skip
    """List and count pairs of vehicles whose circles may touch within the frame: world, number and number."""
    count = 0
    for b in range(speed.shape[0]):
        for n in range(speed.shape[1]):
            x, y, moves_m = xy[b, n, 0], xy[b, n, 1], speed[b, n] * dt
            for other in range(n + 1, speed.shape[1]):
                dx, dy = xy[b, other, 0] - x, xy[b, other, 1] - y
                within = reach[b, n] + reach[b, other] + moves_m + near_m
                if dx * dx + dy * dy < within * within and there[b, n] and there[b, other]:
                    pairs[count, 0], pairs[count, 1], pairs[count, 2] = b, n, other
                    headings[count, 0], headings[count, 1] = heading[b, n], heading[b, other]
                    count += 1
    return count


@_loop(F2, F2, F3, F2, F3, F, F, I2, result=int64)
def _keep_near(
    cos: Floats, sin: Floats, xy: Floats, speed: Floats, size: Floats, dt: float, near_m: float, pairs: Ints
) -> int:
    """Keep and count the pairs that no axis separates throughout the frame, by `separation_m`."""
    count = 0
    for i in range(len(cos)):
        b, n, other = pairs[i, 0], pairs[i, 1], pairs[i, 2]
        dx, dy = xy[b, other, 0] - xy[b, n, 0], xy[b, other, 1] - xy[b, n, 1]
        c, s, its_c, its_s = cos[i, 0], sin[i, 0], cos[i, 1], sin[i, 1]
        dot, cross = abs(c * its_c + s * its_s), abs(c * its_s - s * its_c)
        length, width = size[b, n, 0], size[b, n, 1]
        its_length, its_width = size[b, other, 0], size[b, other, 1]
        apart_m = max(
            abs(dx * c + dy * s) - (length + its_length * dot + its_width * cross) / 2,
            abs(dy * c - dx * s) - (width + its_length * cross + its_width * dot) / 2,
            abs(dx * its_c + dy * its_s) - (its_length + length * dot + width * cross) / 2,
            abs(dy * its_c - dx * its_s) - (its_width + length * cross + width * dot) / 2,
        )
        if apart_m <= (abs(speed[b, n]) + abs(speed[b, other])) * dt + near_m:
            pairs[count, 0], pairs[count, 1], pairs[count, 2] = b, n, other
            count += 1
    return count
