"""Answers: one for each viewer at each decision point, kept as they come, so that a killed run resumes."""

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

CHUNK = 64  # requests that are asked for, and kept, at a time, at least


def requests(spec: Spec, scenes: Sequence[Scene], blind: bool = False) -> Iterator[Request]:
    """The requests, scene by scene, the ego first; of `blind` helpers alone, who are shown nothing."""
    for scene in scenes:
        truth = None
        if any(agent.card.privileged for agent in spec.agents):
            truth = truth_graph(spec.scenario, scene.state)
        for place, viewer in enumerate(spec.viewers(scene)):
            graph, who = scene.record["graphs"][viewer], spec.agent(place)
            agent, name = spec.agents[who], _id(scene, viewer, blind)
            if blind:
                if not place:
                    continue
                graph = blinded(graph)
            yield _request(
                spec, who, name, graph["role"],
                agent.messages(graph, spec.actions, spec.scenario.prompt_words),
                image=picture(spec, who, scene, viewer, blind), view=graph,
                truth=truth if agent.card.privileged else None, scenario=spec.scenario,
            )  # fmt: skip


def _id(scene: Scene, viewer: str, blind: bool) -> str:
    return f"{scene.id}/{viewer}{BLIND * blind}"


def _request(
    spec: Spec, who: int, name: str, role: Role, messages: tuple[Mapping[str, str], ...], **more: Any
) -> Request:
    agent = spec.agents[who]
    if agent.samples:
        more |= {"temperature": spec.temperature, "sample": spec.sampling_seed}
    return Request(
        id=name, role=role, messages=messages, actions=spec.actions, max_tokens=agent.most_tokens(role),
        form=agent.prompt.helper_answer, answer=agent.answer, thinking=agent.thinking,
        reasons_first=role in agent.prompt.reasons_first, agent=who, **more,
    )  # fmt: skip


def fusion_request(
    spec: Spec, scene: Scene, answers: Mapping[str, Answer], senders: Sequence[str]
) -> Request:
    """The fusion call with these helpers' messages; `answers` by key, as `senders` has them."""
    graph, heard = scene.record["graphs"][scene.viewers[0]], messages_of(answers, senders, spec.actions)
    messages = spec.ego.rendered(graph, spec.actions, heard, spec.scenario.prompt_words)
    image = picture(spec, 0, scene, scene.viewers[0])
    return _request(spec, 0, _fusion_id(scene, senders), "ego", messages, image=image)


def _fusion_id(scene: Scene, senders: Sequence[str]) -> str:
    return f"{scene.id}/{'+'.join((scene.viewers[0], *senders))}"


def answer_of(request: Request, completion: Completion) -> Answer:
    """The answer that a completion holds."""
    # A lone surrogate cannot be written to a file; nothing else of the text is touched.
    raw = completion.text.encode("utf-8", "replace").decode("utf-8")
    scene, _, viewers = request.id.partition("/")
    viewer, *heard = viewers.split("+")
    role: RecordedRole = "merge" if heard else "blind" if viewer.endswith(BLIND) else request.role
    said = parse(
        # A read-out is a bare distribution, a helper's too.
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
        status=str(said.status), verdict=said.verdict,
        repairs=tuple(map(str, said.repairs)), intent=said.intent, mass=said.mass, message=said.message,
        detail=said.detail,
    )  # fmt: skip


