"""The answer modes, implemented once for all engines.

`json`: the model writes freely. `constrained`: it fills in the skeleton of the answer. `readout`
and `decision`: it is asked for one letter, and the letters' probabilities are the answer.
"""

import math
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, replace
from itertools import chain
from typing import Any

import numpy as np

from harness.backends.base import Completion, FinishReason, Request, per_token_s
from harness.backends.drafts import Drafts
from harness.backends.engine import Engine, Session, common_length
from harness.backends.orders import average_orders
from harness.backends.skeleton import Filled, Skeleton, filled, tokens_after
from harness.core import noise
from harness.core.arrays import Floats
from harness.core.errors import UserError
from harness.prompts.answer_schema import Shape
from harness.prompts.readout import answer_json, letters


class Choice:
    """Choose the next tokens of a batch of answers: the likeliest, or drawn at a temperature.

    Draws are keyed by the prompt's tokens and the request's `sample`, the answer's number among
    several to one question, so other requests, their order and a resume change none.
    """

    def __init__(self, requests: Sequence[Request], prompts: Sequence[Sequence[int]]) -> None:
        # when the first token was chosen, by `time.perf_counter`
        self.first_at_s: float | None = None
        # calls of `next`: the number of chosen tokens of an answer that is asked alone
        self.rounds = 0
        # temperature and generator of each request whose answer is drawn, by its place
        self._drawn: dict[int, tuple[float, np.random.Generator]] = {}
        for place, (request, ids) in enumerate(zip(requests, prompts, strict=True)):
            if request.temperature:
                generator = noise.generator("answer", tuple(ids), request.sample)
                self._drawn[place] = request.temperature, generator
        self.draws = bool(self._drawn)  # whether any token is drawn and not just the likeliest

    def next(
        self, session: Session, places: Sequence[int], among: Sequence[Sequence[int] | None]
    ) -> list[int]:
        """Return the chosen next token id of each of n sequences of a session, in its order.

        `places` has, for each sequence, the index of its request in the batch; `among` the token
        ids to choose from, None for the whole vocabulary.
        """
        chosen = session.argmax(among)
        if self._drawn:
            log_p = session.log_probs()
            for row, (place, tokens) in enumerate(zip(places, among, strict=True)):
                if place in self._drawn:
                    temperature, generator = self._drawn[place]
                    chosen[row] = drawn(log_p[row], tokens, temperature, generator.random())
        if not self.rounds:
            self.first_at_s = time.perf_counter()
        self.rounds += 1
        return chosen


