"""Define the typed records of a run's files. Comments beside fields are docs/fields.md, too."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import cache
from typing import Annotated, Any, Literal, cast

from msgspec import UNSET, Meta, Struct, UnsetType, defstruct, field, structs, to_builtins

from harness.coordination.operating_point import OperatingPoint
from harness.coordination.part_settings import questions
from harness.core.at_once import AtOnce
from harness.core.config import Seconds, Whole, convert
from harness.core.errors import BETWEEN_NAMES, UserError, printable
from harness.core.statistics import Estimate
from harness.runs import formats, stopping
from harness.runs.answerers import Answerers, answerers_of
from harness.runs.settings import Settings
from harness.runs.stopping import InterimLooks, StoppingRule
from harness.runs.timers import Timer, timer
from harness.world import scenarios
from harness.world.parameters import DIALS
from harness.world.scenario import Scenario

Measured = Annotated[float, Meta(ge=0, description="seconds, 0 or more")]
Share = Annotated[float, Meta(ge=0, le=1.001, description="a share, 0 to 1")]  # up to rounding
# What a file states for an extension: by name, no table in it.
Plain = dict[str, bool | int | float | str | tuple[int, ...] | None]
# Of run.json: the model, prompt and way of answering of the ego's agent; helpers' have the same.
AGENT = ("model", "prompt", "answer", "thinking", "image", "letters", "sums", "flip")
PLAIN_ROLES = ("ego", "helper", "merge")  # `merge` is the ego's fusion call
Role = Annotated[str, Meta(pattern=r"^[a-z-]{1,40}\Z", description="a word")]  # one of `roles`


def roles() -> tuple[Role, ...]:
    """Return the roles of answers: ego, helper, merge (fusion call) and extensions' questions.

    A fusion call asks the ego's model again, with the messages that it heard.
    """
    return (*PLAIN_ROLES, *filter(None, questions()))


def is_helper(role: str) -> bool:
    """Return whether answers of a role are helpers' messages, which the radio may lose.

    Other roles are the ego's: `ego`, and `merge`, after it heard messages.
    """
    return role not in ("ego", "merge")


def role_word(role: str) -> str:
    """Return a role's name for people: `fusion` for `merge`, any other as it is.

    A role is who answers, and to what; `merge` is the ego after it heard messages.
    """
    return "fusion" if role == "merge" else role


# What the seconds of a latency come from: a model's card, the user, a measurement, the paper.
MEASURED = "measured"
SOURCES = ("card", "declared", MEASURED, "paper")
ASKED = "~"  # in the key of an answer, before the name of the question where it is another one
REWRITTEN = "!"  # in a sender's key, before the attack and the defences that change its message
MOST_LETTERS = 300  # of a name
TURNS = ("turns", "first_status", "first_raw")  # an answer's properties that tables show as columns


def asked_key(viewer: str, question: str) -> str:
    """Return the key of a vehicle's answer, unique among the answers about one scene.

    `viewer` is the vehicle's id, and `question` the name of the question that an extension adds;
    empty for the usual one, which asks what the ego should do.
    """
    return f"{viewer}{ASKED}{question}" if question else viewer


FinishReason = Literal["stop", "length", "refusal", "error"]  # why a model's text ends


class FirstTurn(Struct, frozen=True, kw_only=True, gc=False):
    """Hold a failed answer that was followed by a repair turn: a second question after the failure.

    `raw` is its text, `status` the outcome of parsing it, such as `bad_sum`, and `finish_reason`
    why it ends: `stop`, `length`, `refusal` or `error`. `slow_s` are the declared seconds that it
    takes beyond its model's latency. `prompt_tokens` and `completion_tokens` are those read and
    written, None if the engine has no tokenizer; `seconds` is None if it was not timed alone.
    """

    raw: str  # the completion as it came
    status: str  # the outcome of parsing, such as `bad_sum` (docs/names.md)
    finish_reason: FinishReason  # `stop`, `length`, `refusal` or `error`
    prompt_tokens: Whole | None  # tokens in
    completion_tokens: Whole | None  # tokens out
    seconds: Measured | None  # time of this answer, if its request was alone in the engine
    slow_s: float  # declared seconds that it takes beyond its card's latency


class Answer(Struct, frozen=True, kw_only=True, gc=False):
    """Hold one answer of a model, a line of `answers.jsonl`.

    The vehicle `viewer` was asked as `role` (ego, helper, or ego after it `heard` helpers) in the
    decision point `scene`, by a chat and a picture of the digests `prompt_sha256` and
    `image_sha256`. `raw` is its text, `finish_reason` why it ends, and `error` why there is none.
    `status` and `verdict` say how parsing went, `faults` all that is wrong, `detail` a sentence on
    it, and `repairs` what was corrected before. `intent` has each action's probability, None if it
    failed, and `mass` their sum as written; `message` and `extension` are what else was said.

    `seconds` is its time if it was asked alone, `first_token_s` and `token_s` those to the first
    token and of each further one; `slow_s` are declared further seconds. Tokens and seconds include
    those of a repair turn, a second question after the failed answer `first`; None is unknown.
    `batch_size` counts requests computed together, `retries` failed attempts before; `cached` says
    that it was stored earlier. In a read-out, an answer by one letter per action, `label_mass` is
    the letters' total probability; `letter_share` (0 to 1) and `follows_letter` say how far it goes
    by the letter, and `flipped` whether the list reversed changes it. `agent` is the index of the
    helpers' model that answered.
    """

    scene: str  # id of the decision point
    viewer: str  # id of the vehicle that answered
    # keys of the helpers' answers whose messages were in the prompt of a fusion call
    heard: tuple[str, ...] = ()
    # `ego`, `helper`, `merge` (the ego after it heard messages), or an extension's, as `blind`
    role: Role
    raw: str  # the completion as it came, except for lone surrogates, which no file can hold
    finish_reason: FinishReason  # `stop`, `length`, `refusal` or `error`
    error: str | None  # the engine's message; None if it answered
    prompt_tokens: Whole | None  # tokens in; None if the engine has no tokenizer
    completion_tokens: Whole | None  # tokens out; None if the engine has no tokenizer
    # time of this answer if its request was alone in the engine; None otherwise
    seconds: Measured | None
    batch_size: Whole  # how many requests went through the engine together
    label_mass: Share | None  # probability of all letters together in a read-out; None otherwise
    retries: Whole  # failed attempts before this one
    cached: bool  # whether it comes from the completion cache
    slow_s: float  # declared seconds that it takes beyond its card's latency
    prompt_sha256: str  # digest of the chat messages
    status: str  # the outcome of parsing, such as `bad_sum` (docs/names.md)
    # the status in three classes: `strict`, `recovered` or `failed`
    verdict: Literal["strict", "recovered", "failed"]
    repairs: tuple[str, ...]  # corrections before parsing; empty unless recovered
    intent: tuple[float, ...] | None  # probabilities in the order of the actions; None if failed
    mass: float | None  # their sum as written; None if none were written
    message: dict[str, Any] | None  # the rest of a helper's answer; None if there is none
    detail: str  # one sentence for people
    # time to the first token, prefill included; None if `seconds` is None, if it is unknown, or
    # after a repair turn
    first_token_s: Measured | None = None
    # time of each token after the first; None if `first_token_s` is None or no token follows
    token_s: Measured | None = None
    first: FirstTurn | UnsetType = UNSET  # the answer before a repair turn; unset without one
    # digest of the pixels of the picture in its prompt; unset without one
    image_sha256: str | UnsetType = UNSET
    # how much of a read-out over several orders of its letters follows the letter, 0 to 1; unset
    # where the letters were read once, like the next
    letter_share: Share | UnsetType = UNSET
    follows_letter: bool | UnsetType = UNSET  # whether one letter is the likeliest in every order
    # whether the likeliest action changed when the list of actions was reversed; unset where that
    # was not asked, or got no answer
    flipped: bool | UnsetType = UNSET
    # which of several agents of helpers answered, from 1; where several vehicles decide, also 0,
    # the ego's; unset where the place among all answers says
    agent: int | UnsetType = UNSET
    # all that is wrong with a failed answer, the status first; unset where that is the only fault
    faults: tuple[str, ...] | UnsetType = UNSET
    # what a prompt's `answer.json` asks for beside the decision; unset where there is none
    extension: dict[str, Any] | UnsetType = UNSET

    @property
    def turns(self) -> int:
        """Return the number of questions that were asked for the answer: 2 with a repair turn.

        A repair turn is a second question after an answer that could not be parsed. Else it is 1.
        """
        return 2 if self.first else 1

    def may_take_longer(self, tail_s: float) -> bool:
        """Return whether its extra seconds `slow_s` are as its model's file declares them.

        Allowed are none, or in each turn the declared slow tail, `tail_s` in s.
        """
        return self.slow_s in [turns * tail_s for turns in range(self.turns + 1)]

    @property
    def first_status(self) -> str | None:
        return self.first.status if self.first else None

    @property
    def first_raw(self) -> str | None:
        return self.first.raw if self.first else None

    def cell(self, column: str) -> Any:
        """Return the field or property of this name as a table's cell; None where it is unset."""
        if (value := getattr(self, column)) is UNSET:
            return None
        return " ".join(value) if column == "faults" else value

    @property
    def likeliest(self) -> int | None:
        """Return the place of its likeliest action, of equals the first; None if it failed."""
        return self.intent.index(max(self.intent)) if self.intent else None

    @property
    def id(self) -> str:
        """Return the id of its request: the scene's id, a slash, and the answer's key there."""
        return f"{self.scene}/{self.key}"

    @property
    def key(self) -> str:
        """Return its name within its scene: vehicle, senders of messages it heard, and question."""
        return asked_key("+".join((self.viewer, *self.heard)), self.question)

    @property
    def question(self) -> str:
        """Return the name of an extension's question that it answers; empty for the plain one.

        The plain question is what the ego should do, as the vehicle sees it.
        """
        return "" if self.role in PLAIN_ROLES else self.role