class Asker:
    """Gets the answers that are missing, and turns answers into arrays of intents.

    Attributes:
        spec: the evaluation.
        answers: by request id, in the order of the requests.
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
        """An asker.

        Args:
            spec: the evaluation.
            backend: opens the backend, at the first request.
            latency: how long inference takes.
            kept: JSON Lines file of answers so far; may be torn at its end by a kill.
            answers: further answers that are there already, by request id.
            progress: called with the number of new answers, those kept from before included.
            more: called with the number of requests before they are made.
        """
        self.spec, self._backend, self._kept = spec, backend, kept
        self._progress, self._more = progress, more
        self.latency = latency
        self._given = frozenset(answers or {})
        self.answers = {**(read_kept(kept) if kept else {}), **(answers or {})}

    def ask(self, asked: Sequence[Request]) -> None:
        """Get the answers that are missing, and keep each at once."""
        if all(request.id in self.answers for request in asked):
            self._progress(len(asked))
            return
        # Chunks begin at the same places in a resumed run, and a torn one is repeated whole: an answer may
        # depend on the other requests in its batch.
        backend, batch = self._backend(), self.spec.batch_size
        size = batch * math.ceil(CHUNK / batch)
        chunks = [asked[start : start + size] for start in range(0, len(asked), size)]
        if window(backend) and len(chunks) > 1 and len(chunks[-1]) < batch:
            chunks[-2:] = [asked[size * (len(chunks) - 2) :]]  # whose batches are whole, as the others' are
        owed = [chunk for chunk in chunks if any(request.id not in self.answers for request in chunk)]
        if len(owed) < len(chunks):
            self._progress(len(asked) - sum(map(len, owed)))
        found: dict[str, Answer] = {}
        for answers in _each(partial(self._answered, backend), owed, 1 + math.ceil(window(backend) / size)):
            found |= {answer.id: answer for answer in answers}
            if self._kept:
                _keep(self._kept, answers)
            self._progress(len(answers))
        self.answers |= {request.id: found[request.id] for chunk in owed for request in chunk}

    def _answered(self, backend: Backend, chunk: Sequence[Request]) -> list[Answer]:
        """An answer each, those that cannot be read after a repair turn if the prompt has one."""
        words = self.spec.scenario.prompt_words
        answers = [answer_of(r, c) for r, c in zip(chunk, backend.complete(chunk), strict=True)]
        owed = {}
        for place, (request, answer) in enumerate(zip(chunk, answers, strict=True)):
            prompt = self.spec.agents[request.agent].prompt
            if repair.wanted(request, answer, prompt):
                owed[place] = repair.asked(request, answer, prompt, words)
        completions = backend.complete(list(owed.values())) if owed else []
        for place, completion in zip(owed, completions, strict=True):
            answers[place] = repair.together(answers[place], answer_of(chunk[place], completion))
        return answers

    def __call__(self, moments: Sequence[Scene]) -> Intents:
        """What every viewer intends; NaN for one without a request, or whose answer failed."""
        if any(self.lacks(moments)):
            self.answer(list(requests(self.spec, self._not_given(moments))))
        return self.laid_out(moments)

    def blind(self, moments: Sequence[Scene], at: Ints) -> Intents:
        """The same where helpers are shown nothing; NaN for those of other moments than these."""
        wanted = [moments[n] for n in at.tolist()]
        if any(self.lacks(wanted, blind=True)):
            self.answer(list(requests(self.spec, self._not_given(wanted, blind=True), blind=True)))
        return self.laid_out(moments, blind=True)

    def lacks(self, moments: Sequence[Scene], blind: bool = False) -> list[bool]:
        """Whether some viewer's answer is missing, of each; some helper's who is shown nothing."""
        return self._lacking(moments, self.answers, blind)

    def _not_given(self, moments: Sequence[Scene], blind: bool = False) -> list[Scene]:
        """Those with more to ask than `answer` leaves out: no prompt of the rest has to be written."""
        lacks = self._lacking(moments, self._given, blind)
        return [scene for scene, lacking in zip(moments, lacks, strict=True) if lacking]

    def _lacking(self, moments: Sequence[Scene], there: Container[str], blind: bool) -> list[bool]:
        return [any(_id(s, v, blind) not in there for v in self.spec.viewers(s)[blind:]) for s in moments]

    def laid_out(self, moments: Sequence[Scene], blind: bool = False, width: int = 1) -> Intents:
        """The answers that are there as arrays, with `width` vehicles or more; NaN for one that failed."""
        answers = [
            [self.answers.get(_id(s, v, blind and n > 0)) for n, v in enumerate(s.viewers)] for s in moments
        ]
        width, actions = max(width, *map(len, answers)), len(self.spec.actions)
        p = np.full((len(moments), width, actions), np.nan)
        distance, reach = np.full((len(moments), width), np.nan), np.full((len(moments), width - 1), np.nan)
        bits = np.zeros((len(moments), width - 1))
        for i, (scene, row) in enumerate(zip(moments, answers, strict=True)):
            at = {v["id"]: (v["x_m"], v["y_m"]) for v in scene.record["state"]["vehicles"]}
            for j, (viewer, answer) in enumerate(zip(scene.viewers, row, strict=True)):
                distance[i, j] = scene.record["distance_m"][viewer]
                if answer and answer.intent is not None:
                    p[i, j] = answer.intent
                if j:
                    reach[i, j - 1] = scene.record["range_m"][viewer]
                    bits[i, j - 1] = payload_bits(at[viewer], answer) if answer else 0
            row += [None] * (width - len(row))
        valid = ~np.isnan(p[:, 1:]).any(axis=-1)
        times = inference_s(self.latency, answers)
        return Intents(p[:, 0], p[:, 1:], valid, distance, reach, bits, times)

    def fusion_call(self, moments: Sequence[Scene], codes: Ints, rewrites: Rewrites = AS_SENT) -> Fuses:
        """The ego's answers to these sets of messages, shown so."""
        ids = [_fusion_id(*each) for each in _heard(moments, codes, rewrites)]
        if not self.answers.keys() >= set(ids):
            self.answer(self.fusion_requests(moments, codes, rewrites))
        answers = [self.answers[name] for name in ids]
        nothing = [np.nan] * len(self.spec.actions)
        intents = np.array([a.intent or nothing for a in answers]).reshape(len(ids), len(nothing))
        return FusionAnswers(codes, intents, fusion_s(self.latency, answers)).at

    def fusion_requests(
        self, moments: Sequence[Scene], codes: Ints, rewrites: Rewrites = AS_SENT
    ) -> list[Request]:
        """The requests of the fusion calls with these sets of messages."""
        asked = []
        for scene, senders in _heard(moments, codes, rewrites):
            keys = (key.partition(REWRITTEN)[0] for key in senders)
            sent = {key: a for key in keys if (a := self.answers.get(f"{scene.id}/{key}"))}
            asked.append(fusion_request(self.spec, scene, sent, senders))
        return asked

    def answer(self, requests: Sequence[Request]) -> None:
        """Announce the requests and ask what is not there, but for answers that were given."""
        # Those kept from before a kill are among them, so that chunks begin where they did.
        asked = [request for request in requests if request.id not in self._given]
        self._more(len(asked))
        self.ask(asked)


