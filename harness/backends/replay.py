"""The replay backend: answers from an earlier run, to score a changed parser,
rule or mix without a model.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, get_args

from msgspec import structs

from harness.backends.base import (
    AGAIN,
    BARE,
    Backend,
    Completion,
    Request,
    failed,
    same_model,
    say_newly_stated,
)
from harness.backends.cache import cached
from harness.backends.card import Card, Dtype
from harness.backends.cards import find_own
from harness.backends.registry import BUILT_IN, ENGINES, capabilities, open_backend
from harness.backends.token_counts import too_few
from harness.core.config import convert
from harness.core.errors import UserError, printable
from harness.core.files import digest, sha256_file
from harness.runs import digests
from harness.runs.folder import Run, read
from harness.runs.records import ASKED, Answer, FirstTurn, Latency
from harness.runs.unanswered import why

# An answer has the same fields, but no row knows its server (docs/decisions/0051).
_KEPT = [field.name for field in fields(Completion)[2:] if field.name != "server"]


def open(card: Card, **_: Any) -> "Replay":
    """Return the backend that answers from the folder of an earlier run, which a card names.

    A model card, here made of `replay:` and the folder, names what answers. Options of other
    engines are ignored. Raises UserError if it is not a finished run, or not what its digests say,
    is a rule-based driver's, which has answers of the ego only, or lacks answers that no run can do
    without.
    """
    run = read(Path(card.weights or ""))
    for sentence in digests.otherwise(run):
        raise UserError(f"{printable(run.path)} contradicts itself: {sentence}; make the run again")
    engine = ENGINES.get(str(run.manifest.model.get("engine")))
    if engine and not engine.capabilities.asks_helpers:
        raise UserError(
            f"{printable(run.path)} is a run of a driver; "
            f"run it again with --model {printable(run.manifest.model['name'])}"
        )
    if reason := why(run.path):
        raise UserError(
            f"{printable(run.path)} lacks answers, so nothing replays it: {reason}; run it again"
        )
    return Replay(run)


class Replay:
    """Answer requests from a finished run, whose answers are found by scene and viewer.

    The viewer is the vehicle that was asked. If decisions other than the run's lead to a scene that
    it did not reach, the run's model is asked; its identity must be the same. Raises UserError for
    a prompt other than the one that was answered.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._answers = {answer.id: answer for answer in run.answers}
        self._episodes = {_episode(answer.scene) for answer in run.answers}
        self._models: dict[str, Backend] = {}
        self._cache: Path | None = None

    def keep_in(self, file: Path) -> None:
        """Look in the cache `file` for answers that the run lacks, before its model is asked."""
        self._cache = file

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        stored = [self._stored(request) for request in requests]
        missing: dict[str, list[Request]] = {}
        for request, answer in zip(requests, stored, strict=True):
            if answer is None:
                missing.setdefault(request.role, []).append(self._as_run(request))
        new: dict[str, Completion] = {}
        for role, of_role in missing.items():
            for completion in self._model(role, of_role).complete(of_role):
                new[completion.request_id] = completion
        completions = []
        for request, answer in zip(requests, stored, strict=True):
            completions.append(self._completion(request, answer) if answer else new[request.id])
        return completions

    def _stored(self, request: Request) -> Answer | None:
        """Return the run's answer to a request; for a repair turn, only if the answer had one."""
        answer = self._answers.get(request.id.removesuffix(AGAIN))
        return answer if answer and (answer.first or not request.id.endswith(AGAIN)) else None

    def _model(self, role: str, requests: Sequence[Request]) -> Backend:
        """Open the model that answered in a role.
        Raises UserError if it cannot be asked these requests.
        """
        manifest, run_path = self._run.manifest, printable(self._run.path)
        agent = manifest.agent(0 if role == "ego" else 1)
        for request in requests:
            # A run answers the first step of each of its episodes; only those to other questions
            # may be missing, and those of helpers that no condition asked.
            unasked = role == "helper" and manifest.settings.ask == "used"
            plain = ASKED not in request.id.rpartition("/")[2]
            first_step = _step(request.id) == "0" and plain and not unasked
            # a changed parser may ask for a repair that the run did not
            again = request.id.endswith(AGAIN)
            foreign = first_step or _episode(request.id) not in self._episodes or "+" in request.id
            if (foreign and not again) or (role == "helper" and len(manifest.helpers) > 1):
                raise UserError(
                    f"{run_path} holds no answer for {request.id}; replay a run of the same "
                    "dataset and limit"
                    + (
                        ", whose conditions delivered the same messages"
                        if "+" in request.id
                        else ""
                    )
                    + (", made with --ask all" if unasked else "")
                )
            self._check(request, agent)
        if role not in self._models:
            stated_card = convert(agent["model"], Card, f"{run_path}: its model")
            lacking = f"{run_path} holds no answer for {requests[0].id}"
            card = find_own(
                stated_card, (), lacking, "write one of that name, or make the run again"
            )
            stored = {key: value for key, value in manifest.identity.items() if key != "helpers"}
            if manifest.helpers and role == "helper":
                helpers = manifest.identity.get("helpers")
                stored = helpers[0] if isinstance(helpers, list) and helpers else {}
            dtype = manifest.settings.dtype
            if stored.get("dtype") in get_args(Dtype):  # what `auto` was there, and may not be here
                dtype = stored["dtype"]
            model = open_backend(card, dtype=dtype, batch_size=manifest.settings.batch_size)
            if not same_model(stored, model.identity()):
                changed = f"{printable(card.name)} has changed since that run"
                raise UserError(f"{lacking}, and {changed}; make the run again")
            say_newly_stated(run_path, stored, model.identity())
            self._models[role] = cached(model, card, self._cache)
        return self._models[role]

    def _as_run(self, request: Request) -> Request:
        """Return the request with the sampling settings of the run."""
        manifest = self._run.manifest
        if request.bare:
            return request
        return replace(
            request,
            temperature=manifest.settings.temperature,
            sample=manifest.settings.sampling_seed,
        )

    def _check(self, request: Request, agent: Mapping[str, Any]) -> None:
        run_path = printable(self._run.path)
        # The prompt's digest cannot tell: free and constrained answers have the same prompt.
        if agent["answer"] != request.answer:
            raise UserError(
                f"{run_path} was run with --answer {agent['answer']}; replay it with the same"
            )
        if bool(request.orders) != (agent["answer"] in BARE and agent["letters"] == "cyclic"):
            raise UserError(
                f"{run_path} was run with --letters {agent['letters']}; replay it with the same"
            )
        if request.flips and not agent["flip"]:
            raise UserError(
                f"{run_path} was run without --flip; leave it out, or make the run again with it"
            )
        if request.thinking != agent["thinking"]:
            how = "off; leave --thinking out" if request.thinking else "on; add --thinking"
            raise UserError(f"{run_path} was run with thinking {how}")

    def _completion(self, request: Request, answer: Answer) -> Completion:
        agent = self._run.agent(answer)
        self._check(request, agent)
        # only its likeliest was compared
        if self._run.actions != request.actions == self._run.actions[::-1]:
            return failed(request, "the run has no such answer")
        again = request.id.endswith(AGAIN)
        digests = digest(request.messages[: -2 if again else None]), request.image_sha256
        if digests != (answer.prompt_sha256, answer.image_sha256 or None):
            raise UserError(
                f"{printable(self._run.path)} was asked {request.id} with another prompt or "
                "dataset; replay it with that run's --prompt, --image and --dataset"
            )
        if delay := self._run.undeclared_delay(answer):
            raise UserError(f"{printable(self._run.path)} states {delay}")
        can = capabilities(agent["model"]["engine"])
        counts = answer.prompt_tokens, answer.completion_tokens
        if answer.error is None and (few := too_few(request, can, answer.raw, *counts)):
            raise UserError(
                f"{printable(self._run.path)} states {few}, too few, of {request.id}; make the run "
                "again"
            )
        whole = Completion(request.id, answer.raw, **{name: answer.cell(name) for name in _KEPT})
        return _turn(whole, answer.first, again) if answer.first else whole

    def latency(self) -> Latency:
        return self._run.manifest.latency

    def identity(self) -> dict[str, Any]:
        answers_sha256 = sha256_file(self._run.path / "answers.jsonl", "rows")
        manifest = self._run.manifest
        of = {
            "model": manifest.model,
            "identity": manifest.identity,
            "helpers": list(manifest.helpers),
            "temperature": manifest.temperature,
        }
        ours = {"engine": "replay", "answers": BUILT_IN["replay"].answers}
        return {**ours, "answers_sha256": answers_sha256, "of": of}


