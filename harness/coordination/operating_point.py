"""Define operating points: everything a cooperative decision depends on besides the scene and the model."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

from harness.coordination.attacks import attacks_of, in_text
from harness.coordination.robust import Heads
from harness.coordination.rules import EGO_PROMPT, RULES, names
from harness.coordination.schedules import SCHEDULES
from harness.coordination.scheduling import NEVER, ORACLE, PAPER
from harness.core.config import LONGEST_S, changed, settable, value_of
from harness.core.errors import UserError, printable, unknown
from harness.radio.channel import Channel, Physical, Unit
from harness.radio.constant import Radio
from harness.radio.networks import Network, network
from harness.radio.profiles import CHANNELS, NO_CHANNEL
from harness.radio.roadside import Relay
from harness.radio.wrapped import AtLoss

FALLBACKS = ("uniform", "brake")
MESSAGES = ("own", "shuffled", "blind")
DEFENCES = ("quoted", "schema", "majority")
OVERRIDES = ("loss", "latency_s", "density_coupled")  # settings that replace a field of the channel
RELAY, FUSION = "relay", "fusion"
EDGES = ("none", RELAY, FUSION)
UNIT = ("edge_delay_s", "edge_x_m", "edge_y_m", "edge_antenna_m")  # settings of a roadside unit with a place
ALONE = ("fallback", "round_trip", "round_trip_s", "window_s")  # settings of an ego that asks nobody
WEIGHING = ("weight_cap", "min_distance_m", "ego_distance_m")  # settings of the weights by distance
_LARGEST = sys.float_info.max
LONGEST_NAME, MOST_HELPERS = 1000, 1000
TEXTS = (
    "schedule", "fallback", "consensus", "edge", "messages", "round_trip", "radio", "attack", "defence",
)  # fmt: skip


class Rewrites(NamedTuple):
    """How a fusion call shows messages."""

    blind: bool = False  # whether they come from helpers that are shown nothing
    attack: str = ""  # the attack that changes attackers' messages (`attacks.in_text`); empty for none
    defences: tuple[str, ...] = ()  # the defences that change every message


AS_SENT = Rewrites()


@dataclass(frozen=True)
class OperatingPoint:
    """The settings of one condition. Raises UserError for a value that is not allowed."""

    name: str  # its name in reports
    profile: str | None  # channel profile; None disables V2V
    tau_nats: float = 0.7  # the entropy above which the ego asks
    # the rule for whom the ego asks and when: `entropy`, the paper's, or another of `SCHEDULES`
    schedule: str = PAPER
    # the worth above which another schedule asks, in that schedule's unit; None keeps the schedule's own
    threshold: float | None = None
    window_s: float = 0.2  # decision window, from the start of the decision; a later reply is not fused
    radius_m: float = 100.0  # the paper's R; helpers farther from the ego are not asked
    max_helpers: int = 3  # the cooperative neighbourhood; if there are more helpers, the nearest are asked
    min_distance_m: float = 1.0  # lower bound of d in the paper's Eq. 2
    # the ego's d in Eq. 2; None takes its distance to the centroid of the conflict zone. The paper's preset
    # declares a proxy of 3.5 m (section IV-A)
    ego_distance_m: float | None = None
    # what replaces a failed answer of the ego: `uniform`, all actions alike, or `brake`, all mass on the
    # first action, which is the most conservative one
    fallback: str = "uniform"
    consensus: str = "linear"  # consensus rule, or `ego-prompt`
    # size of the ego's request. The default is 50 bytes: who asks whom and until when, as compact JSON
    # without a signature or headers. Replies are counted in the same way
    request_bits: float = 400.0
    # probability that one transmission is lost; None keeps that of the profile or of the link
    loss: float | None = None
    latency_s: float | None = None  # nominal seconds of one exchange; None keeps the profile's
    # whether loss follows the number of active vehicles, instead of the profile's loss
    density_coupled: bool = False
    # whether a helper whose entropy is above tau opens a round of its own, which loads the channel
    helper_rounds: bool = False
    # what a roadside unit does: `relay` sends replies once more; `fusion` asks the helpers for the ego and
    # fuses (`harness.radio.roadside`). With the constant model a relay has no place (`constant.Radio`)
    edge: str = "none"
    # time from the end of what the unit receives to the start of what it sends: processing and backhaul. The
    # default, 0, is declared: a unit that has nothing to wait for
    edge_delay_s: float = 0.0
    # the unit's place, m to the east of the centroid of the conflict zone; 0 and 0 is a gantry above it
    edge_x_m: float = 0.0
    edge_y_m: float = 0.0  # the unit's place, m to the south of the centroid
    # height of its antenna; by default 5 m (TR 37.885, table 6.1.4-1, a roadside unit)
    edge_antenna_m: float = 5.0
    on_demand: bool = False  # whether a helper infers only when it is asked, and not in parallel with the ego
    # what the ego hears: its `own` helpers, or as a control what helpers say in another layout (`shuffled`)
    # or what helpers say that are shown nothing (`blind`). A gain that remains under a control does not come
    # from what helpers see
    messages: str = "own"
    # seconds from the ego's question to the answer of a model in a cloud; they replace the ego's own
    # inference
    round_trip_s: float | None = None
    # network over which the ego asks its model in a cloud, a name of `harness.radio.networks`. Each decision
    # draws a round trip, which is added to the model's inference
    round_trip: str = ""
    radio: str = ""  # further settings of the profile's channel, such as `density_per_km=200,power_dbm=23`
    # what some helpers do instead of saying what they intend, such as `liar:share=1/3+spoof`
    # (`harness.coordination.attacks`); empty for honest helpers
    attack: str = ""
    # what guards a fusion call, some of `DEFENCES` joined by `+`: `quoted` makes evidence a JSON string;
    # `schema` removes free text from messages; `majority` lets an action on which most voices agree win
    # against the call's
    defence: str = ""
    # largest share of the weight that one helper may have (`consensus.capped`); 1 caps nothing
    weight_cap: float = 1.0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.strip():
            raise UserError(f"operating point name {printable(self.name)!r}: give it some text")
        if len(self.name) > LONGEST_NAME:
            raise UserError(
                f"operating point name {printable(self.name)!r}: give it {LONGEST_NAME} characters at most"
            )
        for key in TEXTS:
            if not isinstance(getattr(self, key), str):
                raise self._wrong(key, "a text")
        if self.profile is not None and str(self.profile) not in CHANNELS:
            raise unknown("channel profile", str(self.profile), CHANNELS, "; leave it out to disable V2V")
        if self.fallback not in FALLBACKS:
            raise unknown("fallback", str(self.fallback), FALLBACKS)
        if self.messages not in MESSAGES:
            raise unknown("messages", str(self.messages), MESSAGES)
        if str(self.consensus) not in RULES and self.consensus != EGO_PROMPT:
            raise unknown("consensus", str(self.consensus), names())
        self._number("tau_nats", "a finite number of nats, 0 or more", zero=True)
        if self.schedule == ORACLE:
            raise UserError(
                f"operating point {printable(self.name)!r}: schedule {ORACLE} looks at how scenes end; "
                f"`harness study schedule compare` plays it, and others are {', '.join(SCHEDULES)}"
            )
        if str(self.schedule) not in SCHEDULES:
            raise unknown("schedule", str(self.schedule), SCHEDULES)
        if self.threshold is not None:
            self._number("threshold", "a finite number, 0 or more", zero=True)
            if self.schedule == PAPER:
                raise self._wrong("threshold", f"left out where schedule is {PAPER}: its is tau_nats")
            if SCHEDULES[self.schedule].threshold is None:
                raise self._wrong("threshold", f"left out where schedule is {self.schedule}, which has none")
        self._number("window_s", "seconds above 0, at most 3600", most=LONGEST_S)
        self._number("radius_m", "metres above 0, at most 1000000", most=1e6)
        self._number("min_distance_m", "metres above 0, at most 1000000", most=1e6)
        if self.ego_distance_m is not None:
            self._number("ego_distance_m", "metres above 0, at most 1000000", most=1e6)
        self._number("weight_cap", "a share above 0, up to 1", most=1.0)
        self._number("request_bits", "bits, 0 or more, at most 1e12", zero=True, most=1e12)
        if self.loss is not None:
            self._number("loss", "a probability from 0 to 1", zero=True, most=1.0)
        if self.latency_s is not None:
            self._number("latency_s", "seconds, 0 or more, at most 3600", zero=True, most=LONGEST_S)
        if self.round_trip_s is not None:
            self._number("round_trip_s", "seconds, 0 or more, at most 3600", zero=True, most=LONGEST_S)
        if self.round_trip:
            _ = self.network
            if self.round_trip_s is not None:
                raise self._wrong("round_trip", "left out where round_trip_s says all; keep one of the two")
            if self.asks_again:
                raise self._wrong("round_trip", f"left out where consensus is {EGO_PROMPT}, which asks twice")
        if type(self.max_helpers) is not int or not 0 <= self.max_helpers <= MOST_HELPERS:
            raise self._wrong("max_helpers", f"a whole number, 0 or more, at most {MOST_HELPERS}")
        if self.edge not in EDGES:
            raise unknown("edge", str(self.edge), EDGES)
        self._number("edge_delay_s", "seconds, 0 or more, at most 3600", zero=True, most=LONGEST_S)
        for key in ("edge_x_m", "edge_y_m"):
            self._number(key, "metres from -10000 to 10000", least=-10_000.0, zero=True, most=10_000.0)
        self._number("edge_antenna_m", "metres from 1 to 100", least=1.0, most=100.0)
        if self.edge == FUSION and self.consensus == EGO_PROMPT:
            raise self._wrong("edge", f"none or relay where consensus is {EGO_PROMPT}: a unit has no model")
        for flag in ("density_coupled", "helper_rounds", "on_demand"):
            if type(getattr(self, flag)) is not bool:
                raise self._wrong(flag, "true or false")
        if self.messages == "shuffled" and self.consensus == EGO_PROMPT:
            raise self._wrong("messages", f"own or blind where consensus is {EGO_PROMPT}")
        for attack in attacks_of(str(self.attack)):
            if self.profile is None:
                raise self._wrong("attack", "left out where there is no channel")
            if self.consensus == EGO_PROMPT and not attack.by_moment:
                raise self._wrong(
                    "attack", f"one that needs no past and adds no voices where consensus is {EGO_PROMPT}"
                )
        for part in filter(None, str(self.defence).split("+")):
            if part not in DEFENCES:
                raise unknown("defence", part, DEFENCES)
            if self.consensus != EGO_PROMPT:
                raise self._wrong("defence", f"left out where consensus is not {EGO_PROMPT}")
        _ = self.channel

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "OperatingPoint":
        """Return the operating point of a configuration's table; without a profile it has no V2V.

        Raises UserError for an unknown key, or for a value that is not allowed.
        """
        allowed = [field.name for field in fields(cls)]
        for key in values:
            if key not in allowed:
                raise unknown("operating point setting", str(key), allowed)
        if "name" not in values:
            raise UserError('operating point without a name: add name = "..."')
        return cls(**{"profile": None, **values})

    @cached_property
    def channel(self) -> Channel:
        """The profile's channel with the point's overrides; its file is read once, when the point is made.

        Raises UserError for an override of a setting that the profile does not have.
        """
        if self.profile is None:
            return NO_CHANNEL
        channel = CHANNELS[self.profile]
        settings = {key: getattr(self, key) for key in OVERRIDES}
        overrides = {
            key: value for key, value in settings.items() if value is not None and value is not False
        }
        # A physical channel has no field for a loss: AtLoss wraps it below.
        loss = overrides.pop("loss", None) if isinstance(channel, Physical) else None
        for key in overrides:
            if key not in {field.name for field in fields(channel)}:
                raise self._wrong(key, f"left out: channel profile {self.profile} has no such setting")
        if self.radio:
            channel = changed(channel, pairs(self.radio), f"channel profile {self.profile}")
        channel = replace(channel, **overrides)
        if isinstance(channel, Physical):
            channel = channel if loss is None else AtLoss(channel, loss)
            return Relay(channel, self._unit, self.edge_delay_s) if self.edge == RELAY else channel
        if self.edge != "none":
            channel = self._relayed(channel)
        if self.loss is not None and getattr(channel, "density_coupled", False):
            raise self._wrong("loss", "left out where density_coupled is true; keep one of the two")
        return channel

    def _relayed(self, channel: Channel) -> Channel:
        """Return a channel without places, with the relay as a second path of the same kind."""
        if self.edge == FUSION:
            raise self._wrong(
                "edge", f"none or relay: links of channel profile {self.profile} have no places"
            )
        if not hasattr(channel, "roadside_edge"):
            raise self._wrong("edge", f"left out: channel profile {self.profile} has no such setting")
        for key in UNIT:
            if getattr(self, key) != getattr(POINTS["6g"], key):
                raise self._wrong(key, f"left out: links of channel profile {self.profile} have no places")
        return replace(channel, roadside_edge=True)

    @property
    def _unit(self) -> Unit:
        return Unit(self.edge_x_m, self.edge_y_m, self.edge_antenna_m)

    @property
    def unit(self) -> Unit | None:
        """The roadside unit; None if there is none, or none with a place."""
        return self._unit if self.edge != "none" and isinstance(self.channel, Physical) else None

    @cached_property
    def network(self) -> Network | None:
        """The network to a cloud, or None; its file is read once. Raises UserError if it is unknown."""
        return network(str(self.round_trip)) if self.round_trip else None

    def of_radio(self, settings: Mapping[str, str]) -> "OperatingPoint":
        """Return the point with these settings of its channel. Raises UserError for an unknown setting."""
        texts = {**pairs(self.radio), **settings}
        return replace(self, radio=",".join(f"{key}={value}" for key, value in texts.items()))

    @cached_property
    def asks_above(self) -> float:
        """The worth above which the ego asks, in the schedule's unit."""
        if self.schedule == PAPER:
            return self.tau_nats
        default = SCHEDULES[self.schedule].threshold
        return self.threshold if self.threshold is not None else 0.0 if default is None else default

    def idle(self, setting: str | None) -> str | None:
        """Return why a setting changes nothing here, whatever its value; None if it may change something.

        Args:
            setting: a setting of the point or of its channel; None for the number of vehicles.
        """
        if self.profile is None and setting not in ALONE:
            return "it has no channel"
        if self.schedule == NEVER and setting not in (*ALONE, "schedule"):
            return f"schedule {NEVER} asks nobody"
        if self.max_helpers == 0 and setting not in (*ALONE, "max_helpers"):
            return "max_helpers is 0, so it asks nobody"
        if setting == "tau_nats" and self.schedule != PAPER and not self.helper_rounds:
            return f"schedule {self.schedule} has a threshold of its own"
        if setting in UNIT and self.edge == "none":
            return "it has no roadside unit (edge is none)"
        if setting in WEIGHING and (self.consensus == EGO_PROMPT or isinstance(RULES[self.consensus], Heads)):
            return f"consensus {self.consensus} weighs no distances"
        counts_rounds = isinstance(self.channel, Radio) and not self.channel.density_coupled
        if setting == "helper_rounds" and not counts_rounds:
            return "the load of its channel does not depend on it"
        channel: Any = self.channel
        while channel is not None:
            says = getattr(channel, "idle", None)
            if says and (why := says(setting)):
                return str(why)
            channel = getattr(channel, "channel", None)  # what a wrapper wraps
        return None

    @property
    def asks(self) -> bool:
        """Whether an ego may ask a helper here at all."""
        return self.profile is not None and self.max_helpers > 0 and self.schedule != NEVER

    def needs(self, what: str) -> bool:
        """Whether its schedule, its rule or an attack needs `in_time`, `outlook`, `lot` or `claims`."""
        return what in self._needs

    @cached_property
    def _needs(self) -> frozenset[str]:
        if self.profile is None:
            return frozenset()
        parts = (SCHEDULES[self.schedule], RULES.get(self.consensus), *attacks_of(self.attack))
        return frozenset(need for part in parts for need in getattr(part, "needs", ()))

    @property
    def asks_again(self) -> bool:
        """Whether fusion asks the ego's model a second time, with the messages."""
        return self.profile is not None and self.consensus == EGO_PROMPT

    @property
    def asks_blind(self) -> bool:
        """Whether the helpers that are asked are shown nothing."""
        return self.profile is not None and self.messages == "blind"

    @property
    def guards(self) -> tuple[str, ...]:
        """The defences of its fusion calls."""
        return tuple(part for part in DEFENCES if part in self.defence.split("+"))

    @property
    def rewrites(self) -> "Rewrites":
        """How its fusion calls show messages."""
        shows = tuple(part for part in self.guards if part != "majority")
        return Rewrites(self.asks_blind, in_text(self.attack), shows)

    def _number(
        self, key: str, allowed: str, zero: bool = False, most: float = _LARGEST, least: float = 0.0
    ) -> None:
        value = getattr(self, key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
            raise self._wrong(key, allowed)
        if value == 0 and not zero:
            raise self._wrong(key, allowed)
        # 1 and 1.0 in a configuration are the same point, with the same digest.
        object.__setattr__(self, key, float(value))

    def _wrong(self, key: str, allowed: str) -> UserError:
        value = printable(repr(getattr(self, key)))
        return UserError(f"operating point {printable(self.name)!r}: {key} is {value}; it must be {allowed}")


POINTS = {
    point.name: point
    for point in (
        OperatingPoint("single-local", None),
        OperatingPoint("v2x", "v2x"),
        OperatingPoint("6g", "6g"),
    )
}
# The cloud reference that the paper cites; it runs only if it is named.
CLOUD = OperatingPoint("cloud", None, round_trip_s=0.51)


def named_point(text: str) -> OperatingPoint:
    """Return an operating point by its name and changes, such as `6g:consensus=ego-prompt,window_s=0.4`.

    The name is one of the paper's points, or a channel profile, which stands for a point with that profile
    and the defaults. A setting may have its name in `SHORT`, and may be one of the channel's own. The whole
    text becomes the point's name.

    Raises:
        UserError: there is no such point or setting, or a value is not allowed.
    """
    name, colon, rest = text.partition(":")
    points = {**POINTS, CLOUD.name: CLOUD}
    if name not in points and name not in CHANNELS:
        raise unknown("operating point", name, {*points, *CHANNELS})
    point = points.get(name) or OperatingPoint(name, name)
    channel_settings = (
        [key for key in settable(point.channel) if key not in OVERRIDES] if point.profile else []
    )
    settings: dict[str, Any] = {}
    radio: dict[str, str] = {}
    for setting in rest.split(",") if colon else ():
        key, _, value = setting.partition("=")
        field, scale = SHORT.get(key, (key, 1.0))
        if field not in SETTINGS and field not in channel_settings:
            allowed = (*SETTINGS, *SHORT, *channel_settings)
            raise unknown(f"setting of operating point {name}", key, allowed, f"; as in {name}:window_s=0.3")
        if field in settings or field in radio:
            raise UserError(f"operating point {printable(text)!r}: {field} is given twice; give it once")
        if field not in SETTINGS:
            radio[field] = value
            continue
        parsed = setting_of(field, value)
        settings[field] = parsed * scale if isinstance(parsed, float) else parsed
    for key in (*OVERRIDES, "edge", *UNIT):
        if key in settings and point.profile is None:
            raise UserError(
                f"operating point {printable(text)!r}: {name} has no channel, so {key} changes nothing; "
                "leave it out"
            )
    if "round_trip" in settings and "round_trip_s" not in settings:
        settings["round_trip_s"] = None  # `cloud` has the paper's; only one of the two may be set
    point = point.of_radio(radio) if radio else point
    return replace(point, name=text, **settings) if settings or radio else point


def pairs(text: str) -> dict[str, str]:
    """Return the names and values in `density_per_km=200,power_dbm=23`; a missing value is empty."""
    return {key: value for key, _, value in (pair.partition("=") for pair in text.split(",") if pair)}


# Short names of settings, as in `harness study sweep --over`, each with the factor to the setting's unit.
SHORT = {"tau": ("tau_nats", 1.0), "window": ("window_s", 1e-3), "latency": ("latency_s", 1e-3)}
SETTINGS = tuple(f.name for f in fields(OperatingPoint) if f.name not in ("name", "profile", "radio"))


def setting_of(key: str, text: str) -> object:
    """Parse a setting's text by the type of its default; another text stays text, which no setting allows."""
    return value_of(getattr(POINTS["6g"], key), text)
