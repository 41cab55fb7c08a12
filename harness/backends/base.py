"""The interface of a backend: requests in, completions out, in the same order.

How a backend batches or threads inside is its own matter;
the rest of the program does not depend on it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, TypeVar

from msgspec import Meta

from harness.core.config import Count, Seconds, Whole, between
from harness.core.files import canonical_json
from harness.core.image import Image
from harness.core.plugins import say_once
from harness.prompts.answer_schema import Shape
from harness.prompts.decision import Question

if TYPE_CHECKING:
    from harness.runs.records import Latency
    from harness.world.scenario import Scenario
    from harness.world.scene_graph import SceneGraph

T = TypeVar("T")
Role = Literal["ego", "helper"]
AnswerMode = Literal["json", "constrained", "readout", "decision"]
BARE: tuple[AnswerMode, ...] = ("readout", "decision")  # whose answer is a bare distribution
Letters = Literal["raw", "cyclic"]
Sums = Literal["refuse", "divide"]
FinishReason = Literal["stop", "length", "refusal", "error"]
MOST_CHARS = 4 * 2**20  # of an answer, which has a few thousand
Text = Annotated[
    str, Meta(max_length=MOST_CHARS, description=f"a text of at most {MOST_CHARS} characters")
]
Share = Annotated[float, between(0.0, 1.0 + 1e-6)]  # up to rounding
AGAIN = "#2"  # suffix of the id of a repair turn's request


@dataclass(frozen=True)
class Request:
    """Hold one question to a model: its chat messages, and how the answer is to be given.

    It is what the program asks of a vehicle in one scene: the ego, or a helper, as `role` says,
    about the ego's next action among `actions`. `id` is `<scene>/<viewer>`, `max_tokens` the most
    tokens of the answer.

    `answer` is the answer mode: `json`, in which the model writes freely; `constrained`, in which
    it fills in a fixed text; `readout`, in which it is asked for one letter an action; `decision`,
    in which it gives each option of `question` a probability. `form`, `extension` and
    `placeholders` say what the answer's JSON must look like (see `Shape`); `sums` what is done
    where its probabilities do not sum to 1: `refuse` or divide by the sum. `orders` and `flips` are
    the chats of a read-out with the actions in other orders.

    `thinking` says whether the model thinks first, `reasons_first` that the prompt wants reasons.
    Tokens are drawn at `temperature`, 0 for the likeliest; `sample` is the answer's number among
    several to one question. `timed` says whether its time is measured. `agent` is the index of the
    model that is asked, 0 the ego's. `image` is a picture of the scene. `view` and `truth` are what
    the vehicle sees and what there is, and `scenario` the kind of traffic situation: for rules,
    which read no messages.
    """

    # unique in a run: scene id, slash, vehicle id; a second question after an answer that could not
    # be parsed ends in `AGAIN`
    id: str
    # who is asked, and for what: `ego`, `helper`, or `merge` (the ego again, with the messages that
    # it heard)
    role: Role
    # the chat to answer: dicts `{"role": "system" | "user" | "assistant", "content": text}`
    messages: tuple[Mapping[str, str], ...]
    # names of what the ego can do next, such as `SLOWER`, in the environment's order
    actions: tuple[str, ...]
    max_tokens: int  # most tokens the answer may have
    # what the prompt asks for: `distribution`, a probability for each action, or one action with a
    # confidence (`maneuver` of the ego, `recommendation` of a helper)
    form: str = "distribution"
    # How the model answers. `json`: it writes freely. `constrained`: it fills in numbers and
    # choices of a fixed text. `readout`: it is asked for one letter, and the letters' probabilities
    # are the answer. `decision`: it is asked the `question`, by a read-out unless it is a decision
    # model.
    answer: AnswerMode = "json"
    # the typed question that `messages` ask, in answer mode `decision`; its options are the actions
    question: Question | None = None
    # In a read-out (one letter stands for each action), the same chat once for each further order
    # of the actions behind the letters, so that a liking of a letter can be averaged out.
    orders: tuple[tuple[Mapping[str, str], ...], ...] = ()
    # In a read-out, the chats of `messages` and `orders` with the list of actions reversed; they
    # are asked as a request of their own, to see whether the answer changes. Empty if that is not
    # asked.
    flips: tuple[tuple[Mapping[str, str], ...], ...] = ()
    # JSON Schemas, by name and as JSON text, of what the answer has beside the decision; empty for
    # nothing
    extension: str = ""
    # texts that the prompt shows in place of values, such as `max 12 words`; they are no answer
    placeholders: tuple[str, ...] = ()
    # what becomes of a `json` answer whose probabilities do not sum to 1: `refuse` fails it,
    # `divide` divides them by their sum
    sums: Sums = "refuse"
    # whether the model is asked to think first (if its template can switch that)
    thinking: bool = False
    reasons_first: bool = False  # whether the prompt asks for reasons before the answer
    # sampling temperature T: tokens are drawn from softmax(logits / T); 0 takes the likeliest
    temperature: float = 0.0
    # number of this answer among several to one question, from 0; it seeds the draws
    sample: int = 0
    # whether its time is measured; a server is then asked to stream, to see the first token
    timed: bool = False
    # index of the model that is asked among those of the run: 0 is the ego's, helpers' follow
    agent: int = 0
    # the picture before the text of the last user message; None if there is none
    image: Image | None = None
    # what the vehicle that is asked knows of the scene, for rules in place of a language model; it
    # holds nothing that the prompt's author could not see
    view: "SceneGraph | None" = None
    # the same with every vehicle in view, only for a rule whose card says `privileged`
    truth: "SceneGraph | None" = None
    # the kind of traffic situation, for backends that read `view`
    scenario: "Scenario | None" = None

    @property
    def shape(self) -> Shape:
        """Return what the answer's JSON must look like: for whom, which actions, which members.

        It is a bare distribution over the actions if the answer is probabilities alone (`bare`).
        """
        if self.bare:
            return Shape("ego", self.actions, "distribution")
        return Shape(self.role, self.actions, self.form, self.extension, self.placeholders)

    @property
    def bare(self) -> bool:
        """Return whether the answer is probabilities alone, without text of the model.

        It is so in the answer modes `readout` (a letter) and `decision` (a typed question).
        """
        return self.answer in BARE

    @property
    def divides(self) -> bool:
        """Return whether the answer's probabilities are divided by their sum, whatever that is.

        If not, only a sum that is off 1 by rounding is divided out, and an answer of another sum
        fails to be parsed.
        """
        return self.answer == "constrained" or self.sums == "divide"

    def alike(self, **changes: Any) -> "Request":
        """Return a copy of this question with other values in some fields, given by name.

        It does what `dataclasses.replace` does, in a third of the time.
        """
        request = object.__new__(Request)
        vars(request).update(vars(self), **changes)
        return request

    @property
    def image_sha256(self) -> str | None:
        return self.image.sha256 if self.image else None


def by_scenario(
    requests: Sequence[Request], answer: Callable[[Sequence[Request]], Sequence[T]]
) -> list[T]:
    """Return the answers to requests of several scenarios, in order, one call for each scenario.

    It is for rules that work on scenes of one scenario (kind of traffic situation) at a time.
    `answer` gets all requests of a scenario, and returns their answers in the same order.
    """
    places: dict[int, list[int]] = {}
    for n, request in enumerate(requests):
        places.setdefault(id(request.scenario), []).append(n)
    answers: dict[int, T] = {}
    for at in places.values():
        answers |= zip(at, answer([requests[n] for n in at]), strict=True)
    return [answers[n] for n in range(len(requests))]


@dataclass(frozen=True)
class Completion:
    """Hold a model's answer to one request as text, with its token counts and times.

    The text is as the model wrote it: whether it is a valid answer, the parser decides later.
    `finish_reason` says why it ends: `stop`, `length` (the token limit), `refusal`, or `error`,
    with the message in `error`. `seconds` is the time of an answer that was asked alone, None if
    not measured; `first_token_s` is that to its first token, `token_s` that of each further one.
    `slow_s` are seconds that a rule declares to take longer. `batch_size` is how many requests were
    computed together, `retries` how many attempts failed before, `cached` whether it was stored
    earlier, and `server` the address of the server that gave it.

    In a read-out, which asks for one letter an action, `label_mass` is the letters' total
    probability; `letter_share` (0 to 1) and `follows_letter` say how far that goes by the letter
    and not the action, and `flipped` whether the likeliest action changes with the list reversed.
    None is unknown, or does not apply.
    """

    request_id: str  # of the request that it answers (`Request.id`)
    # the model's text, unchanged but for lone surrogates, which are legal JSON and which no file
    # can hold; empty on an error
    text: Text
    # None if the engine has no tokenizer. Of several orders, what they begin with counts once in
    # process, and as often as a server counts it.
    prompt_tokens: Whole | None
    # tokens of the answer, 0 if none is written; None if nobody counts them
    completion_tokens: Whole | None
    # `stop`, `length` (cut off by max_tokens), `refusal` (of a question that was read) or `error`
    finish_reason: FinishReason
    # Time of this answer if its request ran alone (batch_size 1), else None: the wall time of a
    # batch is not the latency of an answer.
    seconds: Seconds | None
    batch_size: Count  # number of requests that went through the engine together
    error: str | None = None  # the engine's message if finish_reason is `error`
    # total probability of the letters of a read-out; None otherwise
    label_mass: Share | None = None
    retries: Whole = 0  # failed attempts before this one; their time is in `seconds`
    cached: bool = False  # whether it comes from the cache, in which case it has no seconds
    slow_s: Seconds = 0.0  # declared seconds beyond its card's latency (the slow tail of a proxy)
    # time to first token (TTFT), prefill included; None if not known
    first_token_s: Seconds | None = None
    # time per output token (TPOT, see `per_token_s`); None of only one token
    token_s: Seconds | None = None
    # how much of a read-out over several orders follows the letter, 0 to 1
    # (`harness.backends.orders`); None otherwise
    letter_share: Share | None = None
    # whether one letter is the likeliest in every order of a read-out; None otherwise
    follows_letter: bool | None = None
    # address of the server that gave it; None in process, or of several servers
    server: str | None = None
    # of a replayed read-out, whether its likeliest changed in the reversed list
    flipped: bool | None = None

    def __post_init__(self) -> None:
        for name in ("text", "error"):
            if (text := getattr(self, name)) and not text.isascii():
                object.__setattr__(self, name, text.encode("utf-8", "replace").decode())


# Fields of a completion that only a read-out has: its letters' probability, and what follows them.
OF_LETTERS = ("label_mass", "letter_share", "follows_letter", "flipped")


def failed(request: Request, error: str, prompt_tokens: int | None = None) -> Completion:
    """Return the completion that stands for an answer which never came; its text is empty.

    It answers `request`. `error` says in one sentence why there is none; `prompt_tokens` is the
    number of tokens that were read, None if unknown.
    """
    return Completion(request.id, "", prompt_tokens, None, "error", None, 1, error)


def per_token_s(seconds: float, first_token_s: float | None, tokens: int | None) -> float | None:
    """Return the time per output token (TPOT) in s: (seconds - first_token_s) / (tokens - 1).

    `seconds` is the whole answer's time, `first_token_s` that to its first token, and `tokens` the
    number of its tokens. The definition is that of `vllm bench serve`; None if a number is unknown
    or there are fewer than two tokens. Only tokens that the model chose count: the fixed tokens of
    a constrained answer are read as input, and their time is part of the next chosen token's.
    """
    if first_token_s is None or tokens is None or tokens < 2:
        return None
    return (seconds - first_token_s) / (tokens - 1)


class Backend(Protocol):
    """Describe what answers requests: a model in this process, a server, or a rule.

    Code that asks vehicles' models knows them by this interface alone.
    """

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """Return a completion, the model's answer, for each request, in the same order.

        If one failed, its `error` says why.
        """
        ...

    def identity(self) -> dict[str, Any]:
        """Return all that decides the answers, as JSON values by name, for a run's record.

        Such as engine, versions, digests of weights and settings. Two backends with equal
        identities give equal answers. `answers` is the version of the engine's answers, as its
        registration states it.
        """
        ...


# What servers state of a model, and the digest of how an adapter is scaled.
YOUNGER = ("states", "adapter_config_sha256")


def same_model(stored: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Return whether stored answers and the open backend are of one model.

    `stored` is the identity that an earlier run recorded, and `now` that of the open backend, as
    `Backend.identity` returns them: what decides answers, by name. What only now is recorded is
    not compared.
    """
    return canonical_json(_as_stored(now, stored)) == canonical_json(stored)


