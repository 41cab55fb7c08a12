"""Fits the calibrated proxy to a few rows of the paper's numbers.

    python -m harness.extensions.paper.fit

Its mechanism can be solved for all but the helpers' entropies, which are set by hand. A witness is
heard with probability (1 - l)^2, so that success is guess + share x (know - guess) x (1 - l)^2,
where `share` is the part of the dangers that helpers watch.
"""

import numpy as np

from harness.core.quantiles import normal_quantile
from harness.extensions.paper.calibrated import CUT, FITTED_ON, Parameters
from harness.radio.constant import density_coupled_loss
from harness.studies.paper_numbers import paper_numbers


def fit() -> Parameters:
    """Compute the parameters of the proxy, a rule that answers in place of the paper's models.

    They follow in closed form from results of the SwarmDrive paper, the rows of `paper_numbers.csv`
    that `FITTED_ON` names; KeyError if one of these is missing.
    """
    paper = {row["id"]: row for row in paper_numbers()}
    value = {
        key: float(row["paper_value"]) / 100 for key, row in paper.items() if row["paper_value"]
    }
    guess, know = value["A3"], value["B9"]
    heard_of_two, heard_of_three = (1 - density_coupled_loss(np.array([2, 3]))) ** 2
    left = (value["B2"] - guess) / ((know - guess) * heard_of_two)
    both = (value["B3"] - guess) / ((know - guess) * heard_of_three)
    # Of the ego's decisions 67.6 % are above 0.8 nats, and all are above 0.7.
    above = float(normal_quantile(value["B18"]))
    sd = (0.8 - 0.7) / (CUT - above)
    # Below 0.65 the paper's success is that of two to three more rounds on the channel: the two
    # helpers that see no danger ask at every threshold below, the witness at low ones only. Where
    # exactly is not stated.
    return Parameters(
        left_share=round(float(left), 3),
        right_share=round(float(both - left), 3),
        guess_right=round(guess, 4),
        know_right=round(know, 4),
        ego_nats=round(0.8 + above * sd, 3),
        ego_sd_nats=round(sd, 4),
        others_nats=0.625,
        others_sd_nats=0.01,
        witness_nats=0.45,
        inference_s=float(paper["A2"]["paper_value"]) / 1000,
    )


if __name__ == "__main__":
    for name, fitted in vars(fit()).items():
        print(f"{name:<16}{fitted:8.4f}   from {', '.join(FITTED_ON[name])}")