class AnswerFacts(Struct, frozen=True):
    """Hold the fields of `Answer` that a run's figures are computed from, with the same meaning.

    Texts are left out, so that all answers of a run fit into memory. `scene` is the id of the
    decision point, `role` who answered, `verdict` and `repairs` how its text was parsed, and
    `error` why there is none. `prompt_tokens` and `completion_tokens` are counts, and `seconds`,
    `first_token_s` and `token_s` times of the answer, of its first token and of each further one;
    None where unknown. `retries` counts failed attempts, `cached` says that it was stored earlier,
    and `first` is the failed answer before a second question. Of an answer by one letter per
    action, `label_mass` is the letters' total probability; `letter_share`, from 0 to 1, is how much
    of it stays with a letter whatever action that letter stands for, `follows_letter` says whether
    one letter is always the likeliest, and `flipped` whether reversing the list of actions changes
    the likeliest action.
    """

    scene: str
    role: Role
    verdict: Literal["strict", "recovered", "failed"]
    repairs: tuple[str, ...]
    prompt_tokens: Whole | None
    completion_tokens: Whole | None
    seconds: Measured | None
    label_mass: Share | None
    retries: Whole
    cached: bool
    error: str | None
    first_token_s: Measured | None = None
    token_s: Measured | None = None
    first: FirstTurn | UnsetType = UNSET
    letter_share: Share | UnsetType = UNSET
    follows_letter: bool | UnsetType = UNSET
    flipped: bool | UnsetType = UNSET

    @property
    def turns(self) -> int:
        """Return the number of questions that were asked for the answer: 2 with a repair turn.

        A repair turn is a second question after an answer that could not be parsed. Else it is 1.
        """
        return 2 if self.first else 1


