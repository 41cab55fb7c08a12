"""Define the parts of an operating point: radio, whom the ego asks, fusion, a cloud.

Each part checks itself and raises ValueError with the setting, its value and what it must be.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, Protocol, get_type_hints

import numpy as np
from msgspec import Meta, Struct, ValidationError, convert, structs

from harness.coordination.contents import CONTENTS, INTENT, INTENTS, KINDS, PLANS
from harness.coordination.encodings import ENCODINGS, JSON
from harness.coordination.rules import EGO_PROMPT, RULES, names
from harness.coordination.schedules import SCHEDULES
from harness.coordination.scheduling import ORACLE, PAPER
from harness.core.config import LONGEST_S, Seconds, description
from harness.core.errors import UserError, printable, unknown
from harness.core.extensions import owner_of_plugin, part_of
from harness.core.plugins import Plugins
from harness.core.strangers import worded
from harness.radio.networks import network
from harness.radio.profiles import CHANNELS

if TYPE_CHECKING:
    from harness.coordination.intents import Intents
    from harness.coordination.operating_point import OperatingPoint
    from harness.coordination.sent import Speaker
    from harness.core.arrays import Bools, Floats, Ints
    from harness.world.scene_graph import SceneGraph

FALLBACKS = ("uniform", "brake")
RELAY, FUSION = "relay", "fusion"
EDGES = ("none", RELAY, FUSION)
MOST_HELPERS = 1000
MOST_ROUNDS = 3

Metres = Annotated[float, Meta(gt=0, le=1e6, description="metres above 0, at most 1000000")]
Place = Annotated[float, Meta(ge=-10_000, le=10_000, description="metres from -10000 to 10000")]
Text = Annotated[str, Meta(description="a text")]
Flag = Annotated[bool, Meta(description="true or false")]


class Kept(NamedTuple):
    """What a run keeps of something that a condition names."""

    record: Any  # plain values: its content, or the digest of its file
    file: Any = None  # path of its file, if it has one


@dataclass(frozen=True)
class Question:
    """What a helper is asked; plainly, what it intends, with what it sees before it."""

    # ends the key of its answers, behind a `~`, and is their role; empty for the plain one
    name: str = ""
    words: str = "are asked"  # of helpers that are asked so, behind "that"
    pictured: bool = True  # whether it shows what a camera sees

    def shown(self, graph: "SceneGraph") -> "SceneGraph":
        """Return the scene graph that it shows of a helper's own."""
        return graph


PLAIN = Question()


class Change(Protocol):
    """What is done to the message that a voice sends."""

    @property
    def adds(self) -> bool:
        """Whether it adds what no other change is to touch, and so comes last."""

    def message(self, message: Mapping[str, Any], actions: Sequence[str]) -> dict[str, Any]:
        """Return a message as a prompt shows it, with its `intent`."""

    def graph(self, graph: "SceneGraph", scenario: Any, scene: Any) -> "SceneGraph":
        """Return the graph that a message is made of, which its sender sees in a scene."""


class Changes(NamedTuple):
    """What a part changes of messages, by what their keys then hold; text without `+` and `&`."""

    of_attackers: str = ""  # of those of attackers, several joined by `&`
    of_all: tuple[str, ...] = ()


class ActsOn(NamedTuple):
    """A setting that does something with messages of some kinds, and nothing with others."""

    setting: str
    value: object  # of a text that names several things, one of them
    kinds: Collection[str]  # `contents.KINDS`; a content that holds none of them is refused
    instead: str = "left out"  # what the setting must then be
    # what else it may be with what a content holds
    others: "Callable[[frozenset[str]], Collection[str]]" = lambda holds: ()


class RunFacts(Protocol):
    """What a part is told of the run in which its condition is played."""

    @property
    def agents(self) -> Sequence[Any]:
        """The agents, the ego's first; each has `settings()`, a `card`, a `prompt`,
        and what it `can`.
        """

    @property
    def scenario(self) -> Any:
        """The scenario, which has a name."""

    @property
    def ego_alone(self) -> bool:
        """Whether the model answers only for the ego."""

    @property
    def several_decide(self) -> bool:
        """Whether vehicles beside the ego decide, too."""

    @property
    def frozen(self) -> bool:
        """Whether its scenes are frozen."""

    @property
    def device_profile(self) -> Any:
        """The device on which energy is counted; None if it is not."""


