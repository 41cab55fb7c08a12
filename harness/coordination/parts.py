"""Define the parts of an operating point: radio, whom the ego asks, fusion, a cloud.

Each part checks itself and raises ValueError with the setting, its value and what it must be.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, Protocol, get_type_hints

import numpy as np
from msgspec import Meta, Struct, ValidationError, convert, structs

from harness.coordination.contents import CONTENTS, INTENT, KINDS, PLANS
from harness.coordination.encodings import ENCODINGS, JSON
from harness.coordination.rules import EGO_PROMPT, RULES
from harness.coordination.schedules import SCHEDULES
from harness.coordination.scheduling import ORACLE, PAPER
from harness.core.config import LARGEST, LONGEST_S, Seconds, description
from harness.core.errors import UserError, printable, unknown
from harness.core.extensions import owner_of_plugin, part_of
from harness.core.plugins import Plugins
from harness.core.strangers import worded
from harness.radio.channel import Antenna, Channel, Draws, Links
from harness.radio.consulted import Consulted
from harness.radio.networks import network
from harness.radio.profiles import CHANNELS

if TYPE_CHECKING:
    from harness.coordination.coordinate import Coordination
    from harness.coordination.exchange import Exchange
    from harness.coordination.intents import Intents
    from harness.coordination.operating_point import OperatingPoint
    from harness.coordination.sent import SentIntents, Speaker
    from harness.coordination.streams import Stream
    from harness.core.arrays import Bools, Floats, Ints
    from harness.world.scene_graph import SceneGraph

FALLBACKS = ("uniform", "brake")
MOST_HELPERS = 1000

# what a setting must be whose type says no more
BARE = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
Metres = Annotated[float, Meta(gt=0, le=1e6, description="metres above 0, at most 1000000")]
Text = Annotated[str, Meta(description="a text")]
Flag = Annotated[bool, Meta(description="true or false")]


class Kept(NamedTuple):
    """Hold what a run stores of one thing that its settings name.

    Such a thing is the calibration of a model, by its name.
    """

    record: Any  # its content, or the digest of its file, as values that JSON can hold
    file: Any = None  # its file, a `pathlib.Path`; None if it has none


@dataclass(frozen=True)
class Question:
    """Describe what a helper's model is asked: what the ego should do, as the helper sees it.

    Subclasses ask it with a changed scene graph, what the helper knows of the scene. Such is a
    control that shows the helper nothing, to test whether what it sees matters.
    """

    # its name, empty for the ordinary question; it ends the key under which its answers are kept,
    # behind a `~`, and is the role that they are listed under
    name: str = ""
    words: str = "are asked"  # how helpers are asked, in messages behind "that"
    pictured: bool = True  # whether the prompt may have the picture of the helper's camera

    def shown(self, graph: "SceneGraph") -> "SceneGraph":
        """Return what the helper's prompt shows of the scene, given what the helper knows.

        Both are scene graphs, what one vehicle knows of a scene. Here it is unchanged.
        """
        return graph


PLAIN = Question()


class Change(Protocol):
    """Describe how an attack, or a defence, changes messages before the ego's model reads them.

    The model is asked a second time, with the messages that the ego heard (a fusion call).
    """

    @property
    def adds(self) -> bool:
        """Return whether this change to messages adds text that no other change may touch.

        It is then applied last.
        """

    def message(self, message: Mapping[str, Any], actions: Sequence[str]) -> dict[str, Any]:
        """Return a helper's message, a record with its `intent`, as the prompt is to show it.

        `message` has the names and values of what was sent; `actions` the names of the ego's
        actions, in the order of the intent's probabilities.
        """

    def graph(self, graph: "SceneGraph", scenario: Any, scene: Any) -> "SceneGraph":
        """Return the sender's scene graph with this change; its objects are what is sent.

        A scene graph is what one vehicle knows of a scene. `graph` is the true one; `scene`, of the
        scenario `scenario`, is the decision point's scene, which has the state of all vehicles.
        """


class Changes(NamedTuple):
    """Name how attacks and defences change messages before the ego's model reads them.

    The model is asked a second time, with the messages that the ego heard (a fusion call). The
    names become part of the key under which its answer is kept, so they hold no `+` and no `&`.
    """

    # name of the change to messages of helpers that attack, such as `liar:share=1/3`; several are
    # joined by `&`; empty for none
    of_attackers: str = ""
    # names of the changes to messages of all helpers, such as `quoted`, in the order in which they
    # are made
    of_all: tuple[str, ...] = ()


class ActsOn(NamedTuple):
    """Describe a setting that only matters if messages carry certain things, such as words.

    A text attack, for example, needs words. Where the operating point's messages carry none of
    `kinds`, the setting is refused. An operating point is the set of settings that a decision
    depends on.
    """

    setting: str  # name of the setting
    value: object  # its value; of a text that names several things, one of them
    # the kinds of content, such as `intent`, of which messages must hold at least one
    # (`contents.KINDS`)
    kinds: Collection[str]
    instead: str = "left out"  # what the setting must be where they hold none
    # returns other values that the setting may have; takes the kinds that messages hold
    others: "Callable[[frozenset[str]], Collection[str]]" = lambda holds: ()


class RunFacts(Protocol):
    """Describe the run in which settings are to be used, so that they can be refused for it.

    Settings are those of a condition, which the run scores.
    """

    @property
    def agents(self) -> Sequence[Any]:
        """Return the run's agents (`harness.evaluate.agent.Agent`), the ego's first.

        An agent is a model with its prompt and how it answers.
        """

    @property
    def scenario(self) -> Any:
        """Return the run's scenario, a kind of traffic situation.

        It is a `harness.world.scenario.Scenario`.
        """

    @property
    def ego_alone(self) -> bool:
        """Return whether the run's model answers only for the ego, so that no helper is asked."""

    @property
    def several_decide(self) -> bool:
        """Return whether, in the run, vehicles beside the ego decide for themselves, too."""

    @property
    def frozen(self) -> bool:
        """Return whether the run's scenes are recorded (`harness eval`), not simulated."""

    @property
    def ties(self) -> str | None:
        """Return which of equally likely actions is taken; None where no run says so."""

    @property
    def temperature(self) -> float | None:
        """Return the temperature at which answers are sampled; None where no run says so."""


