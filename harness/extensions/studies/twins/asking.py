"""Asks a model about decision points and about their twins."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from harness.backends.base import Backend, Request
from harness.backends.cache import cached
from harness.backends.registry import opened
from harness.core import noise, work
from harness.core.errors import Unanswered, UserError, printable
from harness.core.files import digest, write_whole
from harness.core.parallel import Workers, each, spread
from harness.dataset.load import Dataset, Scene
from harness.evaluate.asking import Asker
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.fusion import messages_of
from harness.evaluate.kept_answers import read_kept
from harness.evaluate.latency import PAPER
from harness.evaluate.requests import fusion_request, requests
from harness.evaluate.spec import Spec
from harness.extensions.studies.twins.declared import TWINS, Twin
from harness.extensions.studies.twins.scoring import Pair, distance, held
from harness.runs.records import Answer
from harness.runs.unanswered import Tally
from harness.runs.writer import lines

RESULT = "twins.json"
Asked = tuple[Twin, str, Request, Request]  # the role, the question and its twin


@dataclass(frozen=True)
class Questions:
    """Describe what is asked in a study of twins: a model, decision points, and their twins.

    A decision point is a situation in which the ego must act. A twin is the same question put
    another way, to which the answer is known to be related.
    """

    spec: Spec  # the evaluation: model, prompt, answer mode and episodes
    # names of the kinds of twins, such as `mirrored`
    twins: tuple[str, ...]
    seed: int  # seed of the draw of decision points

    def __post_init__(self) -> None:
        ego = self.spec.ego
        option = f"--model {printable(ego.card.name)}"
        if not ego.can.closed_loop:
            raise UserError(
                f"{option}: a replay has no answers to twins; give the model that it replays"
            )
        if ego.card.privileged:
            raise UserError(
                f"{option} reads the truth, which no twin changes; give local-view or a model"
            )
        if not any(lack(self.spec, TWINS[name]) is None for name in self.twins):
            raise UserError(f"--twin: none applies here: {self.lacks(self.twins)}")

    def lacks(self, names: Sequence[str]) -> str:
        """Return in words what each of these twins needs to apply, such as a language model.

        A twin is a question put another way, to test whether the answer stays; `names` are those of
        kinds of twins.
        """
        needs = ((name, lack(self.spec, TWINS[name]) or TWINS[name].needs) for name in names)
        return "; ".join(f"{name} needs {what}" for name, what in needs)

    @property
    def dataset(self) -> Dataset:
        """Return the dataset of the episodes from which decision points are drawn."""
        assert isinstance(self.spec.source, FrozenSource)
        return self.spec.source.dataset

    def points(self) -> dict[int, list[str]]:
        """Draw a decision point for each step of each episode; return their ids by episode number.

        A decision point is a situation in which the ego must act. Only points that a reference
        driver (a rule that needs no model) visits are drawn. The ids of an episode are in the order
        of its steps.
        """
        forest = self.dataset.forest
        drawn: dict[int, dict[int, str]] = {}  # by episode and step

        def draw(scene: str) -> float:
            return float(noise.uniforms((1,), "twins", self.seed, scene)[0])

        for scene in sorted(self.dataset.courses(), key=draw):
            place = forest.place[scene]
            episode, step = int(forest.episodes[forest.tree[place]]), int(forest.step[place])
            drawn.setdefault(episode, {}).setdefault(step, scene)
        points = {}
        for episode, by_step in sorted(drawn.items()):
            points[episode] = [by_step[step] for step in sorted(by_step)]
        return points

    def count(self) -> int:
        """Return how many decision points are drawn in all.

        A decision point is a situation in which the ego must act.
        """
        return sum(map(len, self.points().values()))

    def begin(self, identity: str) -> work.WorkStart:
        """Return the record with which the study's folder begins; a resumed one must have the same.

        It has the evaluation's settings and the names of the twins (questions put another way).
        `identity` is the digest of the model's identity.
        """
        settings = {
            **self.spec.record(),
            "twins": self.twins,
            "seed": self.seed,
            "identity": identity,
        }
        return work.WorkStart(settings=msgspec.json.decode(msgspec.json.encode(settings)))

    def goes_on(self, out: Path) -> bool:
        """Return whether the folder `out` holds this study, stopped, with no process on it.

        Then it can be continued.
        """
        try:
            left = work.start_of(out, work.WorkStart)
            if work.idle(out):
                return not work.held(out)
            if left is None or (out / RESULT).exists() or work.held(out):
                return False
            work.same(out, self.begin(str(left.settings.get("identity"))).settings, left.settings)
            return True
        except UserError:
            return False


def lack(spec: Spec, twin: Twin) -> str | None:
    """Return in words what a twin needs and this evaluation lacks; None if it may apply.

    A twin is a question put another way, which may need a picture or a language model. `spec` is
    the evaluation.
    """
    language_model = spec.ego.can.language_model
    if twin.actions and spec.scenario.one_sided is not None:
        return f"{twin.needs}: {spec.scenario.one_sided}"
    if not language_model and twin.text_only:
        return "a language model"
    return twin.needs if spec.ego.answer not in twin.modes else None


def ask(
    questions: Questions,
    out: Path,
    progress: Callable[[int], None],
    cache: Path | None,
    workers: Workers,
) -> tuple[list[Pair], str]:
    """Ask a model about decision points and their twins; any number of workers gives the same.

    A decision point is a situation in which the ego must act, and a twin the same question put
    another way. A stopped study in the folder `out` goes on.

    Args:
        questions: the model, the decision points and the twins.
        out: the study's folder; a working folder in it stays until `work.tidy` is called.
        progress: called with 1 for each finished episode.
        cache: file of stored completions; None for no cache.
        workers: worker processes, each with a backend of its own.

    Returns:
        The pairs of answers, and a text on how many questions to helpers got no answer, empty if
        none; such pairs are left out.

    Raises:
        UserError: the folder holds something else, the model is not available, or no question has a
            twin.
        Unanswered: a question to the ego, or too many to the helpers, got no answer; the folder
            keeps all others.
    """
    if (out / RESULT).exists():
        raise UserError(
            f"--out {printable(out)} already holds finished twins; choose another folder or delete "
            "it"
        )
    name = f"the model {questions.spec.ego.card.name}"
    [identity] = spread(
        _identity, [questions.spec], workers, lambda done: None, lambda spec: name, False
    )
    start = questions.begin(identity)
    if left := work.start_of(out, work.WorkStart):
        work.same(out, start.settings, left.settings)
    with work.working(out, start, RESULT) as place:
        points = [
            (number, questions.dataset.scenes(ids), read_kept(_answers_file(place, number)))
            for number, ids in questions.points().items()
        ]
        by_episode: dict[int, list[Pair]] = {}
        tally = Tally()

        def keep(at: int, answers_of_episode: tuple[list[Pair], list[Answer]]) -> None:
            by_episode[at], answers = answers_of_episode
            tally.add(answers)
            answered = [answer for answer in answers if answer.error is None]
            write_whole(_answers_file(place, points[at][0]), lines(answered))
            progress(1)

        # These are files of one machine.
        files = (cache, place) if isinstance(workers, int) else (None, None)
        job = partial(_ask_episode, questions, *files)
        each(job, points, workers, keep, lambda point: f"episode {point[0]}", repeatable=False)
        if tally.missing:
            raise Unanswered(str(tally))
        pairs = [pair for at in range(len(points)) for pair in by_episode[at]]
        if not pairs:
            raise UserError(
                f"--twin: none applies to what was drawn: {questions.lacks(questions.twins)}"
            )
        return pairs, tally.counts()


def _identity(spec: Spec) -> str:
    return digest(opened(spec.ego.card, **spec.opening).identity())


def _answers_file(place: Path, episode: int) -> Path:
    return place / f"answers-{episode:06d}.jsonl"


def _ask_episode(
    questions: Questions,
    cache: Path | None,
    place: Path | None,
    episode: tuple[int, Sequence[Scene], Mapping[str, Answer]],
) -> tuple[list[Pair], list[Answer]]:
    """Ask about the decision points of an episode, then about their twins;
    return all answers as well.
    """
    (number, scenes, kept), spec = episode, questions.spec

    def backend() -> Backend:
        return cached(opened(spec.ego.card, **spec.opening), spec.ego.card, cache)

    file = place and _answers_file(place, number)
    asker = Asker(spec, backend, PAPER, file, sent=None if file else kept)
    every_twin = [TWINS[name] for name in questions.twins]
    twins = [twin for twin in every_twin if lack(spec, twin) is None]
    of_scenes = {scene.id: list(requests(spec, [scene])) for scene in scenes}
    first = list[Request]()
    # Fusion calls have the helpers' messages, which are there first.
    if any(twin.senders for twin in twins):
        first = [request for of_scene in of_scenes.values() for request in of_scene]
    asker.ask(first)
    questions_and_copies = list[Asked]()
    for scene in scenes:
        for twin in twins:
            if twin.senders:
                questions_and_copies += _fusion(spec, twin, scene, asker.answers)
            else:
                questions_and_copies += _twins(spec, twin, scene, of_scenes[scene.id])
    answered = {request.id for request in first}
    then: dict[str, Request] = {}
    for *_, question, copy in questions_and_copies:
        then |= {each.id: each for each in (question, copy) if each.id not in answered}
    asker.ask(list(then.values()))
    pairs = []
    for twin_of_question in questions_and_copies:
        *_, question, copy = twin_of_question
        errors = (asker.answers[question.id].error, asker.answers[copy.id].error)
        if errors == (None, None):
            pairs.append(_pair(spec, twin_of_question, number, asker.answers))
    return pairs, list(asker.answers.values())


def _twins(spec: Spec, twin: Twin, scene: Scene, questions: Sequence[Request]) -> Iterator[Asked]:
    """Yield the questions about a scene that the twin changes for who reads them,
    each with its twin.
    """
    graphs = scene.graphs
    if twin.graph:
        graphs = {viewer: twin.graph(spec, scene, graph) for viewer, graph in graphs.items()}
    copies = requests(spec, [_named(scene, twin, graphs=graphs)])
    for question, copy in zip(questions, copies, strict=True):
        if spec.ego.can.language_model:
            copy = twin.text(spec, copy) if twin.text else copy
            viewer = question.id.rpartition("/")[2]
            if twin.image and copy.image and graphs[viewer] != scene.graphs[viewer]:
                copy = replace(copy, image=twin.image(copy.image))
            differ = _differ(question, copy)
        else:
            copy = replace(copy, view=twin.view(copy.view)) if twin.view and copy.view else copy
            differ = question.view != copy.view
        if differ:
            yield twin, question.role, question, copy


def _fusion(spec: Spec, twin: Twin, scene: Scene, answers: Mapping[str, Answer]) -> Iterator[Asked]:
    """Yield the ego's fusion call with the messages of all helpers, and its twin."""
    by_viewer = {v: answers[f"{scene.id}/{v}"] for v in spec.viewers(scene)}
    senders = [
        message["sender"] for message in messages_of(by_viewer, scene.viewers[1:], spec.actions)
    ]
    if senders and twin.senders:
        question = fusion_request(spec, scene, by_viewer, senders)
        copy = fusion_request(spec, _named(scene, twin), by_viewer, twin.senders(senders))
        if _differ(question, copy):
            yield twin, "fusion", question, copy


