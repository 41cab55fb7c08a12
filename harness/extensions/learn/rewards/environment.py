"""Driving as a Gymnasium environment: one decision a step, with the worth of every action known.

The reward of a step is minus its regret: the worth of what is taken, less the best worth there.
Summed over an episode it is success, less whether success was possible, where the best takes the
rest. An action is an index, or a distribution over the actions: then the reward is the mean, and
the action that is taken is drawn from it by the environment's own generator.
"""

from collections.abc import Mapping
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
from gymnasium import spaces

from harness.core.arrays import Floats
from harness.core.errors import UserError, printable, unknown
from harness.core.files import digest
from harness.core.seeds import purpose
from harness.evaluate.chats import Asking
from harness.extensions.learn.rewards import asking
from harness.extensions.learn.rewards.trips import Roads, Trees, Trip
from harness.extensions.learn.rewards.values import Values, optimal
from harness.world.scene_numbers import numbers

Observation = Literal["text", "arrays"]
Reward = Literal["regret", "success"]
MOST_CHARS = 100_000  # of a chat message
MOST = 1e6  # as great as a number of a scene graph may be
# What messages are written in: line breaks, and letters and signs up to those of East Asia.
CHARACTERS = frozenset(["\n", "\t"] + [chr(code) for code in range(0x20, 0x3000)])


