"""Ask the agents: one answer for each viewer at each decision point, kept so that a run can resume."""

import math
import os
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from functools import partial
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET

from harness.backends.base import Backend, Completion, Request, Role, window
from harness.coordination.intents import Intents
from harness.coordination.operating_point import AS_SENT, Rewrites
from harness.core.arrays import Ints
from harness.core.errors import UserError, printable
from harness.core.files import canonical_json, digest
from harness.dataset.load import Scene
from harness.evaluate import repair
from harness.evaluate.fusion import FusionAnswers, heard_in, key_of, messages_of
from harness.evaluate.latency import fusion_s, inference_s
from harness.evaluate.pictures import picture
from harness.evaluate.spec import Spec
from harness.evaluate.walk import Fuses
from harness.parsing.parse import parse
from harness.runs.records import BLIND, REWRITTEN, Answer, Latency
from harness.runs.records import Role as RecordedRole
from harness.world.perception.graph import blinded, truth_graph

CHUNK = 64  # fewest requests that are asked, and kept, together


def requests(spec: Spec, scenes: Sequence[Scene], blind: bool = False) -> Iterator[Request]:
    """Yield the requests of scenes, the ego's first; with `blind` only those of blind helpers."""
    for scene in scenes:
        truth = None
        if any(agent.card.privileged for agent in spec.agents):
            truth = truth_graph(spec.scenario, scene.state)
        for place, viewer in enumerate(spec.viewers(scene)):
            graph, index = scene.record["graphs"][viewer], spec.agent(place)
            agent, name = spec.agents[index], _id(scene, viewer, blind)
            if blind:
                if not place:
                    continue
                graph = blinded(graph)
            yield _request(
                spec, index, name, graph["role"],
                agent.messages(graph, spec.actions, spec.scenario.prompt_words),
                image=picture(spec, index, scene, viewer, blind), view=graph,
                truth=truth if agent.card.privileged else None, scenario=spec.scenario,
            )  # fmt: skip


def _id(scene: Scene, viewer: str, blind: bool) -> str:
    return f"{scene.id}/{viewer}{BLIND * blind}"


def _request(
    spec: Spec, index: int, name: str, role: Role, messages: tuple[Mapping[str, str], ...], **more: Any
) -> Request:
    agent = spec.agents[index]
    if agent.samples:
        more |= {"temperature": spec.temperature, "sample": spec.sampling_seed}
    return Request(
        id=name, role=role, messages=messages, actions=spec.actions, max_tokens=agent.most_tokens(role),
        form=agent.prompt.helper_answer, answer=agent.answer, thinking=agent.thinking,
        reasons_first=role in agent.prompt.reasons_first, agent=index, **more,
    )  # fmt: skip


def fusion_request(
    spec: Spec, scene: Scene, answers: Mapping[str, Answer], senders: Sequence[str]
) -> Request:
    """Return the fusion call with these senders' messages; `answers` has the same keys as `senders`."""
    graph, heard = scene.record["graphs"][scene.viewers[0]], messages_of(answers, senders, spec.actions)
    messages = spec.ego.rendered(graph, spec.actions, heard, spec.scenario.prompt_words)
    image = picture(spec, 0, scene, scene.viewers[0])
    return _request(spec, 0, _fusion_id(scene, senders), "ego", messages, image=image)


def _fusion_id(scene: Scene, senders: Sequence[str]) -> str:
    return f"{scene.id}/{'+'.join((scene.viewers[0], *senders))}"


def answer_of(request: Request, completion: Completion) -> Answer:
    """Parse a completion into an answer."""
    # A lone surrogate cannot be written to a file. The rest of the text stays as it is.
    raw = completion.text.encode("utf-8", "replace").decode("utf-8")
    scene, _, viewers = request.id.partition("/")
    viewer, *heard = viewers.split("+")
    role: RecordedRole = "merge" if heard else "blind" if viewer.endswith(BLIND) else request.role
    parsed = parse(
        # A read-out is a bare distribution, even a helper's.
        raw, role="ego" if request.answer == "readout" else request.role, actions=request.actions,
        thinking=request.thinking, reasons_first=request.reasons_first,
        finish_reason=completion.finish_reason, error=completion.error,
    )  # fmt: skip
    return Answer(
        scene=scene, viewer=viewer.removesuffix(BLIND), heard=tuple(heard), role=role, raw=raw,
        finish_reason=completion.finish_reason, error=completion.error,
        prompt_tokens=completion.prompt_tokens, completion_tokens=completion.completion_tokens,
        seconds=completion.seconds, batch_size=completion.batch_size, label_mass=completion.label_mass,
        retries=completion.retries, cached=completion.cached, slow_s=completion.slow_s,
        first_token_s=completion.first_token_s, token_s=completion.token_s,
        prompt_sha256=digest(request.messages),
        image_sha256=request.image_sha256 or UNSET,
        status=str(parsed.status), verdict=parsed.verdict,
        repairs=tuple(map(str, parsed.repairs)), intent=parsed.intent, mass=parsed.mass,
        message=parsed.message, detail=parsed.detail,
    )  # fmt: skip


