"""The engines of a search: each plays candidates until it has tried all, or the budget is spent.

An engine only explores. Which candidate is best is said by `Tuning.best`.
"""

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.backends.base import Backend, Request
from harness.core.errors import Unanswered, UserError, printable
from harness.core.files import canonical_json, sha256_bytes
from harness.core.strangers import strangers
from harness.extensions.learn.optimize.candidate import Candidate, chosen, rewritten, space, systems
from harness.extensions.learn.optimize.feedback import of_course
from harness.extensions.learn.optimize.tuning import Played, Spent, Tuning
from harness.prompts.versions import Prompt
from harness.studies.study import Cells

if TYPE_CHECKING:
    from gepa.core.adapter import EvaluationBatch

Engine = Callable[[Tuning], None]
BATCH = 3  # layouts of which GEPA reads what went wrong, each time
REPLY_TOKENS = 2048  # most tokens of what the reflecting model writes
GEPA_SEED = 0
ASKED = """A driving program asks a small language model at every decision. This is the Jinja template of \
its system message:
```
<curr_param>
```
These are some of its decisions, and what each action would have been worth:

<side_info>

Write a better template of the system message. Keep what stands in {{ }} and {% %} as it is, and leave the \
form of the answer alone, which is asked for elsewhere. Write only the template, between ``` and ```."""  # noqa: E501


def alternatives(tuning: Tuning) -> None:
    """Search the best wording of a prompt, place by place, among those that its author marked.

    Each alternative wording of each marked place is played with the best of the other places, first
    on half of the layouts (start situations), and on the rest if it is not worse there. The search
    ends when a round over all places changes nothing, or raises Spent when the budget of questions
    is spent. `tuning` plays the wordings, scores them, and keeps all results.
    """
    base = tuning.base
    sizes = space(base)
    best = dict.fromkeys(sizes, 0)
    before: dict[str, int] = {}
    while before != best:
        before = dict(best)
        for name, count in sizes.items():
            for number in range(count):
                tried = {**best, name: number}
                if tried != best and _better(tuning, chosen(base, tried), chosen(base, best)):
                    best = tried


def _better(tuning: Tuning, new: Candidate, old: Candidate) -> bool:
    half = tuning.first_half
    now = tuning.rank(old)
    return tuning.score(new, half) >= tuning.score(old, half) and tuning.rank(new) > now


class Reflecting:
    """Search a better prompt with GEPA: a model reads what went wrong, and rewrites the texts.

    These are the system messages. Call it with a `Tuning`, which plays each new wording, keeps all
    results, and ends the search when the budget of questions is spent; `replies` is how often the
    rewriting model answered. Source: Agrawal and others 2025, arXiv:2507.19457, whose package runs
    the loop. All that it draws is seeded, and what the model wrote is kept, so that a stopped
    search resumes by repeating.
    """

    def __init__(
        self,
        rewriter: Callable[[str], str],
        kept: Path,
        settings: Mapping[str, Any],
        roles: Sequence[str],
    ):
        """Set up the search; `rewriter` sends a text to the rewriting model and returns its reply.

        `kept` is the file of the replies so far to a search of these `settings`; `roles` are those
        whose messages are rewritten.
        """
        self._asked, self._roles = rewriter, roles
        self._cells = Cells(kept, sha256_bytes(canonical_json(settings).encode()), computed=False)
        self.replies = 0

    def __call__(self, tuning: Tuning) -> None:
        gepa: Any = import_module("gepa")
        adapter = _Adapter(tuning)
        layouts = list(range(len(tuning.layouts)))
        system_texts = systems(tuning.base)
        with strangers("gepa"):
            gepa.optimize(
                {role: system_texts[role] for role in self._roles if role in system_texts},
                trainset=layouts,
                valset=layouts,
                adapter=adapter,
                reflection_lm=lambda prompt: self._reply(str(prompt), adapter),
                reflection_prompt_template=ASKED,
                reflection_minibatch_size=min(BATCH, len(layouts)),
                stop_callbacks=adapter.over,
                skip_perfect_score=False,
                seed=GEPA_SEED,
                logger=_Silent(),
                raise_on_exception=False,
            )
        if adapter.error and not isinstance(adapter.error, Spent):
            raise adapter.error

    def _reply(self, prompt: str, adapter: "_Adapter") -> str:
        number, self.replies = self.replies, self.replies + 1
        try:
            key = (number, sha256_bytes(prompt.encode()))
            return str(self._cells.part(key, lambda: {"text": self._asked(prompt)})["text"])
        except Exception as error:
            adapter.error = error
            raise


