"""Ask the agents: one answer for each viewer at each decision point,
kept so that a run can resume.
"""

import math
import shlex
import sys
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from functools import cache, partial
from itertools import compress, repeat
from multiprocessing.pool import ThreadPool
from pathlib import Path

import msgspec
import numpy as np
from msgspec import UNSET

from harness.backends import cards
from harness.backends.base import (
    Backend,
    Completion,
    Request,
    Served,
    forget,
    is_record,
    served,
    window,
)
from harness.backends.card import Card
from harness.backends.token_counts import least_tokens
from harness.coordination.coordinate import FusionCall
from harness.coordination.intents import Intents
from harness.coordination.operating_point import AS_SENT, Rewrites
from harness.coordination.parts import PLAIN, Question
from harness.coordination.streams import Stream, Streamed
from harness.core.arrays import Bools, Floats, Ints
from harness.core.at_once import first_at_once
from harness.core.errors import Unanswered, UserError, printable
from harness.core.strangers import strangers
from harness.dataset.load import Scene
from harness.evaluate import flip, kept_faults, repair, servers
from harness.evaluate.answer_arrays import intents_of, models_of
from harness.evaluate.answers import answer_of
from harness.evaluate.fusion import (
    FusionAnswers,
    plan_keys,
    source_of,
)
from harness.evaluate.kept_answers import KeptAnswers, read_kept
from harness.evaluate.latency import fusion_s
from harness.evaluate.requests import (
    EGO,
    Places,
    fusion_id,
    fusion_request,
    heard_sets,
    request_id,
    requests,
    stream_requests,
    stream_sets,
    wanted_in,
)
from harness.evaluate.sharing import shared_graphs
from harness.evaluate.spec import Spec
from harness.evaluate.texts import ASKED_AGAIN, refuse_other_kept
from harness.evaluate.walk import Fuses
from harness.runs.records import (
    REWRITTEN,
    Answer,
    Latency,
    is_helper,
)
from harness.runs.unanswered import Tally

CHUNK = 64  # fewest requests that are asked, and kept, together
OF_RULES_ALONE = 1024  # the same where no model reads: a rule takes less time for each of many
FIRST = 8  # fewest questions that a server is asked before it has answered any
# questions without an answer, one after the other, after which nothing more is asked
IN_A_ROW = CHUNK
# What a rule gives again, whatever came before: its text, and what it says of its time and tokens.
OF_RULES = (
    "raw",
    "finish_reason",
    "prompt_tokens",
    "completion_tokens",
    "seconds",
    "slow_s",
    "retries",
    "cached",
    "first_token_s",
    "token_s",
)
SENT = Path("answers")  # what messages call a file of another machine
WITH_EXAMPLES = "v10"  # the prompt for every scenario that small models answer in its form


@cache  # once: a run has an asker for each of its parts
def _say_unread(card: Card, prompt: str) -> None:
    """Say on stderr that none of the first answers could be read,
    and which prompt to try instead.
    """
    versions = [*(each.version for each in card.prompts), WITH_EXAMPLES]
    readable = [version for version in versions if version != prompt]
    other = readable[0] if readable else "VERSION"
    command = shlex.join(["harness", "prompt", "check", other, "--model", cards.argument(card)])
    print(
        f"harness: none of the first answers of {printable(card.name)} to prompt {prompt} could "
        f"be read; try another: `{printable(command, 300)}`; `harness prompt "
        "list` shows all",
        file=sys.stderr,
    )