def _named(scene: Scene, twin: Twin, **changes: Any) -> Scene:
    """Return a scene of another name, so that its answers have names of their own."""
    return scene.changed(**changes, scene=f"{scene.id}~{twin.name}")


def _differ(a: Request, b: Request) -> bool:
    """Return whether a language model is asked otherwise."""
    return (a.messages, a.actions) != (b.messages, b.actions) or a.image_sha256 != b.image_sha256


def _pair(spec: Spec, twin_of_question: Asked, episode: int, answers: Mapping[str, Answer]) -> Pair:
    twin, role, *both = twin_of_question
    a, b = (answers[request.id] for request in both)
    p, q = a.intent, None
    if b.intent:
        names = ((twin.actions or {}).get(action, action) for action in both[1].actions)
        read = dict(zip(names, b.intent, strict=True))
        q = tuple(read[action] for action in spec.actions)
    return Pair(
        twin.name,
        role,
        episode,
        a.scene,
        a.viewer,
        p,
        q,
        distance(p, q),
        held(twin, p, q),
        (a.raw, b.raw),
        (a.status, b.status),
        (_text(both[0]), _text(both[1])),
    )


def _text(request: Request) -> str:
    lines = []
    for message in request.messages:
        picture = [f"picture {request.image_sha256}"] if "image" in message else []
        lines += [f"--- {message['role']}", *picture, message["content"]]
    return "\n".join(lines)