@cache
def _hints(kind: type["Part"]) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


class Part(Struct, frozen=True, kw_only=True):
    """Hold one group of an operating point's settings, checked when made; a base class.

    An operating point is all settings that a decision depends on besides scene and model, and a
    part those of one concern, such as the radio. An extension adds a subclass
    (`adds={"parts": ...}`); the hooks below do nothing unless overridden, and are called in their
    order here, only for a part that differs from its defaults. Whole numbers become floats where a
    float is declared. Raises ValueError for a value that is not allowed.
    """

    behind: ClassVar[str] = ""  # name of the setting behind which its own stand in run files
    of_ego: ClassVar[bool] = False  # whether it matters to an ego that asks nobody
    of_radio: ClassVar[bool] = False  # whether its settings mean nothing without a channel
    # for each of its settings that names something, what returns the names that there are; an empty
    # setting names nothing
    named: ClassVar[Mapping[str, Callable[[], Collection[str]]]] = {}
    questions: ClassVar[tuple[Question, ...]] = ()  # the questions that helpers may be asked by it
    # what the ego hears under a control, in words, by its setting, such as `messages=blind`
    controls: ClassVar[Mapping[str, str]] = {}
    # for its settings that are words, by name, the values that a sweep takes if none are given,
    # with commas
    usual: ClassVar[Mapping[str, str]] = {}

    def __post_init__(self) -> None:
        hints = _hints(type(self))
        for key in self.__struct_fields__:
            hint, value = hints[key], getattr(self, key)
            try:
                converted = convert(value, hint)
                if isinstance(converted, float) and not math.isfinite(converted):
                    raise ValidationError
            except (ValidationError, OverflowError):
                allowed = description(hint) or BARE.get(hint, "of its type")
                raise wrong(key, value, allowed) from None
            if isinstance(converted, float) and abs(converted) > LARGEST:
                raise wrong(key, value, f"{description(hint)}, and no larger than {LARGEST:.2g}")
            structs.force_setattr(self, key, converted)
        with telling(self):
            self.check()

    def check(self) -> None:
        """Raise ValueError or UserError if settings of this group contradict each other."""

    def implies(self) -> Mapping[str, Any]:
        """Return settings of a condition that follow from these, values by flat name.

        `OperatingPoint.changed` sets those that its caller does not give; `check_with` is to refuse
        others. Only a group that ships may imply some.
        """
        return {}

    @property
    def acts_on(self) -> Collection[ActsOn]:
        """Return which of these settings, as they are now, only matter if messages carry some kind.

        A kind is what messages carry, such as probabilities of actions, words or objects; each is
        refused where there is none of its kinds.
        """
        return ()

    def check_with(self, point: "OperatingPoint") -> None:
        """Raise ValueError if settings of this group contradict others of an operating point.

        `point` is that point, all settings, of which this part is a group.
        """

    def idle(self, setting: str) -> str | None:
        """Return why changing one of this part's settings cannot change a result; None if it may.

        `setting` is its name; the reason is a part of a sentence, such as "it has no channel".
        Unlike other hooks it is also called for a part that has only its defaults.
        """

    def carried(self, point: "OperatingPoint", channel: Channel) -> Channel:
        """Return the radio channel that carries messages, changed by this group of settings.

        `channel` is that without it: the profile's, with the settings of `point` and what earlier
        groups return. Only a group that ships may return another, such as one with a second path.
        """
        return channel

    def obstacle(self, point: "OperatingPoint", run: RunFacts) -> str | None:
        """Return why a run cannot use these settings; None if it can.

        The text also says what to do instead. `run` has the run's models, scenario and world;
        `point` is the operating point: all settings that a decision depends on, of which these are
        a group.
        """

    def obstacle_of_models(self, identities: Sequence[Mapping[str, Any]]) -> str | None:
        """Return why a run cannot use these settings with its opened models; None if it can.

        `identities` are theirs, the ego's first: what tells models apart (`Backend.identity`), such
        as digests of weights. A run adds to the ego's its `latency`, as `run.json` states it. The
        text also says what to do instead.
        """

    def kept(self) -> Mapping[str, Mapping[str, Kept]]:
        """Return what a run must store of the things that this part's settings name.

        Such a thing is the calibration of a model. The outer key is a folder of the run, the inner
        one a name in it.
        """
        return {}

    @property
    def needs(self) -> Collection[str]:
        """Return the names of optional inputs that this part needs; no others are computed.

        `claims`: what helpers claim of themselves; `in_time`: the probability of a reply in the
        decision window; `lot`: a random draw a decision; `outlook`: how much the ego sees of where
        a danger may come from.
        """
        return ()

    @property
    def needs_all(self) -> bool:
        """Return whether these settings need the answers of all helpers, as an attack's may.

        Otherwise those of the helpers that are asked are enough.
        """
        return False

    @property
    def antennas(self) -> Collection[Antenna]:
        """Return the antennas beside the road and the like whose radio links these settings need.

        Only those of a group that ships are used, and only where losses follow from positions.
        """
        return ()

    @property
    def question(self) -> Question:
        """Return the question that helpers' models are asked under these settings.

        It is one of `questions`, or `PLAIN`, the ordinary one: what the ego should do, as the
        helper sees it.
        """
        return PLAIN

    @property
    def elsewhere(self) -> bool:
        """Return whether the ego hears helpers of other scenes than its own.

        It is a control, to test whether what messages say matters; `sources` says of which scenes.
        """
        return False

    def unasked(self, point: "OperatingPoint") -> "Stream | None":
        """Return the messages that helpers send unasked under a condition, `point`; None for none.

        Only a part that ships may have some.
        """
        return None

    @classmethod
    def unasked_of(cls, text: str) -> "Stream | None":
        """Return the stream of which a text says what an ego heard; None for that of another part.

        The text is one that `Stream.heard` returned, read back from the key of a stored answer.
        """
        return None

    def speaker(self) -> "Speaker | None":
        """Return a new object that decides what helpers send, as attackers do; None for the truth.

        Each walk through a run's episodes asks for one of its own, which may keep state.
        """

    def changes(self, words: bool, objects: bool) -> Changes:
        """Return the names of the changes to messages before the ego's model reads them.

        That is in a fusion call, in which the model is asked a second time with what the ego has
        heard; `words` and `objects` say whether it shows messages' words, and their objects.
        """
        return Changes()

    @classmethod
    def change(cls, text: str) -> Change | None:
        """Return the change to messages that a text such as `liar:share=1/3` names, or None.

        The text is one of the names that `changes` returned, read back from the key of a stored
        answer.
        """

    def after_call(self, fused: "Floats", intents: "Floats", heard: "Bools") -> "Floats":
        """Return the policies, `(..., A)`, to use in place of what a fusion call answered.

        A fusion call is a second question to the ego's model, which shows it what it has heard. A
        policy is the probabilities of the ego's A actions.

        Args:
            fused: the call's answers, `(..., A)`; NaN where one failed.
            intents: those of the ego, at index 0, and its H helpers, `(..., 1+H, A)`.
            heard: which helpers were heard in time, `(..., H)`.
        """
        return fused

    def after_fusion(self, policies: "Floats") -> "Floats":
        """Return the policies by which egos act, `(..., A)`, given those after all fusion.

        A policy is the probabilities of the ego's A actions; it is the ego's own intent where
        nobody was heard.
        """
        return policies

    def ask(
        self,
        point: "OperatingPoint",
        links: Links,
        draws: Draws,
        ready: "Callable[[Floats], Floats]",
        left_s: "Floats",
    ) -> Consulted | None:
        """Return what comes of another asking the helpers for the ego; None if the ego asks itself.

        Only a part that ships may ask.

        Args:
            point: the condition.
            links: the links of the ego and its H helpers, with those that it wants to ask.
            draws: the channel's random numbers.
            ready: returns when replies can leave, `(..., H)`, from when helpers have the request,
                of the same shape or `(..., 1)`; both in s from the start of the ego's request.
            left_s: seconds from the start of the ego's request until it waits no longer, `(...)`.
        """

    def again(
        self,
        point: "OperatingPoint",
        sent: "SentIntents",
        heard: "Exchange",
        decide: "Callable[[Exchange, Intents], Coordination]",
    ) -> "tuple[SentIntents, Exchange]":
        """Return what is sent and heard after all that vehicles tell each other before they act.

        Only a part that ships may say more than the first exchange.

        Args:
            point: the condition.
            sent: what vehicles have sent so far in n decisions.
            heard: who was asked and heard so far.
            decide: returns the n decisions as they would be made with an exchange and the intents
                known after it.

        Returns:
            Both `sent` and `heard`, with the further messages.
        """
        return sent, heard

    def sources(self, episodes: "Ints", seeds: "Ints") -> "Ints":
        """Return for each of n decisions the index of the decision whose helpers it hears, `(n,)`.

        Called only where `elsewhere` is true. All decisions are of one step; `episodes` and
        `seeds`, `(n,)`, have the number of each one's episode and the seed of its draws. By default
        each hears its own.
        """
        return np.arange(len(episodes))

    def before(self, intents: "Intents") -> "Intents":
        """Return what vehicles intend in n decisions, corrected before anything else uses it.

        A calibration corrects probabilities so. Of `intents` only `own`, `(n, A)`, and `helpers`,
        `(n, H, A)`, the probabilities of actions, may change; a failed or missing answer is a row
        of NaN.
        """
        return intents


