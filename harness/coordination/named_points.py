"""Name operating points: the paper's, and any other by a text such as `6g:window_s=0.4`."""

from collections.abc import Mapping
from typing import Any

from harness.coordination.operating_point import OperatingPoint, as_here
from harness.coordination.part_settings import (
    OVERRIDES,
    gone_setting,
    lacking_setting,
    settings_of_radio,
    typed_settings,
)
from harness.coordination.parts import Cloud, Radio
from harness.core.config import settable, value_of
from harness.core.errors import UserError, printable, unknown
from harness.radio.profiles import CHANNELS

POINTS = {
    point.name: point
    for point in (
        OperatingPoint("single-local"),
        OperatingPoint("v2x", Radio(profile="v2x")),
        OperatingPoint("6g", Radio(profile="6g")),
    )
}
# The cloud reference that the paper cites; it runs only if it is named.
CLOUD = OperatingPoint("cloud", cloud=Cloud(round_trip_s=0.51))


def named_point(text: str) -> OperatingPoint:
    """Return the operating point that a text states, as `6g:consensus=ego-prompt,window_s=0.4`.

    An operating point is the settings of the radio, of asking helpers and of fusing their messages,
    under which a run's decisions are played.

    Before the colon is the name of one of the paper's points, or of a channel profile, which stands
    for a point with that profile and the defaults. Behind it are settings by name; one may have its
    short name of `SHORT`, such as `tau`, and may be one of the channel's own. The whole text
    becomes the point's name.

    Raises:
        UserError: there is no such point or setting, or a value is not allowed.
    """
    name, colon, rest = text.partition(":")
    points = {**POINTS, CLOUD.name: CLOUD}
    if name not in points and name not in CHANNELS:
        raise unknown("operating point", name, {*points, *CHANNELS})
    point = points.get(name) or OperatingPoint(name, Radio(profile=name))
    channel_settings = (
        [key for key in settable(point.channel) if key not in OVERRIDES]
        if point.radio.profile
        else []
    )
    settings: dict[str, Any] = {}
    radio: dict[str, str] = {}
    for setting in rest.split(",") if colon else ():
        key, equals, value = setting.partition("=")
        field, scale = SHORT.get(key, (key, 1.0))
        if field not in typed_settings() and field not in channel_settings:
            if gone := gone_setting(field):
                raise UserError(lacking_setting(field, value, gone))
            allowed = (*typed_settings(), *SHORT, *channel_settings)
            raise unknown(
                f"setting of operating point {name}", key, allowed, f"; as in {name}:window_s=0.3"
            )
        if not equals:
            raise UserError(
                f"operating point {printable(text)!r}: {printable(key)} has no value; give it one, "
                f"as in {name}:window_s=0.3"
            )
        after_colon = value.partition(":")[2].partition("=")[0]
        if after_colon in SHORT or after_colon in (*typed_settings(), *channel_settings):
            joined = f"{key}={value.replace(':', ',')}"
            raise UserError(
                f"operating point {printable(text)!r}: {printable(setting)} has a colon; settings "
                f"are joined by commas, as in {printable(f'{name}:{joined}')}"
            )
        if field in settings or field in radio:
            raise UserError(
                f"operating point {printable(text)!r}: {field} is given twice; give it once"
            )
        if field not in typed_settings():
            radio[field] = value
            continue
        parsed = setting_of(field, value)
        settings[field] = parsed * scale if isinstance(parsed, float) else parsed
    for key in settings_of_radio():
        if key in settings and point.radio.profile is None:
            raise UserError(
                f"operating point {printable(text)!r}: {name} has no channel, so {key} changes "
                "nothing; leave it out"
            )
    if "round_trip" in settings and "round_trip_s" not in settings:
        settings["round_trip_s"] = None  # `cloud` has the paper's; only one of the two may be set
    point = point.of_radio(radio) if radio else point
    return point.changed(name=text, **settings) if settings or radio else point


def misnamed(settings: Mapping[str, Any]) -> list[str]:
    """Return which recorded settings of a condition are not those that its name stands for.

    A name such as `6g:window_s=0.4` states settings, so a run whose record has others is not what
    it says. `settings` has the values by name, and among them the condition's own `name`. Returned
    are the names of the settings that `named_point` makes otherwise of it; none for a name that it
    cannot read, as of a condition made in Python.
    """
    name = str(settings["name"])
    try:
        named = as_here(named_point(name).record())
    except UserError:
        return []
    here = {**OperatingPoint(name).record(), **as_here(settings)}  # what it lacks, it has plainly
    keys = dict.fromkeys((*named, *here))
    return [key for key in keys if key not in named or key not in here or named[key] != here[key]]


# Short names of settings, as in `harness study sweep --over`, each with the factor to the setting's
# unit.
SHORT = {"tau": ("tau_nats", 1.0), "window": ("window_s", 1e-3), "latency": ("latency_s", 1e-3)}


def setting_of(key: str, text: str) -> object:
    """Return a setting's value from the text that a user typed, such as the number of `0.5`.

    `key` is the setting's name; its default says of which type the value is. A text that cannot be
    converted is returned as it is, and refused where the settings are put together.
    """
    return value_of(POINTS["6g"].setting(key), text)
