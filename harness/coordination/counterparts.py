"""Conditions that a setting of a run puts beside each of its conditions that has a channel.

An extension adds a setting of texts, and under its name a function as
`adds={"counterparts": {NAME: "module:function"}}`. It returns by a text which setting of a
condition, such as `loss=1`, the counterpart has in addition, and raises UserError for a text that
is not allowed.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from harness.coordination.named_points import named_point
from harness.coordination.operating_point import OperatingPoint
from harness.core.plugins import Plugins, texts

COUNTERPARTS = Plugins[Callable[[str], str]]("swarmdrive.counterparts", Callable, {})


def counterparts(
    points: Sequence[OperatingPoint], settings: Mapping[str, Any]
) -> Iterator[OperatingPoint]:
    """Yield for each operating point the ones to compare it with, which differ in one setting.

    So a run scores, beside `6g`, the same with lost messages or under attack. An operating point is
    the settings under which a run's decisions are played. `settings` are a run's settings of
    extensions, values by name; each text of one that is in `COUNTERPARTS` stands for one setting
    that a counterpart has in addition, such as `loss=1`. Counterparts are in the order of these
    texts, and within one in that of the points. A point without a channel has none, nor one that
    states the setting itself. Raises UserError for a text that is not allowed.
    """
    additions = dict[str, None]()  # each once, in their order
    for name in COUNTERPARTS:
        for text in settings.get(name, ()):
            additions[_addition(name, text)] = None
    for addition in additions:
        for point in points:
            if point.radio.profile and addition.partition("=")[0] not in point.name:
                separator = "," if ":" in point.name else ":"
                yield named_point(f"{point.name}{separator}{addition}")


def _addition(name: str, text: str) -> str:
    """Return which setting a counterpart has in addition, such as `loss=1`."""
    [addition] = COUNTERPARTS.ask(name, lambda addition_of: texts([addition_of(text)]))
    return addition
