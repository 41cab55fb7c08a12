"""The backend of sparrow-decider: decision models of a few megabytes, in this process,
on numpy alone.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from harness.backends.base import Completion, Request, failed
from harness.backends.card import Card
from harness.backends.registry import BUILT_IN
from harness.core.errors import UserError, one_line, printable, unknown
from harness.core.files import canonical_json, sha256_file

SUFFIX = ".sparrow"


def find(card: Card) -> Path:
    """Return the file of the sparrow-decider weights that a model card (a model's TOML file) names.

    Sparrow-decider is a package with a model that gives options probabilities. The card gives a
    path, or a file that the package has. Raises UserError if there is none.
    """
    weights = card.weights or ""
    if (path := Path(weights).expanduser()).suffix == SUFFIX:
        if not path.is_file():
            raise UserError(
                f"{card.shown}: weights {printable(weights)} is no file; give one that is there"
            )
        return path
    # an import would take NumPy, and lists only look for weights
    package = find_spec("sparrow_decider")
    assert package
    assert package.origin
    folder = Path(package.origin).parent / "models"
    shipped = {file.stem: file for file in sorted(folder.glob(f"*{SUFFIX}"))}
    if weights not in shipped:
        raise unknown(
            f"weights of {card.shown}", weights, shipped, f"; or the path of a {SUFFIX} file"
        )
    return shipped[weights]


def open(card: Card, **_: Any) -> "Sparrow":
    """Return the backend of the sparrow-decider model that a model card (a TOML file) names.

    Sparrow-decider is a package with a model that gives options probabilities; other options of
    engines are ignored. Raises UserError if the card names none.
    """
    from sparrow_decider import Decider

    file = find(card)
    try:
        model = Decider.load(str(file))
    except Exception as error:  # the file may be anything
        raise UserError(
            f"{card.shown}: {printable(file)} is no model of sparrow-decider ({one_line(error)}); "
            "give another"
        ) from None
    return Sparrow(model, file)


class Sparrow:
    """Answer requests in the answer mode `decision`, one after another, by a sparrow-decider model.

    In that mode a model gives each option of a typed question a probability, and writes no text.
    """

    def __init__(self, model: Any, file: Path) -> None:
        self._model, self._file = model, file

    def complete(self, requests: Sequence[Request]) -> list[Completion]:
        """Return one completion for each request, in order.

        Its text is JSON with the actions' probabilities. They are those that the package's own
        server would answer.
        """
        return [self._answer(request) for request in requests]

    def _answer(self, request: Request) -> Completion:
        from harness.backends.decisions.wires import asked_of, questions, read_systemone

        start_s = time.perf_counter()
        try:
            answers = self._model.ask(asked_of(request).state, questions(request))
        except (ValueError, ArithmeticError) as error:
            return failed(request, one_line(error))
        seconds = time.perf_counter() - start_s
        completion = read_systemone({"answers": answers}, request)
        return replace(completion, seconds=seconds, first_token_s=seconds)

    def rendered(self, requests: Sequence[Request]) -> list[str]:
        """Return for each request what the model reads, as JSON: the scene and the question."""
        from harness.backends.decisions.wires import asked_of, questions

        return [
            canonical_json({"state": asked_of(r).state, "questions": questions(r)})
            for r in requests
        ]

    def identity(self) -> dict[str, Any]:
        """Return what decides the answers: the package's version, the model's name and digest.

        The digest is the SHA-256 of its weights; values are by name.
        """
        ours = {"engine": "sparrow", "answers": BUILT_IN["sparrow"].answers}
        package = version("sparrow-decider")
        return {
            **ours,
            "package": package,
            "model": self._model.name,
            "sha256": sha256_file(self._file, "weights"),
        }
