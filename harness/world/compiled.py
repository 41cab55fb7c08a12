"""The frame of many worlds of `lockstep`, compiled by numba: the same numbers, to the last bit, in less time.

A frame is a few loops over vehicles, with NumPy's functions of whole arrays between them. Loops have only what
IEEE 754 fixes to the last bit: + - * /, square roots, remainders and comparisons, which numba neither reorders
nor fuses without `fastmath`. The rest stays with NumPy, since its last bit depends on the machine: with AVX-512
NumPy has an arcsin, tan, arctan and arctan2 of its own in the place of libm's, and `vecdot` is OpenBLAS's, which
fuses a product into the sum on some processors and not on others.

What happens rarely (a lane ends, two vehicles may touch) is left to `Fleet`. Importing this module compiles it,
or loads it from numba's cache.
"""

from collections.abc import Callable
from math import pi, sqrt
from typing import Any, TypeVar

import numpy as np
from highway_env.road.lane import AbstractLane
from highway_env.vehicle.controller import ControlledVehicle
from numba import boolean, float64, int64, njit, void
from numba.types import UniTuple

from harness.core.arrays import Bools, Floats, Ints
from harness.world.lockstep import SLOW_MPS, Fleet
from harness.world.simulator import BRAKES_OFF_HZ, FAST_MPS, LAMPS_MPS2, NEAR_M, Traffic

# Types of arguments by their dimensions. Constants of other modules are arguments, too: numba's cache would not
# notice that one has changed.
F, F1, F2, F3 = float64, float64[::1], float64[:, ::1], float64[:, :, ::1]
I1, I2, B1, B2 = int64[::1], int64[:, ::1], boolean[::1], boolean[:, ::1]
Loop = TypeVar("Loop", bound=Callable[..., Any])


def _loop(*types: Any, result: Any = void) -> Callable[[Loop], Loop]:
    """Compile a function of arguments of some types, or load it."""
    compiled: Callable[[Loop], Loop] = njit(result(*types), cache=True, error_model="numpy")
    return compiled