# What messages call the parts that packages add, by class; whose class is not here is none of them.
PACKAGES_PARTS: dict[type[Part], str] = {}


def is_ours(part: Part) -> bool:
    """Return whether a group of settings ships with the harness, not with a package.

    `part` is such a group, of an operating point; only one that ships is trusted unchecked.
    """
    return type(part) not in PACKAGES_PARTS


def worded_part(part: Part) -> AbstractContextManager[None]:
    """Return a context in which an error of a package's settings becomes a one-line UserError.

    It is to be entered around each call of a hook (a method to override) of `part`, a group of
    settings. For a part that ships, errors pass.
    """
    return worded(PACKAGES_PARTS.get(type(part), ""), built_in=is_ours(part))


@contextmanager
def telling(part: Part) -> Iterator[None]:
    """Enter a context in which an error of a package's settings becomes a one-line UserError.

    `part` is the group of settings. A ValueError passes as it is: by it a part refuses its
    settings.
    """
    refused = None
    with worded_part(part):
        try:
            yield
        except ValueError as error:
            refused = error
    if refused:
        raise refused


def wrong(key: str, value: object, allowed: str) -> ValueError:
    """Build the ValueError for a setting whose value is not allowed; the caller raises it.

    It says that the setting `key` is `value` and must be what `allowed` says in words.
    """
    return ValueError(f"{key} is {printable(repr(value))}; it must be {allowed}")