class Times(Struct, frozen=True, omit_defaults=True):
    """Hold how long n answers took that were asked one at a time: percentiles, s.

    `median_s`, `p5_s` and `p95_s` are the 50th, 5th and 95th percentile. `median_ci_s` and
    `p95_ci_s` are the ends of their 95 % intervals over episodes, None if these cannot bound them.
    `first_token` has the times to the first token, and `token` those of each further one; None if
    the engine does not report them.
    """

    n: int  # number of answers
    median_s: float  # the median
    p5_s: float  # the 5th percentile
    p95_s: float  # the 95th percentile
    # 95 % interval of the median, over episodes; None if they cannot bound it
    median_ci_s: tuple[float, float] | None = None
    p95_ci_s: tuple[float, float] | None = None  # 95 % interval of the 95th percentile
    first_token: "Times | None" = None  # times to the first token, if the engine reports them
    token: "Times | None" = None  # times per output token, if the engine reports them


class Latency(Struct, frozen=True, omit_defaults=True):
    """Hold the seconds of inference by role, fixed before a run, or token rates to compute them.

    They decide which messages arrive within the decision window. `source` names where they come
    from, `basis` says so in words, and `sample` has the times of the answers that were measured, by
    role. `ego_s`, `helper_s` and `fusion_s` are of one answer of the ego, a helper, and the ego
    after it heard messages; `helpers_s` of each of several models that helpers take in turn. Where
    a timer times each answer by itself, they are None and `speeds` has each agent's speed (a record
    of the timer's own), the ego's first. An agent is a model with its prompt.
    """

    # where they come from: `card`, `declared`, `measured`, `paper`, or what times each answer by
    # itself, such as `device`
    source: str
    basis: str  # the same in words
    # seconds of one inference of the ego; None if each answer is timed, like the next two
    ego_s: Seconds | None = None
    # seconds of one inference of a helper; of the first of several agents
    helper_s: Seconds | None = None
    fusion_s: Seconds | None = None  # seconds of the ego's fusion call
    sample: dict[str, Times] = {}  # times of the answers behind a measured latency, by role
    # seconds of each of several agents of helpers; empty if there is only one
    helpers_s: tuple[Seconds, ...] = ()
    # how fast each agent answers, the ego's first, if each answer is timed by itself; else empty
    speeds: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        has_seconds = None not in (self.ego_s, self.helper_s, self.fusion_s)
        if has_seconds != (self.source in SOURCES) or bool(self.speeds) == has_seconds:
            raise ValueError(
                f"latency has seconds where its source is {', '.join(SOURCES)}, and else speeds"
            )
        if self.speeds:
            of_source = timer(self.source)
            speeds = tuple(of_source.speed(speed) for speed in self.speeds)
            structs.force_setattr(self, "speeds", speeds)

    def helper_times_s(self) -> tuple[Seconds, ...]:
        """Return the seconds of an answer by each of the models that helpers have, in their order.

        The helpers take these models in turn. It is empty if each answer is timed by itself.
        """
        return self.helpers_s or (() if self.helper_s is None else (self.helper_s,))

    def speed(self, place: int) -> Any:
        """Return how fast a vehicle's model answers, an object of the run's timer (`Timer.speed`).

        `place` is the vehicle's index, where 0 is the ego, and the helpers follow from 1. The
        models of helpers are assigned to them in turn.
        """
        ego, *helpers = self.speeds
        return helpers[(place - 1) % len(helpers)] if place and helpers else ego

    def answer_s(self, place: int, answer: Answer) -> float:
        """Return the seconds of an answer by a vehicle, whose index is `place`.

        Index 0 is the ego, and the helpers follow from 1. A repair turn is included. NaN if the
        answer was timed and the engine failed. A repair turn is a second question after an answer
        that cannot be parsed. The engine is what runs the model.
        """
        if self.speeds:
            return timer(self.source).answer_s(self.speed(place), answer)
        helpers = self.helper_times_s()
        usual_s = helpers[(place - 1) % len(helpers)] if place and helpers else self.ego_s
        return cast(float, usual_s) * answer.turns + answer.slow_s