class CompiledFleet(Fleet):
    """A fleet whose frames are compiled; what it holds, and each of its numbers, is that of `Fleet`."""

    def _act(self) -> None:
        ends, ahead, turn = self._turn()
        if ends:
            self.follow(self.ends)
            _, ahead, turn = self._turn()
        of, speed = ControlledVehicle, self.speed
        slip = np.empty_like(speed)
        _slip(ahead, np.arcsin(turn), self.heading, speed, self.size, SLOW_MPS, of.KP_HEADING, slip)
        self.steering = np.arctan(2 * np.tan(np.arcsin(slip)))
        self.acceleration = np.zeros_like(speed)
        self._keep_apart()
        _control(
            self.frame, self.target, speed, self.crashed, self.brakes_at, self.brakes_mps2, self.brakes_to,
            float(self.scenario.parameters.simulation_hz), BRAKES_OFF_HZ, LAMPS_MPS2, of.KP_A, *self.limits,
            FAST_MPS, of.MAX_SPEED, of.MIN_SPEED, self.most_steering,
            self.steering, self.acceleration, self.braking,
        )  # fmt: skip

    def _turn(self) -> tuple[bool, Floats, Floats]:
        """Return whether lanes end, where vehicles' lanes head for, and the sine of the turn towards their middle."""
        lanes, of = self.lanes, ControlledVehicle
        dots, angle = self._dots(self.xy.reshape(-1, 2), self.lane.reshape(-1))
        self.ends = np.empty_like(self.there)
        ahead, turn = np.empty_like(self.speed), np.empty_like(self.speed)
        ends = _turn(
            dots, angle, self.lane, self.speed, lanes.arc, lanes.radius, lanes.phase, lanes.sign, lanes.heading,
            lanes.length, AbstractLane.VEHICLE_LENGTH / 2, of.TAU_PURSUIT, -of.KP_LATERAL, SLOW_MPS,
            self.ends, ahead, turn,
        )  # fmt: skip
        return ends, ahead, turn

    def _dots(self, xy: Floats, lane: Ints) -> tuple[Floats, Floats]:
        """Return what `_place` needs of points (N, 2) and lanes (N,): products (2, N), and angles on arcs (N,)."""
        lanes, away, ways = self.lanes, np.empty_like(xy), np.empty((2, *xy.shape))
        arcs = _away(xy, lane, lanes.base, lanes.along, lanes.across, lanes.arc, away, ways)
        dots = np.vecdot(away, ways)
        return dots, np.arctan2(away[:, 1], away[:, 0]) if arcs else dots[0]

    def _keep_apart(self) -> None:
        """Set the acceleration of vehicles that have to brake for another in their lane."""
        most = self.speed.size * (self.speed.shape[1] - 1)
        pairs, away = np.empty((2, most), dtype=int), np.empty((most, 2))
        count = _faster(self.lane_now, self.speed, self.xy, pairs, away)
        if count:
            heading = self.heading.reshape(-1)[pairs[0, :count]]
            ways = np.empty((count, 2))
            ways[:, 0], ways[:, 1] = np.cos(heading), np.sin(heading)
            ahead = np.vecdot(away[:count], ways)
            _brake(ahead, pairs, self.speed, self.size, Traffic.standoff_m, Traffic.braking_mps2, self.acceleration)

    def _move(self) -> None:
        slip = np.arctan(1 / 2 * np.tan(self.steering))
        way = self.heading + slip
        _move(
            np.cos(way), np.sin(way), np.sin(slip), self.acceleration, self.impact, self.size, self.lane,
            self.there, self.dt, self.xy, self.heading, self.speed, self.pushed, self.crashed, self.lane_now,
        )  # fmt: skip

    def _place_ego(self) -> Bools:
        lanes, worlds = self.lanes, len(self.xy)
        ways = np.tile(self.ways, worlds) if self.ways.size else self.lane_now[:, 0].copy()
        each = len(ways) // worlds
        dots, angle = self._dots(np.repeat(self.xy[:, 0], each, axis=0), ways)
        on_road = np.empty(worlds, dtype=bool)
        _nearest(
            dots, angle, ways, each, lanes.arc, lanes.radius, lanes.phase, lanes.sign, lanes.length, lanes.width,
            AbstractLane.VEHICLE_LENGTH, self.lane_now, on_road,
        )  # fmt: skip
        return on_road

    def _near(self) -> tuple[Ints, Ints, Ints]:
        found = np.empty((3, self.speed.size * (self.speed.shape[1] - 1) // 2), dtype=int)
        count = _near(self.xy, self.speed, self.reach, self.there, self.dt, NEAR_M, found)
        b, n, other = found[:, :count]
        return b, n, other


@_loop(F, result=F)
def _turned(angle: float) -> float:
    """Wrap an angle to -pi to pi."""
    rest = angle + pi
    if not 0 <= rest < 2 * pi:  # else it is its own remainder
        rest %= 2 * pi
    return rest - pi


@_loop(F, F, result=F)
def _not_zero(speed: float, least: float) -> float:
    return speed if abs(speed) > least else least if speed >= 0 else -least


@_loop(F, F, result=F)
def _within(limit: float, value: float) -> float:
    return -limit if value < -limit else limit if value > limit else value


@_loop(F2, I1, F2, F2, F2, B1, F2, F3, result=boolean)
def _away(
    xy: Floats, lane: Ints, base: Floats, along: Floats, across: Floats, arc: Bools, away: Floats, ways: Floats
) -> bool:
    """Set vectors from where lanes begin, (N, 2), and those to multiply them by, (2, N, 2); any arcs?"""
    arcs = False
    for i in range(len(lane)):
        k = lane[i]
        for c in range(2):
            away[i, c] = xy[i, c] - base[k, c]
            ways[0, i, c] = away[i, c] if arc[k] else along[k, c]
            ways[1, i, c] = across[k, c]
        arcs |= arc[k]
    return arcs


@_loop(F, F, F, boolean, F, F, F, result=UniTuple(F, 2))
def _place(
    dot: float, other_dot: float, angle: float, arc: bool, radius: float, phase: float, sign: float
) -> tuple[float, float]:
    """Return the positions along and to the right of a lane."""
    if not arc:
        return dot, other_dot
    phi = phase + _turned(angle - phase)
    return sign * (phi - phase) * radius, sign * (radius - sqrt(dot))


@_loop(F2, F1, I2, F2, B1, F1, F1, F1, F1, F1, F, F, F, F, B2, F2, F2, result=boolean)
def _turn(
    dots: Floats, angle: Floats, lane: Ints, speed: Floats, arc: Bools, radius: Floats, phase: Floats,
    sign: Floats, heading: Floats, length: Floats, margin_m: float, tau_s: float, gain: float, slow: float,
    ends: Bools, ahead: Floats, turn: Floats,
) -> bool:  # fmt: skip
    """Set where lanes end and head for, and the sine of the turn to their middle: the first half of steering."""
    some = False
    for b in range(lane.shape[0]):
        for n in range(lane.shape[1]):
            k, i = lane[b, n], b * lane.shape[1] + n
            along, lateral = _place(dots[0, i], dots[1, i], angle[i], arc[k], radius[k], phase[k], sign[k])
            ends[b, n] = along > length[k] - margin_m
            some |= ends[b, n]
            ahead[b, n] = heading[k]
            if arc[k]:
                ahead[b, n] = sign[k] * (along + speed[b, n] * tau_s) / radius[k] + phase[k] + pi / 2 * sign[k]
            turn[b, n] = _within(1.0, gain * lateral / _not_zero(speed[b, n], slow))
    return some


@_loop(F2, F2, F2, F2, F3, F, F, F2)
def _slip(
    ahead: Floats, turn: Floats, heading: Floats, speed: Floats, size: Floats, slow: float, gain: float,
    slip: Floats,
) -> None:  # fmt: skip
    """Set the sine of the slip angle that turns vehicles where they should head for."""
    for b in range(speed.shape[0]):
        for n in range(speed.shape[1]):
            rate = gain * _turned(ahead[b, n] + _within(pi / 4, turn[b, n]) - heading[b, n])
            slip[b, n] = _within(1.0, size[b, n, 0] / 2 / _not_zero(speed[b, n], slow) * rate)


@_loop(I2, F2, F3, I2, F2, result=int64)
def _faster(lane: Ints, speed: Floats, xy: Floats, pairs: Ints, away: Floats) -> int:
    """List vehicles that are faster than another in their lane, counted through all worlds; how many?"""
    count, most = 0, speed.shape[1]
    for b in range(speed.shape[0]):
        for n in range(most):
            for other in range(most):
                if lane[b, n] == lane[b, other] and speed[b, n] > speed[b, other]:
                    pairs[0, count], pairs[1, count] = b * most + n, b * most + other
                    away[count, 0] = xy[b, other, 0] - xy[b, n, 0]
                    away[count, 1] = xy[b, other, 1] - xy[b, n, 1]
                    count += 1
    return count


@_loop(F1, I2, F2, F3, F, F, F2)
def _brake(
    ahead: Floats, pairs: Ints, speed: Floats, size: Floats, standoff_m: float, braking_mps2: float,
    acceleration: Floats,
) -> None:  # fmt: skip
    most = speed.shape[1]
    for i in range(len(ahead)):
        b, n, other = pairs[0, i] // most, pairs[0, i] % most, pairs[1, i] % most
        room = ahead[i] - (size[b, n, 0] + size[b, other, 0]) / 2 - standoff_m
        closing = speed[b, n] - speed[b, other]
        if ahead[i] > 0 and closing * closing > 2 * braking_mps2 * room:
            acceleration[b, n] = -2 * braking_mps2


@_loop(I1, F2, F2, B2, F2, F2, F2, F, F, F, F, F, F, F, F, F, F, F2, F2, B2)
def _control(
    frame: Ints, target: Floats, speed: Floats, crashed: Bools, brakes_at: Floats, brakes_mps2: Floats,
    brakes_to: Floats, hz: float, brakes_off_hz: float, lamps_mps2: float, gain: float, least: float,
    most: float, fast: float, fastest: float, slowest: float, most_steering: float,
    steering: Floats, acceleration: Floats, braking: Bools,
) -> None:  # fmt: skip
    """Finish steering, acceleration and brake lamps, by vehicles' own plans and what wrecks and limits do."""
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
def _move(
    cos: Floats, sin: Floats, sin_slip: Floats, acceleration: Floats, impact: Floats, size: Floats, lane: Ints,
    there: Bools, dt: float, xy: Floats, heading: Floats, speed: Floats, pushed: Bools, crashed: Bools,
    lane_now: Ints,
) -> None:  # fmt: skip
    """Do what `Vehicle.step` does."""
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


@_loop(F2, F1, I1, int64, B1, F1, F1, F1, F1, F1, F, I2, B1)
def _nearest(
    dots: Floats, angle: Floats, ways: Ints, each: int, arc: Bools, radius: Floats, phase: Floats, sign: Floats,
    length: Floats, width: Floats, room_m: float, lane_now: Ints, on_road: Bools,
) -> None:  # fmt: skip
    """Set the ego's lane to the first of those nearest, and whether its road is below it."""
    for b in range(len(on_road)):
        off = np.inf
        for i in range(b * each, (b + 1) * each):
            k = ways[i]
            along, lateral = _place(dots[0, i], dots[1, i], angle[i], arc[k], radius[k], phase[k], sign[k])
            if abs(lateral) < off:
                off, lane_now[b, 0] = abs(lateral), k
                on_road[b] = off <= width[k] / 2 and -room_m <= along and along < length[k] + room_m


@_loop(F3, F2, F2, B2, F, F, I2, result=int64)
def _near(
    xy: Floats, speed: Floats, reach: Floats, there: Bools, dt: float, near_m: float, found: Ints
) -> int:
    """List pairs of vehicles that are so near that they might touch, as worlds and numbers; how many?"""
    count = 0
    for b in range(speed.shape[0]):
        for n in range(speed.shape[1]):
            for other in range(n + 1, speed.shape[1]):
                within = reach[b, n] + reach[b, other] + speed[b, n] * dt + near_m
                dx, dy = xy[b, other, 0] - xy[b, n, 0], xy[b, other, 1] - xy[b, n, 1]
                if dx * dx + dy * dy < within * within and there[b, n] and there[b, other]:
                    found[0, count], found[1, count], found[2, count] = b, n, other
                    count += 1
    return count
