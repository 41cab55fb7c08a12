"""Ask a model the fixed questions, and find out what its read-outs follow:
the letter, or the scene.

What `harness model check` found is kept in the user's cache by what was asked: the model's
identity, the prompt's digest and the answer mode. Runs that asked the same, and their pages, say
it; no setting follows from it. It is never read from a run: a stranger's file could say anything.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from statistics import fmean
from typing import Any, cast

import msgspec
from msgspec import Struct
from msgspec.structs import replace as replace_struct

from harness.backends.base import BARE, AnswerMode, Backend, Completion, Letters, Request
from harness.core import kept
from harness.core.errors import UserError, printable
from harness.core.files import digest
from harness.evaluate.agent import Agent
from harness.evaluate.answers import answer_of
from harness.extensions.checkups import questions
from harness.extensions.checkups.questions import Fact, Pair
from harness.prompts.readout import MOST_SHARE
from harness.runs.records import Manifest

LEAST_MOVED = 0.05  # by how much the expected action becomes likelier where a fact counts
COUNT = 12 + 2 * 16  # requests that an examination asks, but for those of scenes that moved nothing


class Moved(Struct, frozen=True):
    """Hold how answers to pairs of questions followed the one fact in which both differ.

    It tests whether a model reads what it is asked. The fact is of a kind such as `conflict` (a
    conflict of paths in the scene) or `number` (which of two is greater); each pair has it in one
    question and not in the other, and it should make one action likelier.
    """

    fact: str  # the kind of fact
    n: int  # number of pairs with two answers that can be parsed
    moved: int  # in how many the expected action became clearly likelier with the fact
    # mean change of the expected action's probability, -1 to 1
    mean: float

    @property
    def change(self) -> str:
        """Return the mean change of the probability with its sign, such as `+0.123`.

        A rounded zero is `+0.000`.
        """
        return f"{round(self.mean, 3) + 0.0:+.3f}"

    @property
    def read(self) -> bool:
        return 2 * self.moved > self.n


class Findings(Struct, frozen=True):
    """Hold what fixed questions showed of a model's read-outs, for one prompt and answer mode.

    A read-out takes the probabilities of actions from those of one letter each. `letters` is how
    these are read: `raw`, in one order, or `cyclic`, averaged over orders in which each action has
    each letter once. In `n` questions asked in all these orders, `letter_share` is the mean share,
    from 0 to 1, of the variance that goes by the letter, `follows_letter` in how many one letter
    was always the likeliest, and `label_mass` the mean total probability of the letters. `pairs`
    says whether facts in the scene move answers, and `others` the same with letters read the other
    way.
    """

    prompt: str  # the prompt version that they were asked with
    prompt_sha256: str  # digest of its files
    answer: AnswerMode  # how the model answered
    letters: str  # how the letters of the pairs were read, `raw` or `cyclic`
    n: int  # number of questions that were read over cyclic orders
    letter_share: float  # mean share of the variance that followed the letter
    follows_letter: int  # in how many questions one letter was the likeliest in every order
    label_mass: float  # mean probability of the letters
    pairs: tuple[Moved, ...]
    # the pairs with letters read the other way, where these showed nothing
    others: tuple[Moved, ...] = ()  # under `other_letters`

    @property
    def reads_scene(self) -> bool:
        """Return whether answers follow the scene: in most pairs of scenes that differ in one fact.

        The fact is a conflict of paths, or the time gap to the other vehicle; one of both is
        enough.
        """
        return any(pair.read for pair in _of_scene(self.pairs))

    @property
    def other_letters(self) -> str:
        """Return the way to read letters that `letters` does not name: `raw` or `cyclic`.

        `raw` reads them in one order, and `cyclic` averages over several.
        """
        return "raw" if self.letters == "cyclic" else "cyclic"

    def sentences(self) -> Iterator[str]:
        """Yield the sentences that a page of runs with this model and prompt must show.

        There is one if the answers do not follow the scene, and one if they follow the letter.
        """
        if not self.reads_scene:
            others = _of_scene(self.others)
            otherwise = (
                f"; with --letters {self.other_letters} in {_moved_of(others)}" if others else ""
            )
            reads = any(pair.read for pair in others)
            clause = f"with letters read {self.letters} it does not" if reads else "it does not"
            yield (
                f"{clause} read the scene: a conflict put in or taken out, or a gap of 0.2 or 5 s, "
                f"moved its answer in {_moved_of(_of_scene(self.pairs))} pairs{otherwise} (model "
                f"check, answer {self.answer}, prompt {self.prompt})."
            )
        # A model that learnt one order of the letters is read in that order.
        if self.letters == "cyclic" and self.letter_share > MOST_SHARE:
            yield (
                f"its likeliest action follows the letter in {self.follows_letter} of {self.n} "
                "questions (model check); --letters cyclic averages that out."
            )


def _of_scene(pairs: Sequence[Moved]) -> list[Moved]:
    """Return the pairs whose scenes differ in what is on the road."""
    return [pair for pair in pairs if pair.fact in ("conflict", "gap")]


def _moved_of(pairs: Sequence[Moved]) -> str:
    """Return in how many pairs the answer moved, as `3 of 8`."""
    return f"{sum(pair.moved for pair in pairs)} of {sum(pair.n for pair in pairs)}"


def examine(
    backend: Backend, agent: Agent, progress: Callable[[int], None] = lambda done: None
) -> Findings | str:
    """Ask a model the fixed questions by read-outs, and return what its answers follow.

    A read-out takes the probabilities of actions from those of one letter each. Letters are read in
    several orders to see what follows them, and in pairs of questions as the agent (model, prompt
    and answer mode) reads them. If no scene moved the answers, the pairs are asked with the other
    way to read letters. `progress` is called with 1 after each answer. If a question gets no
    answer, the error's text is returned.
    """
    letters = agent.letters if agent.answer in BARE else None
    reader = replace(agent, answer="readout", letters=letters)
    pairs = [*questions.scene_pairs(reader), *questions.plain_pairs(reader)]
    requests = list(questions.requests(replace(reader, letters="cyclic")))
    for pair in pairs:
        requests += [pair.present, pair.absent]
    done = _answers(backend, requests, progress)
    if isinstance(done, str):
        return done
    of_letters, rest = done[: -2 * len(pairs)], iter(done[-2 * len(pairs) :])
    findings = Findings(
        prompt=agent.prompt.version,
        prompt_sha256=agent.prompt.sha256,
        answer=reader.answer,
        letters=str(reader.letters),
        n=len(of_letters),
        letter_share=round(fmean(c.letter_share or 0.0 for c in of_letters), 4),
        follows_letter=sum(bool(c.follows_letter) for c in of_letters),
        label_mass=round(fmean(c.label_mass or 0.0 for c in of_letters), 4),
        pairs=moved(pairs, rest),
    )
    if findings.reads_scene:
        return findings
    turned = replace(reader, letters=cast("Letters", findings.other_letters))
    scenes = [*questions.scene_pairs(turned)]
    halves = [half for pair in scenes for half in (pair.present, pair.absent)]
    again = _answers(backend, halves, lambda count: None)
    return (
        again
        if isinstance(again, str)
        else replace_struct(findings, others=moved(scenes, iter(again)))
    )


def _answers(
    backend: Backend, requests: Sequence[Request], progress: Callable[[int], None]
) -> list[Completion] | str:
    """Return the answers to some requests, asked one by one, or why one got none."""
    done: list[Completion] = []
    for request in requests:
        try:
            done += backend.complete([request])
        except UserError as error:
            return str(error)
        if done[-1].error is not None:
            return done[-1].error
        progress(1)
    return done


def moved(pairs: Sequence[Pair], completions: Iterator[Completion]) -> tuple[Moved, ...]:
    """Return how answers to pairs of questions moved with their one fact, by kind of fact.

    `completions` has two answers for each pair: with the fact, and without. A pair does not count
    if one of them cannot be parsed.
    """
    changes_by_fact: dict[Fact, list[float]] = {}
    for pair in pairs:
        present = _likelihood(pair, pair.present, next(completions))
        absent = _likelihood(pair, pair.absent, next(completions))
        changes = changes_by_fact.setdefault(pair.fact, [])
        if present is not None and absent is not None:
            changes.append(present - absent)
    summaries = []
    for fact, changes in changes_by_fact.items():
        enough = sum(change >= LEAST_MOVED for change in changes)
        mean = round(fmean(changes), 4) if changes else 0.0
        summaries.append(Moved(fact, len(changes), enough, mean))
    return tuple(summaries)


def _likelihood(pair: Pair, half: Request, completion: Completion) -> float | None:
    """Return how likely the expected action is in one half of a pair;
    None if that cannot be read.
    """
    intent = answer_of(half, completion).intent
    return intent[half.actions.index(pair.expected)] if intent else None


def keep_findings(identity: Mapping[str, Any], findings: Findings) -> None:
    """Store what fixed questions showed of a model's answers, in the user's cache folder.

    They are stored by the model's identity, the prompt and the answer mode (such as `readout`, one
    letter for an action), and `recall_findings` returns them. `identity` has values that tell the
    model apart, by name, as its backend states them, such as the digest of its weights.
    """
    name = _name(identity, findings.prompt_sha256, findings.answer)
    kept.keep(name, msgspec.json.encode(findings))


def recall_findings(
    identity: Mapping[str, Any], prompt_sha256: str, answer: str
) -> Findings | None:
    """Return what fixed questions showed of a model's answers, as this machine has stored it.

    Returns None if nothing is stored. `identity` has values that tell the model apart, by name, as
    its backend states them; `prompt_sha256` is the hex digest of the prompt's files, and `answer`
    the answer mode, such as `readout`.
    """
    data = kept.recall(_name(identity, prompt_sha256, answer))
    try:
        findings = None if data is None else msgspec.json.decode(data, type=Findings)
    except msgspec.MsgspecError:
        return None
    of = findings and (findings.prompt_sha256, findings.answer)
    return findings if of == (prompt_sha256, answer) else None


def _name(identity: Mapping[str, Any], prompt_sha256: str, answer: str) -> str:
    alone = {key: value for key, value in identity.items() if key != "helpers"}
    return f"findings/{digest([alone, prompt_sha256, answer])}.json"


def caveats(manifest: Manifest) -> Iterator[str]:
    """Yield warnings about a run's models, in sentences for the run's page.

    They say where stored answers to fixed questions showed that a model ignores the scene or
    follows the letter of an option. They count for a model, the ego's or a helper's, if it was
    asked with the same prompt and answer mode. `manifest` is what the run's `run.json` has.
    """
    helpers = manifest.identity.get("helpers")
    identities = [manifest.identity, *(helpers if isinstance(helpers, list | tuple) else ())]
    agents = [manifest.agent(0), *manifest.helpers]
    for agent, identity in zip(agents, identities, strict=False):
        if not isinstance(identity, Mapping):
            continue
        if findings := recall_findings(identity, agent["prompt"]["sha256"], agent["answer"]):
            for sentence in findings.sentences():
                yield f"{printable(str(agent['model']['name']), 30)}: {sentence}"