class Part(Struct, frozen=True, kw_only=True):
    """Settings that are checked as they are made;
    whole numbers become floats where a float is meant.

    A part with its defaults does nothing. Those that an extension adds (`adds={"parts": ...}`) are
    called in the order of what follows, and only where they do something.
    """

    behind: ClassVar[str] = ""  # the setting behind which its own stand in records
    of_ego: ClassVar[bool] = False  # whether it matters to an ego that asks nobody
    # its settings that name something, and what returns the names that there are; empty names
    # nothing
    named: ClassVar[Mapping[str, Callable[[], Collection[str]]]] = {}
    questions: ClassVar[tuple[Question, ...]] = ()  # what helpers may be asked by it
    # what the ego hears under a control, by its setting, such as `messages=blind`
    controls: ClassVar[Mapping[str, str]] = {}
    # of its settings that are words, the values that a sweep takes if none are given, with commas
    usual: ClassVar[Mapping[str, str]] = {}

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self), include_extras=True)
        for key in self.__struct_fields__:
            hint, value = hints[key], getattr(self, key)
            try:
                converted = convert(value, hint)
                if isinstance(converted, float) and not math.isfinite(converted):
                    raise ValidationError
            except (ValidationError, OverflowError):
                raise wrong(key, value, str(description(hint))) from None
            structs.force_setattr(self, key, converted)
        with telling(self):
            self.check()

    def check(self) -> None:
        """Raise ValueError or UserError for what no single setting's type says."""

    @property
    def acts_on(self) -> Collection[ActsOn]:
        """Its settings that need messages of some kind."""
        return ()

    def check_with(self, point: "OperatingPoint") -> None:
        """Raise ValueError for what does not go together with other settings of its condition."""

    def obstacle(self, point: "OperatingPoint", run: RunFacts) -> str | None:
        """Return why it cannot be played in a run, and what to do; None if it can."""

    def kept(self) -> Mapping[str, Mapping[str, Kept]]:
        """Return what a run keeps of what it names, by folder and by name."""
        return {}

    @property
    def needs(self) -> Collection[str]:
        """What it needs of the world: `claims`, `in_time`, `lot` or `outlook`."""
        return ()

    @property
    def needs_all(self) -> bool:
        """Whether it needs what every helper intends that is present, whoever is heard."""
        return False

    @property
    def question(self) -> Question:
        """What helpers are asked."""
        return PLAIN

    @property
    def elsewhere(self) -> bool:
        """Whether messages come from other scenes."""
        return False

    def speaker(self) -> "Speaker | None":
        """Return what says to the channel what vehicles intend, in one walk; None if they do."""

    def changes(self, words: bool, objects: bool) -> Changes:
        """Return what it changes of the `words` and the `objects` that a fusion call shows."""
        return Changes()

    @classmethod
    def change(cls, text: str) -> Change | None:
        """Return what is done to a message by a text of `changes`; None if it is no such text."""

    def after_call(self, fused: "Floats", intents: "Floats", heard: "Bools") -> "Floats":
        """Return the policies (..., A) that a fusion call answered, by the intents (..., 1+H, A)
        of the ego and its helpers, of whom some were heard in time, (..., H).
        """
        return fused

    def sources(self, episodes: "Ints", seeds: "Ints") -> "Ints":
        """Return the decision whose helpers each decision hears, (n,), by these places; its own.

        Asked where messages come from elsewhere. All are of one step, with the number of their
        episode and the seed of their draws, (n,).
        """
        return np.arange(len(episodes))

    def before(self, intents: "Intents") -> "Intents":
        """Return what vehicles intend, (n, ...), as it is before anything is made of it;
        NaN may be there.
        """
        return intents


# What messages call the parts that packages add, by class; whose class is not here is none of them.
PACKAGES_PARTS: dict[type[Part], str] = {}


def is_ours(part: Part) -> bool:
    """Return whether no package has added a part."""
    return type(part) not in PACKAGES_PARTS


def worded_part(part: Part) -> AbstractContextManager[None]:
    """Let a part act: what fails in a package's is one line, a UserError."""
    return worded(PACKAGES_PARTS.get(type(part), ""), built_in=is_ours(part))


@contextmanager
def telling(part: Part) -> Iterator[None]:
    """Let a part say what does not go, by ValueError;
    what else fails in a package's is one line, a UserError.
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
    """Return the error of a setting that is not allowed."""
    return ValueError(f"{key} is {printable(repr(value))}; it must be {allowed}")


def _lacking(setting: str, name: str, plugins: Plugins[Any]) -> UserError:
    """Return the error for a name that no plug-in has: whose it is, if its extension is gone."""
    kind = plugins.group.rpartition(".")[2]
    if owner := owner_of_plugin(kind, name):
        return UserError(f"{setting} {printable(name)} is {part_of(owner)}")
    return unknown(setting, name, plugins)


class Ask(Part, frozen=True, kw_only=True):
    """Whom the ego asks, when, and what it hears."""

    # The rule for whom and when: `entropy`, the paper's, or another of `SCHEDULES`.
    schedule: Text = PAPER
    # The entropy above which the ego asks, under the paper's schedule.
    tau_nats: Annotated[float, Meta(ge=0, description="a finite number of nats, 0 or more")] = 0.7
    # The worth above which another schedule asks, in its unit; None keeps the schedule's own.
    threshold: Annotated[float, Meta(ge=0, description="a finite number, 0 or more")] | None = None
    radius_m: Metres = 100.0  # the paper's R; helpers farther from the ego are not asked
    # The cooperative neighbourhood; if there are more helpers, the nearest are asked.
    max_helpers: Annotated[
        int,
        Meta(
            ge=0, le=MOST_HELPERS, description=f"a whole number, 0 or more, at most {MOST_HELPERS}"
        ),
    ] = 3
    # Size of the request. The default is 50 bytes: who asks whom and until when, as compact JSON
    # without a signature or headers. Replies are counted in the same way.
    request_bits: Annotated[
        float, Meta(ge=0, le=1e12, description="bits, 0 or more, at most 1e12")
    ] = 400.0
    # whether a helper infers only when it is asked, not in parallel with the ego
    on_demand: Flag = False
    content: Text = INTENT  # what a message holds (`harness.coordination.contents`)

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
        """The worth above which the ego asks, in the schedule's unit."""
        if self.schedule == PAPER:
            return self.tau_nats
        default = SCHEDULES[self.schedule].threshold
        return self.threshold if self.threshold is not None else 0.0 if default is None else default


