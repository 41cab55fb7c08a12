"""The three answer modes, implemented once for all engines.

`json`: the model writes freely. `constrained`: it fills in the skeleton of the answer. `readout`: it is asked
for one letter, and the letters' probabilities are the answer.
"""

import math
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace

from harness.backends.base import FinishReason, Request, per_token_s
from harness.backends.drafts import Drafts
from harness.backends.engine import Engine, Session, common_length
from harness.backends.orders import averaged
from harness.backends.sampling import Choice
from harness.backends.skeleton import Filled, Skeleton, filled, tokens_after
from harness.core.errors import UserError, printable
from harness.prompts.answer_schema import Shape
from harness.prompts.readout import letters, stated


@dataclass(frozen=True)
class Answer:
    """A model's answer to one prompt.

    Attributes:
        text: the answer without the stop token.
        tokens: number of written tokens, with the fixed ones of a skeleton and the stop token.
        finish_reason: `stop` or `length`.
        label_mass: total probability of the letters in a read-out.
        seconds: time of an answer that was asked alone; None in a batch, as are the next two.
        first_token_s: time until its first token was chosen; for a read-out, until it was complete.
        token_s: time for each token chosen after the first (`per_token_s`).
        letter_share: how much of a read-out over several orders follows the letter; None otherwise, like the
            next.
        follows_letter: whether one letter is the likeliest in every order.
    """

    text: str
    tokens: int
    finish_reason: FinishReason
    label_mass: float | None = None
    seconds: float | None = None
    first_token_s: float | None = None
    token_s: float | None = None
    letter_share: float | None = None
    follows_letter: bool | None = None


