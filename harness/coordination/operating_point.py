"""Define operating points: everything a cooperative decision depends on besides the scene and the
model.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple, get_type_hints

import msgspec
from msgspec import structs

from harness.coordination.contents import (
    CONTENTS,
    INTENTS,
    KINDS,
    OBJECTS,
    PLANS,
    Content,
)
from harness.coordination.encodings import JSON, beacon_bytes, request_bits
from harness.coordination.intents import Intents
from harness.coordination.part_settings import (
    OVERRIDES,
    PARTS,
    RECORDED,
    calls,
    more_parts,
    part_of_settings,
    settings_alone,
    settings_of_radio,
    without_gone,
)
from harness.coordination.parts import (
    PLAIN,
    ActsOn,
    Ask,
    Changes,
    Cloud,
    Fusion,
    Kept,
    Part,
    Question,
    Radio,
    telling,
    worded_part,
    wrong,
)
from harness.coordination.parts import is_ours as is_ours_part
from harness.coordination.parts_of_packages import prepared, speaker_of
from harness.coordination.rules import EGO_PROMPT, RULES, names, reads
from harness.coordination.schedules import SCHEDULES
from harness.coordination.scheduling import NEVER, PAPER
from harness.coordination.sent import Honest, SentIntents, Speaker
from harness.coordination.streams import Stream
from harness.core.arrays import Floats
from harness.core.config import changed
from harness.core.errors import UserError, printable, unknown
from harness.core.pairs import pairs
from harness.radio import constant
from harness.radio.channel import Antenna, Channel, Draws, Links, Physical
from harness.radio.consulted import Consulted
from harness.radio.networks import Network, network
from harness.radio.profiles import CHANNELS, NO_CHANNEL
from harness.radio.wrapped import AtLoss

if TYPE_CHECKING:
    from harness.coordination.coordinate import Coordination
    from harness.coordination.exchange import Exchange

WEIGHING = ("weight_cap", "min_distance_m", "ego_distance_m")  # settings of the weights by distance
# Settings of helpers' intents: how they are fused, and when a helper's model is asked.
OF_INTENTS = ("consensus", *WEIGHING, "on_demand", "helper_rounds")
OF_ASKING = ("ask", "fusion")  # parts that matter only where helpers are asked
LONGEST_NAME = 1000


class Rewrites(NamedTuple):
    """Describe how a fusion call shows helpers' messages to the ego's model.

    A fusion call is a second question to that model, with what the ego has heard. This becomes part
    of the key under which its answer is kept.
    """

    # name of the question that helpers were asked, such as one that shows them nothing; empty for
    # the ordinary one, what the ego should do
    question: str = ""
    # names of the changes that attacks, and defences against these, make to messages
    changes: Changes = Changes()
    # name of the second question to the ego's model, if messages carry what the first cannot show,
    # such as lists of objects; empty for none
    call: str = ""
    whole: bool = True  # whether the prompt shows all of each message
    # whether messages come from other scenes, to test whether what they say matters
    elsewhere: bool = False


AS_SENT = Rewrites()


@dataclass(frozen=True)
class OperatingPoint:
    """Hold the settings under which a run plays its decisions; also called a condition.

    With scene and model they are all that a decision depends on. They are grouped in parts, those
    below and those of extensions. Each setting also has a flat name, without its part's, such as
    `tau_nats`, by which it stands in run files and in texts such as `6g:tau_nats=0.5`. Raises
    UserError if settings contradict each other.
    """

    name: str  # its name in reports and records, such as `6g:window_s=0.4`
    # the radio channel between vehicles
    radio: Radio = Radio()  # noqa: RUF009 (parts are frozen)
    # whom the ego asks, when, and what messages carry
    ask: Ask = Ask()  # noqa: RUF009
    # how the ego fuses what it hears with its own intent
    fusion: Fusion = Fusion()  # noqa: RUF009
    # how far away the ego's model is, if not in the vehicle
    cloud: Cloud = Cloud()  # noqa: RUF009
    # groups of settings that extensions add, those that differ from their defaults, in the order of
    # `more_parts`
    more: tuple[Part, ...] = ()

    def __post_init__(self) -> None:
        if self.more:
            active, kinds = {type(part): part for part in self.more}, more_parts().values()
            more = [active[kind] for kind in kinds if active.get(kind, kind()) != kind()]
            object.__setattr__(self, "more", tuple(more))
        if not isinstance(self.name, str) or not self.name.strip():
            raise UserError(f"operating point name {printable(self.name)!r}: give it some text")
        if len(self.name) > LONGEST_NAME:
            raise UserError(
                f"operating point name {printable(self.name)!r}: give it {LONGEST_NAME} characters "
                "at most"
            )
        try:
            self._check_together()
            _ = self.channel
        except ValueError as error:
            raise _error_of(self.name, error) from None

    def _check_together(self) -> None:
        self._check_reads()
        for part in (self.radio, self.ask, self.fusion, self.cloud, *self.more):
            with telling(part):
                for act in part.acts_on:
                    self._check_holds(act)
                part.check_with(self)
        if self.cloud.round_trip and self.has_fusion_call:
            allowed = f"left out where {self.asks_twice}, which asks twice"
            raise wrong("round_trip", self.cloud.round_trip, allowed)

    def _check_reads(self) -> None:
        """Raise ValueError for a content that holds nothing that its rule reads."""
        content, consensus = self.ask.content, self.fusion.consensus
        call = self.content.call
        if call and call.name not in calls():
            raise wrong("content", content, "another: messages are changed by that name")
        if _may_read(consensus, self.content):
            return
        if consensus == Fusion().consensus:
            able = [name for name in names() if _may_read(name, self.content)]
            raise wrong("consensus", consensus, f"{_any_of(able)} where content is {content}")
        able = [name for name, other in CONTENTS.usable().items() if _may_read(consensus, other)]
        read = [kind for kind in KINDS if kind in reads(consensus)]
        where = f"where consensus is {consensus}, which reads {_any_of(read)}"
        raise wrong("content", content, f"{_any_of(able)} {where}")

    def _check_holds(self, act: ActsOn) -> None:
        """Raise ValueError for a setting that needs messages of other kinds."""
        if not act.kinds or (OBJECTS in act.kinds and self.stream is not None):
            return
        if self.content.holds.isdisjoint(act.kinds):
            allowed = _any_of((*act.others(self.content.holds), act.instead))
            holds = f"content is {self.ask.content}, which holds no {_any_of(act.kinds)}"
            raise wrong(act.setting, act.value, f"{allowed} where {holds}")

    @classmethod
    def of(cls, name: str, profile: str | None = None, **settings: Any) -> "OperatingPoint":
        """Return an operating point called `name`, with defaults where nothing else is stated.

        `profile` names its channel profile, a file of `channels/` such as `6g`; None gives it no
        radio. `settings` are values by flat name, such as `tau_nats=0.5`. Raises UserError for an
        unknown channel profile, or a value that is not allowed.
        """
        return cls(name).changed(profile=profile, **settings)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "OperatingPoint":
        """Return the operating point that a TOML or JSON table states.

        `values` has its `name`, and settings by flat name, such as `tau_nats`. Without a `profile`
        it has no radio. Raises UserError for an unknown key, or for a value that is not allowed.
        """
        allowed = ["name", *(RECORDED.get(key, key) for key in part_of_settings())]
        values = without_gone(values)
        for key in values:
            if key not in allowed:
                raise unknown("operating point setting", str(key), allowed)
        if "name" not in values:
            raise UserError('operating point without a name: add name = "..."')
        return cls.of(
            **{"further" if key == "radio" else key: value for key, value in values.items()}
        )

    @staticmethod
    def types() -> dict[str, Any]:
        """Return the type of each setting by its name, such as `float` for `tau_nats`.

        The names are the keys of the table that `record` returns; a type is an annotation.
        """
        hints = {part: get_type_hints(kind) for part, kind in {**PARTS, **more_parts()}.items()}
        types: dict[str, Any] = {"name": str}
        for key, part in part_of_settings().items():
            types[RECORDED.get(key, key)] = hints[part][key]
        return types

    def record(self) -> dict[str, Any]:
        """Return all settings as a table for run files, by flat name, with the `name`.

        `from_dict` makes an equal object of it. An extension's group of settings that has only its
        defaults is left out, so that runs without that extension can be read where it is not
        installed.
        """
        active = {type(part) for part in self.more}
        idle = {name for name, kind in more_parts().items() if kind not in active}
        record: dict[str, Any] = {"name": self.name}
        for key, part in part_of_settings().items():
            if part not in idle:
                record[RECORDED.get(key, key)] = self.setting(key)
        return record

    def setting(self, key: str) -> Any:
        """Return the value of the setting `key`, a flat name such as `tau_nats`.

        Raises KeyError if there is no such setting.
        """
        return getattr(self._part(part_of_settings()[key]), key)

    def _part(self, name: str) -> Part:
        """Return a part by name; of an extension's that does nothing, its defaults."""
        if name in PARTS:
            part: Part = getattr(self, name)
            return part
        kind = more_parts()[name]
        return next((part for part in self.more if type(part) is kind), kind())

    def changed(self, **settings: Any) -> "OperatingPoint":
        """Return a copy with some settings, or the `name`, changed.

        `settings` are the new values by flat name, such as `tau_nats=0.5`. What these imply
        (`Part.implies`) is set as well where it is not given.
        Raises UserError for a value that is not allowed, or settings that contradict each other.
        """
        name = settings.pop("name", self.name)
        by_part: dict[str, dict[str, Any]] = {}
        for key, value in without_gone(settings).items():
            by_part.setdefault(part_of_settings()[key], {})[key] = value
        try:
            parts = {
                part: structs.replace(self._part(part), **some) for part, some in by_part.items()
            }
        except ValueError as error:
            raise _error_of(name, error) from None
        for part in filter(is_ours_part, parts.values()):
            if not part.implies().keys() <= settings.keys():
                return self.changed(name=name, **{**part.implies(), **settings})
        core_parts: dict[str, Any] = {part: parts[part] for part in PARTS if part in parts}
        changed_kinds = {type(part) for part in parts.values()}
        others = [part for part in self.more if type(part) not in changed_kinds]
        more = (*others, *(parts[part] for part in more_parts() if part in parts))
        return replace(self, name=name, more=more, **core_parts)

    @cached_property
    def channel(self) -> Channel:
        """Return the model of the radio channel: its profile's with this point's overrides.

        A channel decides which messages arrive, and when; its profile is a file of `channels/`.
        Without a profile it is one on which nothing is received. Made once, with the point. Raises
        UserError for an override of a setting that the profile does not have.
        """
        radio = self.radio
        if radio.profile is None:
            return NO_CHANNEL
        channel = CHANNELS[radio.profile]
        settings = {key: getattr(radio, key) for key in OVERRIDES}
        overrides = {
            key: value
            for key, value in settings.items()
            if value is not None and value is not False
        }
        # A physical channel has no field for a loss: AtLoss wraps it below.
        loss = overrides.pop("loss", None) if isinstance(channel, Physical) else None
        for key in overrides:
            if key not in {field.name for field in fields(channel)}:
                raise self._wrong(
                    key, f"left out: channel profile {radio.profile} has no such setting"
                )
        further: Mapping[str, str] = pairs(radio.further) if radio.further else {}
        if further:
            channel = changed(channel, further, f"channel profile {radio.profile}")
        values = vars(channel) if isinstance(channel, Physical) else {}
        if radio.encoding != JSON and "packet_bytes" in values and "packet_bytes" not in further:
            overrides["packet_bytes"] = beacon_bytes(radio.encoding, values["rate_hz"])
        channel = replace(channel, **overrides)
        if isinstance(channel, Physical):
            channel = channel if loss is None else AtLoss(channel, loss)
        elif radio.loss is not None and getattr(channel, "density_coupled", False):
            raise self._wrong("loss", "left out where density_coupled is true; keep one of the two")
        for part in self._shipped:
            channel = part.carried(self, channel)
        return channel

    @cached_property
    def _shipped(self) -> Sequence[Part]:
        """Return the extensions' parts that ship; some hooks are not for packages' parts."""
        return [part for part in self.more if is_ours_part(part)]

    @cached_property
    def physical(self) -> Physical | None:
        """Return the radio channel if its losses follow from where vehicles are, else None."""
        return self.channel if isinstance(self.channel, Physical) else None

    @property
    def antennas(self) -> Collection[Antenna]:
        """Return the antennas beside the road and the like whose radio links are to be computed.

        There are none where the channel is not `physical`, since links then have no positions.
        """
        if self.physical is None:
            return ()
        return tuple(chain(*(part.antennas for part in self._shipped)))

    @cached_property
    def network(self) -> Network | None:
        """Return the network between the ego and its model in a cloud; None without one.

        Round trips over it are drawn. Raises UserError if there is none of the name in the setting
        `round_trip`.
        """
        return network(self.cloud.round_trip) if self.cloud.round_trip else None

    def of_radio(self, settings: Mapping[str, str]) -> "OperatingPoint":
        """Return a copy with some settings of its radio channel changed.

        `settings` has their new values as texts, by name, such as `{"jitter_s": "0.01"}`. Raises
        UserError for an unknown setting or a value that is not allowed.
        """
        texts = {**pairs(self.radio.further), **settings}
        return self.changed(further=",".join(f"{key}={value}" for key, value in texts.items()))

    def idle(self, setting: str | None) -> str | None:
        """Return why changing one setting of this point cannot change a result; None if it may.

        A sweep refuses such a setting. The reason is a part of a sentence, such as "it has no
        channel".

        Args:
            setting: name of a setting of the point or of its channel; None for the number of
                vehicles.
        """
        ask, consensus = self.ask, self.fusion.consensus
        matters_alone = setting in settings_alone() and setting not in settings_of_radio()
        if self.radio.profile is None and not matters_alone:
            return "it has no channel"
        of_asking = part_of_settings().get(setting or "") in OF_ASKING
        if (self.stream is None or of_asking) and setting not in settings_alone():
            if ask.schedule == NEVER and setting != "schedule":
                return f"schedule {NEVER} asks nobody"
            if ask.max_helpers == 0 and setting != "max_helpers":
                return "max_helpers is 0, so it asks nobody"
        if setting == "tau_nats" and ask.schedule != PAPER and not self.radio.helper_rounds:
            return f"schedule {ask.schedule} has a threshold of its own"
        if setting == "request_bits" and self.radio.encoding != JSON:
            return f"encoding {self.radio.encoding} has a size of its own for requests"
        if setting is not None and setting in part_of_settings():
            part = self._part(part_of_settings()[setting])
            if is_ours_part(part) and (why := part.idle(setting)):
                return why
        on_demand = setting == "on_demand" and self.content.asks_helpers
        fuses_none = self.content.holds.isdisjoint((INTENTS, PLANS))
        if setting in OF_INTENTS and fuses_none and not on_demand:
            return f"content {ask.content} holds no intents"
        weighs = consensus != EGO_PROMPT and getattr(RULES[consensus], "by_distance", True)
        if setting in WEIGHING and not weighs:
            return f"consensus {consensus} weighs no distances"
        counts_rounds = (
            isinstance(self.channel, constant.Radio) and not self.channel.density_coupled
        )
        if setting == "helper_rounds" and not counts_rounds:
            return "the load of its channel does not depend on it"
        channel: Any = self.channel
        while channel is not None:
            says = getattr(channel, "idle", None)
            if says and (why := says(setting)):
                return str(why)
            channel = getattr(channel, "channel", None)  # what a wrapper wraps
        return None

    def prepared(self, intents: Intents) -> Intents:
        """Return what vehicles intend in n decisions, corrected as a calibration says.

        An intent is the probabilities of the actions; any group of an extension's settings may
        correct it. This is done first, before a fallback replaces a failed answer, a helper is
        asked, or intents are fused.
        """
        for part in self.more:
            intents = prepared(part, intents)
        return intents

    @property
    def asks(self) -> bool:
        """Return whether an ego may ask helpers at all: it has a channel and a schedule that asks.

        A schedule is the rule for whom to ask.
        """
        return (
            self.radio.profile is not None
            and self.ask.max_helpers > 0
            and self.ask.schedule != NEVER
        )

    def needs(self, what: str) -> bool:
        """Return whether some part, schedule, rule or content needs an optional input `what`.

        A part is a group of settings, a schedule the rule for whom to ask, a rule what fuses, and
        the content what messages hold. What no point needs is not computed. `what` is `in_time`
        (the probability of a reply in the decision window), `outlook` (how much the ego sees of
        where a danger may come from), `lot` (a random draw), `claims` (positions that helpers
        state), `numbers` (which helpers of their episode they are), `objects` (the lists of what
        they see) or `plans` (what vehicles state of their own motion).
        """
        return what in self._needs

    @cached_property
    def _needs(self) -> frozenset[str]:
        needs = set(self.content.needs)
        if self.radio.profile is None:
            return frozenset(needs)
        rule = RULES.get(self.fusion.consensus)
        plug_ins = (SCHEDULES[self.ask.schedule], rule)
        needs.update(need for plug_in in plug_ins for need in getattr(plug_in, "needs", ()))
        for part in self.more:
            with worded_part(part):
                needs.update(part.needs)
        return frozenset(needs)

    @cached_property
    def needs_all(self) -> bool:
        """Return whether some group of settings, such as an attack's, needs all helpers' intents.

        Otherwise those of the helpers that are asked are enough.
        """
        needing = []
        for part in self.more:
            with worded_part(part):
                needing.append(bool(part.needs_all))
        return any(needing)

    @property
    def content(self) -> Content:
        """Return what helpers' messages carry, such as probabilities of actions with words.

        The setting `content` names it.
        """
        return CONTENTS[self.ask.content]

    @property
    def request_bits(self) -> float:
        """Return the size in bits of the message by which an ego asks helpers.

        It is the setting, or follows from the standard by which messages are encoded.
        """
        if self.radio.encoding == JSON:
            return self.ask.request_bits
        return request_bits(self.radio.encoding, self.ask.max_helpers, self.physical is not None)

    @property
    def has_fusion_call(self) -> bool:
        """Return whether the ego's model is asked a second time, with what the ego has heard."""
        return self.radio.profile is not None and self.asks_again

    @property
    def asks_again(self) -> bool:
        """Return whether these settings ask the ego's model a second time, with what it has heard.

        That is so with the consensus `ego-prompt`, or if messages carry what only a second prompt
        can show, such as objects. It is so even without a channel over which the ego could hear
        anything.
        """
        return self.fusion.consensus == EGO_PROMPT or self.content.call is not None

    @property
    def asks_twice(self) -> str:
        """Return in words, for a message, which setting asks the ego's model a second time."""
        if self.content.call:
            return f"content is {self.ask.content}"
        return f"consensus is {EGO_PROMPT}"

    @cached_property
    def question(self) -> Question:
        """Return the question that helpers' models are asked under these settings.

        The ordinary one is what the ego should do, as the helper sees it; an extension's group of
        settings may have another. Raises UserError if a package's returns one that is not in its
        `questions`.
        """
        if self.radio.profile is None:
            return PLAIN
        for part in self.more:
            with worded_part(part):
                question = part.question
                if question not in (PLAIN, *part.questions):
                    raise ValueError("it asks what is none of its questions")
            if question != PLAIN:
                return question
        return PLAIN

    @cached_property
    def stream(self) -> Stream | None:
        """Return the messages that helpers send unasked under these settings; None for none.

        They hold objects.
        """
        streams = [part.unasked(self) for part in self._shipped]
        return next((stream for stream in streams if stream is not None), None)

    @cached_property
    def elsewhere(self) -> Part | None:
        """Return the part, a group of settings, by which the ego hears helpers of other scenes.

        It is a control: such messages say nothing of the ego's own scene. None without one.
        """
        for part in self.more:
            with worded_part(part):
                elsewhere = bool(part.elsewhere)
            if elsewhere:
                return part
        return None

    @property
    def rewrites(self) -> "Rewrites":
        """Return how helpers' messages are shown when the ego's model is asked a second time.

        That is with what the ego has heard (a fusion call). It says which attacks and defences
        change them.
        """
        call = self.content.call
        name = call.name if call else ""
        whole = self.fusion.consensus == EGO_PROMPT and not (call and call.in_words)
        elsewhere = self.elsewhere is not None
        return Rewrites(self.question.name, self._changes(), name, whole, elsewhere)

    @property
    def shows_words(self) -> bool:
        """Return whether the ego's model reads messages or words of helpers, not only objects.

        It reads them in a fusion call, a second question with what the ego has heard.
        """
        call = self.content.call
        return self.fusion.consensus == EGO_PROMPT or (call is not None and call.in_words)

    def _changes(self) -> Changes:
        """Return what parts change of messages whose words or objects a fusion call shows."""
        call = self.content.call
        objects = self.stream is not None or (call is not None and call.in_graph)
        each = []
        for part in self.more:
            with worded_part(part):
                each.append(Changes(*part.changes(self.shows_words, objects)))
        of_attackers = "&".join(filter(None, (changes.of_attackers for changes in each)))
        return Changes(of_attackers, tuple(chain(*(changes.of_all for changes in each))))

    def speaker(self) -> Speaker:
        """Return a new object that decides what helpers send, the truth or what attackers say.

        It is for one walk through a run's episodes; it may keep state, so each walk needs its own.
        """
        for part in self.more:
            if speaker := speaker_of(part):
                return speaker
        return Honest()

    def ask_for_ego(
        self, links: Links, draws: Draws, ready: "Callable[[Floats], Floats]", left_s: Floats
    ) -> Consulted | None:
        """Return what comes of another asking the helpers for the ego; None if the ego asks itself.

        A part may ask, such as an antenna beside the road.

        Args:
            links: the links of the ego and its H helpers, with those that it wants to ask.
            draws: the channel's random numbers.
            ready: returns when replies can leave, `(..., H)`, from when helpers have the request,
                of the same shape or `(..., 1)`; both in s from the start of the ego's request.
            left_s: seconds from the start of the ego's request until it waits no longer, `(...)`.
        """
        for part in self._shipped:
            consulted = part.ask(self, links, draws, ready, left_s)
            if consulted is not None:
                return consulted
        return None

    def again(
        self,
        sent: SentIntents,
        heard: "Exchange",
        decide: "Callable[[Exchange, Intents], Coordination]",
    ) -> "tuple[SentIntents, Exchange]":
        """Return what is sent and heard after all that vehicles tell each other before they act.

        Each part of the condition that is the harness's own may add to it in turn (`Part.again`),
        as further rounds of messages do; without such a part both stay as they are.

        Args:
            sent: what vehicles have sent so far in n decisions.
            heard: who was asked and heard so far.
            decide: returns the n decisions as they would be made with an exchange and the intents
                known after it.

        Returns:
            Both `sent` and `heard`, with the further messages.
        """
        for part in self._shipped:
            sent, heard = part.again(self, sent, heard, decide)
        return sent, heard

    def _wrong(self, key: str, allowed: str) -> UserError:
        return _error_of(self.name, wrong(key, self.setting(key), allowed))


