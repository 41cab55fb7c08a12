"""Define operating points: everything a cooperative decision depends on besides the scene and the model."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple, get_type_hints

from msgspec import structs

from harness.coordination.attacks import ATTACKS, Absent, attacks_of, in_question
from harness.coordination.contents import CONTENTS, INTENT, OBJECTS, PLAN, TRUTH, Content
from harness.coordination.encodings import JSON, beacon_bytes, request_bits
from harness.coordination.parts import FUSION, RELAY, Ask, Cloud, Fusion, Guard, Part, Radio, wrong
from harness.coordination.precedence import Precedence
from harness.coordination.robust import Heads
from harness.coordination.rules import EGO_PROMPT, RULES, names, reads_plans
from harness.coordination.schedules import SCHEDULES
from harness.coordination.scheduling import NEVER, PAPER
from harness.core.config import changed, settable, value_of
from harness.core.errors import UserError, printable, unknown
from harness.core.pairs import pairs
from harness.radio import constant
from harness.radio.channel import Channel, Physical, Unit
from harness.radio.networks import Network, network
from harness.radio.profiles import CHANNELS, NO_CHANNEL
from harness.radio.roadside import Relay
from harness.radio.wrapped import AtLoss

OVERRIDES = ("loss", "latency_s", "density_coupled")  # settings that replace a field of the channel
UNIT = ("edge_delay_s", "edge_x_m", "edge_y_m", "edge_antenna_m")  # settings of a roadside unit with a place
ALONE = (
    "calibration",
    "fallback",
    "round_trip",
    "round_trip_s",
    "window_s",
)  # settings of an ego that asks nobody
WEIGHING = ("weight_cap", "min_distance_m", "ego_distance_m")  # settings of the weights by distance
# Settings of helpers' intents: how they are fused, and when a helper's model is asked.
OF_INTENTS = ("consensus", *WEIGHING, "on_demand", "helper_rounds")
LONGEST_NAME = 1000
PARTS: dict[str, type[Part]] = {
    "radio": Radio, "ask": Ask, "fusion": Fusion, "guard": Guard, "cloud": Cloud,
}  # fmt: skip
# The part of each setting. Manifests and conditions have them flat; `radio` is there the further ones.
PART_OF = {key: part for part, kind in PARTS.items() for key in kind.__struct_fields__}
RECORDED = {"further": "radio"}


class Rewrites(NamedTuple):
    """How a fusion call shows messages."""

    blind: bool = False  # whether they come from helpers that are shown nothing
    attack: str = ""  # the attack that changes attackers' messages (`attacks.in_question`); empty for none
    defences: tuple[str, ...] = ()  # the defences that change every message
    graph: str = ""  # what the ego's graph is extended by (`contents.Content`)
    # what the prompt shows of messages: all of each, its words alone, or nothing
    shows: Literal["message", "words", ""] = "message"
    shuffled: bool = False  # whether they come from another layout


AS_SENT = Rewrites()


@dataclass(frozen=True)
class OperatingPoint:
    """The settings of one condition, in parts. Raises UserError for what does not go together."""

    name: str  # in reports
    radio: Radio = Radio()  # noqa: RUF009 (parts are frozen)
    ask: Ask = Ask()  # noqa: RUF009
    fusion: Fusion = Fusion()  # noqa: RUF009
    guard: Guard = Guard()  # noqa: RUF009
    cloud: Cloud = Cloud()  # noqa: RUF009

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.strip():
            raise UserError(f"operating point name {printable(self.name)!r}: give it some text")
        if len(self.name) > LONGEST_NAME:
            raise UserError(
                f"operating point name {printable(self.name)!r}: give it {LONGEST_NAME} characters at most"
            )
        try:
            self._check_together()
        except ValueError as error:
            raise _error_of(self.name, error) from None
        _ = self.channel

    def _check_together(self) -> None:
        holds = f"content is {self.ask.content}"
        self._check_plans(holds)
        if self.guard.attack and self.radio.profile is None:
            raise wrong("attack", self.guard.attack, "left out where there is no channel")
        if self.cloud.round_trip and self.has_fusion_call:
            twice = f"consensus is {EGO_PROMPT}" if self.content == CONTENTS[INTENT] else holds
            raise wrong("round_trip", self.cloud.round_trip, f"left out where {twice}, which asks twice")
        if self.ask.calibration and self.has_fusion_call:
            twice = f"consensus is {EGO_PROMPT}" if self.content == CONTENTS[INTENT] else holds
            allowed = f"left out where {twice}: the second question has no fit"
            raise wrong("calibration", self.ask.calibration, allowed)
        if self.content.graph == TRUTH and self.ask.messages == "shuffled":
            raise wrong("messages", "shuffled", f"own or blind where {holds}")
        if self.content.asks_again and self.radio.edge == FUSION:
            raise wrong(
                "edge", FUSION, f"none or relay where {holds}: a unit sends a policy and nothing else"
            )
        attacks = attacks_of(self.guard.attack)
        if any(attack.in_objects for attack in attacks) and self.content.graph != OBJECTS:
            raise wrong("attack", self.guard.attack, "one on intents where content lists no objects")
        kind = "in_words" if self.content.words else "in_objects"
        apt = all(getattr(attack, kind) or isinstance(attack, Absent) for attack in attacks)
        if not (self.content.intent or self.content.plan or apt):
            able = ", ".join(name for name in ATTACKS if getattr(ATTACKS[name], kind))
            allowed = f"some of {able} and absent where {holds}, which holds no intents"
            raise wrong("attack", self.guard.attack, allowed)
        if self.content.graph and len({attack.share for attack in attacks}) > 1:
            allowed = f"attacks of one share where {holds}, as the same vehicles do all"
            raise wrong("attack", self.guard.attack, allowed)
        if self.content.words and self.guard.defence not in ("", "quoted"):
            raise wrong("defence", self.guard.defence, f"quoted or left out where {holds}")
        if self.has_fusion_call and not all(attack.by_scene for attack in attacks):
            allowed = "one that needs no past and adds no voices where the ego is asked twice"
            raise wrong("attack", self.guard.attack, allowed)
        if self.fusion.consensus != EGO_PROMPT:
            if self.guard.defence:
                raise wrong("defence", self.guard.defence, f"left out where consensus is not {EGO_PROMPT}")
            return
        where = f"where consensus is {EGO_PROMPT}"
        if not (self.content.asks_helpers or self.content.plan):
            allowed = f"intent, text, both or {PLAN} {where}, which reads the helpers' words"
            raise wrong("content", self.ask.content, allowed)
        if self.radio.edge == FUSION:
            raise wrong("edge", FUSION, f"none or relay {where}: a unit has no model")

    def _check_plans(self, holds: str) -> None:
        """Raise ValueError for a rule that does not fit the content, and for what plans go without."""
        asks_again = self.content.plan and self.fusion.consensus == EGO_PROMPT
        if reads_plans(self.fusion.consensus) != self.content.plan and not asks_again:
            if self.content.plan:
                able = ", ".join(name for name in names() if reads_plans(name) or name == EGO_PROMPT)
                raise wrong("consensus", self.fusion.consensus, f"one of {able} where {holds}")
            raise wrong("content", self.ask.content, f"{PLAN} where consensus is {self.fusion.consensus}")
        if not self.content.plan:
            if self.fusion.rounds > 1:
                raise wrong("rounds", self.fusion.rounds, f"1 where {holds}, which holds no plans")
            return
        if self.fusion.rounds > 1 and (self.cloud.round_trip or self.cloud.round_trip_s is not None):
            raise wrong("rounds", self.fusion.rounds, "1 where the ego's model runs in a cloud")
        if self.ask.messages != "own":
            raise wrong("messages", self.ask.messages, f"own where {holds}")
        if self.ask.on_demand:
            raise wrong("on_demand", True, f"false where {holds}: an agent plans in any case")
        if self.radio.edge == FUSION:
            raise wrong("edge", FUSION, f"none or relay where {holds}: a unit has no plan")
        if any(attack.in_words for attack in attacks_of(self.guard.attack)):
            raise wrong("attack", self.guard.attack, f"one on intents where {holds}, which has no words")
        if self.guard.defence:
            allowed = f"left out where {holds}, which is no advice and has no words"
            raise wrong("defence", self.guard.defence, allowed)

    @classmethod
    def of(cls, name: str, profile: str | None = None, **settings: Any) -> "OperatingPoint":
        """Return the point of flat settings. Raises UserError for one that is unknown or not allowed."""
        return cls(name).changed(profile=profile, **settings)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "OperatingPoint":
        """Return the operating point of a configuration's table; without a profile it has no V2V.

        Raises UserError for an unknown key, or for a value that is not allowed.
        """
        allowed = ["name", *(RECORDED.get(key, key) for key in PART_OF)]
        for key in values:
            if key not in allowed:
                raise unknown("operating point setting", str(key), allowed)
        if "name" not in values:
            raise UserError('operating point without a name: add name = "..."')
        return cls.of(**{"further" if key == "radio" else key: value for key, value in values.items()})

    @staticmethod
    def types() -> dict[str, Any]:
        """Return the types of what `record` returns."""
        hints = {key: hint for kind in PARTS.values() for key, hint in get_type_hints(kind).items()}
        return {"name": str, **{RECORDED.get(key, key): hint for key, hint in hints.items()}}

    def record(self) -> dict[str, Any]:
        """Return the flat settings, as manifests have them; `from_dict` reads them."""
        return {"name": self.name, **{RECORDED.get(key, key): self.setting(key) for key in PART_OF}}

    def setting(self, key: str) -> Any:
        """Return a setting by its flat name."""
        return getattr(getattr(self, PART_OF[key]), key)

    def changed(self, **settings: Any) -> "OperatingPoint":
        """Return the point with some settings changed by their flat names, or its name. Raises UserError."""
        name = settings.pop("name", self.name)
        by_part: dict[str, dict[str, Any]] = {}
        for key, value in settings.items():
            by_part.setdefault(PART_OF[key], {})[key] = value
        try:
            parts = {part: structs.replace(getattr(self, part), **some) for part, some in by_part.items()}
        except ValueError as error:
            raise _error_of(name, error) from None
        return replace(self, name=name, **parts)

    @cached_property
    def channel(self) -> Channel:
        """The profile's channel with the point's overrides; its file is read once, when the point is made.

        Raises UserError for an override of a setting that the profile does not have.
        """
        radio = self.radio
        if radio.profile is None:
            return NO_CHANNEL
        channel = CHANNELS[radio.profile]
        settings = {key: getattr(radio, key) for key in OVERRIDES}
        overrides = {
            key: value for key, value in settings.items() if value is not None and value is not False
        }
        # A physical channel has no field for a loss: AtLoss wraps it below.
        loss = overrides.pop("loss", None) if isinstance(channel, Physical) else None
        for key in overrides:
            if key not in {field.name for field in fields(channel)}:
                raise self._wrong(key, f"left out: channel profile {radio.profile} has no such setting")
        further: Mapping[str, str] = pairs(radio.further) if radio.further else {}
        if further:
            channel = changed(channel, further, f"channel profile {radio.profile}")
        known = vars(channel) if isinstance(channel, Physical) else {}
        if radio.encoding != JSON and "packet_bytes" in known and "packet_bytes" not in further:
            overrides["packet_bytes"] = beacon_bytes(radio.encoding, known["rate_hz"])
        channel = replace(channel, **overrides)
        if isinstance(channel, Physical):
            channel = channel if loss is None else AtLoss(channel, loss)
            return Relay(channel, self._unit, radio.edge_delay_s) if radio.edge == RELAY else channel
        if radio.edge != "none":
            channel = self._relayed(channel)
        if radio.loss is not None and getattr(channel, "density_coupled", False):
            raise self._wrong("loss", "left out where density_coupled is true; keep one of the two")
        return channel

    @cached_property
    def physical(self) -> Physical | None:
        """The channel if its losses follow from where vehicles are; None if it has one loss for all links."""
        return self.channel if isinstance(self.channel, Physical) else None

    def _relayed(self, channel: Channel) -> Channel:
        """Return a channel without places, with the relay as a second path of the same kind."""
        profile = self.radio.profile
        if self.radio.edge == FUSION:
            raise self._wrong("edge", f"none or relay: links of channel profile {profile} have no places")
        if not hasattr(channel, "roadside_edge"):
            raise self._wrong("edge", f"left out: channel profile {profile} has no such setting")
        for key in UNIT:
            if getattr(self.radio, key) != getattr(Radio(), key):
                raise self._wrong(key, f"left out: links of channel profile {profile} have no places")
        return replace(channel, roadside_edge=True)

    @property
    def _unit(self) -> Unit:
        return Unit(self.radio.edge_x_m, self.radio.edge_y_m, self.radio.edge_antenna_m)

    @property
    def unit(self) -> Unit | None:
        """The roadside unit; None if there is none, or none with a place."""
        return self._unit if self.radio.edge != "none" and self.physical else None

    @cached_property
    def network(self) -> Network | None:
        """The network to a cloud, or None; its file is read once. Raises UserError if it is unknown."""
        return network(self.cloud.round_trip) if self.cloud.round_trip else None

    def of_radio(self, settings: Mapping[str, str]) -> "OperatingPoint":
        """Return the point with these settings of its channel. Raises UserError for an unknown setting."""
        texts = {**pairs(self.radio.further), **settings}
        return self.changed(further=",".join(f"{key}={value}" for key, value in texts.items()))

    def idle(self, setting: str | None) -> str | None:
        """Return why a setting changes nothing here, whatever its value; None if it may change something.

        Args:
            setting: a setting of the point or of its channel; None for the number of vehicles.
        """
        ask, consensus = self.ask, self.fusion.consensus
        if self.radio.profile is None and setting not in ALONE:
            return "it has no channel"
        if ask.schedule == NEVER and setting not in (*ALONE, "schedule"):
            return f"schedule {NEVER} asks nobody"
        if ask.max_helpers == 0 and setting not in (*ALONE, "max_helpers"):
            return "max_helpers is 0, so it asks nobody"
        if setting == "tau_nats" and ask.schedule != PAPER and not self.radio.helper_rounds:
            return f"schedule {ask.schedule} has a threshold of its own"
        if setting == "request_bits" and self.radio.encoding != JSON:
            return f"encoding {self.radio.encoding} has a size of its own for requests"
        if setting in UNIT and self.radio.edge == "none":
            return "it has no roadside unit (edge is none)"
        on_demand = setting == "on_demand" and self.content.asks_helpers
        if setting in OF_INTENTS and not (self.content.intent or self.content.plan or on_demand):
            return f"content {ask.content} holds no intents"
        if setting == "rounds" and not self.content.plan:
            return f"content {ask.content} holds no plans"
        weighs_none = consensus == EGO_PROMPT or isinstance(RULES[consensus], Heads | Precedence)
        if setting in WEIGHING and weighs_none:
            return f"consensus {consensus} weighs no distances"
        counts_rounds = isinstance(self.channel, constant.Radio) and not self.channel.density_coupled
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
        return self.radio.profile is not None and self.ask.max_helpers > 0 and self.ask.schedule != NEVER

    def needs(self, what: str) -> bool:
        """Return whether a schedule, rule or attack of it needs `in_time`, `outlook`, `lot` or `claims`."""
        return what in self._needs

    @cached_property
    def _needs(self) -> frozenset[str]:
        if self.radio.profile is None:
            return frozenset()
        rule = RULES.get(self.fusion.consensus)
        parts = (SCHEDULES[self.ask.schedule], rule, *attacks_of(self.guard.attack))
        return frozenset(need for part in parts for need in getattr(part, "needs", ()))

    @property
    def content(self) -> Content:
        """What a message holds."""
        return CONTENTS[self.ask.content]

    @property
    def request_bits(self) -> float:
        """Size of a request."""
        if self.radio.encoding == JSON:
            return self.ask.request_bits
        return request_bits(self.radio.encoding, self.ask.max_helpers, self.physical is not None)

    @property
    def has_fusion_call(self) -> bool:
        """Whether fusion asks the ego's model a second time, with the messages or what they add."""
        second = self.fusion.consensus == EGO_PROMPT or self.content.asks_again
        return self.radio.profile is not None and second

    @property
    def blind_helpers(self) -> bool:
        """Whether the helpers that are asked are shown nothing."""
        return self.radio.profile is not None and self.ask.messages == "blind"

    @property
    def rewrites(self) -> "Rewrites":
        """How its fusion calls show messages."""
        defences = tuple(part for part in self.guard.defences if part != "majority")
        whole: Literal["message", ""] = "message" if self.fusion.consensus == EGO_PROMPT else ""
        shows: Literal["message", "words", ""] = "words" if self.content.words else whole
        graph = self.content.graph
        attack = in_question(self.guard.attack, bool(shows), bool(graph))
        return Rewrites(self.blind_helpers, attack, defences, graph, shows, self.ask.messages == "shuffled")

    def _wrong(self, key: str, allowed: str) -> UserError:
        return _error_of(self.name, wrong(key, self.setting(key), allowed))


def _error_of(name: str, error: ValueError) -> UserError:
    return UserError(f"operating point {printable(name)!r}: {error}")


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
    point = points.get(name) or OperatingPoint(name, Radio(profile=name))
    channel_settings = (
        [key for key in settable(point.channel) if key not in OVERRIDES] if point.radio.profile else []
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
        if key in settings and point.radio.profile is None:
            raise UserError(
                f"operating point {printable(text)!r}: {name} has no channel, so {key} changes nothing; "
                "leave it out"
            )
    if "round_trip" in settings and "round_trip_s" not in settings:
        settings["round_trip_s"] = None  # `cloud` has the paper's; only one of the two may be set
    point = point.of_radio(radio) if radio else point
    return point.changed(name=text, **settings) if settings or radio else point


# Short names of settings, as in `harness study sweep --over`, each with the factor to the setting's unit.
SHORT = {"tau": ("tau_nats", 1.0), "window": ("window_s", 1e-3), "latency": ("latency_s", 1e-3)}
SETTINGS = tuple(key for key in PART_OF if key not in ("profile", "further"))


def setting_of(key: str, text: str) -> object:
    """Parse a setting's text by the type of its default; another text stays text, which no setting allows."""
    return value_of(POINTS["6g"].setting(key), text)
