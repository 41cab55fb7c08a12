"""Ask a model the fixed questions in words, and count what its answers do with the prompt."""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any, get_args

from msgspec import Struct

from harness.backends.base import Backend, Completion, Role
from harness.backends.card import Card
from harness.backends.cards import resolve
from harness.backends.registry import capabilities, open_backend
from harness.core.depth import shallow
from harness.core.errors import Unanswered, UserError, printable
from harness.core.progress import Progress
from harness.evaluate.agent import Agent
from harness.evaluate.answers import answer_of
from harness.extensions.checkups import questions
from harness.extensions.checkups.read_outs import COUNT as READ_OUTS
from harness.extensions.checkups.read_outs import Findings, Moved, examine, moved
from harness.parsing.status import Repair, Status
from harness.prompts.versions import Prompt, unfit
from harness.runs.records import Answer

ROLES: tuple[Role, ...] = get_args(Role)
COUNT = len(ROLES) * 12 + 2 * 8  # requests of a trial
CHUNK = 8  # requests that are asked together


class Answers(Struct, frozen=True):
    """Count qualities and faults of one role's answers to the twelve fixed questions.

    The role is the ego or a helper. Of `n` questions, `readable` answers say what to do, `strict`
    ones need no repair, and `distinct` ones differ in their text. `action` is the commonest
    likeliest action, None without a readable answer, in `action_count` of them. `example_copies`
    and `placeholder_copies` count answers that copy an example or a placeholder of the prompt,
    `bad_sums` those whose numbers do not sum to 1, and `at_limit` those that end at the limit of
    tokens. `faults` counts, by the parser's status, why answers cannot be read. `sample` is the
    commonest text.
    """

    role: Role  # the role
    n: int  # number of questions
    readable: int  # answers that say what to do
    strict: int  # answers that need no repair
    distinct: int  # answers that differ in their text
    action: str | None  # the commonest likeliest action of the readable ones; None without any
    action_count: int  # number of readable answers in which that action is the likeliest
    example_copies: int  # answers that are one of the prompt's examples' answers
    placeholder_copies: int  # answers that copy a placeholder of the prompt
    bad_sums: int  # answers whose numbers do not sum to one
    at_limit: int  # answers that ran to the limit of tokens
    # how many answers have each fault for which they cannot be read, by status; an answer may have
    # several
    faults: dict[str, int]
    sample: str  # the first text of the commonest kind

    def sentences(self) -> Iterator[str]:
        """Yield sentences on the faults of one role's answers to a prompt, the most frequent first.

        The last one says which action is the likeliest in how many, or that all texts are the same.
        """
        causes = {
            "copy a placeholder of the prompt": self.placeholder_copies,
            "are word for word the answer of an example": self.example_copies,
            "state numbers that do not sum to one": self.bad_sums,
            "run to the limit of tokens": self.at_limit,
        }
        for status, count in self.faults.items():
            if status not in (Status.SCHEMA_ECHO, Status.BAD_SUM):
                causes[f"cannot be read: {status}"] = count
        for what, count in sorted(causes.items(), key=lambda cause: -cause[1]):
            if count:
                yield f"{count} of {self.n} answers {what}"
        if self.distinct == 1 and self.n > 1:
            yield f"all {self.n} answers are the same text, whatever is asked"
        elif self.readable:
            often = f"{self.action_count} of {self.readable} readable answers"
            yield f"{self.action} is the likeliest action in {often}"


class Trial(Struct, frozen=True):
    """Hold what a model does with a prompt: what is in its answers to the fixed questions.

    These are twelve scenes that ship with the program. `model` is its name, `prompt` the prompt
    version's, and `roles` counts the answers of the ego and of helpers. `pairs` says, by kind of
    fact, how the ego's answers moved between scenes that differ in that one fact.
    """

    model: str  # name of the model
    prompt: str  # the prompt version
    roles: tuple[Answers, ...]  # each role's answers
    # how the ego's answers moved in pairs of scenes that differ in one fact
    pairs: tuple[Moved, ...]


def card_of(prompt: Prompt, model: str, engine: str | None) -> Card:
    """Return the card (the file that describes a model) on which a prompt is to be tried.

    `model` is the model's name, and `engine` the code that is to run it, such as `llama-cpp`; None
    for the first that its cards name. Raises UserError if it is no language model, or if the prompt
    cannot ask the fixed questions, twelve scenes that ship with the program.
    """
    card = resolve(model, engine)
    if not capabilities(card.engine).language_model:
        raise UserError(
            f"--model {printable(card.name)}: it reads no prompt; give a language model (`harness "
            "model list`)"
        )
    if reason := unfit(prompt, questions.scenario()):
        raise UserError(
            f"--model: prompt {prompt.version} {reason}; the fixed questions are of that scenario; "
            "leave --model out"
        )
    return card


