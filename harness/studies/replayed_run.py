"""A finished run as a source: its answers are coordinated again,
and no model is asked what the run has.
"""

import gc
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from harness.backends.base import Backend, Request, same_model, say_newly_stated
from harness.backends.cache import default_file
from harness.backends.card import Card
from harness.backends.cards import find_own
from harness.backends.registry import open_backend
from harness.backends.swarm import open_each, together
from harness.coordination.coordinate import FusionCall
from harness.coordination.exchange import Exchange
from harness.coordination.intents import Intents
from harness.coordination.operating_point import AS_SENT, OperatingPoint, Rewrites
from harness.coordination.parts import PLAIN, Question
from harness.coordination.scheduling import chosen
from harness.coordination.streams import Stream, Streamed
from harness.core.arrays import Bools, Floats, Ints
from harness.core.errors import UserError, printable, unknown
from harness.core.files import alone, canonical_json
from harness.core.progress import Progress
from harness.dataset.load import Scene
from harness.evaluate import stated_times
from harness.evaluate.asking import Asker
from harness.evaluate.frozen_world import FrozenSource, FrozenWorld
from harness.evaluate.latency import PAPER
from harness.evaluate.of_run import check_prompts, points_of, spec_of
from harness.evaluate.requests import EGO, wanted_in
from harness.evaluate.spec import Spec
from harness.evaluate.texts import refuse_others
from harness.evaluate.walk import Fuses
from harness.report.caveats import lost_messages, stated_elsewhere
from harness.runs.contradictions import sound
from harness.runs.records import Answer
from harness.runs.run_dataset import dataset_of
from harness.runs.success import Success, alike
from harness.runs.unanswered import Tally, tally
from harness.studies.axes import Setting
from harness.studies.play import Read, WalkResult, metric_columns, walk_through

SILENT = Progress()
WALKS = 1 << 15  # most that are walked together, unless one grid point has more: some 30 MB
# Scenes that stay in memory, some 24 kB each: every grid point comes to most of them again.
KEPT = 1 << 14
FEW = 8  # share of them that is walked first, so that who waits sees results soon
_GIVE_IT = (
    "to ask it, give --model with its folder, .gguf file, hub id or server's address, or write a "
    "card models/NAME.toml"
)
OWN = ("ego", "helper")  # roles that have one answer a vehicle
LEFT_OUT, ASKED, LOST = "left-out", "asked", "lost"  # what results lack; a role follows the others
# answers at decision points that the run did not come to, and its fusion calls
MORE = "more-answers.jsonl"