def _each(
    work: Callable[[Sequence[Request]], list[Answer]], chunks: Sequence[Sequence[Request]], calls: int
) -> Iterator[list[Answer]]:
    """The answers to each chunk as they come; so many are at work, so that none waits for another's last."""
    if calls == 1 or len(chunks) == 1:
        yield from map(work, chunks)
        return
    with ThreadPool(min(calls, len(chunks))) as pool:  # whose threads end with the program
        yield from pool.imap_unordered(work, chunks)


def _heard(
    moments: Sequence[Scene], codes: Ints, rewrites: Rewrites
) -> Iterator[tuple[Scene, list[str]]]:  # fmt: skip
    """The scene of each set of messages, and the keys of its senders."""
    helpers = max(len(scene.viewers) for scene in moments) - 1
    for code in codes.tolist():
        moment, heard, attacking = heard_in(code, helpers, bool(rewrites.attack))
        scene = moments[moment]
        yield scene, [key_of(scene.viewers[1 + h], rewrites, h in attacking) for h in heard]


def payload_bits(xy_m: tuple[float, float], answer: Answer) -> int:
    """Size of the message a helper sends: its id, position, intent, evidence and risk, as compact JSON."""
    message = {
        "from": answer.viewer,
        "xy_m": [round(x, 1) for x in xy_m],
        "intent": answer.intent and [round(x, 2) for x in answer.intent],
        "says": answer.message,
    }
    return 8 * len(canonical_json(message).encode())


def read_kept(kept: Path) -> dict[str, Answer]:
    """Answers kept so far, by request id. A torn last line is dropped."""
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
