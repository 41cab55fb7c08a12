"""Average a read-out over cyclic orders of its letters, and say how much of it follows the letter.

Small models prefer a letter, or a place in the list, whatever action it stands for. Over as many
cyclic orders as there are actions, each action has each letter once: the mean of an action's
log-probabilities holds every letter's preference equally, so that it cancels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from harness.core.arrays import Floats
from harness.prompts.readout import answer_json

LEAST_P = 1e-9  # a letter to which a server's list leaves nothing


@dataclass(frozen=True)
class AveragedReadOut:
    """Hold an answer made of letters' probabilities, averaged over orders of the action list.

    In a read-out the model is asked for one letter, which stands for an action of the list. `text`
    is the answer, `label_mass` the letters' total probability, averaged over the orders, and
    `letter_share`, from 0 to 1, how much of the probabilities goes with the letter and not the
    action. `follows_letter` says that one letter is the likeliest in every order.
    """

    text: str  # the answer
    label_mass: float  # total probability of the letters, the mean over the orders
    # share of the variance of the log-probabilities, over actions and orders, that goes with the
    # letter and not with the action; 0 if there is no variance
    letter_share: float
    follows_letter: bool  # whether one letter is the likeliest in every order


def average_orders(actions: Sequence[str], letters_p: Sequence[Sequence[float]]) -> AveragedReadOut:
    """Average a read-out, in which letters stand for A actions, over cyclic orders of the actions.

    `letters_p`, `(orders, A)`, has in row s the probabilities of the A letters when the list of
    actions begins with action s of `actions` and goes round. Over all orders each action has each
    letter once, so that a model's liking of a letter cancels.
    """
    p: Floats = np.array(letters_p, dtype=float)
    mass = p.sum(axis=1)
    log_p = np.log(np.maximum(p / mass[:, None], LEAST_P))
    # In the order that begins with action s, letter l stands for action l + s.
    by_action = np.stack([np.roll(row, start) for start, row in enumerate(log_p)])
    mean = by_action.mean(axis=0)
    weights = np.exp(mean - mean.max())
    within = log_p - log_p.mean(axis=1, keepdims=True)
    total = float((within**2).sum())
    of_letter = len(p) * float((within.mean(axis=0) ** 2).sum())
    return AveragedReadOut(
        text=answer_json(actions, weights.tolist()),
        label_mass=min(1.0, float(mass.mean())),
        letter_share=round(min(1.0, of_letter / total), 6) if total > 0 else 0.0,
        follows_letter=len(set(log_p.argmax(axis=1).tolist())) == 1,
    )
