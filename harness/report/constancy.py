"""Say of a language model that its answers are the same whatever it is shown."""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from harness.backends.registry import find
from harness.runs.folder import Run

LEAST = 20  # answers that say something about a model
CONSTANT = 0.98  # share of the likeliest action from which a model is said to ignore its input
DRIVERS = {"SLOWER": "brake", "IDLE": "cruise"}  # reference drivers that always take one action


def ignores_input(run: Run) -> Iterator[str]:
    """Yield the sentence on an ego whose likeliest action is nearly always the same one.

    It is said of language models with `LEAST` readable ego answers or more, where one action is the likeliest
    in a share of `CONSTANT` of them. The standard deviation is that of its probability over these answers.
    """
    engine = find(run.manifest.model["engine"])
    if engine is None or not engine.capabilities.language_model:
        return
    answers = [answer for answer in run.answers if answer.role == "ego" and answer.error is None]
    intents = [answer.intent for answer in answers if answer.intent]
    if len(intents) < LEAST:
        return
    p = np.array(intents)
    [(place, count)] = Counter(p.argmax(axis=1).tolist()).most_common(1)
    if count < CONSTANT * len(intents):
        return
    action = run.actions[place]
    said = ""
    if len(intents) == len(answers):
        driver = DRIVERS.get(action)
        like = f"`{driver}`, which needs no model" if driver else f"one that always takes {action}"
        said = f" Without messages it drives as the driver {like}."
    yield (
        f"The model ignores its input: {action} is the likeliest action in {count} of the ego's "
        f"{len(intents)} readable answers, and its probability moves by {p[:, place].std():.3f} (standard "
        f"deviation) between them.{said}"
    )