class Message(Struct, frozen=True, rename={"sender": "from"}):
    """Hold a helper's reply to the ego: whether and when it arrived, and its weight in fusion.

    `sender` is the helper's id. `delivered` says whether the reply arrived at all, `arrival_ms`
    when, from the start of the decision, None if it was lost, and `on_time` whether that was within
    the decision window. `weight` (0 to 1) is None if a fusion call made the decision, `trust` (0 to
    1) if the consensus rule rates none; `attacker` says whether the sender attacks. A fusion call
    asks the ego's model again, with the messages that it heard.
    """

    sender: str  # the helper
    delivered: bool  # whether it arrived
    on_time: bool  # whether it arrived within the decision window
    arrival_ms: float | None  # when it arrived, from the start of the decision; None if lost
    weight: float | None  # its weight in the policy; None if a fusion call answered
    # how far the consensus rule trusted it, from 0 to 1; None if the rule rates no trust
    trust: float | None
    # whether the sender attacks under this condition; None in runs older than attacks
    attacker: bool | None


class Decision(Struct, frozen=True, kw_only=True, gc=False):
    """Hold one decision, a row of `decisions.parquet`, for reports; None where unknown.

    It is about the decision point `scene`, number `step` of `episode`, under one condition (named
    set of settings of channel, asking and fusion) and channel seed; `agent` is the id of who
    decided. `danger` is the side that a hidden vehicle comes from. `entropy_nats` is that of the
    ego's own answer, `own_failed` whether it could not be parsed, `triggered` whether the ego asked
    helpers, and `messages` their replies. `fused` is the policy after fusion: a probability for
    each action; the ego's own answer has the weight `own_weight` in it. `action` is the name of the
    one taken.

    `latency_ms` is from seeing to acting, of which `fusion_ms` is fusion's; `deadline_missed` says
    that it took longer than the decision window. `value` is whether success was still possible
    before the action, `safe` whether it is after it, `regret` whether the action gave it away, and
    `delay_s` how long it puts off success. `off_lag` says that the decision took another time than
    the recorded scenes allow; `acts_at_s` and `acted` when and whether it took effect in a
    simulator.
    """

    scene: str  # id of the decision point
    episode: int  # the episode's number
    step: int  # its number in the episode
    danger: str | None  # where the hidden danger comes from; None without one
    condition: str  # name of the operating point
    seed: int  # seed of the channel's draws
    action: str  # the meta-action that was taken
    fused: tuple[float, ...]  # the policy, in the order of the actions
    entropy_nats: float | None  # entropy of the ego's own intent
    # whether the ego asked; before 26 November 2026 also if it would have, and nobody was there
    triggered: bool
    own_failed: bool  # whether the ego's own answer could not be parsed
    own_weight: float | None  # weight of its intent in the policy; None if a fusion call answered
    latency_ms: float | None  # time from seeing to acting
    fusion_ms: float | None  # the part of it that fusion takes
    deadline_missed: bool | None  # whether it took longer than the window
    messages: tuple[Message, ...]  # the replies that were scheduled
    value: bool | None  # whether success was still possible; frozen scenes only, like the next four
    safe: bool | None  # whether success is still possible after the action
    regret: bool | None  # whether the action gave success away; None if it was not possible before
    delay_s: float | None  # by how much the action puts off the earliest success
    # whether the decision took longer or shorter than the dataset's lag, in whole frames
    off_lag: bool | None
    acts_at_s: float | None  # when the action takes effect; closed loop only
    acted: bool | None  # whether the episode lasted until then; closed loop only
    agent: str | None = None  # id of who decided; None if only the ego decides