def _lacking(setting: str, name: str, plugins: Plugins[Any], *others: str) -> UserError:
    """Return the error for a name that neither plug-ins nor `others` have: whose it is, if its
    extension is gone.
    """
    kind = plugins.group.rpartition(".")[2]
    if owner := owner_of_plugin(kind, name):
        return UserError(f"{setting} {printable(name)} is {part_of(owner)}")
    return unknown(setting, name, (*others, *plugins))


class Ask(Part, frozen=True, kw_only=True):
    """Hold the settings of whom the ego asks, when, and what helpers' messages hold.

    An intent is the probabilities of the ego's actions; the more alike they are, the higher is
    their entropy.
    """

    # the rule for whom the ego asks, and when: `entropy`, the paper's, or another
    schedule: Text = PAPER
    # the entropy of the ego's intent, in nats, above which it asks, under the paper's schedule
    tau_nats: Annotated[float, Meta(ge=0, description="a finite number of nats, 0 or more")] = 0.7
    # the worth above which another schedule asks, in its unit; None keeps the schedule's own
    threshold: Annotated[float, Meta(ge=0, description="a finite number, 0 or more")] | None = None
    # distance from the ego, m, beyond which helpers are not asked: the paper's R
    radius_m: Metres = 100.0
    # the most helpers that are asked in one decision; of more, those that the schedule says are
    # worth the most, and of equals the nearest
    max_helpers: Annotated[
        int,
        Meta(
            ge=0, le=MOST_HELPERS, description=f"a whole number, 0 or more, at most {MOST_HELPERS}"
        ),
    ] = 3
    # size of the request, bits. The default is 50 bytes: who asks whom and until when, as compact
    # JSON without a signature or headers. Replies are counted in the same way.
    request_bits: Annotated[
        float, Meta(ge=0, le=1e12, description="bits, 0 or more, at most 1e12")
    ] = 400.0
    # whether a helper infers only when it is asked, not in parallel with the ego
    on_demand: Flag = False
    # what a message holds, such as `intent`, probabilities of the ego's actions
    content: Text = INTENT

    def check(self) -> None:
        if self.content not in CONTENTS:
            raise _lacking("content", self.content, CONTENTS)
        if self.schedule == ORACLE:
            raise ValueError(
                f"schedule {ORACLE} looks at how scenes end; `harness study schedule compare` "
                f"plays it, and others are {', '.join(SCHEDULES)}"
            )
        if self.schedule not in SCHEDULES:
            raise _lacking("schedule", self.schedule, SCHEDULES)
        if self.threshold is not None and self.schedule == PAPER:
            raise wrong(
                "threshold", self.threshold, f"left out where schedule is {PAPER}: its is tau_nats"
            )
        if self.threshold is not None and SCHEDULES[self.schedule].threshold is None:
            raise wrong(
                "threshold",
                self.threshold,
                f"left out where schedule is {self.schedule}, which has none",
            )

    @property
    def acts_on(self) -> Collection[ActsOn]:
        if not self.on_demand:
            return ()
        others = [kind for kind in KINDS if kind != PLANS]  # an agent plans in any case
        return (ActsOn("on_demand", True, others, "false"),)

    @property
    def above(self) -> float:
        """Return the least worth of asking a helper at which the ego does not yet ask.

        A schedule, the rule for whom to ask, computes the worth: in nats under the schedule
        `entropy`, else in a unit of its own.
        """
        if self.schedule == PAPER:
            return self.tau_nats
        default = SCHEDULES[self.schedule].threshold
        return self.threshold if self.threshold is not None else 0.0 if default is None else default