class Asker:
    """Ask models for the answers that a run still lacks, and give answers as arrays.

    It is what the loop over decision points (`walk.walk`) asks for vehicles' intents: the
    probabilities that each gives to the ego's actions. A question that got no answer is never kept,
    so that it is asked again when the work goes on.

    Attributes:
        spec: the evaluation: models with their prompts, scenes, conditions and settings.
        answers: answers by request id, in the order of the requests.
        latency: how long the models take to answer.
        tally: how many of the questions asked here got an answer, an earlier one that was kept
            among them, and how many an error.
        served: which server gave each answer that is not kept in a file.
    """

    def __init__(
        self,
        spec: Spec,
        backend: Callable[[], Backend],
        latency: Latency,
        kept: Path | None = None,
        answers: Mapping[str, Answer] | None = None,
        progress: Callable[[int], None] = lambda count: None,
        more: Callable[[int], None] = lambda count: None,
        earlier: Path | None = None,
        sent: Mapping[str, Answer] | None = None,
    ) -> None:
        """Create an asker. `backend` opens the backend, at the first request.

        `kept` is the file of the answers so far; `answers` need not be asked for. `progress` gets
        the number of new answers, those kept by a stopped run included; `more` that of requests
        before they are made. An answer of the file counts only once its question is asked here,
        and UserError is raised if it cannot be the answer to that. `earlier` is
        another file of kept answers, to which none are added, and `sent` has those of a file that
        lies on another machine.
        """
        self.spec, self._backend, self.latency = spec, backend, latency
        self._kept = KeptAnswers(kept) if kept else None
        self._earlier = KeptAnswers(earlier) if earlier else None
        self._progress, self._more = progress, more
        self._of_rules = not any(agent.can.language_model for agent in spec.agents)
        self._given, self.served = frozenset(answers or {}), list[Served]()
        self._asked = list[str]()  # ids of questions that were asked here and had no answer given
        recalled = {**(sent or {}), **self._recalled()}
        agents, actions = spec.agents, spec.actions
        refuse_other_kept(SENT, (sent or {}).values(), agents, actions)
        self.answers = {**recalled, **(answers or {})}
        # Kept answers whose question was not asked here yet.
        self._unasked = set(recalled.keys() - (answers or {}).keys())
        self.tally, self._in_a_row = Tally(), 0
        # How many there are while none could be read; None once one could, or it was said.
        self._unread: int | None = None if self.answers else 0

    def ask(self, requests: Sequence[Request]) -> None:
        """Ask the requests whose answers are missing, each once, and store the answers.

        They are written to a file in chunks, some requests each. Raises Unanswered if a question of
        the ego or a fusion call (the ego asked again, with messages) got no answer, once all others
        of these were asked; or if none of the first questions was answered, or none of the last
        `IN_A_ROW` and too few of all.
        """
        if self._kept:  # another process may have asked, too
            recalled = self._recalled(cut=True)
            self._unasked |= recalled.keys() - self.answers.keys()
            self.answers = recalled | self.answers
        kept = [request for request in requests if request.id in self._unasked]
        for request in kept:
            self._check_kept(request)
            self._asked.append(request.id)
        self._check_rules(kept)
        # Else what was lost before, which is asked again, would be all that counts.
        self.tally.add(self.answers[request.id] for request in kept)
        missing = [request for request in requests if request.id not in self.answers]
        if len(missing) < len(requests):
            self._progress(len(requests) - len(missing))
        if not missing:
            return
        # An answer may depend on the other requests in its batch. Chunks are kept whole or not at
        # all, and all but the last are equally long. So what a resumed run lacks falls into the
        # same chunks.
        backend, batch = self._backend(), first_at_once(self.spec.settings.batch_size)
        if is_record(backend):  # no other prompt would help what was answered long ago
            self._unread = None
        size = batch * math.ceil((OF_RULES_ALONE if self._of_rules else CHUNK) / batch)
        chunks = [missing[start : start + size] for start in range(0, len(missing), size)]
        if window(backend) and len(chunks) > 1 and len(chunks[-1]) < batch:
            # a short last chunk would not fill a batch
            chunks[-2:] = [missing[size * (len(chunks) - 2) :]]
        waves, first = [chunks], self._first()
        if window(backend) and self._refused_so_far() and len(chunks[0]) >= first + batch:
            chunks[:1] = [chunks[0][:first], chunks[0][first:]]
            waves = [chunks[:1], chunks[1:]]
        new_answers: dict[str, Answer] = {}
        answering = partial(self._answered, backend)
        calls = 1 + math.ceil(window(backend) / size)
        try:
            for wave in waves:
                with closing(_answer_chunks(answering, wave, calls)) as chunks_answered:
                    for answers in chunks_answered:
                        new_answers |= answers
                        self._keep_servers(served(backend))
                        self._take(answers.values(), single=window(backend) > 0)
        finally:
            there = [request.id for request in missing if request.id in new_answers]
            self.answers |= {name: new_answers[name] for name in there}
            self._asked += there
        tally = Tally(new_answers.values())
        if not all(map(is_helper, tally.missing)):
            raise Unanswered(str(tally))

    def _recalled(self, cut: bool = False) -> dict[str, Answer]:
        """Return the answers kept since they were last recalled, each as its text says."""
        recalled: dict[str, Answer] = {}
        for file in (self._earlier, self._kept):
            if file:
                of_file = file.recall(cut)
                agents, actions = self.spec.agents, self.spec.actions
                refuse_other_kept(file.file, of_file.values(), agents, actions)
                recalled |= of_file
        return recalled

    def _check_kept(self, request: Request) -> None:
        """Raise UserError if what was kept of an answer cannot be the answer to its request."""
        if fault := kept_faults.fault(self.spec, request, self.answers[request.id]):
            raise self._refused(request, fault)
        self._unasked.remove(request.id)

    def _refused(self, request: Request, fault: str) -> UserError:
        """Return the error of a kept answer, of which a phrase says what is wrong with it."""
        files = [each.file for each in (self._kept, self._earlier) if each]
        file = next((file for file in files if request.id in read_kept(file)), SENT)
        where = f"{printable(file)}: answer {printable(request.id)}"
        return UserError(f"{where} {fault}; {ASKED_AGAIN}")

    def _check_rules(self, kept: Sequence[Request]) -> None:
        """Raise UserError if an answer was kept that the rule which is here does not give."""
        agents = self.spec.agents
        of_rules = [each for each in kept if not agents[each.agent].can.language_model]
        if not of_rules:
            return
        for request, here in zip(of_rules, self._backend().complete(of_rules), strict=True):
            kept_answer = self.answers[request.id]
            first_answer = kept_answer.first or kept_answer  # before a repair turn
            expected = answer_of(request, here)
            given = {name: getattr(expected, name) for name in OF_RULES}
            # the record of an answer before a repair turn has some of these
            if any(getattr(first_answer, name, value) != value for name, value in given.items()):
                raise self._refused(request, "is not what the rule here gives")

    def _has(self, name: str) -> bool:
        """Return whether there is an answer to a question that was asked here."""
        return name in self.answers and name not in self._unasked

    def asked_answers(self) -> dict[str, Answer]:
        """Return all answers by request id that belong to the run.

        Answers that an earlier, stopped run kept are left out if nothing asked for them here.
        """
        return {name: answer for name, answer in self.answers.items() if self._has(name)}

    def new_answers(self, after: int = 0) -> list[Answer]:
        """Return the answers to questions that were asked here and had none given, in that order.

        Those that were kept from earlier are among them; the first `after` are left out.
        """
        return [self.answers[name] for name in self._asked[after:]]

    def settle(self) -> None:
        """Raise Unanswered if too many questions that were asked here got no answer.

        Results would be invalid then. Questions whose answers were kept before count, too.
        """
        if self.tally.missing:
            raise Unanswered(str(self.tally))

    def _take(self, answers: Collection[Answer], single: bool) -> None:
        """Count and keep the answers of a chunk; stop if nothing is answered any more.

        Unless each question stands `single`, an answer may depend on the others of its chunk,
        which is then kept only if all of it was answered.
        """
        answered = [answer for answer in answers if answer.error is None]
        if self._kept and answered and (single or len(answered) == len(answers)):
            self._kept.append(answered)
        refused_so_far = self._refused_so_far()
        self.tally.add(answers)
        self._in_a_row = 0 if answered else self._in_a_row + len(answers)
        most = self._first() if refused_so_far else IN_A_ROW
        if self._in_a_row >= most and self.tally.missing:
            raise Unanswered(str(self.tally))
        self._look_at(answered)
        self._progress(len(answers))

    def _look_at(self, answered: Sequence[Answer]) -> None:
        """Say it once if none of the first answers of a language model can be read."""
        if self._unread is None:
            return
        read = any(answer.intent is not None for answer in answered)
        self._unread = None if read else self._unread + len(answered)
        ego = self.spec.ego
        if self._unread is not None and self._unread >= FIRST and ego.can.language_model:
            if not ego.can.from_file:  # whose model is elsewhere
                _say_unread(ego.card, ego.prompt.version)
            self._unread = None

    def _keep_servers(self, these: Sequence[Served]) -> None:
        if self._kept:
            servers.keep(self._kept.file.parent, these)
        else:
            self.served += these

    def _first(self) -> int:
        """Return how many questions are asked before anything was answered: whole batches."""
        batch = first_at_once(self.spec.settings.batch_size)
        return batch * math.ceil(FIRST / batch)

    def _refused_so_far(self) -> bool:
        return self.tally.asked == self.tally.unanswered

    def _answered(self, backend: Backend, chunk: Sequence[Request]) -> dict[str, Answer]:
        """Answer each request, and ask what its answer calls for:
        a repair turn, or the reversed list.
        """
        with strangers(f"the engine of {printable(self.spec.ego.card.name, 40)}"):
            return self._answers(backend, chunk)

    def _answers(self, backend: Backend, chunk: Sequence[Request]) -> dict[str, Answer]:
        forget(backend)  # so that a run that resumes, and one of several repeats, answer alike
        pairs = zip(chunk, backend.complete(chunk), strict=True)
        answers = [self._answer(request, completion) for request, completion in pairs]
        repairs, flips = {}, {}
        for place, (request, answer) in enumerate(zip(chunk, answers, strict=True)):
            if flip.wanted(request, answer):
                flips[place] = flip.mirror_request(request)
            prompt = self.spec.agents[request.agent].prompt
            if repair.wanted(request, answer, prompt):
                words = (request.scenario or self.spec.scenario).prompt_words
                repairs[place] = repair.repair_request(request, answer, prompt, words)
        completions = backend.complete(list(repairs.values())) if repairs else []
        for place, completion in zip(repairs, completions, strict=True):
            answers[place] = repair.together(answers[place], self._answer(chunk[place], completion))
        completions = backend.complete(list(flips.values())) if flips else []
        for place, completion in zip(flips, completions, strict=True):
            answers[place] = flip.compared(answers[place], answer_of(flips[place], completion))
        for place, request in enumerate(chunk):
            agent = self.spec.agent_of_answer(request.agent)
            if agent is not UNSET:
                answers[place] = msgspec.structs.replace(answers[place], agent=agent)
        return {request.id: answer for request, answer in zip(chunk, answers, strict=True)}

    def _answer(self, request: Request, completion: Completion) -> Answer:
        """Return the answer that a completion gives, as what times answers by tokens takes it.

        A server may state fewer tokens of a prompt than its text can have; they are unknown then,
        or time and energy would follow from them.
        """
        answer = answer_of(request, completion)
        if self.spec.timer is None or answer.prompt_tokens is None:
            return answer
        characters = sum(len(message["content"]) for message in request.messages)
        if answer.prompt_tokens >= least_tokens(characters):
            return answer
        return msgspec.structs.replace(answer, prompt_tokens=None)

    def __call__(self, scenes: Sequence[Scene]) -> Intents:
        """Return what every viewer intends; NaN if it has no request or its answer failed."""
        self.ask_at_first(scenes)
        return self.laid_out(scenes)

    def ask_at_first(self, scenes: Sequence[Scene]) -> None:
        """Ask whom a run asks before it knows more: the egos of scenes, or every vehicle."""
        self._ask_at(scenes, None if self.spec.asks_all else [EGO] * len(scenes))

    def whole(self, scenes: Sequence[Scene]) -> Intents:
        """Return the intents of n scenes, `(n, ...)`, after asking every vehicle in them.

        Helpers are asked, too. An intent is the probabilities that a vehicle gives to the ego's
        actions; NaN where its answer failed.
        """
        self._ask_at(scenes)
        return self.laid_out(scenes)

    def others(self, scenes: Sequence[Scene], question: Question, at: Ints) -> Intents:
        """Return the intents of n scenes, `(n, ...)`, where helpers are asked another question.

        An intent is the probabilities that a vehicle gives to the ego's actions. `question` is
        asked in place of what the ego should do as the helper sees it; such is one that shows the
        helper nothing. Only the scenes at the indices `at` are asked, and only if a run asks all
        helpers; NaN elsewhere.
        """
        if self.spec.asks_all:
            self._ask_at([scenes[n] for n in at.tolist()], question=question)
        return self.laid_out(scenes, question)

    def helpers(
        self, scenes: Sequence[Scene], wanted: Bools, question: Question = PLAIN
    ) -> Intents:
        """Ask some helpers, those marked in `wanted`, `(n, H)`, of n scenes with H helpers.

        `question` is what they are asked; by default the plain one, what the ego should do as they
        see it. Returns the intents (probabilities of the ego's actions) in the scenes in which a
        helper is marked, in their order.
        """
        scenes, places = wanted_in(scenes, wanted)
        self._ask_at(scenes, places, question)
        return self.laid_out(scenes, question, 1 + wanted.shape[1])

    def lacks(
        self,
        scenes: Sequence[Scene],
        question: Question = PLAIN,
        places: Places | None = None,
    ) -> list[bool]:
        """Return for each scene whether some vehicle's answer to a question is missing.

        `places` restricts this to some vehicles of each scene, by their index in `Scene.viewers`,
        the ego at 0; None for all. With another `question` than the plain one, what the ego should
        do, only helpers count.
        """
        return list(self._lacking(scenes, self._has, question, places))

    def _ask_at(
        self,
        scenes: Sequence[Scene],
        places: Places | None = None,
        question: Question = PLAIN,
    ) -> None:
        """Ask what is missing of the viewers at these places of each scene;
        None for all of them.
        """
        if not any(self._lacking(scenes, self._has, question, places)):
            return
        # Only the prompts of scenes whose answers were not all given are rendered, or with rules,
        # whose answers depend on no batch, of those that still lack one.
        is_there = self._has if self._of_rules else self._given.__contains__
        lacks = list(self._lacking(scenes, is_there, question, places))
        scenes = list(compress(scenes, lacks))
        lacking_places = None if places is None else list(compress(places, lacks))
        self.answer(list(requests(self.spec, scenes, question, lacking_places)))

    def _lacking(
        self,
        scenes: Sequence[Scene],
        is_available: Callable[[str], bool],
        question: Question = PLAIN,
        places: Places | None = None,
    ) -> Iterator[bool]:
        first = 0 if question == PLAIN else 1  # only helpers are asked another question
        for scene, asked_places in zip(scenes, places or repeat(None), strict=False):
            viewers = enumerate(self.spec.viewers(scene))
            yield any(
                not is_available(request_id(scene, viewer, question))
                for place, viewer in viewers
                if place >= first and (asked_places is None or place in asked_places)
            )

    def laid_out(
        self, scenes: Sequence[Scene], question: Question = PLAIN, width: int = 1
    ) -> Intents:
        """Return the answers that there are so far to n scenes as arrays, `(n, ...)`.

        Nothing is asked. They are intents, probabilities of the ego's actions; NaN for a vehicle
        without one. Arrays have room for `width` vehicles at least, the ego included. `question` is
        what helpers were asked.
        """
        answers = [self._answers_in(scene, question) for scene in scenes]
        return intents_of(self.spec, self.latency, scenes, answers, width)

    def _answers_in(self, scene: Scene, question: Question) -> list[Answer | None]:
        """Return the answers so far in a scene, the ego's first, which is asked the plain one."""
        ego, *helpers = scene.viewers
        ids = [
            request_id(scene, ego, PLAIN),
            *(request_id(scene, viewer, question) for viewer in helpers),
        ]
        return [self.answers[name] if self._has(name) else None for name in ids]

    def streamed(
        self, scenes: Sequence[Scene], stream: Stream, codes: Ints, rewrites: Rewrites = AS_SENT
    ) -> Streamed:
        """Return what K egos answer once they have heard a stream, `(K, ...)`.

        `stream` are the messages that helpers send unasked; an ego that has heard nothing answers
        as without them. `codes`, `(K,)`, and `rewrites` say what each hears (`stream_sets`).
        """
        sets = stream_sets(self.spec.scenario, scenes, stream, codes, rewrites)
        # Who has heard nothing has the id of the plain question.
        ids = [fusion_id(*each) for each in sets]
        pairs = zip(sets, ids, strict=True)
        lacking = [each for each, name in pairs if each[1] and not self._has(name)]
        if lacking:
            self.answer(list(stream_requests(self.spec, scenes, lacking)))
        of_egos = [scene for scene, _ in sets]
        answers: list[list[Answer | None]] = []
        for scene, name in zip(of_egos, ids, strict=True):
            answers.append([self.answers.get(name), *[None] * (len(scene.viewers) - 1)])
        laid_out = intents_of(self.spec, self.latency, of_egos, answers)
        sent = stream.sent(self.spec.scenario, of_egos)
        allowed_s = np.zeros((len(sets), max(len(scene.viewers) for scene in scenes) - 1))
        by_sender = stream.allowed_s(self.spec.scenario, of_egos)
        for n, (scene, of_ego_s) in enumerate(zip(of_egos, by_sender, strict=True)):
            for helper, viewer in enumerate(scene.viewers[1:]):
                allowed_s[n, helper] = of_ego_s.get(viewer, 0.0)
        return Streamed(laid_out.own, laid_out.inference_s[:, 0], sent, allowed_s)

    def fusion_call(
        self, scenes: Sequence[Scene], codes: Ints, rewrites: Rewrites = AS_SENT
    ) -> Fuses:
        sets = list(heard_sets(scenes, codes, rewrites))
        ids = [fusion_id(*each) for each in sets]
        if not all(map(self._has, ids)):
            self.answer(self.fusion_requests(scenes, codes, rewrites))
        return FusionAnswers(codes, *self._after([scene for scene, _ in sets], ids)).at

    def _after(self, scenes: Sequence[Scene], ids: Sequence[str]) -> tuple[Floats, Floats]:
        """Return the intents (K, A) after the fusion calls of these ids in scenes,
        and their seconds (K,).
        """
        answers = [self.answers[name] for name in ids]
        models = [models_of(self.spec, scene, 1)[0] for scene in scenes]
        unknown = [np.nan] * len(self.spec.actions)
        intents = np.array([a.intent or unknown for a in answers]).reshape(len(ids), len(unknown))
        return intents, fusion_s(self.latency, answers, models)

    def call_of_agents(self, scenes: Sequence[Scene], at: Ints, intents: Intents) -> FusionCall:
        return partial(self._of_plans, [scenes[n] for n in at.tolist()], intents)

    def _of_plans(
        self, scenes: Sequence[Scene], intents: Intents, on_time: Bools
    ) -> tuple[Floats, Floats]:
        """Ask those who have heard plans, (n, H);
        return their intents and seconds, NaN for the others.
        """
        after, seconds = np.full(intents.own.shape, np.nan), np.full(len(scenes), np.nan)
        rows = np.flatnonzero(on_time.any(axis=1)).tolist()
        sets = [(scenes[n], plan_keys(scenes[n].viewers[1:], intents, n, on_time[n])) for n in rows]
        by_id = {fusion_id(*each): each for each in sets}
        if not all(map(self._has, by_id)):
            self.answer(
                [fusion_request(self.spec, scene, {}, senders) for scene, senders in by_id.values()]
            )
        ids = [fusion_id(*each) for each in sets]
        after[rows], seconds[rows] = self._after([scenes[n] for n in rows], ids)
        return after, seconds

    def fusion_requests(
        self, scenes: Sequence[Scene], codes: Ints, rewrites: Rewrites = AS_SENT
    ) -> list[Request]:
        """Return the requests that ask egos once more, with each set of messages that one heard.

        `codes`, `(K,)`, has for each of K sets an integer that says in which of `scenes` who was
        heard (`fusion.codes_of`); `rewrites` says how attacks and defences change messages, and how
        they are shown.
        """
        sets = list(heard_sets(scenes, codes, rewrites))
        lacks = [not self._has(fusion_id(*each)) for each in sets]
        by_id = {scene.id: scene for scene in scenes}
        graphs = iter(shared_graphs(self.spec.scenario, list(compress(sets, lacks)), by_id))
        calls = []
        for (scene, senders), lacking in zip(sets, lacks, strict=True):
            source = source_of(scene.id, senders)
            sent = {}
            for sender in senders:
                key = sender.partition(REWRITTEN)[0]
                answer = self.answers.get(f"{source}/{key}")
                if answer:
                    sent[key] = answer
            graph = next(graphs) if lacking else None
            calls.append(fusion_request(self.spec, scene, sent, senders, graph))
        return calls

    def answer(self, requests: Sequence[Request]) -> None:
        """Ask those of some requests whose answers are missing, and keep the answers.

        It is for requests known beforehand. The function `more`, by which a progress bar learns how
        much there is to do, is first called with their number. Raises Unanswered if a question of
        the ego or a fusion call (the ego asked again, with messages) got no answer, or many in a
        row.
        """
        # Requests whose answers were kept stay, so that the chunks begin at the same places as
        # before.
        requests_to_ask = [request for request in requests if request.id not in self._given]
        self._more(len(requests_to_ask))
        self.ask(requests_to_ask)


def _answer_chunks(
    work: Callable[[Sequence[Request]], dict[str, Answer]],
    chunks: Sequence[Sequence[Request]],
    calls: int,
) -> Generator[dict[str, Answer], None, None]:
    """Yield the answers of each chunk as they come, by request id.

    Up to `calls` chunks are asked at the same time, so that no chunk waits for the last answer of
    another. Raises Unanswered if nothing more may be asked, once what was asked already has come.
    """
    if calls == 1 or len(chunks) == 1:
        yield from map(work, chunks)
        return
    refused: Unanswered | None = None
    with ThreadPool(min(calls, len(chunks))) as pool:  # its threads end with the program
        coming = pool.imap_unordered(work, chunks)
        for _ in chunks:
            try:
                yield next(coming)
            except Unanswered as error:
                refused = error
    if refused:
        raise refused