class Decoding:
    """Answer requests in all answer modes (free text, constrained, letters) with one engine.

    The engine only reads tokens and gives the probabilities of the next ones.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._chat = engine.chat
        self._skeletons: dict[Shape, Skeleton] = {}
        self._letters: dict[str, list[list[int]]] = {}

    def room(self, request: Request) -> int:
        """Return the most tokens that the answer to a request can take, to see whether it fits.

        The tokens of the prompt are not counted, which share the context with it. Raises UserError
        if the tokenizer or `max_tokens` leaves no room for this answer mode (free text,
        constrained, or letters).
        """
        if request.answer == "constrained":
            return self._skeleton(request).most_tokens
        if request.bare:
            self._letter_tokens(request.actions)
            return 1
        return request.max_tokens

    def answer(
        self, requests: Sequence[Request], orders: Sequence[Sequence[list[int]]]
    ) -> list[Completion]:
        """Return the answers to a batch of requests of one answer mode.

        They have no prompt token counts. `orders` has, for each request, the token ids of its
        prompt: one prompt, or for a read-out (an answer by letters' probabilities) one for each
        order of the actions in its list, equally many for all. A single request is timed. The first
        token of a read-out comes when it is complete.
        """
        start_s = time.perf_counter()
        prompts = [prompt for prompt, *_ in orders]
        choice = Choice(requests, prompts)
        if requests[0].bare:
            answers = self._read_out(requests, orders)
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

    def _free(
        self, session: Session, requests: Sequence[Request], choice: Choice
    ) -> list[Completion]:
        """Return answers that the model writes freely."""
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
        completions = []
        for request, tokens in zip(requests, written, strict=True):
            stopped = tokens[-1] in self._engine.stops
            text = self._chat.decode(tokens[:-1] if stopped else tokens)
            reason: FinishReason = "stop" if stopped else "length"
            completions.append(_completion(request, text, len(tokens), len(requests), reason))
        return completions

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
        """Append the last token of each answer to the session,
        and to both what is guessed rightly.
        """
        guesses = []
        for request, tokens in written.values():
            drafts.learn(request.shape, tokens)
            most = request.max_tokens - len(tokens) - 1
            guesses.append(drafts.after(request.shape, tokens, most))
        # no wider than half of the answers fill
        widths = sorted(len(guess) for guess in guesses)
        width = widths[len(widths) // 2]
        guesses = [guess[:width] for guess in guesses]
        counts = session.follow([tokens[-1:] for _, tokens in written.values()], guesses)
        for (_, tokens), guess, count in zip(written.values(), guesses, counts, strict=True):
            tokens += guess[:count]

    def _over(self, tokens: list[int], request: Request) -> bool:
        return tokens[-1] in self._engine.stops or len(tokens) == request.max_tokens

    def _constrained(
        self, session: Session, requests: Sequence[Request], choice: Choice
    ) -> list[Completion]:
        """Return answers that fill in the skeletons of what is asked for."""
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
        return [_completion(r, *done[i], len(requests)) for i, r in enumerate(requests)]

    def _skeleton(self, request: Request) -> Skeleton:
        """Return the skeleton of an answer. Raises UserError if it may need too many tokens."""
        shape = request.shape
        if shape not in self._skeletons:
            self._skeletons[shape] = Skeleton(self._chat, shape)
        skeleton = self._skeletons[shape]
        if skeleton.most_tokens > request.max_tokens:
            raise UserError(
                f"{self._chat.subject}: a constrained {request.role} answer takes "
                f"{skeleton.most_tokens} tokens, and {request.max_tokens} are allowed; raise "
                "max_new_tokens"
            )
        return skeleton

    def _read_out(
        self, requests: Sequence[Request], orders: Sequence[Sequence[list[int]]]
    ) -> list[Completion]:
        """Return the probabilities of each request's letters, each order read by itself."""
        # Requests may have different numbers of actions: each column stands for one letter's token.
        spellings = {r.actions: self._letter_tokens(r.actions) for r in requests}
        of_letters = chain.from_iterable(spellings.values())
        tokens = sorted(set(chain.from_iterable(of_letters)))
        column_of = {token: column for column, token in enumerate(tokens)}
        if len(orders[0]) == 1:
            with closing(self._engine.begin([prompt for [prompt] in orders], tokens)) as session:
                readings = session.log_probs(tokens)[:, None]
        else:  # what all orders of a question begin with is read once, and then the rest of each
            heads, rests = list[list[int]](), list[list[list[int]]]()
            for prompts in orders:
                length = common_length(prompts)
                heads.append(prompts[0][:length])
                rests.append([ids[length:] for ids in prompts])
            with closing(self._engine.begin(heads, tokens)) as session:
                readings = session.ends(rests, tokens)
        completions = []
        for request, rows in zip(requests, readings, strict=True):
            log_p: list[list[list[float]]] = [[] for _ in rows]
            for spelling in spellings[request.actions]:
                columns = [column_of[token] for token in spelling]
                for of_order, row in zip(log_p, rows, strict=True):
                    of_order.append(row[columns].tolist())
            completions.append(_completion_of_letters(request, len(requests), log_p))
        return completions

    def _letter_tokens(self, actions: tuple[str, ...]) -> list[list[int]]:
        """Return the tokens of each letter, in all its spellings:
        with a blank before it, and without.
        """
        names = letters(actions)
        if names not in self._letters:
            encodings = [tokens_after(self._chat, "\n", letter) for letter in names]
            single = all(len(tokens) == 1 for tokens in encodings)
            if not single or len(set(encodings)) < len(encodings):
                raise UserError(
                    f"{self._chat.subject}: its tokenizer has no single token for each of "
                    f"the letters {names}; use --answer json"
                )
            spellings = self._chat.spellings(names)
            tokens_of_letters = []
            for (token,), letter in zip(encodings, names, strict=True):
                tokens_of_letters.append(sorted({token, *spellings[letter]}))
            self._letters[names] = tokens_of_letters
        return self._letters[names]


def _completion(
    request: Request,
    text: str,
    tokens: int,
    batch_size: int,
    reason: FinishReason = "stop",
    **details: Any,
) -> Completion:
    return Completion(request.id, text, None, tokens, reason, None, batch_size, **details)


def _completion_of_letters(
    request: Request, batch_size: int, log_p: Sequence[Sequence[Sequence[float]]]
) -> Completion:
    """Return a read-out, from the log-probabilities of each letter's tokens in each order."""
    if len(log_p) > 1:
        p = [_letter_weights(of_letters) for of_letters in log_p]
        average = asdict(average_orders(request.actions, p))
        return _completion(request, tokens=1, batch_size=batch_size, **average)
    [of_letters] = log_p
    largest = max(max(of_tokens) for of_tokens in of_letters)
    weights = _letter_weights(of_letters, largest)
    mass = min(1.0, math.exp(largest) * sum(weights))
    return _completion(
        request, answer_json(request.actions, weights), 1, batch_size, label_mass=mass
    )


def _letter_weights(log_p: Sequence[Sequence[float]], scale_log_p: float = 0.0) -> list[float]:
    """Return the probability of each letter, the sum over its tokens, divided by a scale."""
    weights = []
    for of_tokens in log_p:
        weights.append(math.fsum(math.exp(value - scale_log_p) for value in of_tokens))
    return weights


def _narrow(session: Session, live: list[int], unfinished: list[bool]) -> list[int]:
    """Drop finished sequences from the session, and return the unfinished ones."""
    places = [place for place, continues in enumerate(unfinished) if continues]
    if 0 < len(places) < len(live):
        session.keep(places)
    return [live[place] for place in places]


def drawn(log_p: Floats, among: Sequence[int] | None, temperature: float, u: float) -> int:
    """Return a token id drawn from softmax(log_p / temperature) over the ids in `among`.

    `log_p`, `(vocabulary,)`, has the log-probability of each token id; `among` None takes all ids.
    `u` is the uniform draw, in [0, 1), that decides. The temperature is above 0.
    """
    tokens = np.arange(len(log_p)) if among is None else np.unique(among)
    with np.errstate(over="ignore"):  # a token far below the likeliest gets probability 0
        ends = np.exp((log_p[tokens] - log_p[tokens].max()) / temperature).cumsum()
    # rounding may take a draw beyond the last possible token
    last = np.searchsorted(ends, ends[-1])
    return int(tokens[min(np.searchsorted(ends, u * ends[-1], side="right"), last)])
