"""Play candidates on tune layouts within a budget of questions, and say which is best.

A candidate's score is its success, balanced over layouts with and without a danger where there are
both, and a thousandth of the worth of what it states: the probability that the tree gives success
if its policy decides once and all later actions are drawn evenly. So a layout more outweighs any
worth, and worth decides between equals; of prompts with equal scores, the shorter is better.
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import chain, compress, repeat
from pathlib import Path
from typing import NamedTuple

import numpy as np

from harness.backends.base import Backend
from harness.coordination.operating_point import AS_SENT, Rewrites
from harness.coordination.parts import PLAIN, Question
from harness.coordination.streams import Stream, Streamed
from harness.core.arrays import Bools, Floats, Ints
from harness.core.progress import Progress
from harness.dataset.load import Dataset, Scene
from harness.evaluate.asking import Asker
from harness.evaluate.frozen_world import FrozenSource, FrozenWorld
from harness.evaluate.kept_answers import read_kept
from harness.evaluate.requests import Places, fusion_id, stream_sets
from harness.evaluate.spec import Spec
from harness.evaluate.walk import Fuses, walk
from harness.extensions.learn.optimize.candidate import Candidate
from harness.prompts.versions import Prompt
from harness.runs.records import Answer, Latency
from harness.runs.success import Success

TIE = 1e-3  # weight of worth in a score


class Spent(Exception):
    """Signal that the budget of questions does not suffice for what would be asked next."""


class Decision(NamedTuple):
    """Hold one decision of an episode: its scene, the messages heard, the policy and the action.

    `scene`, of the dataset `dataset`, is the situation. Fusion makes the ego's policy of its own
    answer (the text `raw`) and of the messages that it `heard`: `policy` (A,) has the probabilities
    of the scenario's A actions, and `action` is the index of the one taken.
    """

    # the layouts (start situations) that were played, with their trees: every course that actions
    # can lead to
    dataset: Dataset
    scene: Scene  # the situation in which the ego decided
    policy: Floats  # the probabilities of the scenario's A actions after fusion, (A,)
    action: int  # index of the action taken
    heard: tuple[Answer, ...]  # the answers of the helpers whose messages came in time
    raw: str  # the text of the ego's own answer


class Played(NamedTuple):
    """Hold the result of a candidate wording on one layout, a start situation of a scenario.

    It is one episode under each channel seed, by which messages are lost or delayed. `success` is
    the share of these that succeed. `worth` is how probable success is under the stated
    distributions, as a mean over decisions, if later actions are drawn evenly. `course` has the
    decisions under the first seed.
    """

    success: float  # share of successful episodes over the channel seeds
    # mean probability of success under the stated distributions if later actions are drawn evenly,
    # over the decisions at which success was still possible; 0 without one
    worth: float
    course: tuple[Decision, ...]  # the episode's decisions under the first channel seed

    @property
    def score(self) -> float:
        return self.success + TIE * self.worth


@dataclass
class Record:
    """Hold all results of one candidate wording so far, and the questions that it asked.

    A wording is played on layouts, start situations of scenarios; each question to the model counts
    once in the budget.
    """

    candidate: Candidate  # the wording
    # characters of the ego's prompt, in the first decision point of each scenario, in sum
    length: int
    # the results by the layout's index in `Tuning.layouts`
    played: dict[int, Played] = field(default_factory=dict)
    asked: set[Hashable] = field(default_factory=set)  # the questions charged to it so far


class Tuning:
    """Score candidate wordings on tune layouts, and stop when the budget of questions is spent.

    Tune layouts are start situations of scenarios on which settings may be chosen.

    Attributes:
        specs: the evaluations of the base on tune layouts, one a scenario; each has one condition
            (operating point).
        base: the prompt version whose wording is searched.
        budget: most questions that may be asked.
        records: the results of every candidate that was played, by its digest, in order.
        spent: questions so far, those of an earlier, stopped search included.
    """

    def __init__(
        self,
        specs: Sequence[Spec],
        budget: int,
        backend: Backend,
        latency: Latency,
        place: Path,
        progress: Progress,
    ) -> None:
        """Set up; `place` is the folder of the answers so far.

        `progress` gets the number of questions asked.
        """
        self.specs, self.base, self.budget = specs, specs[0].ego.prompt, budget
        self.records: dict[str, Record] = {}
        self.spent = 0
        self._backend, self._latency = backend, latency
        self._place, self._progress = place, progress

    @cached_property
    def layouts(self) -> list[tuple[int, int]]:
        """Return all start situations (tune layouts) on which wordings are compared, as pairs.

        A pair is the index of the scenario's evaluation in `specs`, and the number of the episode
        there. Other methods number layouts by their index in this list.
        """
        return [(n, e) for n, spec in enumerate(self.specs) for e in _dataset(spec).episodes]

    @cached_property
    def _dangerous(self) -> Bools:
        return np.concatenate([_dataset(spec).dangerous for spec in self.specs])

    @cached_property
    def first_half(self) -> Ints:
        """Return the indices (n,) of half of the layouts, on which a worse candidate is given up.

        So less of the budget is spent on it. A layout is a start situation, by its index in the
        list `layouts`. The half is every second one of each scenario, of those with a danger (a
        vehicle that the ego would meet) and of those without.
        """
        kinds: dict[tuple[int, bool], list[int]] = {}
        for n, (family, _) in enumerate(self.layouts):
            kinds.setdefault((family, bool(self._dangerous[n])), []).append(n)
        return np.array(sorted(n for of_kind in kinds.values() for n in of_kind[::2]))

    def weights(self, layouts: Ints) -> Floats:
        """Return the weights (n,) of layouts in a mean score, given their indices (n,).

        They sum to 1, and indices are those in the list `layouts` of start situations. Scenarios
        weigh alike, and in each so do layouts with a danger (a vehicle that the ego would meet) and
        without.
        """
        family = np.array([self.layouts[n][0] for n in layouts])
        weights = np.zeros(len(layouts))
        for number in np.unique(family):
            of_family = family == number
            dangerous = self._dangerous[layouts][of_family]
            weights[of_family] = Success(dangerous).weights(np.ones(len(dangerous), dtype=int))
        return np.asarray(weights / weights.sum())

    def play(self, candidate: Candidate, layouts: Iterable[int]) -> list[Played]:
        """Return a wording's results on the layouts of these indices; only new ones are played.

        A layout is a start situation. The results are in the order of `layouts`, the indices.
        Raises Spent before the budget would be exceeded.
        """
        wanted = list(layouts)
        record = self.records.get(candidate.key)
        if record is None:
            record = self.records[candidate.key] = Record(candidate, self._length(candidate.prompt))
        for family in range(len(self.specs)):
            missing: dict[int, int] = {}  # place of each layout by its episode
            for n in wanted:
                its_family, episode = self.layouts[n]
                if its_family == family and n not in record.played:
                    missing[episode] = n
            if missing:
                for episode, played in self._walked(record, family, missing).items():
                    record.played[missing[episode]] = played
        return [record.played[n] for n in wanted]

    def score(self, candidate: Candidate, layouts: Ints) -> float:
        """Return a candidate's mean score on the layouts of these indices (n,).

        A layout is a start situation, numbered as in `Tuning.layouts`. A score is success plus
        0.001 times the worth, the mean probability of success if all later actions are drawn
        evenly. Raises Spent before the budget would be exceeded.
        """
        scores = [played.score for played in self.play(candidate, layouts.tolist())]
        return float(self.weights(layouts) @ scores)

    def rank(self, candidate: Candidate) -> tuple[float, int]:
        """Return a candidate's sort key, greater for a better one: its score, and minus its length.

        The score is over all layouts (start situations), and the length is the characters of its
        prompts to the ego. Raises Spent before the budget would be exceeded.
        """
        score = self.score(candidate, np.arange(len(self.layouts)))
        return round(score, 9), -self.records[candidate.key].length

    @property
    def tokens(self) -> int:
        """Return how many tokens all answers of the search took so far, prompts included."""
        return sum(tokens(read_kept(file).values()) for file in self._place.glob("answers-*.jsonl"))

    def best(self) -> Candidate:
        """Return the best wording of those played on all layouts, start situations for choosing.

        The best has the greatest score (success), of equal ones the shortest prompts, then the
        first that was played.
        """
        whole = [r.candidate for r in self.records.values() if len(r.played) == len(self.layouts)]
        return max(whole, key=self.rank)

    def _length(self, prompt: Prompt) -> int:
        """Return the characters of the ego's prompt, in the first decision point of each family."""
        length = 0
        for spec in self.specs:
            ego = changed(spec, prompt).ego
            for scene in spec.source.trial(1, ego_alone=True):
                words = spec.scenario_of(scene).prompt_words
                chat = ego.rendered(scene.graphs[scene.viewers[0]], spec.actions, (), words)
                length += sum(len(message["content"]) for message in chat)
        return length

    def _walked(
        self, record: Record, family: int, episodes: Mapping[int, int]
    ) -> dict[int, Played]:
        dataset = _dataset(self.specs[family]).of_episodes(episodes.keys())
        spec = replace(
            changed(self.specs[family], record.candidate.prompt), source=FrozenSource(dataset)
        )
        kept = self._place / f"answers-{record.candidate.key[:16]}-{family}.jsonl"
        asker = _Asker(self, record, spec, kept)
        world, [point] = FrozenWorld(dataset, spec.points, spec.seeds), spec.points
        decided = list(chain.from_iterable(walk(world, spec.points, asker, spec.ties)))
        asker.settle()
        forest, success = dataset.forest, world.ends(point)["success_rate"].mean(axis=0)
        values: dict[int, list[float]] = {episode: [] for episode in episodes}
        courses: dict[int, list[Decision]] = {episode: [] for episode in episodes}
        for part in decided:
            for row, at in enumerate(part.due.at.tolist()):
                scene = part.decision_points[at]
                node, policy = forest.place[scene.id], part.result.fused[row]
                if forest.value[node]:
                    values[scene.record.episode].append(float(policy @ forest.worth[node]))
                if part.due.seed[row] == spec.seeds[0]:
                    ego, *helpers = scene.viewers
                    heard = compress(helpers, part.result.on_time[row].tolist())
                    answers = [asker.answers.get(f"{scene.id}/{helper}") for helper in heard]
                    messages = tuple(answer for answer in answers if answer)
                    reply = asker.answers.get(f"{scene.id}/{ego}")
                    action, text = int(part.result.action[row]), reply.raw if reply else ""
                    decision = Decision(dataset, scene, policy, action, messages, text)
                    courses[scene.record.episode].append(decision)
        played = {}
        for n, episode in enumerate(dataset.episodes):
            worth = float(np.mean(values[episode])) if values[episode] else 0.0
            played[episode] = Played(float(success[n]), worth, tuple(courses[episode]))
        return played

    def take(self, record: Record, questions: Iterable[Hashable]) -> None:
        """Charge those of these questions that the candidate has not asked before to the budget.

        `record` has the candidate wording's questions so far. A question is any hashable key; equal
        keys are the same question. Raises Spent, and charges none, if the budget has too few left.
        """
        new = set(questions) - record.asked
        if self.spent + len(new) > self.budget:
            raise Spent
        record.asked |= new
        self.spent += len(new)
        self._progress.more(len(new))
        self._progress(len(new))