def try_on(
    prompt: Prompt, card: Card, device: str | None, dtype: str | None, progress: Progress
) -> tuple[Trial, Findings | str | None]:
    """Try a prompt on a model: ask the fixed questions for answers in words, and by read-outs.

    The fixed questions are scenes that ship with the program; a read-out takes the probabilities of
    one letter an action. `card` describes the model, `device` is where it is loaded (None: the
    engine chooses), and `dtype` the number format (None: the card's). `progress` is told how many
    questions there are, and called with 1 after each.

    Returns:
        Counts of qualities and faults of the answers in words; and what read-outs follow, the scene
        or the letter. The second is None if the engine has no read-outs, and an error's text if one
        got no answer.
    """
    agent = Agent(card, prompt)
    reads_out = "readout" in agent.can.answer_modes and not agent.thinking
    backend = open_backend(card, device=device, dtype=dtype)
    progress.more(COUNT + reads_out * READ_OUTS)
    trial = try_out(backend, agent, progress)
    return trial, examine(backend, agent, progress) if reads_out else None


def try_out(
    backend: Backend, agent: Agent, progress: Callable[[int], None] = lambda done: None
) -> Trial:
    """Ask a model the fixed questions of both roles, and the ego's pairs of scenes; sum them up.

    There are `COUNT` questions: twelve scenes to the ego and to a helper, and pairs of scenes that
    differ in one fact. `backend` runs the model, and `agent` is the model with its prompt and
    answer mode. `progress` is called with the number of answers that have just come. Raises
    Unanswered if a question got no answer.
    """
    pairs = questions.scene_pairs(agent)
    by_role = {role: questions.requests(agent, role) for role in ROLES}
    halves = [half for pair in pairs for half in (pair.present, pair.absent)]
    requests = [*by_role["ego"], *by_role["helper"], *halves]
    completions: list[Completion] = []
    for start in range(0, len(requests), CHUNK):
        chunk = requests[start : start + CHUNK]
        completions += backend.complete(chunk)
        for completion in completions[start:]:
            if completion.error is not None:
                raise Unanswered(
                    f"{printable(completion.error, 300)}: a fixed question got no answer"
                )
        progress(len(chunk))
    rest = iter(completions)
    roles = []
    for role, of_role in by_role.items():
        answers = [answer_of(request, next(rest)) for request in of_role]
        roles.append(described(agent.prompt, role, of_role[0].actions, answers))
    return Trial(agent.card.name, agent.prompt.version, tuple(roles), moved(pairs, rest))


def described(
    prompt: Prompt, role: Role, actions: Sequence[str], answers: Sequence[Answer]
) -> Answers:
    """Return how many of one role's answers have which quality or fault.

    `answers` are the model's, with their parsed probabilities, and `role` is who was asked, `ego`
    or `helper`. `actions` are the names of the actions, in the order of an answer's probabilities.
    `prompt` is what was asked with: answers that copy one of its examples are counted.
    """
    examples = []
    if prompt.examples:
        examples = [_value(example.answer) for example in prompt.examples.of(role)]
    intents = [answer.intent for answer in answers if answer.intent]
    likeliest = Counter(actions[intent.index(max(intent))] for intent in intents)
    faults = Counter(fault for answer in answers for fault in _faults(answer))
    texts = Counter(answer.raw.strip() for answer in answers)
    return Answers(
        role=role,
        n=len(answers),
        readable=len(intents),
        strict=sum(answer.status == Status.STRICT for answer in answers),
        distinct=len(texts),
        action=max(likeliest, key=likeliest.__getitem__, default=None),
        action_count=max(likeliest.values(), default=0),
        example_copies=sum(_value(answer.raw.strip()) in examples for answer in answers),
        placeholder_copies=sum(_echoes(answer) for answer in answers),
        bad_sums=faults[Status.BAD_SUM],
        at_limit=sum(a.finish_reason == "length" for a in answers),
        faults=dict(faults.most_common()),
        sample=texts.most_common(1)[0][0],
    )


def _faults(answer: Answer) -> tuple[str, ...]:
    """Return all faults of an answer that cannot be read, the first first; none of one that can."""
    if answer.intent:
        return ()
    return answer.faults or (answer.status,)


def _echoes(answer: Answer) -> bool:
    return Status.SCHEMA_ECHO in _faults(answer) or Repair.EVIDENCE_ECHO in answer.repairs


def _value(text: str) -> Any:
    """Return the value of a JSON text, so that spaces do not count; the text where it is none."""
    try:
        return shallow(json.loads(text))
    except (ValueError, RecursionError):
        return text
