"""Hold and check the complete settings of an evaluation: enough to run it again."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import msgspec
from msgspec import UNSET, UnsetType, structs

from harness.backends.base import BARE
from harness.backends.card import Card
from harness.backends.cards import argument
from harness.backends.registry import ENGINES
from harness.coordination import contents_of_packages, parts_of_packages
from harness.coordination.coordinate import TIES
from harness.coordination.counterparts import COUNTERPARTS
from harness.coordination.operating_point import OperatingPoint, kept_of
from harness.coordination.schedules import SCHEDULES
from harness.core import extensions
from harness.core.at_once import AUTO
from harness.core.errors import UserError, in_range, printable
from harness.core.seeds import LAST_SEED
from harness.dataset.load import Scene
from harness.dataset.select import SELECTIONS, Choice
from harness.evaluate.agent import Agent, example_actions
from harness.evaluate.command_options import Guard
from harness.evaluate.latency import NAMES, declared
from harness.prompts.versions import ROLES, Prompt, unfit
from harness.radio.profiles import CHANNELS
from harness.runs import formats, role_agents
from harness.runs.answerers import answerers_of
from harness.runs.folder import read
from harness.runs.metric import World
from harness.runs.records import MEASURED, ClosedLoop, FrozenScenes, Latency, Manifest
from harness.runs.settings import (
    DriveSettings,
    FrozenSettings,
    Settings,
    of_extensions,
)
from harness.runs.stopping import STOPPING_RULES, InterimLooks, StoppingRule
from harness.runs.timers import TIMERS, Timer
from harness.world.perception.graph import truth_graph
from harness.world.scenario import Scenario
from harness.world.seats import agent_share

USUAL = Settings()
TAG_CHARACTERS = 40
HOTTEST = 2.0
TRIED = 8  # scenes of which one must change the ego's prompt, where messages hold objects
ASKS = ("used", "all")  # what --ask takes, the default first


class Source(Protocol):
    """Describe where the scenes of an evaluation come from: a dataset, or layouts to drive.

    A layout is one start situation of a scenario.
    """

    @property
    def kind(self) -> World:
        """Return the kind of world that scenes are of: `frozen` or `closed-loop`."""
        ...

    @property
    def name(self) -> str:
        """Return the word for the source in the name of a run's folder: a dataset's, or `drive`."""
        ...

    @property
    def actions(self) -> tuple[str, ...]:
        """Return the names of the meta-actions, in the environment's order."""
        ...

    @property
    def scenario(self) -> Scenario: ...

    @property
    def numbers(self) -> Sequence[int]:
        """Return the numbers of the episodes to evaluate.

        A run that stops early has the first of them.
        """
        ...

    @property
    def choice(self) -> Choice | None:
        """Return what chose some of the episodes, such as a sample; None if nothing did.

        Then they are all, or the first.
        """
        ...

    def first(self, count: int) -> "Source":
        """Return these scenes cut to at most `count` episodes, from the first."""
        ...

    @property
    def layout_seeds(self) -> Iterable[int]: ...

    def record(self) -> FrozenScenes | ClosedLoop:
        """Return what a run's manifest states of its scenes.

        The manifest is the record of a run's settings and origin.
        """
        ...

    def settings(self) -> FrozenSettings | DriveSettings:
        """Return the settings of a run that select this source of scenes."""
        ...

    def trial(self, most: int, ego_alone: bool) -> Iterator[Scene]:
        """Yield one scene of each of up to `most` episodes, such as to time a model on.

        With `ego_alone`, only the ego will be asked, and what helpers know, their scene graphs, may
        be left out.
        """
        ...