class Radio(Part, frozen=True, kw_only=True):
    """Hold the settings of the radio: a channel profile, a file of `channels/`, and overrides.

    A channel decides which messages arrive, and when.
    """

    profile: Text | None = None  # name of the channel profile, such as `6g`; None disables V2V
    # probability that one transmission is lost, of which a request and a reply are one each; None
    # keeps that of the profile or of the link
    loss: Annotated[float, Meta(ge=0, le=1, description="a probability from 0 to 1")] | None = None
    # seconds that one request with its replies takes, without losses; None keeps the profile's
    latency_s: Seconds | None = None
    density_coupled: Flag = False  # whether loss grows with the number of vehicles in the scene
    # whether a helper that is unsure itself (entropy above `tau_nats`) asks others, too, which
    # loads the channel
    helper_rounds: Flag = False
    # how messages are encoded, which is their size, such as `json`
    encoding: Text = JSON
    further: Text = ""  # further settings of the profile's channel, such as `jitter_s=0.01`

    def check(self) -> None:
        if self.profile is not None and self.profile not in CHANNELS:
            raise unknown(
                "channel profile", self.profile, CHANNELS, "; leave it out to disable V2V"
            )
        if self.encoding != JSON and self.encoding not in ENCODINGS:
            raise _lacking("encoding", self.encoding, ENCODINGS, JSON)


