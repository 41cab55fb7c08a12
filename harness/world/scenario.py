"""The interface of a scenario: parameters, layout, road, goal.
Other code takes a scenario as an argument.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import InitVar, dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple
from warnings import warn

from harness.core import noise
from harness.core.arrays import Bools, Floats, Texts
from harness.core.errors import printable
from harness.core.strangers import worded
from harness.world import parameters as _parameters
from harness.world.parameters import SETTABLE, Parameters
from harness.world.road import PathKey, Road
from harness.world.state import Building, Kind, Part

MOST_LETTERS = 1000  # of the name of what layouts are cut from
LAYOUTS_KEPT = 64  # scenarios of single layouts that stay in memory, each with its road
KNOWN_ACTIONS = ("SLOWER", "IDLE", "FASTER")  # actions that reference drivers and the planner use


@dataclass(frozen=True)
class Draws:
    """Draw the random quantities of one layout, each keyed by its name and the layout seed.

    A layout is the start situation of an episode. So a parameter that changes one quantity leaves
    the draws of all others as they are.
    """

    scenario: str  # name of the scenario
    seed: int  # layout seed, the number that fixes the layout
    # number of earlier draws of this layout that did not fit, since the wrong vehicles saw the
    # danger
    attempt: int = 0
    seats: tuple[str, ...] = ()  # names of further cars, which stand where no danger can be seen

    def share(self, what: str) -> float:
        again = (self.attempt,) if self.attempt else ()
        return float(noise.uniforms((1,), self.scenario, self.seed, what, *again)[0])

    def between(self, what: str, bounds: tuple[float, float]) -> float:
        return bounds[0] + self.share(what) * (bounds[1] - bounds[0])

    def ids(self, names: Collection[str]) -> dict[str, str]:
        """Draw the ids of a layout's other vehicles; return each one's id by its name.

        `names` are the scenario's own words for vehicles that a layout may have, such as `late`;
        those in `seats` are added. Ids are `v5` and on in random order, and absent vehicles get one
        too, so neither an id nor a gap between two tells anything about a vehicle. The ego and the
        helpers have `v1` to `v4`.
        """
        names = (*names, *self.seats)
        order = noise.generator(self.scenario, self.seed, "ids").permutation(len(names)).tolist()
        return {name: f"v{5 + number}" for name, number in zip(names, order, strict=True)}


@dataclass(frozen=True)
class Spawn:
    """Describe one vehicle at the start of an episode, and when it brakes by itself.

    Its path is known by its approach (where it comes from) and its route (what it does).
    """

    id: str  # `v1`, `v2`, …
    # `car`, `van`, `truck`, `bicycle`, `motorcycle` or `pedestrian`
    kind: Kind
    part: Part  # `ego`, `helper` (may be asked for messages) or `other`
    approach: str  # where its path comes from, such as `left`
    route: str  # what its path does, such as `straight`
    arc_m: float  # position along the path, m from its beginning
    speed_mps: float  # speed at the start, m/s
    # seconds from the start until it begins to brake by itself; None if it does not
    brakes_at_s: float | None = None
    brakes_mps2: float = 0.0  # its deceleration then, m/s2
    brakes_to_mps: float = 0.0  # the speed down to which it brakes, m/s
    radio: bool = field(default=False, kw_only=True)  # whether an `other` sends beacons


@dataclass(frozen=True)
class Layout:
    """Hold the start situation of one episode: its vehicles, its buildings and its danger.

    A danger is the vehicle that would meet an ego which keeps its speed.
    """

    spawns: tuple[Spawn, ...]  # its vehicles at their starts, the ego first
    buildings: tuple[Building, ...]  # obstacles to sight besides vehicles
    # name of the sector, the direction that the danger comes from; None without a danger
    danger: str | None
    danger_id: str | None  # id of the dangerous vehicle; None without a danger

    @classmethod
    def arranged(
        cls,
        spawns: Iterable[Spawn],
        danger: str | None,
        danger_id: str,
        buildings: Iterable[Building] = (),
    ) -> "Layout":
        """Return a layout with the vehicles in the order of their ids.

        `spawns` are the vehicles in any order, and `buildings` what blocks sight beside them.
        `danger` is the sector, or direction, that the dangerous vehicle `danger_id` comes from; if
        it is None the layout has no danger, and the id is ignored.
        """
        order = sorted(spawns, key=lambda spawn: int(spawn.id[1:]))
        return cls(tuple(order), tuple(buildings), danger, danger_id if danger else None)


class Names(NamedTuple):
    """Say what the source of a layout's traffic calls its vehicles, and what its clock shows."""

    begin_s: float  # what that clock shows at the start of the episode, s
    # `SCENE/NAME` of each vehicle there, by its id here, such as `v2`; a scene has one clock
    by_id: Mapping[str, str]
    several_scenes: bool = False  # whether the source has others, where names may be the same