@dataclass(frozen=True)
class Spec:
    """Describe one evaluation completely: agents, scenes, conditions, seeds and settings.

    It holds opened what `settings`, those typed, name: `ego` and `helpers` are models with their
    prompts, the latter empty if the ego's answers for helpers, `source` has the scenes, and
    `points` are the conditions, each a named set of settings of the radio, of asking helpers and of
    fusing their messages. `seeds` are of the channel's random numbers. `timer` times each answer by
    itself, and `stopping_rule` may end the run early, None without; `interim_looks` says when a run
    that it ended was looked at. `guards` may refuse to ask. Raises UserError for what is not
    allowed, or does not go together.
    """

    ego: Agent  # the agent that answers for the ego: a model, its prompt and how it is asked
    source: Source  # the scenes: a dataset's, or those of layouts to drive
    # the conditions, each a named set of settings of the radio, of asking helpers and of fusing
    # their messages
    points: tuple[OperatingPoint, ...]
    seeds: tuple[int, ...]  # seeds of the channel's draws
    # the agents that answer for the helpers. Helpers take them in turn, in the order in which they
    # were spawned. Empty if the ego's agent answers for the helpers, too
    helpers: tuple[Agent, ...] = ()
    # what times each answer by itself, in place of `--latency`; None for the latter
    timer: Timer | None = None
    stopping_rule: StoppingRule | None = None  # when episodes are enough; None if all are evaluated
    interim_looks: InterimLooks | None = None  # at a run that has stopped by this rule
    # all settings as typed, of which `resolve.spec` makes this evaluation; those that fields above
    # hold opened are rewritten to agree with them
    settings: Settings = USUAL
    guards: tuple[Guard, ...] = ()  # what may refuse to ask; they change nothing in the run

    def __post_init__(self) -> None:
        if all(agent == self.ego for agent in self.helpers):
            object.__setattr__(self, "helpers", ())
        if not self.seeds or len(set(self.seeds)) != len(self.seeds):
            raise UserError(
                f"--seeds {list(self.seeds)}: give one or more different whole numbers, such as 0:5"
            )
        object.__setattr__(self, "settings", structs.replace(self.settings, **self._opened()))
        for tag in self.settings.tag:
            if not (0 < len(tag) <= TAG_CHARACTERS and tag.isprintable() and tag == tag.strip()):
                raise UserError(
                    f"--tag {printable(tag)!r}: give 1 to {TAG_CHARACTERS} printable characters, "
                    "with no space at either end"
                )
        for flag, choice, choices in (
            ("--ask", self.settings.ask, ASKS),
            ("--ties", self.ties, TIES),
        ):
            if choice not in choices:
                raise UserError(f"{flag} {printable(choice)}: give {' or '.join(choices)}")
        self._check_batch_size()
        self._check_servers()
        self._check_sampling()
        for agent in self.agents:
            self._check(agent)
        if self.helpers:
            role_agents.of_helpers().check(self)
        if (latency := self.settings.latency) not in (None, *NAMES):
            times = len(declared(latency).helpers_s)
            replays = any(agent.can.own_latency for agent in self.agents)  # answers of several
            if times and times != len(self.helpers) and not replays:
                raise UserError(
                    f"--latency {printable(latency)}: {times} times for {len(self.helpers)} helper "
                    "models; give one, or one each"
                )
        if self.timer:
            self.timer.check(self)
        for point in self.points:
            self._check_point(point)
        if self.stopping_rule:
            self.stopping_rule.check(self)
        for flag, value in {
            "--device": self.settings.device,
            "--dtype": self.settings.dtype,
        }.items():
            if value is not None and not any(agent.can.has_weights for agent in self.agents):
                engines = [
                    name
                    for name, engine in ENGINES.usable().items()
                    if engine.capabilities.has_weights
                ]
                raise UserError(
                    f"{flag} {printable(value)}: {printable(self.ego.card.name)} has no weights "
                    f"here (engines {' and '.join(engines)} have); leave it out"
                )

    def _check_servers(self) -> None:
        served = {agent.card for agent in self.agents if agent.card.server}
        if self.settings.server and len(served) != 1:
            models = " and ".join(
                sorted(printable(card.name) for card in served or {self.ego.card})
            )
            reason = "are asked at servers of their own" if served else "is asked at none"
            raise UserError(
                f"--server: {models} {reason}; leave it out, and give base_url in a card"
            )
        try:
            for card in served:
                card.at(self.settings.server)
        except ValueError as error:
            raise UserError(f"--server: {error}") from None

    def _check_sampling(self) -> None:
        temperature, seed = self.settings.temperature, self.settings.sampling_seed
        option = f"--temperature {temperature:g}"
        if not 0 <= temperature <= HOTTEST:
            raise UserError(
                f"{option}: give 0, which takes the likeliest token each time, to {HOTTEST:g}"
            )
        in_range("--sampling-seed", seed, 0, LAST_SEED)
        if seed and not temperature:
            raise UserError(
                f"--sampling-seed {seed}: give a --temperature above 0 with it: greedy answers are "
                "not drawn"
            )
        if temperature and not any(agent.samples for agent in self.agents):
            name = printable(self.ego.card.name)
            reason = (
                f"{name} has nothing to sample; leave it out, or give a model that writes its "
                "answers"
            )
            if self.ego.answer in BARE:
                reason = (
                    f"a {self.ego.answer} is a distribution already; use --answer json or "
                    "constrained"
                )
            raise UserError(f"{option}: {reason}")

    def _check(self, agent: Agent) -> None:
        name, version = printable(agent.card.name), agent.prompt.version
        if reason := unfit(agent.prompt, self.scenario):
            raise UserError(
                f"--prompt {version} {reason}; give {self.scenario.prompt}, or one of your own"
            )
        self._check_examples(agent.prompt)
        if agent.can.from_file:
            self._check_of_file(agent)
        if self.source.kind == "closed-loop" and agent.image == "another":
            raise UserError(
                "--image another: pictures of other scenes are a dataset's; give blank or none"
            )
        if self.source.kind == "closed-loop" and not agent.can.closed_loop:
            raise UserError(
                f"--model {name}: a replay has answers to frozen scenes alone; give the model that "
                "it replays"
            )
        latency = self.settings.latency
        option = f"--latency {printable(latency)}"
        if latency not in NAMES:
            return
        if agent.can.own_latency and latency != "paper":
            raise UserError(
                f"{option}: a replay has the times of its run; use paper, or leave it out"
            )
        elif latency == MEASURED and agent.can.from_file:
            raise UserError(f"{option}: no answer of a file is timed here; use paper, or seconds")
        elif latency == MEASURED and not agent.can.language_model:
            raise UserError(f"{option}: {name} is no language model; use card or paper")
        elif latency == "card" and agent.card.latency.inference_s is None:
            raise UserError(
                f"{option}: the card of {name} declares no inference time; "
                "use paper or measured, or add inference_s to the card"
            )

    def _check_of_file(self, agent: Agent) -> None:
        """Raise UserError if the questions of a run cannot be written for another program."""
        option = f"--answers {printable(agent.card.weights)}"
        if self.helpers:
            raise UserError(
                f"{option}: the file answers for helpers, too; give them no models of their own"
            )
        if agent.prompt.image and agent.image != "none":
            raise UserError(
                f"{option}: prompt {agent.prompt.version} shows a picture, and questions are "
                "written as text; give another prompt, or --image none"
            )

    def _check_examples(self, prompt: Prompt) -> None:
        """Raise UserError if an example's layout is evaluated,
        or if the parser would not take its answer.
        """
        if prompt.examples is None:
            return
        if shared_seeds := sorted(prompt.examples.seeds.intersection(self.source.layout_seeds)):
            raise UserError(
                f"--prompt {prompt.version} has an example of layout seed {shared_seeds[0]}, "
                "which is evaluated; leave that episode out, or draw the examples anew: "
                "`harness prompt examples --first-seed`"
            )
        for role in ROLES:
            example_actions(prompt, role, self.actions)

    def _check_point(self, point: OperatingPoint) -> None:
        condition, ego = f"condition {printable(point.name)}", self.ego
        reads = point.has_fusion_call and point.shows_words
        if obstacle := self._obstacle(point, reads):
            raise UserError(f"{condition}: {obstacle}")
        call = point.content.call
        if point.has_fusion_call and call and call.in_graph and ego.can.language_model:
            self._check_shows_objects(condition)
        if reads and point.content.asks_helpers and self.fusion_obstacle:
            raise UserError(f"{condition}: {self.fusion_obstacle}")

    def _obstacle(self, point: OperatingPoint, reads: bool) -> str | None:
        """Return why a condition, whose ego `reads` messages, cannot be played; None if it can."""
        if reads and not self.ego.can.language_model:
            name = printable(self.ego.card.name)
            return f"{name} is no language model and cannot fuse messages"
        if obstacle := contents_of_packages.obstacle(point, self):
            return obstacle
        if self.timer and (obstacle := self.timer.obstacle(point)):
            return obstacle
        for part in point.more:
            if obstacle := parts_of_packages.obstacle(part, point, self):
                return obstacle
        return None

    def check_models(self, identity: Mapping[str, Any], latency: Latency) -> None:
        """Raise UserError if a condition cannot be used with the models that were opened.

        `identity` tells them apart, as a run's manifest states it: the ego's, and those of helpers.
        Of answers that are replayed it is that of the models that gave them. `latency` has the
        seconds of answers.
        """
        ego = answerers_of(identity, identity, (), 0.0).identity
        timed = {**ego, "latency": msgspec.to_builtins(latency)}
        identities = [timed, *(ego.get("helpers") or ())]
        for point in self.points:
            for part in point.more:
                if obstacle := parts_of_packages.obstacle_of_models(part, identities):
                    raise UserError(f"condition {printable(point.name)}: {obstacle}")

    def _check_shows_objects(self, condition: str) -> None:
        """Raise UserError if the ego's prompt is the same whatever is around;
        it is tried on some scenes.
        """
        for scene in self.source.trial(TRIED, ego_alone=True):
            scenario = self.scenario_of(scene)
            graph = truth_graph(scenario, scene.state)
            full, empty = (
                self.ego.rendered(each, self.actions, (), scenario.prompt_words)
                for each in (graph, graph.blinded())
            )
            if full != empty:
                return
        raise UserError(
            f"{condition}: prompt {self.ego.prompt.version} shows no objects in its text, so the "
            "ego would be asked the same question again; give another --prompt"
        )

    @property
    def fusion_obstacle(self) -> str | None:
        """Return why the ego's prompt cannot show helpers' messages, as a phrase; None if it can.

        It must, where a condition asks the ego's model again with the messages (fusion call). A
        condition is a named set of settings of the radio, of asking helpers and of fusing their
        messages.
        """
        if bare := [agent.answer for agent in self.agents if agent.answer in BARE]:
            return f"a {bare[0]} gives no messages to fuse; use --answer json or constrained"
        return role_agents.of_helpers().unlike(self) if self.helpers else None

    @property
    def agents(self) -> tuple[Agent, ...]:
        return self.ego, *self.helpers

    @property
    def cards(self) -> tuple[Card, ...]:
        """Return the agents' model cards, the ego's first: what a file says of each model.

        A served model's has the servers of the settings, if they name any.
        """
        return tuple(agent.card.at(self.settings.server) for agent in self.agents)

    def scenario_of(self, scene: Scene) -> Scenario:
        """Return the scenario from the view of the vehicle that decides in a scene.

        Where several vehicles decide, its words and roads are that vehicle's own, with it as the
        ego.
        """
        return scene.seat or self.scenario

    def agent(self, place: int) -> int:
        """Return the index in `agents` of the agent that answers for a vehicle of a scene.

        An agent is a model, its prompt and how it answers. `place` is the vehicle's index
        (`Scene.place`), 0 the ego; helpers take the helpers' agents in turn.
        """
        return 1 + (place - 1) % len(self.helpers) if place and self.helpers else 0

    def agent_of_answer(self, agent: int) -> int | UnsetType:
        """Return the index of an agent as an answer states it, unset where it follows without.

        `agent` is the index in `agents`, 0 the ego's. It follows from whose answer it is with one
        agent of helpers, or where every helper is asked in turn, and for the ego unless other
        vehicles decide as well.
        """
        if self.several_decide and self.helpers:
            return agent
        chosen = len(self.helpers) > 1 and not self.asks_all
        return agent if agent and chosen else UNSET

    @property
    def actions(self) -> tuple[str, ...]:
        return self.source.actions

    @property
    def scenario(self) -> Scenario:
        return self.source.scenario

    @property
    def several_decide(self) -> bool:
        """Return whether vehicles beside the ego decide for themselves, too."""
        return agent_share(self.scenario) > 0

    @property
    def asks_all(self) -> bool:
        """Return whether all helpers are asked, not only those whose answers a condition uses.

        It is so with `ask = "all"`, with a timer, which counts what all answers cost, and for a
        driver (`ego_alone`). A condition is a named set of settings of the radio, of asking helpers
        and of fusing their messages.
        """
        return self.settings.ask == "all" or self.ego_alone or self.timer is not None

    @property
    def frozen(self) -> bool:
        """Return whether scenes are recorded (`harness eval`), not simulated (`harness drive`)."""
        return self.source.kind == "frozen"

    @property
    def ego_alone(self) -> bool:
        """Return whether the model answers only for the ego, so that no helper is asked.

        It is a rule-based driver then.
        """
        return not self.ego.can.asks_helpers

    def viewers(self, scene: Scene) -> tuple[str, ...]:
        """Return the ids of a scene's vehicles for which a model answers, the ego first."""
        return scene.viewers[:1] if self.ego_alone else scene.viewers

    def changed(self, **settings: Any) -> "Spec":
        """Return a copy of this evaluation with other values of some of its `settings`.

        Keywords are the settings' names, such as `temperature`. Raises ValueError for one that
        names a file or model: what it names is opened in another field, which is to be replaced.
        """
        spec = replace(self, settings=structs.replace(self.settings, **settings))
        if lost := [
            name for name, value in settings.items() if getattr(spec.settings, name) != value
        ]:
            raise ValueError(f"{lost[0]} is what is opened here: replace that")
        return spec

    def stopped(self, looks: InterimLooks) -> "Spec":
        """Return this evaluation cut to the episodes after which its stopping rule ended a run.

        Such a rule looks, after some of a run's layouts (start situations, one an episode), whether
        these are enough; `looks` says after how many it did.
        """
        looks = replace(looks, layouts=len(self.source.numbers))
        return replace(self, source=self.source.first(looks.at[-1]), interim_looks=looks)

    @property
    def world(self) -> FrozenScenes | ClosedLoop:
        """Return what a run's manifest states of its scenes, and of what may stop the run early.

        The manifest is the record of a run's settings and origin.
        """
        world = self.source.record()
        if self.stopping_rule is None:
            return world
        looks = self.interim_looks or InterimLooks(len(self.source.numbers))
        return structs.replace(world, interim_looks=self.stopping_rule.record(looks))

    def record(self) -> dict[str, Any]:
        """Return all settings, and a record of every file that they opened, for a run's `run.json`.

        Values are plain, by name.
        """
        settings = msgspec.to_builtins(self.settings)
        return {
            **self.ego.settings(),
            "helpers": [agent.settings() for agent in self.helpers],
            "world": msgspec.to_builtins(self.world),
            "actions": list(self.actions),
            "conditions": [point.record() for point in self.points],
            **files_of(self.points),
            "seeds": list(self.seeds),
            "beside": self.timer.record() if self.timer else {},
            **{key: settings[name] for key, name in formats.BESIDE.items()},
            "settings": settings,
        }

    def _opened(self) -> dict[str, Any]:
        """Return the settings that open what is opened here;
        and those that depend on it if nothing is typed.

        A counterpart of a condition has a name of its own, and so has a model on another engine.
        """
        first = self.seeds[0]
        return {
            "model": argument(self.ego.card),
            "answers": self.ego.card.weights if self.ego.can.from_file else None,
            "engine": None,
            "prompt": self.ego.prompt.version,
            "world": self.source.settings(),
            "condition": tuple(point.name for point in self.points),
            "seeds": ",".join(map(str, self.seeds))
            if len(self.seeds) > 1
            else f"{first}:{first + 1}",
            **{
                name: getattr(self.ego, name)
                for name in ("answer", "thinking", "image", "flip", "sums")
            },
            "letters": self._letters,
            "ties": self.ties,
            "extensions": self._of_extensions(),
            "tag": tuple(dict.fromkeys(self.settings.tag)),
        }

    def _of_extensions(self) -> dict[str, Any]:
        """Return the settings of extensions; those that open something say what is open.

        Of those that make counterparts of conditions there is none, nor of others without texts.
        """
        beside = extensions.beside()
        settings: dict[str, Any] = {}
        for name, setting in of_extensions().items():
            if name not in beside and setting.default not in (None, *formats.NO_TEXTS):
                settings[name] = setting.default
        others = self.settings.extensions
        for choices in (SELECTIONS, TIMERS, STOPPING_RULES):
            others = choices.without(others)
        for name, value in others.items():
            if name not in (*COUNTERPARTS, *role_agents.settings()):
                settings[name] = value
        given = self.source.choice.given if self.source.choice else {}
        for name, value in given.items():
            if name in beside and value != beside[name].default:
                settings[name] = value
        by_timer = self.timer.settings() if self.timer else {}
        by_rule = self.stopping_rule.settings() if self.stopping_rule else {}
        by_agents = {}
        if self.helpers:
            by_agents = role_agents.of_helpers().settings(self.ego, self.helpers)
        return {**settings, **by_timer, **by_rule, **by_agents}

    @property
    def ties(self) -> str:
        """Return which of equally likely actions the ego takes: one `drawn`, or the `first`.

        By default it is as in the run that is replayed, if there is one.
        """
        if self.settings.ties is not None:
            return self.settings.ties
        manifest = replayed(self.ego)
        return manifest.settings.ties or TIES[0] if manifest else TIES[0]

    @property
    def temperature(self) -> float:
        """Return the temperature at which answers are sampled; 0 takes the likeliest token."""
        return self.settings.temperature

    def _check_batch_size(self) -> None:
        at_once = self.settings.batch_size
        if at_once != AUTO:
            if at_once < 1:
                raise UserError(f"--batch-size {at_once}: give 1 or more")
            return
        for agent in self.agents:
            if agent.can.language_model and not agent.can.adapts:
                raise UserError(
                    f"--batch-size {AUTO}: {printable(agent.card.name)} is not asked at servers, "
                    "which alone say what they take; give a number, 1 or more"
                )

    @property
    def opening(self) -> dict[str, Any]:
        """Return the options with which models are opened, by name.

        They are `device`, `dtype` (number format of weights) and `batch_size`.
        """
        return {name: getattr(self.settings, name) for name in ("device", "dtype", "batch_size")}

    @property
    def _letters(self) -> str | None:
        """The option that reads the letters as here; None if it is the cards' own choice."""
        reads = [agent for agent in self.agents if agent.answer == "readout"]
        is_cards_choice = all(
            agent.letters == replace(agent, letters=None).letters for agent in reads
        )
        return None if is_cards_choice else reads[0].letters


