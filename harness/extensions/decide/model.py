"""A model as it is served: what it is sent of a question, what it may be asked,
and what it is called.
"""

import time
from itertools import count
from typing import Any

from harness.backends.base import Backend, Request
from harness.backends.card import Card
from harness.backends.registry import capabilities
from harness.core.errors import UserError, printable
from harness.core.files import digest
from harness.core.image import Image
from harness.evaluate.agent import Agent
from harness.extensions.decide.asked import Asked, Enquiry, Refusal
from harness.extensions.decide.picture import picture
from harness.prompts import decision, versions
from harness.prompts.readout import LETTERS

ANY = "default"  # the name that asks for whatever there is
# of a state and its question: each order of the letters is split into tokens
MOST_CHARACTERS = 2**18
_PROMPT = "v9"  # no text of it is asked


def served(card: Card, letters: Any = None) -> Agent:
    """Return a card's model as it is served: an agent, the model with how it answers decisions.

    A decision is a question with listed options, of which the model gives each a probability;
    `card` describes the model. `letters` says how letters that stand for options are read, as
    `--letters` takes it: `raw`, in one order, or `cyclic`, averaged over several; None takes the
    default. Raises UserError if the model cannot be asked such questions.
    """
    can = capabilities(card.engine)
    if not ("decision" in can.answer_modes and can.closed_loop):
        raise UserError(
            f"{card.shown}: its engine {card.engine} reads scenes or recorded answers, and no "
            "question of others, so it cannot be served; give a language model or a decision model"
        )
    return Agent(card, versions.load(_PROMPT), "decision", letters=letters)


class ServedModel:
    """Hold a model that is served, and turn clients' questions into requests to it.

    A question has listed options, of which the model gives each a probability. `name` is the
    model's, `backend` is the code that runs it, and `sees` says whether it takes pictures.
    """

    def __init__(self, agent: Agent, backend: Backend) -> None:
        self._agent, self.backend = agent, backend
        self.name = agent.card.name
        self._reads_letters = "readout" in agent.can.answer_modes
        self.sees = agent.card.vision is not None
        self._numbers = count()  # of requests, which several threads make
        self._started_s = int(time.time())
        self._digest = digest({**backend.identity(), "letters": agent.letters})

    def listed(self) -> dict[str, Any]:
        """Return the model's entry in the response of `GET /v1/models`, as values for JSON."""
        reads = ["text", *(["image"] if self.sees else [])]
        return {
            "id": self.name,
            "object": "model",
            "created": self._started_s,
            "owned_by": "swarmdrive-harness",
            "architecture": {"input_modalities": reads, "output_modalities": ["decisions"]},
            "meta": {"digest": self._digest},
        }

    def requests(self, enquiry: Enquiry) -> list[Request]:
        """Return a request to the model for each question of a client, in their order.

        `enquiry` has the questions, about one state. Raises Refusal if it asks for another model,
        or for what this one cannot take, such as pictures.
        """
        if enquiry.model not in (None, ANY, self.name):
            raise Refusal(
                f"there is no model {printable(enquiry.model)!r}; ask for "
                f"{printable(self.name)!r}, or for "
                f"{ANY!r}",
                code="model_not_found",
            )
        if enquiry.images and not self.sees:
            raise Refusal(
                f"{printable(self.name)} reads texts alone; leave pictures out", code="picture"
            )
        if len(enquiry.images) > 1:
            raise Refusal(f"{len(enquiry.images)} pictures; give one", code="picture")
        image = picture(enquiry.images[0]) if enquiry.images else None
        questions = enumerate(enquiry.questions, 1)
        return [self._request(number, each, image) for number, each in questions]

    def _request(self, number: int, query: Asked, image: Image | None) -> Request:
        """Return the question of a number, from 1, as a request, with a picture if there is one.

        Raises Refusal if it has too many options, or is too long.
        """
        if self._reads_letters and len(query.options) > len(LETTERS):
            which = number if query.name is None else repr(printable(query.name, 40))
            raise Refusal(
                f"question {which} has {len(query.options)} options; "
                f"{printable(self.name)} answers by a letter each, and takes {len(LETTERS)} at "
                "most",
                code="options",
            )
        if query.length > MOST_CHARACTERS:  # before each order of the letters has a copy
            raise Refusal(
                f"a question and its state have {query.length} characters; give {MOST_CHARACTERS} "
                "at most",
                code="context_length_exceeded",
            )
        turn = {"role": "user", "image": "camera"} if image else {"role": "user"}
        chats = self._agent.in_orders(
            query.options, lambda order: decision.letter_chat(query.question, (turn,), order)
        )
        blank = self._agent.blank("ego", query.options)
        return blank.alike(
            id=f"{next(self._numbers)}/asked", question=query.question, image=image, **chats
        )
