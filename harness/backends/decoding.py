"""The three answer modes, each written once, over any engine.

`json`: the model writes freely. `constrained`: it fills in the skeleton of the answer. `readout`: it is asked
for one letter, and the letters' probabilities are the answer.
"""

import math
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace

from harness.backends.base import FinishReason, Request, per_token_s
from harness.backends.engine import Engine, Session
from harness.backends.sampling import Choice
from harness.backends.skeleton import Skeleton, finished, tokens_after
from harness.core.errors import UserError, printable
from harness.prompts.readout import letters, stated


@dataclass(frozen=True)
class Answer:
    """What a model said to one prompt.

    Attributes:
        text: without the stop token.
        tokens: how many were written, the fixed ones of a skeleton and the stop token included.
        finish_reason: `stop` or `length`.
        label_mass: probability on the letters together, of a read-out.
        seconds: of an answer alone, as are the next two; None in a batch.
        first_token_s: until its first token was chosen; of a read-out, until it was there.
        token_s: for each token chosen after the first (`per_token_s`).
    """

    text: str
    tokens: int
    finish_reason: FinishReason
    label_mass: float | None = None
    seconds: float | None = None
    first_token_s: float | None = None
    token_s: float | None = None


class Decoding:
    """Answers of one engine."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._chat = engine.chat
        self._skeletons: dict[tuple[str, str, tuple[str, ...]], Skeleton] = {}
        self._letters: dict[tuple[str, ...], list[int]] = {}

    def room(self, request: Request) -> int:
        """Most tokens that the answer takes behind the prompt.

        Raises:
            UserError: the tokenizer or the request's `max_tokens` leaves no room for this answer mode.
        """
        if request.answer == "constrained":
            return self._skeleton(request).most_tokens
        if request.answer == "readout":
            self._letter_tokens(request.actions)
            return 1
        return request.max_tokens

    def answer(self, requests: Sequence[Request], prompts: Sequence[Sequence[int]]) -> list[Answer]:
        """One answer a request, in order.

        Args:
            requests: all to be answered the same way, and `room` was there for each.
            prompts: their rendered messages, in tokens.
        """
        start_s = time.perf_counter()
        choice = Choice(requests, prompts)
        with closing(self._engine.begin(prompts)) as session:
            if requests[0].answer == "readout":
                answers = self._read_out(session, requests)
            else:
                way = self._free if requests[0].answer == "json" else self._constrained
                answers = way(session, requests, choice)
        end_s = time.perf_counter()
        if len(answers) > 1:
            return answers
        seconds, first_s = end_s - start_s, (choice.first_at_s or end_s) - start_s
        token_s = per_token_s(seconds, first_s, choice.rounds)
        return [replace(answers[0], seconds=seconds, first_token_s=first_s, token_s=token_s)]

    def _free(self, session: Session, requests: Sequence[Request], choice: Choice) -> list[Answer]:
        said: list[list[int]] = [[] for _ in requests]
        live = list(range(len(requests)))
        while live:
            for i, token in zip(live, choice.next(session, live, [None] * len(live)), strict=True):
                said[i].append(token)
            live = _narrow(session, live, [not self._over(said[i], requests[i]) for i in live])
            if live:
                session.advance([said[i][-1:] for i in live])
        return [self._ended(tokens) for tokens in said]

    def _over(self, said: list[int], request: Request) -> bool:
        return said[-1] in self._engine.stops or len(said) == request.max_tokens

    def _ended(self, said: list[int]) -> Answer:
        if said[-1] in self._engine.stops:
            return Answer(self._chat.decode(said[:-1]), len(said), "stop")
        return Answer(self._chat.decode(said), len(said), "length")

    def _constrained(self, session: Session, requests: Sequence[Request], choice: Choice) -> list[Answer]:
        walks = [self._skeleton(request).walk() for request in requests]
        asks = [next(walk) for walk in walks]
        chosen: dict[int, list[int]] = {}
        live = list(range(len(requests)))
        while live:
            session.advance([asks[i].forced for i in live])
            among = [asks[i].among for i in live]
            for i, token in zip(live, choice.next(session, live, among), strict=True):
                try:
                    asks[i] = walks[i].send(token)
                except StopIteration as end:
                    chosen[i] = end.value
            live = _narrow(session, live, [i not in chosen for i in live])
        return [
            Answer(finished(r.role, r.form, r.actions, chosen[i]), self._skeleton(r).count(chosen[i]), "stop")
            for i, r in enumerate(requests)
        ]

    def _skeleton(self, request: Request) -> Skeleton:
        key = (request.role, request.form, request.actions)
        if key not in self._skeletons:
            self._skeletons[key] = Skeleton(self._chat, *key)
        skeleton = self._skeletons[key]
        if skeleton.most_tokens > request.max_tokens:
            raise UserError(
                f"model {printable(self._chat.name)!r}: a constrained {request.role} answer takes "
                f"{skeleton.most_tokens} tokens, and {request.max_tokens} are allowed; raise max_new_tokens"
            )
        return skeleton

    def _read_out(self, session: Session, requests: Sequence[Request]) -> list[Answer]:
        # Rows may have more or fewer actions: each column stands for one letter's token.
        every = sorted({token for r in requests for token in self._letter_tokens(r.actions)})
        column = {token: j for j, token in enumerate(every)}
        answers = []
        for request, row in zip(requests, session.log_probs(every), strict=True):
            logs = [float(row[column[token]]) for token in self._letter_tokens(request.actions)]
            most = max(logs)
            weights = [math.exp(x - most) for x in logs]
            text = stated(request.actions, weights)
            answers.append(Answer(text, 1, "stop", min(1.0, math.exp(most) * sum(weights))))
        return answers

    def _letter_tokens(self, actions: tuple[str, ...]) -> list[int]:
        if actions not in self._letters:
            found = [tokens_after(self._chat, "\n", letter) for letter in letters(actions)]
            if any(len(tokens) != 1 for tokens in found) or len(set(found)) < len(found):
                raise UserError(
                    f"model {printable(self._chat.name)!r}: its tokenizer has no single token for each of "
                    f"the letters {letters(actions)}; use --answer json"
                )
            self._letters[actions] = [token for (token,) in found]
        return self._letters[actions]


def _narrow(session: Session, live: list[int], going: list[bool]) -> list[int]:
    """Let the sequences that are done leave the session; those that go on."""
    places = [place for place, goes_on in enumerate(going) if goes_on]
    if 0 < len(places) < len(live):
        session.keep(places)
    return [live[place] for place in places]