def kept_of(points: Iterable[OperatingPoint]) -> dict[str, dict[str, Kept]]:
    """Return what a run must store of the things that its operating points name.

    An operating point is a set of settings; such a thing is the calibration of a model. The outer
    key is a folder of the run, the inner one a name in it. Raises UserError if a package's code
    fails, or gives a name that is no plain file name.
    """
    kept: dict[str, dict[str, Kept]] = {}
    for point in points:
        for part in point.more:
            with worded_part(part):
                for folder, by_name in part.kept().items():
                    for name in (folder, *by_name):
                        if name in ("", ".", "..") or {"/", "\\"} & set(name):
                            raise ValueError(f"{name} to keep is no plain name")
                    msgspec.json.encode([each.record for each in by_name.values()])
                    kept.setdefault(folder, {}).update(by_name)
    return kept


def as_here(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return a condition's recorded settings without those of extensions that do nothing.

    So a run of a version with more extensions can be read. A condition is an operating point of a
    run, a set of settings; `settings` are values by flat name. A part, an extension's group of
    them, does nothing if all are at their defaults. Raises UserError for a setting that does
    something and whose extension is not installed.
    """
    here = without_gone(settings)
    for kind in more_parts().values():
        defaults = kind()
        if all(
            here.get(key, default) == default for key, default in structs.asdict(defaults).items()
        ):
            here = {key: value for key, value in here.items() if key not in kind.__struct_fields__}
    return here


def _may_read(consensus: str, content: Content) -> bool:
    """Return whether a rule fuses what a content holds, or what the ego answers to it."""
    kinds = content.holds
    if content.call and consensus != EGO_PROMPT:
        kinds = kinds | {INTENTS}
    return not kinds.isdisjoint(reads(consensus))


def _any_of(names: Iterable[str]) -> str:
    *others, last = names
    return f"{', '.join(others)} or {last}" if others else last


def _error_of(name: str, error: ValueError) -> UserError:
    return UserError(f"operating point {printable(name)!r}: {error}")
