"""Say of a language model what it answers most often,
and how much that moves with what it is shown.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from harness.backends.registry import ENGINES
from harness.coordination.coordinate import TIE
from harness.runs.folder import Run
from harness.world.drivers import ALWAYS

LEAST = 20  # answers that say something about a model
CONSTANT = 0.98  # share of the likeliest action from which a model is said to ignore its input
DRIVERS = {action: driver for driver, action in ALWAYS.items()}


@dataclass(frozen=True)
class Commonest:
    """Hold which likeliest action comes most often among an ego's answers (`commonest`).

    `actions` has its name, or several that are equally likely. It is so in `count` of `n` readable
    answers, and `all_read` says that there are no others. `moves` is the standard deviation of its
    probability over them, near 0 if the model answers alike whatever it is shown.
    """

    # the likeliest action of these answers; several where they are equally likely
    actions: Sequence[str]
    count: int  # in how many readable answers
    n: int  # how many are readable
    moves: float  # standard deviation of the action's probability over all readable answers
    all_read: bool  # whether every answer could be read

    @property
    def likeliest(self) -> str:
        if len(self.actions) == 1:
            return f"{self.actions[0]} is the likeliest action"
        return f"{', '.join(self.actions)} are equally likely"

    @property
    def constant(self) -> bool:
        return self.count >= CONSTANT * self.n


def commonest(run: Run) -> Commonest | None:
    """Return which likeliest action a language model's ego answers most often in a run.

    None if the ego's engine, what runs the model, is no language model's, or fewer than `LEAST`
    answers are readable.
    """
    engine = ENGINES.get(run.manifest.model["engine"])
    if engine is None or not engine.capabilities.language_model:
        return None
    p = run.answered.ego
    if len(p) < LEAST:
        return None
    likeliest = p >= p.max(axis=1, keepdims=True) - TIE
    [(places, count)] = Counter(map(tuple, likeliest.tolist())).most_common(1)
    actions = [action for action, likely in zip(run.actions, places, strict=True) if likely]
    moves = float(p[:, places.index(True)].std())
    return Commonest(actions, count, len(p), moves, len(p) == run.answered.count["ego"])


def ignores_input(run: Run) -> Iterator[str]:
    """Yield a warning if the ego's answers nearly always have the same likeliest action.

    It is so from a share of `CONSTANT` of the readable answers on.
    """
    common = commonest(run)
    if common and common.constant:
        like = f" Without messages it drives as {_like(run, common)}." if common.all_read else ""
        yield (
            f"The model ignores its input: {common.likeliest} in {common.count} of the ego's "
            f"{common.n} readable answers, and its probability moves by {common.moves:.3f} "
            f"(standard deviation) between them.{like}"
        )


def _like(run: Run, common: Commonest) -> str:
    taken = common.actions[:1] if run.manifest.settings.ties == "first" else common.actions
    if len(taken) == len(run.actions):
        return "the driver `uniform`, which needs no model"
    if len(taken) > 1:
        return f"one that takes {' or '.join(taken)} by chance"
    if driver := DRIVERS.get(taken[0]):
        return f"the driver `{driver}`, which needs no model"
    return f"one that always takes {taken[0]}"


def in_a_line(run: Run) -> Iterator[str]:
    """Yield a line on which likeliest action a language model's ego answers most often.

    It yields none if the answers are nearly all alike, of which `ignores_input` warns.
    """
    common = commonest(run)
    if common and not common.constant:
        yield (
            f"ego answers: {common.likeliest} in {100 * common.count / common.n:.0f} % of "
            f"{common.n}; its probability moves by {common.moves:.2f} (standard deviation)"
        )


def tile(run: Run) -> list[dict[str, str]]:
    """Return a key figure for the page's top: how often the ego's commonest likeliest action comes.

    An entry has `what`, `value`, `interval` and `n` as text; the list is empty if the ego is no
    language model, or few of its answers are readable.
    """
    common = commonest(run)
    if common is None:
        return []
    figure = {
        "what": f"ego's answers in which {common.likeliest}",
        "value": f"{100 * common.count / common.n:.0f} %",
        "interval": f"its probability moves by {common.moves:.2f}",
        "n": f"n = {common.n} readable answers",
    }
    return [figure]