@dataclass(frozen=True)
class Seat:
    """Describe the scenario as an agent other than the ego plays it: with that agent as the ego.

    An agent is a vehicle that decides for itself. `scenario` has the road network, name, actions
    and parameters of the shared scenario, but road, goal and prompt words of the agent's own.
    `names` has, by the key (approach, route) of a path of the shared road, the key that it has on
    the agent's.
    """

    scenario: "Scenario"  # the scenario with the agent as its ego
    # by key (approach, route) of each path of the shared road the key that it has for this agent
    names: Mapping[PathKey, PathKey]


@dataclass(frozen=True)
class Scenario:
    """Describe one scenario: its road, layouts, goal, actions, parameters and words for prompts.

    A layout is the start situation of an episode. A scenario is pickled by name and parameters, so
    it must be found by name in the registry, `harness.world.scenarios`.
    """

    name: str  # its name for users, and in manifests and frozen states
    description: str  # text whose first line is `Scenario <name>: <summary>`
    # names of highway-env's meta-actions that the ego chooses from, the most careful first
    actions: tuple[str, ...]
    parameters: Parameters  # its parameters, such as speeds and the time limit
    road: Callable[[], Road]  # returns the road, always the same object
    # draws the start of an episode: takes its layout seed and the parameters
    layout: Callable[[int, Any], Layout]
    # tells whether egos have reached their goal, (...): takes `xy_m`, the centres of V vehicles of
    # any number of episodes in highway-env's own frame, m, (..., V, 2), the ego first, NaN where an
    # episode has fewer, then `approaches`, where their paths come from, (..., V), and the
    # parameters. It is called after every frame.
    cleared: Callable[[Floats, Texts, Any], Bools]
    # texts for prompts by name: `task`, after "You drive car v1:", and `hiding`, after "Others may
    # be hidden by". Templates read `words.<name>`.
    words: Mapping[str, str]
    brake_lamps: bool = False  # whether vehicles have brake lamps
    prompt: str = "v4"  # default prompt version
    # why scenes with left and right swapped are not valid scenes; None if they are
    one_sided: str | None = "nothing says that a mirrored scene is one of it"
    # names of the parameters that a user may set behind the name: `NAME:beacon_loss=0.3`
    dials: tuple[str, ...] = SETTABLE
    # returns the scenario as other vehicles that decide play it, each with itself as the ego, by
    # the path (approach, route) that they begin on, always the same object; `cleared` of such a
    # scenario is asked about its agent alone. None if only the ego has a goal.
    seats: Callable[[], Mapping[PathKey, Seat]] | None = None
    # the class of its worlds, an `OwnWorld`, if they are played elsewhere; None for the harness's
    # own simulator
    world: type[Any] | None = None
    # returns the scenario as the layout of a seed, its argument, has it: with that layout's road,
    # goal and words; only of worlds that are played elsewhere. None if all layouts have one road
    layouts: Callable[[int], "Scenario"] | None = None
    layout_seed: int | None = None  # seed of the only layout that has this road; None for all
    # what the source of this layout's traffic calls its vehicles; None if there is no such source
    names: Names | None = None
    source: str = ""  # where its traffic comes from, for a dataset's card; empty for the harness's
    licence: str = ""  # terms of that source, for the card; empty for the harness's own
    # returns what the layout of a seed, its argument, is cut from, such as the name of a recording
    # of traffic. Layouts of one are alike: an interval counts them as one, whatever their number.
    # A name such as `a + b` says that it is cut from both: one that has `a` or `b` is alike, too.
    # None if each layout is drawn on its own
    cluster: Callable[[int], str] | None = None
    # spelling of 0.2, until 0.5.0: what starts an episode of such a world; takes the scenario and
    # the layout seed
    start: InitVar[Callable[["Scenario", int], Any] | None] = None

    def __post_init__(self, start: Callable[["Scenario", int], Any] | None) -> None:
        if start is not None:
            object.__setattr__(self, "world", _world_of(start))
        if self.world is None:
            from harness.world.scenario_of_package import put_doors

            put_doors(self)

    @property
    def has_own_world(self) -> bool:
        """Return whether something beside the harness's simulator plays the episodes.

        The harness then knows no layout, where vehicles start, and no danger.
        """
        return self.world is not None

    @property
    def caveat(self) -> str:
        """Return a sentence that whoever learns from it is told; empty for none."""
        return ""

    def at(self, seed: int) -> "Scenario":
        """Return the scenario as the layout of a seed has it, with that layout's road.

        It is the scenario itself unless layouts have roads of their own (`layouts`).
        """
        return self if self.layouts is None else _at(self, seed)

    def cluster_of(self, seed: int) -> str | None:
        """Return the name of what the layout of a seed is cut from, such as a recording.

        None if each layout is drawn on its own. Raises UserError for a name that is none.
        """
        if self.cluster is None:
            return None
        with worded(f"scenario {printable(self.name, 80)}"):
            name: object = self.cluster(seed)
            if self.cluster(seed) != name:
                raise ValueError(
                    f"cluster of layout seed {seed} differs from call to call; let it follow from "
                    "the seed alone"
                )
            if isinstance(name, str) and 0 < len(name) <= MOST_LETTERS and name.isprintable():
                return name
            raise ValueError(
                f"cluster of layout seed {seed} is {printable(repr(name), 60)}, no text of 1 to "
                f"{MOST_LETTERS} printable characters"
            )

    @property
    def prompt_words(self) -> dict[str, str]:
        """Return texts for prompts by name: `words`, and `speeds`, the target speeds in m/s.

        The speeds are one text, the highest first: `14, 7, 0`. Templates read `words.<name>`.
        """
        speeds = ", ".join(f"{speed:g}" for speed in reversed(self.parameters.target_speeds_mps))
        return {**self.words, "speeds": speeds}

    @property
    def summary(self) -> str:
        return self.description.strip().splitlines()[0].partition(": ")[2]

    def __hash__(self) -> int:
        return hash((self.name, self.parameters, self.layout_seed))


@lru_cache(maxsize=LAYOUTS_KEPT)
def _at(scenario: Scenario, seed: int) -> Scenario:
    assert scenario.layouts is not None
    of_layout = scenario.layouts(seed)
    return replace(
        of_layout,
        parameters=scenario.parameters,
        layouts=None,
        layout_seed=seed,
        cluster=scenario.cluster,
    )


def _world_of(start: Callable[[Scenario, int], Any]) -> type[Any]:
    """Return a class of worlds that a function starts. It warns:
    the class is what a scenario states now.
    """
    from harness.world.own_world import OwnWorld

    warn(
        "Scenario(start=f) is now Scenario(world=Class), whose `begun` is f; it works until 0.5.0",
        FutureWarning,
        stacklevel=4,
    )
    return type("Started", (OwnWorld,), {"begun": staticmethod(start)})


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Return what stood here in 0.2; until 0.5.0, with a warning."""
        if name.startswith("_") or not hasattr(_parameters, name):
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        warn(
            f"{name} is now in harness.world.parameters; it works here until 0.5.0",
            FutureWarning,
            stacklevel=2,
        )
        return getattr(_parameters, name)
