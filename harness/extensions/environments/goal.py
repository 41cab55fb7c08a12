"""When the ego of an environment has reached its goal: as a setting says, or the environment."""

import re
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from harness.core.errors import UserError, printable
from harness.extensions.environments.environment import raised
from harness.world.road import Path

Kind = Literal["speed", "own", "place", "time", "stay"]
SPEED, OWN = "speed", "own"
NUMBER = r"(\d+(?:\.\d+)?)"
FORMS = {"place": f"{NUMBER}m", "time": f"{NUMBER}s", "stay": f"{NUMBER}s/{NUMBER}m"}
ALLOWED = "speed, own, a place such as 120m, a time such as 6s, or both to stay there, as in 6s/5m"
BESIDE_M = 10.0  # a place farther than this from the ego's path is none on it


@dataclass(frozen=True)
class Goal:
    """Say when the ego of an environment has reached its goal.

    `speed` is the way that it drives at its first target speed in the time of its decisions and two
    periods; `place` is a way of `metres`; `time` is to be unhurt after `seconds`, and `stay` to be
    so no farther than `metres` from its start. Each is reached, too, where the environment itself
    ends the episode without a crash, unless it says that this is no success; `own` is that alone,
    or `info["is_success"]`.
    """

    kind: Kind = "speed"
    metres: float = 0.0  # how far the ego goes, or at most, m
    seconds: float = 0.0  # until when it must be unhurt, s

    @classmethod
    def of(cls, text: str, who: str = "scenario") -> "Goal":
        """Return the goal that a text says, such as `120m`.

        Raises UserError, which names whose goal it is by `who`, for another text.
        """
        if text in (SPEED, OWN):
            return cls("speed" if text == SPEED else "own")
        for kind, form in FORMS.items():
            if match := re.fullmatch(form, text):
                numbers = [float(number) for number in match.groups()]
                if min(numbers) <= 0:
                    break
                seconds = numbers[0] if kind != "place" else 0.0
                metres = numbers[-1] if kind != "time" else 0.0
                return cls(kind, metres, seconds)  # type: ignore[arg-type] # FORMS has kinds
        raise UserError(f"{who}: goal is {printable(text, 40)!r}; it must be {ALLOWED}")

    def ahead_m(self, cruise_s: float, speed_mps: float) -> float:
        """Return how far the ego may come until it is decided, m, if it keeps its speed, m/s.

        `cruise_s` is the time of its decisions and two periods, s.
        """
        if self.kind == "place":
            return self.metres
        return (self.seconds if self.is_time else cruise_s) * speed_mps

    @property
    def text(self) -> str:
        """Return the goal as a setting says it, such as `120m`; of a place in whole metres."""
        if self.kind in (SPEED, OWN):
            return self.kind
        parts = [f"{self.seconds:g}s"] if self.is_time else []
        parts += [f"{self.metres:.0f}m"] if self.metres else []
        return "/".join(parts)

    @property
    def is_place(self) -> bool:
        """Return whether it is a place on the ego's path, at which the episode ends."""
        return self.kind in ("speed", "place")

    @property
    def is_time(self) -> bool:
        """Return whether it is decided at a moment, `seconds` after the start."""
        return self.kind in ("time", "stay")

    def task(self, road: str, environment: str) -> str:
        """Return what prompts tell the ego to do, after "You drive car v1:".

        `road` says where the ego's path leads, and `environment` is the environment's name.
        """
        return {
            "speed": f"follow your road, {road}, and keep up speed",
            "own": f"follow your road, {road}, to the goal of {environment}",
            "place": f"follow your road, {road}, for {self.metres:.0f} m from your start",
            "time": f"follow your road, {road}, and be unhurt {self.seconds:g} s after your start",
            "stay": f"be unhurt {self.seconds:g} s after your start, and then at most "
            f"{self.metres:g} m from it",
        }[self.kind]


def declared(name: str, env: Any) -> str | tuple[float, float]:
    """Return the goal that an environment declares by its attribute or method `goal`.

    It is a text such as `120m`, or a place, x and y in m of highway-env's frame; `speed` if it
    declares none. `env` is the environment after its reset, and `name` names it in messages. Raises
    UserError for anything else.
    """
    try:
        goal = getattr(env, "goal", None)
        goal = goal() if callable(goal) else goal
    except Exception as error:
        raise UserError(f"{name}: its goal fails: {raised(error)}") from None
    if goal is None:
        return SPEED
    if isinstance(goal, str):
        return goal
    try:
        x_m, y_m = (float(part) for part in goal)
    except (TypeError, ValueError):
        x_m = y_m = np.nan
    if not np.isfinite([x_m, y_m]).all():
        raise UserError(
            f"{name}: its goal is {printable(repr(goal), 40)}; it must be {ALLOWED}, or a place, "
            "x and y in m"
        )
    return x_m, y_m


def at_place(name: str, path: Path, begin_m: float, x_m: float, y_m: float) -> Goal:
    """Return the goal at a place on the ego's path. Raises UserError if it is not ahead on it.

    `begin_m` is where the ego starts on `path`, m along it; `x_m` and `y_m` are the place in the
    path's frame, m, and `name` names the environment in messages.
    """
    arc_m, beside_m, _ = path.project(x_m, y_m)
    if arc_m <= begin_m or beside_m > BESIDE_M:
        raise UserError(
            f"{name}: its goal is {arc_m - begin_m:.0f} m along the ego's path, {beside_m:.0f} m "
            f"beside it; it must be ahead, and at most {BESIDE_M:g} m beside"
        )
    return Goal("place", arc_m - begin_m)