class Episode(Struct, frozen=True, kw_only=True, gc=False):
    """Hold the outcome of one layout under one condition and seed, a line of `episodes.csv`.

    A layout is one start situation, which `layout_seed` draws; a condition is a named set of
    settings of channel, asking and fusion. `danger` is the side that a hidden vehicle comes from,
    which `witnesses` helpers see at first, and `danger_radio` whether it has a radio. `success`
    says whether it succeeded, `outcome` how it ended, `failure` how it failed, and `time_s` when
    that was decided. A field is None where its kind of run, on recorded scenes or simulated, does
    not know it. Times are in s, but for `latency_ms`, the mean of its decisions.

    `messages` counts replies, `deadline_misses` decisions that took too long, `skipped` those not
    begun since one was open, and `never_acted` those not ready at the end; `trigger_rate` is the
    share that asked. `delay_s` is needless delay, `time_lost_s` how much later the ego cleared than
    it could; `miss` says that a decision made harm inevitable, `false_alarm` that one only gave
    success away. Of a collision, `partner` is the other's id; `striker` and `fault` say whether the
    ego or the other hit, and should have given way. `least_gap_m`, `least_ttc_s` and `least_pet_s`
    are the least distance, time to collision and post-encroachment time, `short_ttc` and
    `short_pet` whether these were below 1.5 s; `hard_brakings` and `other_crashes` are counts.

    Where several vehicles decide, `agents` is how many, of whom `arrived` reached their goal and
    `met` hit each other; `agents_lost_s` is how much later in sum than alone, `most_lost_s` that of
    the one who lost most, `gave_way`. `journeys` has how each ended, as JSON.

    Layouts that are cut from one thing, such as a recording of traffic, are alike; they have the
    same `cluster`, and intervals count clusters in place of layouts.
    """

    condition: str  # name of the operating point
    seed: int  # seed of the channel's draws
    episode: int  # the episode's number
    layout_seed: int  # seed of the layout
    danger: str  # where the hidden danger comes from; `none` without one
    success: bool  # whether it succeeded
    failure: str  # `collision`, `late`, `time_out` or `off_road`; empty if it did not fail
    delay_s: float | None = None  # total needless delay
    messages: int = 0  # replies scheduled
    trigger_rate: float | None = None  # share of its decisions in which the ego asked
    latency_ms: float | None = None  # mean latency of its decisions
    deadline_misses: int = 0  # decisions that outlasted the window
    time_s: float | None = None  # when the outcome was decided
    partner: str | None = None  # the vehicle that the ego collided with
    # whose front hit the other: `ego`, `other`, `both` or `neither` (a side swipe)
    striker: str | None = None
    # who should have given way, or drove into the other's back: `ego` or `other`
    fault: str | None = None
    least_gap_m: float | None = None  # smallest distance to another vehicle's outline
    hard_brakings: int | None = None  # times the ego began to brake harder than 4 m/s²
    other_crashes: int | None = None  # vehicles that crashed without the ego
    decisions: int | None = None  # decisions begun
    skipped: int | None = None  # decisions not begun, since one was still open
    never_acted: int | None = None  # decisions that were not ready before the end
    # how it ended: `success`, `late`, `unsafe` (a collision, or off the road) or `stuck` (never
    # there); None where `limits` is 1
    outcome: str | None = None
    # by how much the ego cleared later than was possible; frozen only, like the next two
    time_lost_s: float | None = None
    miss: bool | None = None  # whether a decision made harm inevitable, which was not before
    # whether a decision gave success away, and harm could still be avoided
    false_alarm: bool | None = None
    # least time to collision with another vehicle; None where none was near
    least_ttc_s: float | None = None
    short_ttc: bool | None = None  # whether it was below 1.5 s; None where it was not measured
    least_pet_s: float | None = None  # least post-encroachment time
    short_pet: bool | None = None  # whether it was below 1.5 s
    # how many helpers have, or would have, the danger in sight at the first decision; None if not
    # declared
    witnesses: int | None = None
    # whether the danger sends beacons; None without one, or undeclared
    danger_radio: bool | None = None
    # how many vehicles decided; None if only the ego did, like the next six
    agents: int | None = None
    arrived: int | None = None  # how many of them reached their goal
    met: int | None = None  # how many collided with another of them
    # how much later than alone on the road, at their first speed, those who arrived did, in sum
    agents_lost_s: float | None = None
    most_lost_s: float | None = None  # the same of the one who lost most
    gave_way: str | None = None  # id of that one; None if nobody lost time
    # how each of them ended: JSON, a list with the columns of `run.agents` for each
    journeys: str | None = None
    # what its layout is cut from, such as a recording of traffic; None for a layout of its own
    cluster: str | None = None


class Variant(Struct, frozen=True):
    """Name the model, prompt and answer mode of a run, as the first columns of its CSV files do.

    `prompt` is the prompt's version, and `answer` how the model answers, such as `json` (free text)
    or `readout` (a letter). `helpers` has the same of models that answer for helpers.
    """

    model: str  # name of the model, which is that of the file that describes it (its card)
    prompt: str  # the prompt version
    answer: str  # the answer mode
    helpers: str = ""  # the same for the helpers' agents; empty if the ego's agent answers for them

    def __str__(self) -> str:
        return f"{BETWEEN_NAMES.join((self.model, self.prompt, self.answer))}{self.mix}"

    @property
    def mix(self) -> str:
        """Return the helpers' models as the end of a name: ` + M`; empty if they have none."""
        return self.helpers and f" + {self.helpers}"


class Score(Struct, frozen=True, rename={"low": "ci_low", "high": "ci_high"}):
    """Hold the estimate of a metric in a condition, a line of `summary.csv`.

    A condition is a named set of settings of channel, asking and fusion. `low` and `high` are the
    ends of the 95 % interval, None if the data cannot bound it; `value` is None if nothing could be
    averaged. `n` counts the units that `interval` names, such as episodes, and `n_excluded` those
    without a value.
    """

    condition: str  # name of the operating point, or `all` for what is the same in all
    metric: str  # name of the metric, its unit at the end
    value: float | None  # the mean; None if there was nothing to average
    low: float | None  # lower end of the 95 % interval; None if the data cannot bound it
    high: float | None  # its upper end
    n: int  # number of units
    n_excluded: int  # units without a value
    # what the units are: `episodes`, `seed means` or `answers`; `any time` for episodes and an
    # interval that holds at every look
    interval: str

    @classmethod
    def of(cls, condition: str, metric: str, e: Estimate, interval: str) -> "Score":
        """Return an estimate `e` as a line of `summary.csv`, with None for NaN.

        `condition` and `metric` are the names of what it is of; `interval` says what the units of
        the estimate are, such as `episodes`.
        """
        value, low, high = (None if x != x else float(x) for x in (e.value, e.low, e.high))
        return cls(condition, metric, value, low, high, e.n, e.n_excluded, interval)

    @property
    def key(self) -> tuple[str, str, str]:
        """Return what is unique in a summary: condition, metric and kind of interval.

        A condition is a named set of settings of channel, asking and fusion.
        """
        return self.condition, self.metric, self.interval

    @property
    def estimate(self) -> Estimate:
        value, low, high = (
            float("nan") if x is None else x for x in (self.value, self.low, self.high)
        )
        return Estimate(value, low, high, self.n, self.n_excluded)