def _as_stored(now: Mapping[str, Any], stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return an identity without what older runs did not record, if the stored one lacks that;
    the helpers' as well.
    """
    identity = {key: value for key, value in now.items() if key not in YOUNGER or key in stored}
    if "answers" in stored:
        identity.setdefault("answers", 1)  # of an engine from outside that states none
    of, stored_of = identity.get("of"), stored.get("of")  # the run that a replay is of
    if isinstance(of, Mapping) and isinstance(stored_of, Mapping):
        identity["of"] = {key: value for key, value in of.items() if key in stored_of}
    helpers, stored_helpers = identity.get("helpers"), stored.get("helpers")
    if (
        isinstance(helpers, list | tuple)
        and isinstance(stored_helpers, list | tuple)
        and len(helpers) == len(stored_helpers)
    ):
        pairs = zip(helpers, stored_helpers, strict=True)
        identity["helpers"] = [_as_stored(h, o) if isinstance(o, Mapping) else h for h, o in pairs]
    return identity


def say_newly_stated(what: str, stored: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Say on stderr if the open backend states more than was recorded beside stored answers.

    `same_model` does not compare that: the server, or the harness, told less then. `what` names the
    answers in the message; `stored` and `now` are as there.
    """
    if _tells_more(now, stored):
        say_once(
            f"{what}: its model states more now than then, so that it may have other weights; if "
            "so, make the run again"
        )


def _tells_more(now: Mapping[str, Any], stored: Mapping[str, Any]) -> bool:
    """Return whether an identity, or one of its helpers', has what the stored one did not yet."""
    helpers, stored_helpers = now.get("helpers") or (), stored.get("helpers") or ()
    if any(key in now and key not in stored for key in YOUNGER):
        return True
    pairs = zip(helpers, stored_helpers, strict=False)
    return any(_tells_more(one, other) for one, other in pairs if isinstance(other, Mapping))


class Rendering(Backend, Protocol):
    """Describe a backend of a language model that can show prompts as its model reads them."""

    def rendered(self, requests: Sequence[Request]) -> list[str]:
        """Return each request's prompt as text after the chat template.

        For a server that renders prompts itself it is what is sent. Raises UserError if the chat
        template refuses the messages.
        """
        ...


def window(backend: Backend) -> int:
    """Return how many requests may be under way at a backend, over several concurrent calls.

    It is for callers that send further requests before the first are answered. It is 0 if only one
    call of `complete` may run at a time.
    """
    return getattr(backend, "window", 0)


def is_record(backend: Backend) -> bool:
    """Return whether a backend holds a finished run's answers, and asks no model for others."""
    return getattr(backend, "is_record", False)


def forget(backend: Backend) -> None:
    """Let a backend drop what its engine keeps of earlier prompts, as if it was just opened.

    An engine keeps computed beginnings of prompts to save time, which moves probabilities by
    rounding. Does nothing for backends that keep nothing.
    """
    forgets: Callable[[], None] | None = getattr(backend, "forget", None)
    if forgets:
        forgets()


def keep_in(backend: Backend, file: Path) -> None:
    """Tell a backend the file of stored completions that models may use which it opens itself.

    A replay opens the model of its run for what that lacks. Does nothing for other backends.
    """
    keeps: Callable[[Path], None] | None = getattr(backend, "keep_in", None)
    if keeps:
        keeps(file)


@dataclass(frozen=True)
class Served:
    """Hold which server answered one request, where a model is behind one or several servers.

    `id` is the request's, `server` the base URL of the server, and `model` the model that the
    server names in its reply, None if it names none.
    """

    id: str  # of the request (`Request.id`)
    server: str  # the server's base URL
    model: str | None = None  # the model that its reply names; None if it names none


def served(backend: Backend) -> list[Served]:
    """Return which server gave each answer since the last call of this function.

    It is for a run's record. The list is empty for a model in this process, which has no servers.
    """
    taken: Callable[[], list[Served]] | None = getattr(backend, "served", None)
    return taken() if taken else []


def doubt(backend: Backend) -> str | None:
    """Return a sentence on why cached answers may come from other weights; None if they cannot.

    Cached answers were stored by an earlier run under the model's name. A server that does not
    state a digest of its weights may have got others since.
    """
    return getattr(backend, "doubt", None)


def several(backend: Backend) -> Sequence[str]:
    """Return the addresses of a model's servers if more than one may answer; else empty."""
    return getattr(backend, "several", ())


class Timed(Backend, Protocol):
    """Describe a backend that replays answers of an earlier run, whose times are known from there.

    `latency()` returns the record of how many seconds answers took in that run, so that nothing is
    measured again.
    """

    def latency(self) -> "Latency": ...