class LacksAnswer(UserError):
    """Report that a run has no answer to a question which its own record says was asked.

    `question` is the id of the request. `otherwise` counts the run's answers that differ from what
    a rule in place of a model answers here, if the run says that this rule gave them.
    """

    def __init__(self, run: Path, question: str) -> None:
        super().__init__(f"{printable(run)} holds no answer for {question}")
        self.question, self.otherwise = question, 0  # answers that the rule here gives otherwise


class Kept(Replay):
    """Answer requests from a finished run that may be a stranger's, and never open a model.

    A missing answer raises UserError. A delay that the run states of an answer is not believed:
    only rules in place of models declare delays, and these are asked again.
    """

    is_record = True

    def _completion(self, request: Request, answer: Answer) -> Completion:
        replayed = self._run.agent(answer)["model"]["engine"] == "replay"
        taken = answer if replayed else structs.replace(answer, slow_s=0.0)
        return super()._completion(request, taken)

    def _model(self, role: str, requests: Sequence[Request]) -> Backend:
        """Raise UserError: the run has no such answer."""
        raise LacksAnswer(self._run.path, printable(requests[0].id))


def _turn(whole: Completion, first: FirstTurn, again: bool) -> Completion:
    """Return one of an answer's two turns: the repair turn if `again`, else the first."""
    costs: dict[str, Any] = {}
    for name in ("prompt_tokens", "completion_tokens", "seconds", "slow_s"):
        both, one_turn = getattr(whole, name), getattr(first, name)
        if again:
            one_turn = None if both is None or one_turn is None else both - one_turn
        costs[name] = one_turn
    if again:
        return replace(whole, **costs)
    reason: Any = first.finish_reason
    return replace(whole, text=first.raw, finish_reason=reason, error=None, retries=0, **costs)


def _episode(scene: str) -> str:
    return scene.partition("-")[0]


def _step(scene: str) -> str:
    return scene.split("-")[1]