class Fusion(Part, frozen=True, kw_only=True):
    """Hold the settings of how the ego fuses its own intent with those that it heard in time.

    An intent is the probabilities of the ego's actions.
    """

    # the rule that fuses intents, or `ego-prompt`: the ego's model is asked again with the messages
    consensus: Text = "linear"
    # decision window, seconds from the start of the decision; a later reply is not fused
    window_s: Annotated[
        float, Meta(gt=0, le=LONGEST_S, description="seconds above 0, at most 3600")
    ] = 0.2
    # lower bound of d, m, a vehicle's distance that its weight falls with, in the paper's Eq. 2.
    min_distance_m: Metres = 1.0
    # the ego's d in Eq. 2, m; None takes its distance to the centroid of the conflict zone. The
    # paper's preset declares a proxy of 3.5 m (section IV-A).
    ego_distance_m: Metres | None = None
    # largest share of the weight that one helper may have; 1 caps nothing
    weight_cap: Annotated[float, Meta(gt=0, le=1, description="a share above 0, up to 1")] = 1.0
    # what replaces a failed answer of the ego: `uniform`, all actions alike, or `brake`, all mass
    # on the first action, which is the most conservative one
    fallback: Text = "uniform"

    def check(self) -> None:
        if self.fallback not in FALLBACKS:
            raise unknown("fallback", self.fallback, FALLBACKS)
        if self.consensus not in RULES and self.consensus != EGO_PROMPT:
            raise _lacking("consensus", self.consensus, RULES, EGO_PROMPT)


class Cloud(Part, frozen=True, kw_only=True):
    """Hold the settings of a cloud that the ego's model runs in; at most one may be set.

    With none set it runs in the vehicle.
    """

    # seconds from the ego's question to the answer of a model in a cloud, in place of the ego's own
    # inference; None for none
    round_trip_s: Seconds | None = None
    # network over which the ego asks its model in a cloud, a name of a file of `networks/`; empty
    # for none. Each decision draws a round trip, which is added to the model's inference.
    round_trip: Text = ""

    def check(self) -> None:
        if self.round_trip:
            network(self.round_trip)
            if self.round_trip_s is not None:
                raise wrong(
                    "round_trip",
                    self.round_trip,
                    "left out where round_trip_s says all; keep one of the two",
                )