class Driving(gymnasium.Env):  # type: ignore[misc] # gymnasium counts as untyped
    """Let a learning program decide for the ego, one decision a step, as a Gymnasium environment.

    Users get one from `harness.environment`. An observation is a chat that asks the viewer, the
    vehicle whose sight it shows (`text`), or the numbers of its scene graph, what it knows of the
    scene (`arrays`): `numbers`, named by `self.numbers`, which are 0 where `known` is 0. The last
    observation of an episode repeats the one before.

    `info` has what no driver knows: `values`, the probability of success after each of A actions,
    (A,), `optimal`, a mask (A,) of the best ones, `lost` if success is out of reach, `scene` (its
    id), `layout_seed` (which draws the start situation), `danger` (the side that a hidden vehicle
    comes from, such as `left`, "" without one) and `viewer`; after a step the index `taken`, and at
    the end `success`.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 # as gymnasium declares it
    advantage = staticmethod(asking.advantage)
    expected_advantage = staticmethod(asking.expected_advantage)

    def __init__(
        self,
        source: Trees | Roads,
        ask: Asking,
        *,
        observation: Observation = "text",
        viewer: str | None = None,
        reward: Reward = "regret",
        distributions: bool = False,
    ) -> None:
        if observation not in get_args(Observation):
            raise unknown("observation", str(observation), get_args(Observation))
        if reward not in get_args(Reward):
            raise unknown("reward", str(reward), get_args(Reward))
        if reward == "regret" and isinstance(source, Roads) and not source.then:
            raise UserError(
                'reward="regret" needs values; give then="local-view", or reward="success"'
            )
        if observation == "arrays" and source.scenario.layouts is not None:
            raise UserError(
                "the layouts here have roads of their own, and vectors need one road; give "
                'observation="text"'
            )
        self.source, self.ask, self.actions = source, ask, source.scenario.actions
        self.viewer, self.reward, self._text = viewer, reward, observation == "text"
        scene = source.begin(source.seeds[0]).scene
        road = source.scenario.at(scene.state.episode_seed).road()
        graph = scene.graphs[asking.viewer_of(scene, viewer, 0.0)]
        self.numbers = tuple(name for name, _ in numbers(graph, road))
        count = len(self.actions)
        self.action_space = (
            spaces.Box(0.0, 1.0, (count,)) if distributions else spaces.Discrete(count)
        )
        text = spaces.Text(MOST_CHARS, charset=CHARACTERS)
        chat = spaces.Sequence(spaces.Dict({"role": text, "content": text}))
        shape = (len(self.numbers),)
        arrays = spaces.Dict(
            numbers=spaces.Box(-MOST, MOST, shape), known=spaces.MultiBinary(shape)
        )
        self.observation_space = chat if self._text else arrays
        self.trip: Trip | None = None

    @property
    def values(self) -> Values:
        """Return the probability of success after every action, at every decision point, as arrays.

        Raises UserError if episodes are driven in the simulator and so have no decision trees, from
        which it is computed.
        """
        return self._trees("values").values

    def rows(self, per_level: int = 6) -> list[dict[str, Any]]:
        """Return questions of all layouts (start situations) for trainers of text models, as dicts.

        A dict has `prompt`, the chat messages that ask, and the columns that the reward functions
        read: `values`, the probability of success after each action, (A,), `constant`, the index of
        the action that is always taken, and how the answer is parsed. They are of decision points
        at which the action matters, `per_level` for each step of each layout. Raises UserError if
        the episodes are driven in the simulator and so have no trees.
        """
        trees = self._trees("rows()")
        at = trees.drawn(per_level)
        return [
            *asking.rows(trees.dataset, trees.values, trees.constant, self.ask, self.viewer, at)
        ]

    def references(self, per_level: int = 6) -> dict[str, dict[str, float]]:
        """Return the scores of drivers that need no model, to draw beside a training curve.

        The keys are drivers, such as `constant`, `uniform` and `full-view`, which sees everything.
        Each has `advantage`, the mean reward over `rows(per_level)` (0 for `constant`), and
        `success`, the share of successful episodes on their layouts (start situations), balanced
        over those with and without a danger, a vehicle that a cruising ego would meet. `per_level`
        is about how many decision points are drawn at each step of each layout. Raises UserError if
        the episodes are simulated and have no stored trees, or if no decision matters.
        """
        trees = self._trees("references()")
        return trees.references(trees.drawn(per_level))

    def learnt(self) -> dict[str, Any]:
        """Return what the card, the file that describes a model, should state of one trained here.

        It is plain values: `scenarios` (name to digest), `layouts` (how many start situations),
        `first_seed` (of these), `purpose` of the seeds, `then` (who decides after a judged action),
        `reward`, and `prompts` (version to digest).
        """
        scenario, seeds = self.source.scenario, self.source.seeds
        prompt = self.ask.prompt
        return {
            "scenarios": {scenario.name: digest(scenario.parameters.stated())},
            "layouts": len(seeds),
            "first_seed": seeds[0],
            "purpose": purpose(seeds[0], len(seeds)),
            "then": self.source.then,
            "reward": self.reward,
            "prompts": {prompt.version: prompt.sha256} if self._text else {},
        }

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode on a random layout, or on that of `options={"layout_seed": ...}`.

        A layout is a start situation. `seed` seeds the draw of layouts. Returns the observation and
        `info`. Raises UserError for a layout that may not be learnt from, or has no tree here.
        """
        super().reset(seed=seed)
        seeds = self.source.seeds
        drawn = seeds[int(self.np_random.integers(len(seeds)))]
        self.trip = self.source.begin((options or {}).get("layout_seed", drawn))
        return self._look()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take an action, given as an index or as a distribution over A actions, (A,).

        A distribution is normalised. Returns observation, reward, whether the episode ended, False,
        and `info`, as Gymnasium asks. Raises UserError before `reset`, after the end, or if it is
        not an action.
        """
        if self.trip is None or self.trip.success is not None:
            raise UserError("no episode is under way; call reset() first")
        p = self._distribution(action)
        index = np.ndim(action) == 0
        taken = int(action) if index else int(self.np_random.choice(len(p), p=p))
        values = self.trip.values
        regret = values.max() - float(p @ values)
        self.trip.take(taken)
        success = self.trip.success
        reward = -regret if self.reward == "regret" else float(success or 0)
        observation, info = self._look()
        info |= {"taken": taken} if success is None else {"taken": taken, "success": success}
        return observation, reward, success is not None, False, info

    def _distribution(self, action: Any) -> Floats:
        try:
            given = np.asarray(action)
            if given.ndim == 0 and given.dtype.kind in "iu" and 0 <= given < len(self.actions):
                return np.asarray(np.eye(len(self.actions))[int(given)])
            p = given.astype(float)
            total = p.sum()
            if p.shape == (len(self.actions),) and (p >= 0).all() and 0 < total < np.inf:
                return np.asarray(p / total)
        except (TypeError, ValueError):
            pass
        raise UserError(
            f"action {printable(str(action), 40)}: give an index, 0 to {len(self.actions) - 1} for "
            f"{', '.join(self.actions)}, or {len(self.actions)} probabilities"
        )

    def _look(self) -> tuple[Any, dict[str, Any]]:
        assert self.trip
        scene, values = self.trip.scene, self.trip.values
        viewer = asking.viewer_of(scene, self.viewer, float(self.np_random.random()))
        record, graph = scene.record, scene.graphs[viewer]
        info = {
            "values": values.copy(),
            "optimal": optimal(values),
            "lost": bool((values == 0).all()),
            "scene": scene.id,
            "layout_seed": record.episode_seed,
            "danger": record.danger.sector or "",
            "viewer": viewer,
        }
        if self._text:
            return tuple(self.ask.chat(graph, scene.seat)), info
        read = [number for _, number in numbers(graph, self.source.scenario.road())]
        is_known = np.array([number is not None for number in read], np.int8)
        return {
            "numbers": np.array([number or 0.0 for number in read], np.float32),
            "known": is_known,
        }, info

    def _trees(self, what: str) -> Trees:
        if isinstance(self.source, Trees):
            return self.source
        raise UserError(
            f"{what} of driven episodes are not known in advance; leave out driven=True"
        )