class Decoding:
    """Answers requests with one engine."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._chat = engine.chat
        self._skeletons: dict[Shape, Skeleton] = {}
        self._letters: dict[tuple[str, ...], list[list[int]]] = {}

    def room(self, request: Request) -> int:
        """Return the most tokens that the answer can take after the prompt.

        Raises:
            UserError: the tokenizer or the request's `max_tokens` leaves no room for this answer mode.
        """
        if request.answer == "constrained":
            return self._skeleton(request).most_tokens
        if request.answer == "readout":
            self._letter_tokens(request.actions)
            return 1
        return request.max_tokens

    def answer(
        self, requests: Sequence[Request], prompts: Sequence[Sequence[int]],
        further: Sequence[Sequence[list[int]]] = (),
    ) -> list[Answer]:  # fmt: skip
        """Return one answer for each request, in order.

        Args:
            requests: requests of one answer mode, for each of which there is `room`.
            prompts: their rendered messages, in tokens.
            further: of a read-out over several orders, those of each request's other orders, equally many.
        """
        start_s = time.perf_counter()
        choice = Choice(requests, prompts)
        if requests[0].answer == "readout":
            answers = self._read_out(requests, prompts, further)
        else:
            mode = self._free if requests[0].answer == "json" else self._constrained
            with closing(self._engine.begin(prompts)) as session:
                answers = mode(session, requests, choice)
        end_s = time.perf_counter()
        if len(answers) > 1:
            return answers
        seconds, first_s = end_s - start_s, (choice.first_at_s or end_s) - start_s
        token_s = per_token_s(seconds, first_s, choice.rounds)
        return [replace(answers[0], seconds=seconds, first_token_s=first_s, token_s=token_s)]

    def _free(self, session: Session, requests: Sequence[Request], choice: Choice) -> list[Answer]:
        written: list[list[int]] = [[] for _ in requests]
        # An answer that is asked alone is timed, token by token.
        drafts = self._drafts(requests) if len(requests) > 1 and not choice.draws else None
        live = list(range(len(requests)))
        while live:
            for i, token in zip(live, choice.next(session, live, [None] * len(live)), strict=True):
                written[i].append(token)
            live = _narrow(session, live, [not self._over(written[i], requests[i]) for i in live])
            if live and drafts:
                self._follow(session, drafts, {i: (requests[i], written[i]) for i in live})
            elif live:
                session.advance([written[i][-1:] for i in live])
        return [self._ended(tokens) for tokens in written]

    def _drafts(self, requests: Sequence[Request]) -> Drafts:
        """Return guesses that know the fixed text of what each kind of request asks for."""
        drafts = Drafts(self._chat)
        for shape in {request.shape for request in requests}:
            for option in (0, -1):  # two fillings, so that what differs is not guessed
                tokens = tokens_after(self._chat, "\n", filled(shape, option))
                for end in range(1, len(tokens) + 1):
                    drafts.learn(shape, tokens[:end])
        return drafts

    def _follow(
        self, session: Session, drafts: Drafts, written: dict[int, tuple[Request, list[int]]]
    ) -> None:
        """Append the last token of each answer to the session, and to both what is guessed rightly."""
        guesses = []
        for request, tokens in written.values():
            drafts.learn(request.shape, tokens)
            guesses.append(drafts.after(request.shape, tokens, request.max_tokens - len(tokens) - 1))
        width = sorted(map(len, guesses))[len(guesses) // 2]  # no wider than half of the answers fill
        guesses = [guess[:width] for guess in guesses]
        counts = session.follow([tokens[-1:] for _, tokens in written.values()], guesses)
        for (_, tokens), guess, count in zip(written.values(), guesses, counts, strict=True):
            tokens += guess[:count]

    def _over(self, tokens: list[int], request: Request) -> bool:
        return tokens[-1] in self._engine.stops or len(tokens) == request.max_tokens

    def _ended(self, tokens: list[int]) -> Answer:
        if tokens[-1] in self._engine.stops:
            return Answer(self._chat.decode(tokens[:-1]), len(tokens), "stop")
        return Answer(self._chat.decode(tokens), len(tokens), "length")

    def _constrained(self, session: Session, requests: Sequence[Request], choice: Choice) -> list[Answer]:
        walks = [self._skeleton(request).walk() for request in requests]
        asks = [next(walk) for walk in walks]
        done: dict[int, Filled] = {}
        live = list(range(len(requests)))
        while live:
            session.advance([asks[i].forced for i in live])
            among = [asks[i].among for i in live]
            for i, token in zip(live, choice.next(session, live, among), strict=True):
                try:
                    asks[i] = walks[i].send(token)
                except StopIteration as end:
                    done[i] = end.value
            live = _narrow(session, live, [i not in done for i in live])
        return [Answer(done[i].text, done[i].tokens, "stop") for i in range(len(requests))]

    def _skeleton(self, request: Request) -> Skeleton:
        shape = request.shape
        if shape not in self._skeletons:
            self._skeletons[shape] = Skeleton(self._chat, shape)
        skeleton = self._skeletons[shape]
        if skeleton.most_tokens > request.max_tokens:
            raise UserError(
                f"model {printable(self._chat.name)!r}: a constrained {request.role} answer takes "
                f"{skeleton.most_tokens} tokens, and {request.max_tokens} are allowed; raise max_new_tokens"
            )
        return skeleton

    def _read_out(
        self, requests: Sequence[Request], prompts: Sequence[Sequence[int]],
        further: Sequence[Sequence[list[int]]],
    ) -> list[Answer]:  # fmt: skip
        # Requests may have different numbers of actions: each column stands for one letter's token.
        spellings = {r.actions: self._letter_tokens(r.actions) for r in requests}
        tokens = sorted({token for of in spellings.values() for tokens in of for token in tokens})
        column = {token: j for j, token in enumerate(tokens)}
        others = further or [()] * len(prompts)
        orders = [[list(prompt), *rest] for prompt, rest in zip(prompts, others, strict=True)]
        if len(orders[0]) == 1:
            with closing(self._engine.begin(prompts, tokens)) as session:
                readings = session.log_probs(tokens)[:, None]
        else:  # what all orders of a question begin with is read once, and then the rest of each
            shared = [common_length(of) for of in orders]
            heads = [of[0][:length] for of, length in zip(orders, shared, strict=True)]
            with closing(self._engine.begin(heads, tokens)) as session:
                rests = [[ids[length:] for ids in of] for of, length in zip(orders, shared, strict=True)]
                readings = session.ends(rests, tokens)
        answers = []
        for i, request in enumerate(requests):
            log_p = [
                [[float(reading[column[token]]) for token in of] for of in spellings[request.actions]]
                for reading in readings[i]
            ]
            answers.append(_read(request.actions, log_p))
        return answers

    def _letter_tokens(self, actions: tuple[str, ...]) -> list[list[int]]:
        """Return the tokens of each letter, in all its spellings: with a blank before it, and without."""
        if actions not in self._letters:
            encodings = [tokens_after(self._chat, "\n", letter) for letter in letters(actions)]
            if any(len(tokens) != 1 for tokens in encodings) or len(set(encodings)) < len(encodings):
                raise UserError(
                    f"model {printable(self._chat.name)!r}: its tokenizer has no single token for each of "
                    f"the letters {letters(actions)}; use --answer json"
                )
            known = self._chat.spellings(letters(actions))
            self._letters[actions] = [
                sorted({token, *known[letter]})
                for (token,), letter in zip(encodings, letters(actions), strict=True)
            ]
        return self._letters[actions]


def _read(actions: Sequence[str], log_p: Sequence[Sequence[Sequence[float]]]) -> Answer:
    """Return a read-out as an answer, from the log-probabilities of each letter's tokens in each order."""
    if len(log_p) > 1:
        p = [[math.fsum(map(math.exp, of)) for of in letters_log_p] for letters_log_p in log_p]
        return Answer(tokens=1, finish_reason="stop", **asdict(averaged(actions, p)))
    largest = max(map(max, log_p[0]))
    weights = [math.fsum(math.exp(x - largest) for x in of) for of in log_p[0]]
    return Answer(stated(actions, weights), 1, "stop", min(1.0, math.exp(largest) * sum(weights)))


def _narrow(session: Session, live: list[int], unfinished: list[bool]) -> list[int]:
    """Drop finished sequences from the session, and return the unfinished ones."""
    places = [place for place, continues in enumerate(unfinished) if continues]
    if 0 < len(places) < len(live):
        session.keep(places)
    return [live[place] for place in places]
