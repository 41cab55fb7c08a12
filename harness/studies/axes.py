"""What can be swept, any setting of the operating point or the number of vehicles,
and the grid points.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from harness.coordination.contents import of_any_model
from harness.coordination.named_points import POINTS, SHORT, setting_of
from harness.coordination.operating_point import OperatingPoint
from harness.coordination.part_settings import more_parts, typed_settings
from harness.coordination.rules import POOLS, names
from harness.coordination.schedules import SCHEDULES
from harness.core.config import settable
from harness.core.errors import UserError, printable, unknown
from harness.core.extensions import part_of, setting_of_extension
from harness.radio.profiles import CHANNELS

MOST_POINTS = 1000
CORE = "core"  # the panel that compares operating points
CROSS = " × "  # between axes that are crossed
NONE = "none"  # of what may be left out

Value = float | str


@dataclass(frozen=True)
class Axis:
    """Describe one thing that a sweep can vary, and the values it takes unless the user gives some.

    A sweep scores a run's answers again at every point of a grid. What varies is a setting of the
    operating point (everything a decision depends on besides scene and model, such as packet loss),
    or the number of vehicles. `name` is what `--over` calls it, and `label` what a figure says,
    with the unit in which values are typed. A value times `scale` is the setting `field`, which is
    None for the number of vehicles. `usual` is the text of the default values; where it is empty,
    `named` may return them. `worded` says that values are words, such as names of rules, and not
    numbers.
    """

    name: str  # what `--over` calls it
    label: str  # what an axis of a figure says, with its unit
    field: str | None  # the operating point's setting; None for the number of vehicles
    scale: float  # what a value is multiplied by to be that setting
    usual: str  # the grid if none is given; empty if one must be
    worded: bool = False  # its values are words, not numbers
    named: Callable[[], Collection[str]] | None = None  # returns the grid if `usual` is empty

    @property
    def values(self) -> str:
        """Return the text of the default grid, the values to try unless the user gives some.

        It is such as `0,10,20`, in the axis's unit; empty if the user must give one.
        """
        return ",".join(self.named()) if self.named else self.usual

    def at(self, point: OperatingPoint, value: Value) -> OperatingPoint:
        """Return the operating point `point` with this axis at a value, in the axis's unit.

        An operating point is everything a decision depends on besides scene and model. It is
        unchanged for the number of vehicles, which is none of its settings. Raises UserError for a
        value that is not allowed.
        """
        if self.field is None:
            return point
        if self.field not in typed_settings():
            return point.of_radio(
                {self.field: value if isinstance(value, str) else f"{value:.10g}"}
            )
        setting: object
        if isinstance(value, str):
            left_out = value == NONE and self.field in _named()
            setting = "" if left_out else setting_of(self.field, value)
        else:
            setting = scaled = value * self.scale
            if isinstance(point.setting(self.field), int) and scaled == int(scaled):
                setting = int(scaled)
        # A given loss stands in place of one that follows the number of vehicles.
        freed = point.changed(density_coupled=False) if self.field == "loss" else point
        return freed.changed(**{self.field: setting})


AXES = {
    axis.name: axis
    for axis in (
        Axis("tau", "entropy threshold τ, nats", *SHORT["tau"], "0.3:1.05:0.05"),
        Axis("loss", "packet loss", "loss", 1.0, "0:0.5:0.05"),
        Axis("size", "vehicles, the ego included", None, 1.0, "1:4"),
        Axis(
            "latency", "nominal latency of the channel, ms", *SHORT["latency"], "0,5,10,25,50,100"
        ),
        Axis("window", "decision window, ms", *SHORT["window"], "150:400:25"),
        Axis("consensus", "consensus", "consensus", 1.0, ",".join(POOLS), worded=True),
        Axis("content", "content of a message", "content", 1.0, "", True, of_any_model),
    )
}


def axis_of(name: str) -> Axis:
    """Return what a sweep can vary, an axis, by the name that a user types after `--over`.

    That is one of `AXES`, or else a setting of operating points or radio channels, in the setting's
    own unit. Raises UserError if there is none.
    """
    if name in AXES:
        return AXES[name]
    usual = {name: POINTS["6g"].setting(name)} if name in typed_settings() else _usual()
    if name not in usual:
        if gone := setting_of_extension(name):
            raise UserError(f"--over {name}: this setting is {part_of(gone.extension)}")
        raise unknown("--over", name, {*AXES, *usual})
    values = "".join(kind.usual.get(name, "") for kind in more_parts().values())
    worded = isinstance(usual[name], str | bool)
    return Axis(name, name.replace("_", " "), name, 1.0, values, worded)


def grid(axis: Axis, text: str | None = None) -> tuple[Value, ...]:
    """Return the values of an axis that a text states, or its default grid for None.

    An axis is what a sweep varies; values are in its unit. The text is a list such as `0,10,20`,
    ranges `from:to[:step]` with both ends, or both mixed.

    Raises:
        UserError: the text cannot be read, or there are more than `MOST_POINTS` values.
    """
    if text is not None and not text.strip():
        raise UserError(f"--grid: no values for {axis.name}; give some, or leave it out")
    text = text or axis.values
    if not text:
        raise UserError(f"--over {axis.name}: no grid is usual; give its values with --grid")
    parts = [part.strip() for part in text.split(",")]
    if axis.worded:
        choices = {
            "consensus": names(),
            "schedule": SCHEDULES,
            **{setting: (NONE, *there()) for setting, there in _named().items()},
        }.get(axis.name)
        for text_of_value in parts:
            for part in text_of_value.split("+"):
                name = part.partition(":")[0]
                if choices and name not in choices:
                    raise unknown("--grid", name, choices)
        return tuple(dict.fromkeys(parts))
    values = [value for part in parts for value in _values(axis, part)]
    if len(values) > MOST_POINTS:
        raise UserError(
            f"--grid {printable(text)}: {len(values)} points; give {MOST_POINTS} or fewer"
        )
    if axis.field is None and any(value != int(value) or value < 1 for value in values):
        raise UserError(f"--grid {printable(text)}: give whole numbers of vehicles, 1 or more")
    return tuple(dict.fromkeys(values))


def usual_at(axis: Axis, point: OperatingPoint) -> tuple[Value, ...]:
    """Return those of an axis's default values that an operating point allows.

    An axis is what a sweep varies, such as packet loss; an operating point is a set of settings,
    some of which exclude values. Raises UserError if the axis has no default values.
    """
    return tuple(value for value in grid(axis) if not axis.worded or _allows(axis, point, value))


def refusal(axis: Axis, point: OperatingPoint) -> str:
    """Return why an operating point does not allow the last of an axis's default values, in words.

    An axis is what a sweep varies, such as packet loss; an operating point is a set of settings.
    The text is empty if it does.
    """
    try:
        axis.at(point, grid(axis)[-1])
    except UserError as error:
        return str(error)
    return ""


def _named() -> dict[str, Callable[[], Collection[str]]]:
    """Return the settings of extensions that name something,
    and what returns the names that there are.
    """
    named: dict[str, Callable[[], Collection[str]]] = {}
    for kind in more_parts().values():
        named |= kind.named
    return named


def _allows(axis: Axis, point: OperatingPoint, value: Value) -> bool:
    try:
        axis.at(point, value)
    except UserError:
        return False
    return True


def _usual() -> dict[str, object]:
    """Return what every setting of an operating point or of a channel usually is."""
    radios = CHANNELS.usable().values()
    of_radios = {name: getattr(channel, name) for channel in radios for name in settable(channel)}
    return of_radios | {name: POINTS["6g"].setting(name) for name in typed_settings()}


def _values(axis: Axis, part: str) -> Sequence[float]:
    try:
        numbers = [float(x) for x in part.split(":")]
        low, high, step = [*numbers, 1.0][:3] if len(numbers) > 1 else (*numbers, *numbers, 1.0)
        steps = (high - low) / step
        if (
            len(numbers) > 3
            or not 0 <= steps <= MOST_POINTS
            or not np.isfinite(numbers).all()
            or step <= 0
        ):
            raise ValueError
    except (ValueError, ZeroDivisionError):
        raise UserError(
            f"--grid {printable(part)}: give numbers such as {axis.usual or '0,1,2'}, a list or "
            "from:to:step"
        ) from None
    return [round(low + i * step, 10) for i in range(int(steps + 1e-9) + 1)]


@dataclass(frozen=True)
class Setting:
    """Hold one grid point of a sweep: an operating point, the vehicle count and what was varied.

    An operating point is everything a decision depends on besides scene and model. A panel is a
    named set of grid points that are shown together: along an axis, over several crossed axes, or
    to compare conditions.

    `condition` is the name of the operating point that is varied, and `point` that with the varied
    settings. `vehicles` includes the ego. `value` is that of the axis `variable`, in the axis's
    unit: one for each if axes are crossed, None if conditions are compared.
    """

    condition: str  # name of the operating point that it is a change of
    point: OperatingPoint  # the operating point
    vehicles: int  # how many, the ego included
    # name of the axis that varies in the panel, such as `loss`; empty where conditions are compared
    variable: str = ""
    # the axis's value at this point, in its unit; where axes are crossed, one of each; None where
    # conditions are compared
    value: Value | tuple[Value, ...] | None = None

    @property
    def place(self) -> dict[str, Value | None]:
        """Return what identifies a point of a sweep's grid in a table, values by column.

        The columns are `condition`, the name of the varied settings, `variable`, what varies, and
        `value`. If several axes are crossed, there is one more column for each of them.
        """
        place = {"condition": self.condition, "variable": self.variable}
        if not isinstance(self.value, tuple):
            return {**place, "value": self.value}
        texts = [value if isinstance(value, str) else f"{value:g}" for value in self.value]
        axes = dict(zip(self.variable.split(CROSS), self.value, strict=True))
        return {**place, "value": CROSS.join(texts), **axes}


def crossed(axes: Sequence[Axis], grids: Sequence[Sequence[Value]]) -> list[tuple[Value, ...]]:
    """Return all combinations of the values of several axes, one tuple of values for each.

    An axis is what a sweep varies, such as packet loss. `grids` has the values of each, in the
    order of `axes`, and so has each tuple one. Raises UserError if there are more than
    `MOST_POINTS`.
    """
    values = list(product(*grids))
    if len(values) > MOST_POINTS:
        names = " ".join(f"--over {axis.name}" for axis in axes)
        raise UserError(
            f"{names}: {len(values)} combinations; give {MOST_POINTS} or fewer, with --grid"
        )
    return values


def described(panels: Mapping[str, Sequence[Setting]]) -> dict[str, list[dict[str, Any]]]:
    """Return all points of a sweep with every setting, as plain values for its manifest.

    `panels` has, by name, the points that are shown together, each an operating point (set of
    settings) with a number of vehicles. The result has, by that name, a dict of settings for each
    point.
    """
    rows: dict[str, list[dict[str, Any]]] = {}
    for name, settings in panels.items():
        rows[name] = []
        for setting in settings:
            row = {"value": setting.value, "vehicles": setting.vehicles, **setting.point.record()}
            rows[name].append(row)
    return rows