class ReplayedRun:
    """Replay a finished run's answers at other operating points, as a source of intents.

    An intent is a vehicle's distribution over the ego's actions. Answers that the run lacks are
    asked of its model, unless that is switched off.

    Attributes:
        run: the run.
        name: its model, prompt and answer mode.
        vehicles: most vehicles in any of its scenes, the ego included.
        seeds: the run's channel seeds.
        points: the run's operating points, by name.
        dataset: the run's episodes.
        episodes: number of episodes for a seed.
        same_episodes: True, since every seed has the run's episodes.
        left_out: ids of decision points without a stored answer, whose episodes were left out.
    """

    same_episodes = True

    def __init__(
        self,
        folder: Path,
        latency: str = "run",
        progress: Progress = SILENT,
        asks: bool = True,
        dataset: Path | None = None,
        models: Sequence[Card] = (),
    ) -> None:
        """Read a run.

        Args:
            folder: its folder.
            latency: `run` for its own inference times, `paper` for the paper's.
            progress: of questions that the model is asked;
                before the first to a language model it is told how much is asked.
            asks: whether its model is asked what the run has no answer to. Else a walk is left out
                that comes to a decision point without an answer of the ego, and one that needs a
                helper whom the run did not ask is refused.
            dataset: folder of its dataset; None where the run states.
            models: cards that the user gave; a model of another name is asked only if the user has
                a card file of it. What a run says of a model's place is never used.
        """
        if latency not in ("run", "paper"):
            raise unknown("--latency", latency, ("run", "paper"))
        self.run = sound(folder)
        stated_times.refuse_otherwise(self.run)
        if self.run.world != "frozen":
            raise UserError(
                f"{printable(folder)} was driven, and other decisions lead elsewhere; "
                "give a folder made by `harness eval`"
            )
        manifest = self.run.manifest
        self.name = str(manifest.variant)
        self.seeds = manifest.seeds
        self.points = points_of(self.run)
        frozen = dataset_of(self.run, dataset).of_episodes(self.run.grid.episodes)
        self.dataset = replace(frozen, kept=KEPT)
        self.episodes = len(self.dataset.episodes)
        self.clusters = self.dataset.clusters
        self.vehicles = max(len(scene.viewers) for scene in self.dataset.scenes(self._roots()))
        self._asks, self._models = asks, models
        self._progress = progress
        self.left_out: set[str] = set()
        # what results lack, ids by kind, and of how many new answers that was found
        self._gaps, self._answers_before = defaultdict[str, set[str]](set), 0
        self._announced, self._left = False, 0  # questions that are asked next
        self._opened: dict[int, Backend] = {}
        # a lost message is a part of the run; what it lacks is asked again
        missing = tally(self.run).missing
        answers = {a.id: a for a in self.run.answers if a.error is None or a.role not in missing}
        times = PAPER if latency == "paper" else manifest.latency
        self._asker = Asker(
            spec_of(self.run, FrozenSource(self.dataset)),
            self._open,
            times,
            folder / MORE,
            answers,
            self._count_answered,
            self._set_left,
        )
        refuse_others(self.run)
        # what vehicles intend in the scenes so far, a row each, and the row of each scene's id
        self._intents: Intents | None = None
        self._rows: dict[str, int] = {}

    @property
    def asks(self) -> bool:
        """Return whether the run's model may be asked what the run has no answer to."""
        return self._asks

    def _set_left(self, count: int) -> None:
        self._left = count
        self._progress.more(count)

    def _count_answered(self, count: int) -> None:
        self._left -= count
        self._progress(count)

    def _announce_once(self) -> None:
        """Tell how much is asked now, at the first questions to a language model."""
        if self._announced or not any(agent.can.language_model for agent in self.spec.agents):
            return
        self._announced = True
        size = ""
        tokens = [a.prompt_tokens for a in self.run.answers if a.prompt_tokens is not None]
        if tokens:
            total = float(f"{self._left * np.mean(tokens):.2g}")
            size = f" (about {total:.0f} prompt tokens)"
        reached = self.run.decisions.scenes
        own_answers = sum(answer.role in OWN for answer in self.run.answers)
        lacks = len(reached) * self.vehicles - own_answers
        questions = "1 question" if self._left == 1 else f"{self._left} questions"
        unasked = (
            f"; of helpers at the {len(reached)} decision points that it reached, it lacks {lacks} "
            "at most"
        )
        self._progress.say(
            f"{printable(self.name)} is asked {questions} now that the run did not ask{size}"
            f"{unasked if lacks > 0 else ''}"
        )

    def _roots(self) -> list[str]:
        forest = self.dataset.forest
        return [forest.ids[n] for n in forest.root.tolist()]

    def manifest(self) -> dict[str, Any]:
        """Return where the intents come from, as plain values for a study's manifest.

        Intents are vehicles' probabilities of actions. The values are the run's name and path, the
        dataset's digest, how latency was set, and the decision points without an answer.
        """
        return {
            "name": self.name,
            "run": str(self.run.path),
            "dataset_sha256": self.dataset.sha256,
            "latency": msgspec.to_builtins(self._asker.latency),
            "decision_points_without_answer": sorted(self.left_out),
        }

    def walked(
        self,
        settings: Sequence[Setting],
        seeds: Sequence[int],
        read: Read = metric_columns,
        few: int = FEW,
    ) -> Iterator[Sequence[WalkResult]]:
        """Yield the results of each grid point of `settings`, of all episodes at once.

        A grid point is an operating point with a number of vehicles: the ego and the helpers
        nearest to it. `seeds` are those of the channel, and `read` returns the columns of decisions
        to keep. The first points are walked alone, one in `few` of those that are walked together;
        1 is for who needs no result before the others.

        Raises:
            UserError: an operating point needs a fusion call, in which the ego's model reads
                messages, and the run's model cannot make it.
        """
        self.check([setting.point for setting in settings])
        at_once = max(1, WALKS // (len(seeds) * len(self.dataset.episodes)))
        for vehicles, same in groupby(settings, lambda setting: setting.vehicles):
            points = [setting.point for setting in same]
            starts = (0, *range(max(1, at_once // few), len(points), at_once))
            for first, after in pairwise((*starts, len(points))):
                yield from self._walked(points[first:after], vehicles, seeds, read)

    def check(self, points: Sequence[OperatingPoint]) -> None:
        """Raise UserError if the run's model cannot make what conditions need, a fusion call."""
        manifest, asks = self.run.manifest, self._asker.spec
        ego = replace(asks.ego, flip=manifest.flip)  # what is asked now is not asked twice
        spec = replace(asks, ego=ego, points=tuple(dict.fromkeys(points)))
        spec.check_models(manifest.identity, self._asker.latency)

    def _walked(
        self, points: Sequence[OperatingPoint], vehicles: int, seeds: Sequence[int], read: Read
    ) -> Iterator[Sequence[WalkResult]]:
        """Yield the walks at each of some points, which are walked together."""
        different = list(dict.fromkeys(points))
        world = FrozenWorld(self.dataset, different, seeds)

        def leave_out(at: Bools) -> None:
            for point in different:
                world.leave_out(point, at)

        ask = _Nearest(self, vehicles - 1, leave_out)
        walks = walk_through(world, different, ask, seeds, world.numbers, self.spec.ties, read)
        walked = dict(zip(different, walks, strict=True))
        for point in points:
            yield [WalkResult(world.numbers, world.ends(point), *walked[point])]

    def joules(self, scenes: Sequence[Scene], point: OperatingPoint) -> Floats:
        """Return the joules of each vehicle's answer in n scenes, (n, 1 + H); NaN where unknown.

        Column 0 is the ego's, which is unknown if its model is in a cloud; then come the H
        helpers'. `point` is the operating point, which may name the computers.
        """
        manifest = self.run.manifest
        if manifest.timer is None:
            return np.full((len(scenes), self.vehicles), np.nan)
        return manifest.timer.joules(manifest.latency, point, scenes, self._asker.answers)

    def energy_j(self, point: OperatingPoint, heard: Exchange, joules: Floats) -> Floats:
        """Return the joules of each of n decisions, (n,), for the answers made and the radio.

        `point` is the operating point, `joules` has those of the ego's and H helpers' answers, (n,
        1 + H), and `heard` says which helpers answered, and what was sent. It is NaN where it is
        unknown.
        """
        timer = self.run.manifest.timer
        if timer is None:
            return np.full(heard.messages.shape, np.nan)
        return timer.energy_j(point, heard, joules)

    @property
    def spec(self) -> Spec:
        """Return the evaluation that made the run, with all that its answers depend on.

        It has no conditions (operating points), at which a replay scores the answers.
        """
        return self._asker.spec

    @property
    def answers(self) -> Mapping[str, Answer]:
        """Return the answers that the run has stored, by request id; nothing is asked."""
        return self._asker.answers

    def answered(self, requests: Sequence[Request]) -> Mapping[str, Answer]:
        """Return all stored answers by request id, after asking for the missing ones of `requests`.

        New answers are stored in the run's folder.
        """
        self._rows.clear()
        with self._writing():
            self._asker.answer(requests)
        return self.answers

    @property
    def caveats(self) -> tuple[str, ...]:
        """Return warnings on the results: whose answers they are of, if another program wrote them,
        requests of the run and of the study without an answer, and episodes left out.
        """
        counts, name, n = self._tally().counts(), printable(self.name), len(self.left_out)
        of_run = [f"{name}: {sentence}" for sentence in lost_messages(self.run)]
        here = "no answer here either" if of_run else "no answer"
        lost = f"{name}: {here} to {counts}; left out, as lost messages are" if counts else ""
        left_out = (
            f"{name}: left out episodes that reach one of {n} decision points without a stored "
            "answer; without --no-model the model is asked there"
        )
        caveats = (*stated_elsewhere(self.run), *of_run, lost, left_out if n else "")
        return tuple(filter(None, caveats))

    def _tally(self) -> Tally:
        """Count the questions that the run did not ask, and those of them without an answer."""
        counts = Tally()
        for kind, ids in self.gaps().items():
            what, _, role = kind.partition(" ")
            if role:
                (counts.asked if what == ASKED else counts.unanswered)[role] = len(ids)
        return counts

    def gaps(self) -> dict[str, set[str]]:
        """Return what results lack so far, ids by kind, that of results which were kept included.

        They are decision points without an answer, whose episodes were left out, and by role the
        questions that the run did not ask, and those of them that got no answer.
        """
        gaps = {kind: set(ids) for kind, ids in self._gaps.items()}
        for kind, ids in self._others().items():
            gaps.setdefault(kind, set()).update(ids)
        return gaps

    def new_gaps(self) -> dict[str, list[str]]:
        """Return what results lack that was not returned here yet, ids by kind, as `gaps` does."""
        new = self._others()
        self._answers_before += len(self._asker.new_answers(self._answers_before))
        self.recall_gaps(new)
        return new

    def _others(self) -> dict[str, list[str]]:
        """Return what results lack that is not among the gaps noted yet, ids by kind."""
        others = defaultdict[str, list[str]](list)
        others[LEFT_OUT] = sorted(self.left_out - self._gaps[LEFT_OUT])
        for answer in self._asker.new_answers(self._answers_before):
            kinds = [f"{ASKED} {answer.role}"]
            if answer.error is not None:
                kinds.append(f"{LOST} {answer.role}")
            for kind in kinds:
                if answer.id not in self._gaps[kind]:  # else a kept part has it
                    others[kind].append(answer.id)
        return dict(others)

    def recall_gaps(self, gaps: Mapping[str, Collection[str]]) -> None:
        """Take over what kept results lack, ids by kind, as `gaps` has them."""
        self.left_out.update(gaps[LEFT_OUT])
        for kind, ids in gaps.items():
            self._gaps[kind].update(ids)

    def settle(self) -> None:
        """Raise Unanswered if results are invalid: too many requests of the study got no answer."""
        self._asker.settle()

    def __call__(self, scenes: Sequence[Scene]) -> Intents:
        """Return what every vehicle intends.
        Where the run has no answer of an ego its model is asked.
        """
        self._rows.clear()
        with self._writing():
            return self._asker(scenes)

    def whole(self, scenes: Sequence[Scene]) -> Intents:
        """Return the intents (distributions over actions) of all vehicles in n scenes, (n, ...).

        The model is asked for what is not stored, and its answers are stored in the run's folder.
        """
        self._rows.clear()
        with self._writing():
            return self._asker.whole(scenes)

    def helpers(
        self, scenes: Sequence[Scene], wanted: Bools, question: Question = PLAIN
    ) -> Intents:
        """Return the intents (distributions over actions) of helpers where `wanted`, a mask (n, H).

        The axes are n scenes and H helpers; the result has the m scenes in which one is wanted, (m,
        ...), in their order. The model is asked for what is not stored: `question` says whether
        plainly, or another way. Raises UserError if it may not be asked and an answer is missing.
        """
        asked_scenes, places = wanted_in(scenes, wanted)
        if not self._asks and any(self._asker.lacks(asked_scenes, question, places)):
            plain = question == PLAIN
            lacks = "that it did not ask" if plain else f"that {question.words}"
            remedy = ", or make the run again with --ask all" if plain else ""
            raise UserError(
                f"--no-model: {printable(self.run.path)} lacks answers of helpers {lacks}; "
                f"leave it out{remedy}"
            )
        for scene in asked_scenes:
            self._rows.pop(scene.id, None)
        with self._writing():
            return self._asker.helpers(scenes, wanted, question)

    def intents(self, scenes: Sequence[Scene], leave_out: Callable[[Bools], None]) -> Intents:
        """Return all vehicles' intents (distributions over actions) in n scenes, (n, ...), stored.

        Those of helpers that the run did not ask are missing. Where the ego's is, the model is
        asked; if it may not be, `leave_out` is called with the mask (n,) of these scenes, whose
        episodes are left out.
        """
        lacks = self._asker.lacks(scenes, places=[EGO] * len(scenes))
        if any(lacks) and self._asks:
            with self._writing():
                self._asker.ask_at_first(scenes)
        elif any(lacks):
            pairs = zip(scenes, lacks, strict=True)
            self.left_out |= {scene.id for scene, lacking in pairs if lacking}
            leave_out(np.array(lacks))
        return self._laid_out(scenes)

    def _laid_out(self, scenes: Sequence[Scene]) -> Intents:
        """Return the intents in n scenes, (n, ...), laid out once until a vehicle is asked."""
        new = [scene for scene in scenes if scene.id not in self._rows]
        if new or self._intents is None:
            parts = [] if self._intents is None else [self._intents]
            begin = sum(len(part.own) for part in parts)
            laid_out = self._asker.laid_out(new, width=self.vehicles)
            self._intents = Intents.joined([*parts, laid_out])
            self._rows |= {scene.id: begin + n for n, scene in enumerate(new)}
        rows = np.array([self._rows[scene.id] for scene in scenes], dtype=int)
        helpers = max(len(scene.viewers) for scene in scenes) - 1
        return self._intents.take(rows).of_first(helpers)

    def others(self, scenes: Sequence[Scene], question: Question, at: Ints) -> Intents:
        """Return the intents of all vehicles in n scenes if helpers are asked `question`, (n, ...).

        An intent is a vehicle's probabilities of the ego's actions. The question stands in place of
        the plain one, such as in a control that shows helpers nothing. Missing answers are NaN,
        unless the run asks all helpers: then they are asked for, in the scenes whose indices are in
        `at`.
        """
        with self._writing():
            return self._asker.others(scenes, question, at)

    def streamed(
        self, scenes: Sequence[Scene], stream: Stream, codes: Ints, rewrites: Rewrites = AS_SENT
    ) -> Streamed:
        """Return what K egos answer once they have heard a stream, (K, ...).

        `stream` are the messages that helpers send unasked; `codes`, (K,), and `rewrites` say what
        each hears (`requests.stream_sets`). The model is asked what is not stored. Raises UserError
        if it may not be.
        """
        if not self._asks:
            raise UserError(
                f"--no-model: {printable(self.run.path)} may lack answers of an ego that has heard "
                "messages unasked; leave it out"
            )
        with self._writing():
            return self._asker.streamed(scenes, stream, codes, rewrites)

    def fusion_call(
        self, scenes: Sequence[Scene], codes: Ints, rewrites: Rewrites = AS_SENT
    ) -> Fuses:
        """Return the ego's answers after it heard messages in these scenes, as an object to call.

        In a fusion call the ego's model answers with the helpers' messages in its prompt. `codes`,
        (K,), are whole numbers that encode the K sets of messages that are asked about
        (`fusion.codes_of`), and `rewrites` says how attacks and defences change the messages that
        are shown. It is called with the indices of n decisions' scenes, (n,), and, where attackers'
        messages are changed, who attacks, (n, H). It returns a function of who of H helpers was
        heard, (n, H), which returns the ego's probabilities of A actions, (n, A), and the seconds
        of these answers, (n,). The model is asked what is not stored. Raises UserError if it may
        not be.
        """
        if not self._asks:
            raise UserError(
                f"--no-model: {printable(self.run.path)} may lack answers to other sets of "
                "messages, which a fusion call needs; leave it out"
            )
        with self._writing():
            return self._asker.fusion_call(scenes, codes, rewrites)

    def call_of_agents(self, scenes: Sequence[Scene], at: Ints, intents: Intents) -> FusionCall:
        """Return a function that asks n agents again, with the plans that they heard.

        An agent is a vehicle that decides for itself; runs in which only the ego decides do not use
        the function. `at` (n,) has the indices in `scenes` of those in which the agents decide, and
        `intents` (n, ...) their plans, probabilities of actions. The function takes who of H others
        was heard, (n, H), and returns each agent's probabilities of A actions, (n, A), and the
        seconds of each answer, (n,), NaN for who heard nobody.
        """
        return self._asker.call_of_agents(scenes, at, intents)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            with alone(self.run.path / f".{MORE}.lock"):
                yield
        except BlockingIOError:
            raise UserError(
                f"{printable(self.run.path)} is being written by another process; wait"
            ) from None

    def _open(self) -> Backend:
        """This process's backend, opened once: a forked process may not ask its parent's."""
        if (process := os.getpid()) not in self._opened:
            self._opened[process] = self._newly_opened()
        self._announce_once()
        return self._opened[process]

    def _newly_opened(self) -> Backend:
        spec, folder = self._asker.spec, printable(self.run.path)
        check_prompts(self.run, spec)
        cards = [find_own(card, self._models, folder, _GIVE_IT) for card in spec.cards]
        opens = partial(open_backend, **spec.opening)
        if any(agent.can.language_model for agent in spec.agents):
            gc.enable()  # what an engine leaves behind in cycles might not fit into memory
        models = open_each(cards, opens)
        identity = together(cards, models).identity()
        stored, now = self.run.manifest.identity, msgspec.json.decode(canonical_json(identity))
        if not same_model(stored, now):
            changes = [key for key in {**now, **stored} if now.get(key) != stored.get(key)]
            raise UserError(
                f"{folder}: the model is not what it was ({printable(', '.join(changes))}); run "
                "again"
            )
        say_newly_stated(folder, stored, now)
        return together(cards, models, default_file())


class _Nearest:
    """A run's intents, of which only the nearest helpers' count."""

    def __init__(
        self, stored: ReplayedRun, helpers: int, leave_out: Callable[[Bools], None]
    ) -> None:
        self._stored, self._helpers, self._leave_out = stored, helpers, leave_out

    def __call__(self, scenes: Sequence[Scene]) -> Intents:
        return self._nearest(self._stored.intents(scenes, self._leave_out))

    def others(self, scenes: Sequence[Scene], question: Question, at: Ints) -> Intents:
        return self._nearest(self._stored.others(scenes, question, at))

    def helpers(
        self, scenes: Sequence[Scene], wanted: Bools, question: Question = PLAIN
    ) -> Intents:
        return self._nearest(self._stored.helpers(scenes, wanted, question))

    def _nearest(self, intents: Intents) -> Intents:
        reach = np.nan_to_num(intents.range_m, nan=np.inf)
        near = chosen(np.zeros_like(reach), -1.0, np.isfinite(reach), reach, self._helpers)
        range_m = np.where(near, intents.range_m, np.nan)
        # what a helper intends that is not there must not be remembered until it comes near
        helpers = np.where(near[..., None], intents.helpers, np.nan)
        return replace(intents, helpers=helpers, valid=intents.valid & near, range_m=range_m)

    def fusion_call(
        self, scenes: Sequence[Scene], codes: Ints, rewrites: Rewrites = AS_SENT
    ) -> Fuses:
        return self._stored.fusion_call(scenes, codes, rewrites)

    def streamed(
        self, scenes: Sequence[Scene], stream: Stream, codes: Ints, rewrites: Rewrites = AS_SENT
    ) -> Streamed:
        return self._stored.streamed(scenes, stream, codes, rewrites)

    def call_of_agents(self, scenes: Sequence[Scene], at: Ints, intents: Intents) -> FusionCall:
        return self._stored.call_of_agents(scenes, at, intents)


def refuse_twice(runs: Sequence[ReplayedRun]) -> None:
    """Raise UserError if two runs are of one folder, whose episodes would count twice."""
    folders = set[Path]()
    for run in runs:
        folder = run.run.path.resolve()
        if folder in folders:
            raise UserError(f"{printable(run.run.path)} is given twice; give each run once")
        folders.add(folder)


def name_apart(runs: Sequence[ReplayedRun]) -> None:
    """Give runs of one name, which is that of their model, the names of their folders as well.

    Raises UserError if two are of one folder.
    """
    refuse_twice(runs)
    total = Counter(run.name for run in runs)
    of_folders = Counter((run.name, run.run.path.name) for run in runs)
    for number, run in enumerate(runs, 1):
        is_alone = of_folders[run.name, run.run.path.name] == 1
        if total[run.name] > 1:
            folder = run.run.path.name if is_alone else f"{run.run.path.name} ({number})"
            run.name = f"{run.name} · {folder}"


def counted(runs: Sequence[ReplayedRun]) -> dict[ReplayedRun, Success]:
    """Return for each run how its success is averaged over episodes, the same way for all.

    It is balanced, the mean over episodes with a danger (a vehicle that the ego would meet) and
    without, if it can be so for all of them, else plain.
    """
    rules = []
    for run in runs:
        of_run = run.dataset
        rules.append(Success(of_run.dangerous, of_run.clusters, of_run.cluster_names))
    return dict(zip(runs, alike(rules), strict=True))
