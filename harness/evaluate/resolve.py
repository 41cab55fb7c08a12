"""Make an evaluation of settings: cards, prompts, datasets,
operating points and seeds in place of names.
"""

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from harness.backends import cards
from harness.backends.answered_prompts import prompt_for
from harness.backends.base import BARE
from harness.backends.card import Card
from harness.coordination.counterparts import counterparts
from harness.coordination.named_points import POINTS, named_point
from harness.coordination.operating_point import OperatingPoint
from harness.core.errors import UserError, in_range, printable
from harness.core.files import text_of
from harness.core.resources import folder
from harness.core.seeds import LAST_EPISODE, LAST_SEED, purpose
from harness.dataset import load
from harness.dataset.select import SELECTIONS
from harness.evaluate.agent import Agent
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.spec import Source, Spec, replayed
from harness.prompts import versions
from harness.prompts.versions import Prompt
from harness.runs import role_agents
from harness.runs.settings import DriveSettings, FrozenSettings, Settings, parse_seeds
from harness.runs.stopping import STOPPING_RULES
from harness.runs.timers import TIMERS, Timer
from harness.world.scenario import Scenario
from harness.world.scenarios import DEFAULT

if TYPE_CHECKING:
    from harness.evaluate.live_world import LiveSource


def spec(settings: Settings, source: Source) -> Spec:
    """Return the evaluation that a run's settings describe, with all files that they name opened.

    `source` has the scenes: recorded ones of a dataset, or start situations to drive from. Raises
    UserError for a name that there is not, or settings that are not allowed together.
    """
    ego, helpers = agents(settings, source.scenario)
    return Spec(
        ego=ego,
        helpers=helpers,
        source=source,
        seeds=parse_seeds(settings.seeds),
        points=points(settings.condition or tuple(POINTS), settings.extensions),
        timer=TIMERS.chosen(settings.extensions) or _of_replayed(ego, settings),
        stopping_rule=STOPPING_RULES.chosen(settings.extensions),
        settings=settings,
    )


def _of_replayed(ego: Agent, settings: Settings) -> Timer | None:
    """Return what timed the answers of the run that is replayed, unless --latency is given."""
    manifest = replayed(ego) if settings.latency is None else None
    return manifest.timer if manifest else None


def frozen(settings: Settings, dataset: str) -> FrozenSource:
    """Return the episodes of a dataset, given by name or folder, that settings of a run select.

    Raises UserError if there is no such dataset, or the selection is not allowed.
    """
    world, selection = settings.world, SELECTIONS.chosen(settings.extensions)
    assert isinstance(world, FrozenSettings)
    whole = load.load(load.find(dataset), None if selection else world.limit)
    choice = selection.choice(whole.episodes, whole) if selection else None
    numbers = choice.numbers if choice else whole.episodes
    part = whole.of_episodes(frozenset(numbers[: world.limit]))
    source = FrozenSource(part, world.limit, choice)
    if not source.scenario.has_own_world:
        source.scenario.road()  # which is on the page, and needs the simulator for some scenarios
    return source


def driven(settings: Settings, scenario: str | None = None) -> "LiveSource":
    """Return the layouts to drive in closed loop, by default those of the shipped dataset.

    A layout is one start situation of a scenario. `scenario` is a name, in place of that in the
    settings. Raises UserError if an episode or seed is out of range or mixed with those of another
    purpose, or if the scenario is an environment that cannot be driven.
    """
    # A base install evaluates without the simulator.
    from harness.evaluate.live_world import LiveSource

    world, selection = settings.world, SELECTIONS.chosen(settings.extensions)
    assert isinstance(world, DriveSettings)
    name = scenario or world.scenario or DEFAULT
    shipped = _shipped(name.partition(":")[0])
    episodes = shipped["episodes"] if world.episodes is None else world.episodes
    first_seed = shipped["seed"] if world.first_seed is None else world.first_seed
    in_range("--episodes", episodes, 1, LAST_EPISODE + 1)
    in_range("--first-seed", first_seed, 0, LAST_SEED)
    purpose(first_seed, episodes)
    choice = selection.choice(range(episodes), None) if selection else None
    source = LiveSource(first_seed, episodes, name, choice)
    if world_of_scenario := source.scenario.world:
        world_of_scenario.examine(source.scenario, first_seed)
    source.scenario.cluster_of(source.layout_seeds[0])
    return source


def _shipped(scenario: str) -> dict[str, Any]:
    """Return the manifest of the dataset that ships of a scenario;
    where none does, of the default one.
    """
    manifests = [
        json.loads(text_of(file, "record"))
        for file in sorted(folder("datasets").glob("*/manifest.json"))
    ]
    by_scenario: dict[str, dict[str, Any]] = {
        manifest["scenario"]: manifest for manifest in manifests
    }
    return by_scenario.get(scenario) or by_scenario[DEFAULT]


def agents(settings: Settings, scenario: Scenario) -> tuple[Agent, tuple[Agent, ...]]:
    """Return the agent that answers for the ego, and those that answer for helpers.

    An agent is a model, its prompt and how it answers, by a run's settings. The second are empty if
    the ego's answers for helpers, too. Raises UserError for models, prompts or answer modes that do
    not exist or do not fit.
    """
    card = _card(settings)
    prompt = versions.load(settings.prompt) if settings.prompt else _prompt_of(card, scenario)
    # Agent checks the modes.
    how = (
        settings.answer,
        settings.thinking,
        settings.image,
        settings.letters,
        settings.sums,
        settings.flip,
    )
    ego = Agent(card, prompt, *how)  # type: ignore[arg-type]
    helpers = role_agents.opened(settings, ego)
    if settings.letters and not any(agent.answer in BARE for agent in (ego, *helpers)):
        raise UserError(
            f"--letters {settings.letters}: no letters are read of an answer in {settings.answer}; "
            "leave it out, or give --answer readout"
        )
    return ego, helpers


def _prompt_of(card: Card, scenario: Scenario) -> Prompt:
    """Return the prompt of a scenario where none is typed, or that which a model's card names."""
    version = prompt_for(scenario.prompt, card.prompts)
    try:
        return versions.load(version)
    except UserError as error:
        if version == scenario.prompt:
            raise
        raise UserError(
            f"card {printable(card.name)}, [[prompts]]: {error}; correct the card, or give --prompt"
        ) from None


def _card(settings: Settings) -> Card:
    """Return the card of the model that answers for the ego, or of a file of answers."""
    if settings.answers is None:
        return cards.resolve(settings.model, settings.engine)
    option = f"--answers {printable(settings.answers)}"
    if settings.engine is not None:
        raise UserError(f"{option}: no engine answers here; leave --engine out")
    if settings.model == Settings().model:
        raise UserError(f"{option}: name what answered, such as --model my-model")
    return cards.of_answers(settings.model, settings.answers)


def points(
    conditions: Sequence[str], settings: Mapping[str, Any] | None = None
) -> tuple[OperatingPoint, ...]:
    """Return the conditions that texts name, each once, with the counterparts of these.

    A condition is a set of settings of the radio, of asking helpers and of fusing their messages,
    such as `6g:window_s=0.4`; a counterpart differs from it in one setting, such as a control,
    which replaces what helpers say. `settings` are a run's settings of extensions, values by name.
    Raises UserError for an unknown name.
    """
    named = [named_point(name) for name in dict.fromkeys(conditions)]
    return tuple(dict.fromkeys((*named, *counterparts(named, settings or {}))))