class _Asker(Asker):
    """Takes questions from the budget before they are asked,
    also those that a stopped search asked.
    """

    def __init__(self, tuning: Tuning, record: Record, spec: Spec, kept: Path) -> None:
        super().__init__(spec, lambda: tuning._backend, tuning._latency, kept)
        self._charge = partial(tuning.take, record)

    def _ask_at(
        self,
        scenes: Sequence[Scene],
        places: Places | None = None,
        question: Question = PLAIN,
    ) -> None:
        first = 0 if question == PLAIN else 1
        questions = []
        for scene, selected in zip(scenes, places or repeat(None), strict=False):
            for place in range(first, len(self.spec.viewers(scene))):
                if selected is None or place in selected:
                    questions.append((scene.id, place, question.name))
        self._charge(questions)
        super()._ask_at(scenes, places, question)

    def streamed(
        self, scenes: Sequence[Scene], stream: Stream, codes: Ints, rewrites: Rewrites = AS_SENT
    ) -> Streamed:
        sets = stream_sets(self.spec.scenario, scenes, stream, codes, rewrites)
        self._charge([fusion_id(*each) for each in sets if each[1]])
        return super().streamed(scenes, stream, codes, rewrites)

    def fusion_call(
        self, scenes: Sequence[Scene], codes: Ints, rewrites: Rewrites = AS_SENT
    ) -> Fuses:
        self._charge([(scenes[0].id, code, rewrites) for code in codes.tolist()])
        return super().fusion_call(scenes, codes, rewrites)


def tokens(answers: Iterable[Answer]) -> int:
    """Return the sum of prompt and completion tokens of answers; uncounted ones count 0."""
    return sum((each.prompt_tokens or 0) + (each.completion_tokens or 0) for each in answers)


def changed(spec: Spec, prompt: Prompt) -> Spec:
    """Return an evaluation with another prompt for the ego, and for helpers that share the ego's.

    `spec` is the evaluation. Helpers (the vehicles that the ego asks) with a prompt version of
    their own keep it.
    """
    version = spec.ego.prompt.version
    helpers = [
        replace(each, prompt=prompt) if each.prompt.version == version else each
        for each in spec.helpers
    ]
    return replace(spec, ego=replace(spec.ego, prompt=prompt), helpers=tuple(helpers))


def _dataset(spec: Spec) -> Dataset:
    assert isinstance(spec.source, FrozenSource)
    return spec.source.dataset