class Radio(Part, frozen=True, kw_only=True):
    """The channel, what replaces its profile's settings, and a roadside unit."""

    profile: Text | None = None  # channel profile; None disables V2V
    # Probability that one transmission is lost; None keeps that of the profile or of the link.
    loss: Annotated[float, Meta(ge=0, le=1, description="a probability from 0 to 1")] | None = None
    latency_s: Seconds | None = None  # nominal seconds of one exchange; None keeps the profile's
    density_coupled: Flag = False  # whether loss follows the number of active vehicles
    # Whether a helper whose entropy is above tau opens a round of its own, which loads the channel.
    helper_rounds: Flag = False
    # What a roadside unit does: `relay` sends replies once more; `fusion` asks the helpers for the
    # ego and fuses (`harness.radio.roadside`). With the constant model a relay has no place
    # (`constant.Radio`).
    edge: Text = "none"
    # From the end of what the unit receives to the start of what it sends: processing and backhaul.
    # The default is declared: a unit that has nothing to wait for.
    edge_delay_s: Seconds = 0.0
    # to the east of the centroid of the conflict zone; 0 and 0 is a gantry above it
    edge_x_m: Place = 0.0
    edge_y_m: Place = 0.0  # to the south
    # Height of the unit's antenna; by default that of TR 37.885, table 6.1.4-1, a roadside unit.
    edge_antenna_m: Annotated[float, Meta(ge=1, le=100, description="metres from 1 to 100")] = 5.0
    # How messages are encoded, which is their size (`harness.coordination.encodings`).
    encoding: Text = JSON
    further: Text = ""  # further settings of the profile's channel, such as `density_per_km=200`

    def check(self) -> None:
        if self.profile is not None and self.profile not in CHANNELS:
            raise unknown(
                "channel profile", self.profile, CHANNELS, "; leave it out to disable V2V"
            )
        if self.edge not in EDGES:
            raise unknown("edge", self.edge, EDGES)
        if self.encoding not in ENCODINGS:
            raise unknown("encoding", self.encoding, ENCODINGS)

    @property
    def acts_on(self) -> Collection[ActsOn]:
        if self.edge != FUSION:
            return ()
        return (ActsOn("edge", FUSION, (INTENTS,), "none or relay"),)


class Fusion(Part, frozen=True, kw_only=True):
    """How the ego fuses what it has heard in time."""

    consensus: Text = "linear"  # consensus rule, or `ego-prompt`
    # Decision window, from the start of the decision; a later reply is not fused.
    window_s: Annotated[
        float, Meta(gt=0, le=LONGEST_S, description="seconds above 0, at most 3600")
    ] = 0.2
    min_distance_m: Metres = 1.0  # lower bound of d in the paper's Eq. 2
    # The ego's d in Eq. 2; None takes its distance to the centroid of the conflict zone. The
    # paper's preset declares a proxy of 3.5 m (section IV-A).
    ego_distance_m: Metres | None = None
    # Largest share of the weight that one helper may have (`consensus.capped`); 1 caps nothing.
    weight_cap: Annotated[float, Meta(gt=0, le=1, description="a share above 0, up to 1")] = 1.0
    # What replaces a failed answer of the ego: `uniform`, all actions alike, or `brake`, all mass
    # on the first action, which is the most conservative one.
    fallback: Text = "uniform"
    # How often agents tell each other their plans before they act (`harness.evaluate.rounds`).
    rounds: Annotated[
        int, Meta(ge=1, le=MOST_ROUNDS, description=f"a whole number from 1 to {MOST_ROUNDS}")
    ] = 1

    def check(self) -> None:
        if self.fallback not in FALLBACKS:
            raise unknown("fallback", self.fallback, FALLBACKS)
        if self.consensus not in RULES and self.consensus != EGO_PROMPT:
            raise unknown("consensus", self.consensus, names())

    @property
    def acts_on(self) -> Collection[ActsOn]:
        return (ActsOn("rounds", self.rounds, (PLANS,), "1"),) if self.rounds > 1 else ()


class Cloud(Part, frozen=True, kw_only=True):
    """Where the ego's model runs, if not in the vehicle; at most one of the two is set."""

    # From the ego's question to the answer of a model in a cloud; replaces the ego's own inference.
    round_trip_s: Seconds | None = None
    # Network over which the ego asks its model in a cloud, a name of `harness.radio.networks`. Each
    # decision draws a round trip, which is added to the model's inference.
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