def asked_of(backend: Backend) -> Callable[[str], str]:
    """Return a function that sends a text to a model as one user message and returns its reply.

    `backend` runs the model. The function raises Unanswered if the model gives no reply.
    """

    def reply(prompt: str) -> str:
        request = Request(
            "reflect",
            "ego",
            ({"role": "user", "content": prompt},),
            ("SLOWER", "IDLE", "FASTER"),
            REPLY_TOKENS,
        )
        [completion] = backend.complete([request])
        if completion.error is not None:
            raise Unanswered(f"--reflect: {printable(completion.error, 300)}")
        return completion.text

    return reply


class _Silent:
    def log(self, message: str) -> None:
        """Print nothing: the command has a progress bar."""


class _Adapter:
    """What GEPA asks of a program: to play candidates, and to say what went wrong."""

    propose_new_texts = None
    IDLE = 5  # rounds in a row without a question, after which nothing new is expected

    def __init__(self, tuning: Tuning) -> None:
        self._tuning = tuning
        self.error: Exception | None = None
        self._still, self._spent = 0, -1

    def over(self, state: Any) -> bool:
        """Return whether the search is to end: it is spent or has failed, or asks nothing new.

        `state` is the `GEPAState` of the package gepa, and is not read.
        """
        self._still = self._still + 1 if self._tuning.spent == self._spent else 0
        self._spent = self._tuning.spent
        return self.error is not None or self._still > self.IDLE

    def evaluate(
        self, batch: list[int], candidate: dict[str, str], capture_traces: bool = False
    ) -> "EvaluationBatch[Any, Any]":
        from gepa.core.adapter import EvaluationBatch

        tuning = self._tuning
        try:
            played = tuning.play(rewritten(tuning.base, candidate), batch)
        except Unanswered as error:
            self.error = error
            raise
        except UserError as error:  # what the model wrote is no template
            nothing = [str(error)] * len(batch)
            return EvaluationBatch(nothing, [0.0] * len(batch), nothing if capture_traces else None)
        except Exception as error:
            self.error = error
            raise
        weights = tuning.weights(np.arange(len(tuning.layouts))) * len(tuning.layouts)
        scores = [each.score * float(weights[n]) for n, each in zip(batch, played, strict=True)]
        return EvaluationBatch(
            [each.score for each in played], scores, played if capture_traces else None
        )

    def make_reflective_dataset(
        self,
        candidate: dict[str, str],
        eval_batch: "EvaluationBatch[Any, Any]",
        components_to_update: list[str],
    ) -> Mapping[str, Sequence[Mapping[str, Any]]]:
        records = [
            _reflected(self._tuning, candidate, each) for each in eval_batch.trajectories or ()
        ]
        return dict.fromkeys(components_to_update, records)


def _reflected(tuning: Tuning, candidate: Mapping[str, str], trace: Played | str) -> dict[str, str]:
    """Return one course for the reflecting model:
    a question, its answer, and what is to be said of it.
    """
    if isinstance(trace, str):
        return {"Inputs": "", "Generated Outputs": "", "Feedback": trace}
    decision, text = of_course(trace)
    prompt: Prompt = rewritten(tuning.base, candidate).prompt
    scene = decision.scene
    graph, scenario = scene.graphs[scene.viewers[0]], scene.seat or decision.dataset.scenario
    user = prompt.render(graph, decision.dataset.actions, words=scenario.prompt_words)[-1][
        "content"
    ]
    return {"Inputs": user, "Generated Outputs": decision.raw, "Feedback": text}