class Asker:
    """Asks for the answers that are missing, and turns answers into arrays of intents.

    Attributes:
        spec: the evaluation.
        answers: answers by request id, in the order of the requests.
        latency: how long inference takes.
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
    ) -> None:
        """Create an asker.

        Args:
            spec: the evaluation.
            backend: opens the backend, at the first request.
            latency: how long inference takes.
            kept: JSON Lines file of the answers so far; its last line may be torn if a run was killed.
            answers: further answers that need not be asked for, by request id.
            progress: called with the number of new answers, those kept by a stopped run included.
            more: called with the number of requests before they are made.
        """
        self.spec, self._backend, self._kept = spec, backend, kept
        self._progress, self._more = progress, more
        self.latency = latency
        self._given = frozenset(answers or {})
        self.answers = {**(read_kept(kept) if kept else {}), **(answers or {})}

    def ask(self, asked: Sequence[Request]) -> None:
        """Ask for the missing answers, and keep each chunk as soon as it is answered."""
        if all(request.id in self.answers for request in asked):
            self._progress(len(asked))
            return
        # An answer may depend on the other requests in its batch. So the chunks of a resumed run begin at the
        # same places, and a chunk with an answer missing is asked again as a whole.
        backend, batch = self._backend(), self.spec.batch_size
        size = batch * math.ceil(CHUNK / batch)
        chunks = [asked[start : start + size] for start in range(0, len(asked), size)]
        if window(backend) and len(chunks) > 1 and len(chunks[-1]) < batch:
            chunks[-2:] = [asked[size * (len(chunks) - 2) :]]  # a short last chunk would not fill a batch
        incomplete = [chunk for chunk in chunks if any(request.id not in self.answers for request in chunk)]
        if len(incomplete) < len(chunks):
            self._progress(len(asked) - sum(map(len, incomplete)))
        new_answers: dict[str, Answer] = {}
        for answers in _answer_chunks(
            partial(self._answered, backend), incomplete, 1 + math.ceil(window(backend) / size)
        ):
            new_answers |= {answer.id: answer for answer in answers}
            if self._kept:
                _keep(self._kept, answers)
            self._progress(len(answers))
        self.answers |= {request.id: new_answers[request.id] for chunk in incomplete for request in chunk}

    def _answered(self, backend: Backend, chunk: Sequence[Request]) -> list[Answer]:
        """Answer each request; one whose answer cannot be parsed gets a repair turn if its prompt has one."""
        words = self.spec.scenario.prompt_words
        answers = [answer_of(r, c) for r, c in zip(chunk, backend.complete(chunk), strict=True)]
        repairs = {}
        for place, (request, answer) in enumerate(zip(chunk, answers, strict=True)):
            prompt = self.spec.agents[request.agent].prompt
            if repair.wanted(request, answer, prompt):
                repairs[place] = repair.asked(request, answer, prompt, words)
        completions = backend.complete(list(repairs.values())) if repairs else []
        for place, completion in zip(repairs, completions, strict=True):
            answers[place] = repair.together(answers[place], answer_of(chunk[place], completion))
        return answers

    def __call__(self, moments: Sequence[Scene]) -> Intents:
        """Return what every viewer intends; NaN if it has no request or its answer failed."""
        if any(self.lacks(moments)):
            self.answer(list(requests(self.spec, self._not_given(moments))))
        return self.laid_out(moments)

    def blind(self, moments: Sequence[Scene], at: Ints) -> Intents:
        """Return intents where helpers are shown nothing; NaN for those of moments not in `at`."""
        blind_moments = [moments[n] for n in at.tolist()]
        if any(self.lacks(blind_moments, blind=True)):
            self.answer(list(requests(self.spec, self._not_given(blind_moments, blind=True), blind=True)))
        return self.laid_out(moments, blind=True)

    def lacks(self, moments: Sequence[Scene], blind: bool = False) -> list[bool]:
        """For each moment, whether a viewer's answer is missing; with `blind`, a blind helper's."""
        return self._lacking(moments, self.answers, blind)

    def _not_given(self, moments: Sequence[Scene], blind: bool = False) -> list[Scene]:
        """Return the moments whose answers were not all given; only their prompts are rendered."""
        lacks = self._lacking(moments, self._given, blind)
        return [scene for scene, lacking in zip(moments, lacks, strict=True) if lacking]

    def _lacking(self, moments: Sequence[Scene], available: Container[str], blind: bool) -> list[bool]:
        return [any(_id(s, v, blind) not in available for v in self.spec.viewers(s)[blind:]) for s in moments]

    def laid_out(self, moments: Sequence[Scene], blind: bool = False, width: int = 1) -> Intents:
        """Return the answers so far as arrays of at least `width` vehicles; NaN without an intent."""
        answers = [
            [self.answers.get(_id(s, v, blind and n > 0)) for n, v in enumerate(s.viewers)] for s in moments
        ]
        width, actions = max(width, *map(len, answers)), len(self.spec.actions)
        p = np.full((len(moments), width, actions), np.nan)
        distance_m = np.full((len(moments), width), np.nan)
        range_m = np.full((len(moments), width - 1), np.nan)
        bits = np.zeros((len(moments), width - 1))
        for i, (scene, row) in enumerate(zip(moments, answers, strict=True)):
            positions = {v["id"]: (v["x_m"], v["y_m"]) for v in scene.record["state"]["vehicles"]}
            for j, (viewer, answer) in enumerate(zip(scene.viewers, row, strict=True)):
                distance_m[i, j] = scene.record["distance_m"][viewer]
                if answer and answer.intent is not None:
                    p[i, j] = answer.intent
                if j:
                    range_m[i, j - 1] = scene.record["range_m"][viewer]
                    bits[i, j - 1] = payload_bits(positions[viewer], answer) if answer else 0
            row += [None] * (width - len(row))
        valid = ~np.isnan(p[:, 1:]).any(axis=-1)
        seconds = inference_s(self.latency, answers)
        return Intents(p[:, 0], p[:, 1:], valid, distance_m, range_m, bits, seconds)

    def fusion_call(self, moments: Sequence[Scene], codes: Ints, rewrites: Rewrites = AS_SENT) -> Fuses:
        """Return the ego's answers to these sets of messages, rewritten as `rewrites` says."""
        ids = [_fusion_id(*each) for each in _heard_sets(moments, codes, rewrites)]
        if not self.answers.keys() >= set(ids):
            self.answer(self.fusion_requests(moments, codes, rewrites))
        answers = [self.answers[name] for name in ids]
        unknown = [np.nan] * len(self.spec.actions)
        intents = np.array([a.intent or unknown for a in answers]).reshape(len(ids), len(unknown))
        return FusionAnswers(codes, intents, fusion_s(self.latency, answers)).at

    def fusion_requests(
        self, moments: Sequence[Scene], codes: Ints, rewrites: Rewrites = AS_SENT
    ) -> list[Request]:
        """Return the requests of the fusion calls with these sets of messages."""
        calls = []
        for scene, senders in _heard_sets(moments, codes, rewrites):
            keys = (key.partition(REWRITTEN)[0] for key in senders)
            sent = {key: a for key in keys if (a := self.answers.get(f"{scene.id}/{key}"))}
            calls.append(fusion_request(self.spec, scene, sent, senders))
        return calls

    def answer(self, requests: Sequence[Request]) -> None:
        """Announce the requests whose answers were not given, and ask for what is missing."""
        # Requests whose answers were kept stay, so that the chunks begin at the same places as before.
        asked = [request for request in requests if request.id not in self._given]
        self._more(len(asked))
        self.ask(asked)