class FrozenScenes(
    Struct, frozen=True, tag="frozen", tag_field="kind", kw_only=True, omit_defaults=True
):
    """Record the dataset of a frozen run (on recorded scenes), and which of its episodes were used.

    `name` and `path` are the dataset's and its folder's, `sha256` its digest. `episodes` and
    `nodes` are the numbers of episodes and decision points that were used; these are all of the
    dataset without `limit` (the first so many) and `selection` (options by name).
    `delay_allowance_s` is the needless delay with which an episode still succeeds, and
    `decision_lag_s` the time from a decision to its action that the dataset was made with.
    `interim_looks` is what a rule that may stop the run states.
    """

    name: str  # the dataset's name
    sha256: str  # digest of the dataset
    nodes: int  # number of decision points of the episodes that were used
    episodes: int  # number of episodes that were used
    limit: int | None  # only so many episodes, from the first; None for all
    delay_allowance_s: float  # needless delay with which an episode still succeeds
    decision_lag_s: float  # time from a decision to its action that the dataset was made with
    path: str  # the dataset's folder
    # values of `--only`, `--danger` and `--sample`, by name; empty for none
    selection: dict[str, int | str] = {}
    # what a rule that may stop the run states of its looks; None for a run of as many episodes as
    # were asked for
    interim_looks: Plain | None = field(default=None, name=formats.LOOKS)

    @property
    def pinned(self) -> Any:
        """Return what is equal in two runs on the same scenes: the dataset's digest."""
        return self.sha256


class ClosedLoop(
    Struct, frozen=True, tag="closed-loop", tag_field="kind", kw_only=True, omit_defaults=True
):
    """Record the scenario of a closed-loop run (in a simulator), and which layouts were driven.

    `scenario` has its `name` and `parameters`. A layout is one start situation of a scenario;
    episode e has layout seed `first_seed` + e, which fixes who stands where, and `episodes` is how
    many were driven. If they were sampled, `selection` has the number sampled from, `of`, and the
    seed of the draw. `late_against` says in words whose time lateness is measured against;
    `interim_looks` is what a rule that may stop the run states.
    """

    scenario: dict[str, Any]  # its `name` and `parameters`, values by name
    first_seed: int  # layout seed of episode 0
    episodes: int  # number of episodes that were driven
    late_against: str  # phrase on the driver against whose time lateness is measured
    selection: dict[str, int] = {}  # how a sample was drawn; empty for all
    # what a rule that may stop the run states of its looks; None for a run of as many episodes as
    # were asked for
    interim_looks: Plain | None = field(default=None, name=formats.LOOKS)

    def __post_init__(self) -> None:
        name, parameters = self.scenario.get("name"), self.scenario.get("parameters")
        if not isinstance(name, str) or not isinstance(parameters, dict):
            raise ValueError("the scenario has no name, or no parameters")

    @property
    def pinned(self) -> Any:
        """Return what is equal in two runs on the same scenes.

        That is the scenario's name, its parameters without those of beacons, and the first layout
        seed. A layout is one start situation of a scenario.
        """
        parameters = {k: v for k, v in self.scenario["parameters"].items() if k not in DIALS}
        return self.scenario["name"], parameters, self.first_seed

    @property
    def title(self) -> str:
        """Return the scenario's title for people; its name if this version does not have it."""
        name: str = self.scenario["name"]
        with suppress(UserError):
            if scenarios.is_here(name):
                return scenarios.title(scenarios.of_manifest(name, self.scenario["parameters"]))
        return name


class ChannelRecord(Struct, frozen=True, kw_only=True):
    """Record a channel profile (a radio) as it was when the run was made, with all its parameters.

    `model` is the name of the channel model, `source` says where the parameters come from, and
    `status` how well they are supported. `limits` has the least and greatest value for which the
    model was validated, by parameter.
    """

    model: str  # name of the channel model
    description: str  # one sentence for people
    source: str  # where the parameters come from
    status: str  # how well they are supported, such as measured or assumed
    parameters: dict[str, Any]  # values by name, such as range in m
    # least and greatest value for which the model was validated, by parameter
    limits: dict[str, tuple[float, float]] = {}


@cache
def _condition() -> type[Struct]:
    """Make the record of a condition's settings as a file states them;
    one of another version has others.
    """
    types = OperatingPoint.types()
    return defstruct("Condition", [(name, kind | UnsetType, UNSET) for name, kind in types.items()])


_SUMMED = ("amount", "asked", "uncounted", "read_tokens", "written_tokens")  # fields of a cost


class Cost(Struct, frozen=True):
    """Hold what a run's requests to one model cost, by the price that the model's file states.

    `amount` is in `currency`; of the `asked` requests, the `uncounted` ones are not in it, since
    nobody said how many tokens they had. `read_tokens` are those of prompts, `written_tokens` those
    of answers.
    """

    currency: str  # such as `USD`
    amount: float  # what the counted requests cost
    asked: int  # number of requests
    uncounted: int  # of these, so many are not in the amount: nobody said how many tokens they had
    read_tokens: int  # tokens of the prompts
    written_tokens: int  # tokens of the answers

    @classmethod
    def joined(cls, runs: "Iterable[Manifest]") -> "dict[str, Cost]":
        """Return the cost of several runs in sum, by name of the model; all have the same price.

        `runs` are the runs' manifests.
        """
        total: dict[str, Cost] = {}
        for model, cost in (each for run in runs for each in (run.cost or {}).items()):
            old = total.get(model)
            sums = {
                name: getattr(cost, name) + (getattr(old, name) if old else 0) for name in _SUMMED
            }
            total[model] = cls(cost.currency, **sums)
        return total


