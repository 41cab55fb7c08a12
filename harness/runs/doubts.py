"""The conditions of a run that a warning is about.

Read from plain values of `run.json` and `summary.csv`, so that pages,
which hold a whole run, and lists, which read no more than these, agree.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from harness.core.extensions import control_settings
from harness.core.pairs import pairs
from harness.radio.limits import outside

OFF_LAG = "off_lag_rate"
MOST_OFF_LAG = 0.5  # from this share of decisions that act in another frame a page warns
Conditions = Sequence[Mapping[str, Any]]
Channel = tuple[Mapping[str, Any], Mapping[str, Sequence[float]]]  # its parameters and their limits


def doubted(
    conditions: Conditions, channels: Mapping[str, Channel], off_lag: Mapping[str, float | None]
) -> set[str]:
    """Return the names of the conditions that a report warns about.

    A condition is a named set of settings of the radio, of asking helpers and of fusing their
    messages that a run scores. A warning is due if it is a control, which replaces what helpers
    say; if half of its decisions or more act at another time than the dataset knows the outcome
    for; or if its radio is outside of what its channel model was validated for.

    Args:
        conditions: the settings of each condition, values by name, its `name` among them.
        channels: by name of a channel profile (a radio) its parameters, and for some of these the
            least and greatest value for which its model was validated.
        off_lag: by condition the share of decisions, 0 to 1, that act in another frame than after
            the dataset's lag (the time from a decision to its action); None where unknown.
    """
    names = {name for control in control_settings().values() for name in under(conditions, control)}
    return names | {*lagging(off_lag)} | {name for name, _ in beyond(conditions, channels)}


def under(conditions: Conditions, control: str) -> list[str]:
    """Return the names of the conditions that test whether a gain comes from cooperation.

    Under such a control, named by `control` as in `messages=blind`, something else replaces what
    helpers say. A condition is a set of settings that a run scores; `conditions` has the settings
    of each, values by name.
    """
    setting, _, value = control.partition("=")
    return [c["name"] for c in conditions if c.get(setting) == value]


def lagging(off_lag: Mapping[str, float | None]) -> list[str]:
    """Return the names of the conditions half or more of whose decisions miss the dataset's lag.

    The lag is the time from a decision to its action for which the dataset knows the outcome.
    `off_lag` has by condition the share of decisions, 0 to 1, that would act in another frame; None
    where unknown. A condition is a named set of settings of the radio, of asking helpers and of
    fusing their messages.
    """
    return [name for name, share in off_lag.items() if (share or 0.0) >= MOST_OFF_LAG]


def beyond(conditions: Conditions, channels: Mapping[str, Channel]) -> Iterator[tuple[str, str]]:
    """Yield the name of each condition whose radio its channel model is not validated for, and why.

    `conditions` has the settings of each, values by name; `channels` by name of a channel profile
    (a radio) its parameters, and for some of these the least and greatest value for which the model
    was validated. Why is a sentence.
    """
    for condition in conditions:
        if channel := channels.get(condition.get("profile") or ""):
            parameters, limits = channel
            for sentence in outside({**parameters, **pairs(condition.get("radio", ""))}, limits):
                yield condition["name"], sentence