def files_of(points: Sequence[OperatingPoint]) -> dict[str, Any]:
    """Return a record of every file that operating points name, by folder and name.

    An operating point is the settings of radio, asking and fusion. They are channel profiles,
    networks, schedules, and what extensions keep, such as calibrations.
    """
    profiles = [point.radio.profile for point in points]
    networks = {point.cloud.round_trip: point.network for point in points}
    schedules = {point.ask.schedule: SCHEDULES.file_sha256(point.ask.schedule) for point in points}
    kept = {}
    for folder, by_name in kept_of(points).items():
        kept[folder] = {name: each.record for name, each in by_name.items()}
    return {
        "channels": {name: CHANNELS.record(name) for name in profiles if name},
        "networks": {name: asdict(network) for name, network in networks.items() if network},
        "schedules": {name: sha256 for name, sha256 in schedules.items() if sha256},
        "kept": kept,
    }


def replayed(ego: Agent) -> Manifest | None:
    """Return the manifest of the run whose answers the ego's model replays; None for others.

    A replay scores a run's stored answers again, and a manifest is the record of a run's settings
    and origin. None also for what is no run, which is refused when it is opened.
    """
    if not ego.can.own_latency:
        return None
    with suppress(UserError):
        return read(Path(ego.card.weights or "")).manifest
    return None