def _is_name(name: str) -> bool:
    """Return whether a text can be a name in a table, where it stands beside others."""
    return bool(name.strip()) and len(name) <= MOST_LETTERS and BETWEEN_NAMES not in name


class Manifest(Struct, frozen=True, kw_only=True):
    """Hold a run's settings and origin: the content of `run.json`.

    Whole records of models (`model`, `helpers`), radios (`channels`), networks to a cloud
    (`networks`) and conditions (named sets of settings of channel, asking and fusion) are in it,
    with digests and versions, so that the run can be made again and checked; so are those of what
    conditions (`kept`) and settings of extensions (`beside`) name. `world` says where scenes come
    from, `actions` are the names of what the ego can do, `seeds` are of the channel's random
    numbers, and `latency` has the seconds of answers. `identity` tells the model that answered
    apart, and `cost` says by model what it cost. `settings` has all settings as typed; fields of
    the same names, such as `answer` and `ties`, are what these came to.
    """

    format: str  # the format of the run's files, such as `swarmdrive-run/2`
    name: str  # the name of the run's folder
    created: str  # when the run was begun, UTC
    command: str  # the command line that makes it again
    tags: tuple[str, ...]  # words by which to find it
    model: dict[str, Any]  # the whole content of the file that describes the ego's model (its card)
    prompt: dict[str, Any]  # the ego's prompt: `version`, `sha256` and whether it is `released`
    # the models that answer for helpers, with prompt and way of answering; empty if the ego's does
    helpers: tuple[dict[str, Any], ...]
    world: FrozenScenes | ClosedLoop  # where the decision points come from
    # names of the meta-actions, in the order of every distribution over them
    actions: tuple[str, ...]
    # what the run scores: named sets of settings of channel, asking and fusion, each whole
    conditions: tuple[dict[str, Any], ...]
    channels: dict[str, ChannelRecord]  # the radios of the conditions, by name of the profile
    networks: dict[str, dict[str, Any]]  # the networks to a cloud that the conditions use, by name
    schedules: dict[str, str]  # digests of the rules by which helpers are asked, by name
    # other things that conditions name, such as calibrations, by kind and name
    kept: dict[str, dict[str, Any]]
    # what settings of extensions opened, by name of the setting
    beside: dict[str, Any] = field(default_factory=dict)
    seeds: tuple[int, ...]  # seeds of the channel's random numbers
    # which helpers were asked: those whose answer a condition uses, or all; `all` where missing
    ask: Literal["used", "all"]
    # which of equally likely actions was taken: a drawn one, or the first; `first` where missing
    ties: Literal["drawn", "first"]
    thinking: bool  # whether the model was asked to think before it answers
    answer: str  # how the model answers: `json`, `constrained`, `readout` or `decision`
    image: str  # the picture an image prompt shows: `own`, `blank`, `another` or `none`
    # read-outs: letters read once, or averaged over several orders
    letters: Literal["raw", "cyclic"]
    # whether an answer whose numbers do not sum to 1 is refused or divided
    sums: Literal["refuse", "divide"]
    flip: bool  # whether read-outs were also asked with the actions reversed
    batch_size: AtOnce  # number of prompts in one batch; `auto` of those that servers had at once
    dtype: str | None  # number format of the weights; None is the card's
    temperature: float  # sampling temperature; 0 is greedy
    sampling_seed: int  # seed of the sampling
    latency_source: str | None  # the value of `--latency`; None is the card's, else the paper's
    # all settings by their names in `run.toml`; what another key states, too, is the same there
    settings: Settings
    latency: Latency  # the inference times that decide which messages arrive
    # what answers took that were asked alone, by role; they decide nothing
    answer_times: dict[str, Times] = field(default_factory=dict)
    identity: dict[str, Any]  # the model that answered: engine, digests, versions, device
    cached_answers: int  # number of answers from the completion cache
    engine_errors: int  # helpers' questions without an answer, which count as lost messages
    retries: int = 0  # number of failed attempts before answers came
    cost: dict[str, Cost] | UnsetType = UNSET  # by model; unset if no model has a price
    # of the harness, Python and packages, by name
    versions: dict[str, str] = field(default_factory=dict)
    # of what decides the answers of the ego's agent and of each of helpers, of all else that is
    # stated here (`run`), and of `answers.jsonl`; empty where missing
    digests: dict[str, str] = field(default_factory=dict)

    @property
    def scenario(self) -> Scenario:
        """Return the scenario of a closed-loop run, with the parameters in the manifest.

        In closed loop a simulator plays the episodes. Raises UserError if this version has no such
        scenario or parameters.
        """
        assert isinstance(self.world, ClosedLoop)
        record = self.world.scenario
        try:
            return scenarios.of_manifest(record["name"], record["parameters"])
        except UserError as error:
            raise UserError(f"run.json of {printable(self.name)}: {error}") from None

    def as_file(self) -> dict[str, Any]:
        """Return the manifest in the form of `run.json`, as plain values by name."""
        return formats.as_file(to_builtins(self))

    @property
    def timer(self) -> Timer | None:
        """Return what timed each answer by itself; None if nothing did, or in a replay."""
        return timer(self.latency.source).recorded(self) if self.latency.speeds else None

    @property
    def stopping_rule(self) -> StoppingRule | None:
        """Return the rule that may have stopped the run early; None if the run had none.

        It is as registered: what the run's settings open for it is not opened.
        """
        return stopping.rule_of(self.world.interim_looks)

    @property
    def interim_looks(self) -> InterimLooks | None:
        """Return when the run was looked at, since it might stop; None without a stopping rule."""
        rule, record = self.stopping_rule, self.world.interim_looks
        if rule is None or record is None:
            return None
        looks = rule.looks(record)
        if looks.at[-1] != self.world.episodes:
            raise ValueError(
                f"{formats.LOOKS}: the last is not at all {self.world.episodes} layouts"
            )
        return looks

    def __post_init__(self) -> None:
        _ = self.timer, self.interim_looks  # of what a run states
        of_model, of_prompt = ("name", "engine"), ("version", "sha256")
        tables: list[tuple[str, dict[str, Any], tuple[str, ...]]] = [
            ("model", self.model, of_model),
            ("prompt", self.prompt, of_prompt),
        ]
        tables += [("conditions", point, ("name",)) for point in self.conditions]
        tables += [("helpers", helper, ("answer",)) for helper in self.helpers]
        tables += [("helpers", helper.get("model", {}), of_model) for helper in self.helpers]
        tables += [("helpers", helper.get("prompt", {}), of_prompt) for helper in self.helpers]
        for table_name, table, keys in tables:
            if not isinstance(table, dict):
                raise ValueError(f"{table_name}: {printable(repr(table), 40)} is no table")
            if missing := [key for key in keys if not isinstance(table.get(key), str)]:
                raise ValueError(f"{table_name}: {missing[0]} is no text")
            if table_name != "conditions" and not _is_name(table[keys[0]]):
                raise ValueError(f"{table_name}: {keys[0]} is no name")
        if any(not isinstance(helper.get("thinking", False), bool) for helper in self.helpers):
            raise ValueError("helpers: thinking is neither true nor false")
        for point in self.conditions:
            core_settings = {
                name: point[name] for name in _condition().__struct_fields__ if name in point
            }
            try:
                convert(core_settings, _condition(), "conditions")
            except UserError as mistake:
                raise ValueError(str(mistake)) from None
        names = tuple(point["name"] for point in self.conditions)
        lists: dict[str, Sequence[Any]] = {
            "actions": self.actions,
            "conditions": names,
            "seeds": self.seeds,
        }
        for field_name, values in lists.items():
            if not 0 < len(values) == len(set(values)):
                raise ValueError(f"{field_name}: none, or one twice")
        self._check_speeds()

    def _check_speeds(self) -> None:
        """Raise ValueError unless answers are timed as what times them says."""
        if not self.latency.speeds:
            if self.beside:
                raise ValueError(f"{next(iter(self.beside))}: nothing timed the answers by it")
            return
        if (its_timer := self.timer) is None:
            if self.model["engine"] != "replay":
                raise ValueError("latency has speeds, and nothing states what timed the answers")
            return
        models = [self.model["name"], *(helper["model"]["name"] for helper in self.helpers)]
        try:
            speeds = its_timer.speeds(models)
        except UserError as error:
            raise ValueError(str(error)) from None
        if speeds != self.latency.speeds:
            raise ValueError(f"latency has other speeds than {its_timer.option} makes")

    @property
    def answerers(self) -> Answerers:
        """Return who was asked: of a run that replays others, in the first of them."""
        return self.answerers_at(0)

    def answerers_at(self, place: int) -> Answerers:
        """Return who was asked for a vehicle: of a replay, in the first of the runs.

        `place` is the vehicle's index, where 0 is the ego, and the helpers follow from 1.
        """
        if not (place and self.helpers):
            return answerers_of(self.model, self.identity, self.helpers, self.temperature)
        n = (place - 1) % len(self.helpers)
        identities = self.identity.get("helpers")
        by_place = dict(enumerate(identities)) if isinstance(identities, list | tuple) else {}
        identity = by_place.get(n)
        identity = identity if isinstance(identity, dict) else {}
        return answerers_of(self.helpers[n]["model"], identity, (), self.temperature)

    @property
    def variant(self) -> Variant:
        helpers = []
        for h in self.helpers:
            names = h["model"]["name"], h["prompt"]["version"], h["answer"]
            helpers.append(BETWEEN_NAMES.join(names))
        model, version = self.model["name"], self.prompt["version"]
        return Variant(model, version, self.answer, " + ".join(helpers))

    def agent(self, place: int) -> dict[str, Any]:
        """Return the model, prompt and way of answering of a vehicle, as plain values by name.

        `place` is the vehicle's index, where 0 is the ego, and the helpers follow from 1. Models of
        helpers are assigned to them in turn; without any, the ego's answers for all.
        """
        if place and self.helpers:
            return self.helpers[(place - 1) % len(self.helpers)]
        return {name: getattr(self, name) for name in AGENT}
