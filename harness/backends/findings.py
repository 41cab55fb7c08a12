"""What `harness model check` found out about a model, kept in the user's cache by the model's identity.

Runs and their pages say it; no setting follows from it. It is never read from a run: a stranger's file could
say anything.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import msgspec
from msgspec import Struct

from harness.core import kept
from harness.core.files import digest

MOST = 0.5  # letter share from which the letter explains more than all else


class Moved(Struct, frozen=True):
    """How the `n` pairs of questions that differ in one fact were answered."""

    fact: str  # the kind of fact
    n: int
    moved: int  # in how many the expected action became clearly likelier with the fact
    mean: float  # mean change of its probability

    @property
    def change(self) -> str:
        """The mean change with its sign; what rounds to nothing has none of its own."""
        return f"{round(self.mean, 3) + 0.0:+.3f}"

    @property
    def read(self) -> bool:
        return 2 * self.moved > self.n


class Findings(Struct, frozen=True):
    """What fixed questions showed of a model."""

    prompt: str  # the prompt version that they were asked with
    letters: str  # how the letters of the pairs were read, `raw` or `cyclic`
    n: int  # number of questions that were read over cyclic orders
    letter_share: float  # mean share of the variance that followed the letter
    follows_letter: int  # in how many questions one letter was the likeliest in every order
    label_mass: float  # mean probability of the letters
    pairs: tuple[Moved, ...]

    @property
    def reads_scene(self) -> bool:
        """Whether a conflict in the scene, or its gap, moves the answer."""
        return any(pair.read for pair in self.pairs if pair.fact in ("conflict", "gap"))

    def sentences(self, letters: bool = True) -> Iterator[str]:
        """Yield what a reader of the model's runs has to know; `letters` says whether they are read out."""
        if not self.reads_scene:
            scene = [pair for pair in self.pairs if pair.fact in ("conflict", "gap")]
            moved, n = sum(pair.moved for pair in scene), sum(pair.n for pair in scene)
            yield (
                "it does not read the scene: a conflict put in or taken out, or a gap of 0.2 or 5 s, moved "
                f"its answer in {moved} of {n} pairs (model check, prompt {self.prompt})."
            )
        # A model that learnt one order of the letters is read in that order.
        if letters and self.letters == "cyclic" and self.letter_share > MOST:
            yield (
                f"its likeliest action follows the letter in {self.follows_letter} of {self.n} questions "
                "(model check); --letters cyclic averages that out."
            )


def keep(identity: Mapping[str, Any], findings: Findings) -> None:
    """Keep what was found of the model with an identity."""
    kept.keep(_name(identity), msgspec.json.encode(findings))


def recall(identity: Mapping[str, Any]) -> Findings | None:
    """Return what was found of the model with an identity; None if nobody checked it here."""
    data = kept.recall(_name(identity))
    try:
        return None if data is None else msgspec.json.decode(data, type=Findings)
    except msgspec.MsgspecError:
        return None


def _name(identity: Mapping[str, Any]) -> str:
    alone = {key: value for key, value in identity.items() if key != "helpers"}
    return f"findings/{digest(alone)}.json"