def _answer_chunks(
    work: Callable[[Sequence[Request]], list[Answer]], chunks: Sequence[Sequence[Request]], calls: int
) -> Iterator[list[Answer]]:
    """Yield the answers of each chunk as they come; up to `calls` chunks are asked at the same time.

    With several at work, no chunk waits for the last answer of another.
    """
    if calls == 1 or len(chunks) == 1:
        yield from map(work, chunks)
        return
    with ThreadPool(min(calls, len(chunks))) as pool:  # its threads end with the program
        yield from pool.imap_unordered(work, chunks)


def _heard_sets(
    moments: Sequence[Scene], codes: Ints, rewrites: Rewrites
) -> Iterator[tuple[Scene, list[str]]]:  # fmt: skip
    """Yield the scene of each set of messages and the keys of its senders."""
    helpers = max(len(scene.viewers) for scene in moments) - 1
    for code in codes.tolist():
        moment, heard, attacking = heard_in(code, helpers, bool(rewrites.attack))
        scene = moments[moment]
        yield scene, [key_of(scene.viewers[1 + h], rewrites, h in attacking) for h in heard]


def payload_bits(xy_m: tuple[float, float], answer: Answer) -> int:
    """Return the bits of a helper's message: id, position, intent, evidence and risk, as compact JSON."""
    message = {
        "from": answer.viewer,
        "xy_m": [round(x, 1) for x in xy_m],
        "intent": answer.intent and [round(x, 2) for x in answer.intent],
        "says": answer.message,
    }
    return 8 * len(canonical_json(message).encode())


def read_kept(kept: Path) -> dict[str, Answer]:
    """Read the answers kept so far, by request id, and cut a torn last line from the file."""
    if not kept.is_file():
        return {}
    data = kept.read_bytes()
    whole = data[: data.rfind(b"\n") + 1]
    if len(whole) < len(data):
        with kept.open("r+b") as file:
            file.truncate(len(whole))
    try:
        answers = [_DECODER.decode(line) for line in whole.splitlines()]
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"{printable(kept)} is damaged ({printable(error)}); delete its folder and start again"
        ) from None
    return {answer.id: answer for answer in answers}


_DECODER = msgspec.json.Decoder(Answer)


def _keep(kept: Path, answers: Sequence[Answer]) -> None:
    with kept.open("ab") as file:
        file.write(b"".join(msgspec.json.encode(answer) + b"\n" for answer in answers))
        file.flush()
        os.fsync(file.fileno())
