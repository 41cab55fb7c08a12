"""`harness study schedule learn`: learn what asking a helper is worth from where train decisions
lead.

At every decision point that some choice of helpers leads to, asking one helper alone has a gain:
success with it less success without, the rest of the course decided as the schedule decides. The
network learns the gain, averaged over the channel's draws; then the rest of the courses is decided
by the network, and it learns anew. The threshold is chosen on tune layouts.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from harness.coordination.exchange import known_of
from harness.coordination.operating_point import OperatingPoint
from harness.core import noise
from harness.core.arrays import Floats
from harness.core.errors import UserError, printable
from harness.core.figures import amount
from harness.core.files import write_whole
from harness.core.seeds import Purpose, purposes, seeds_text
from harness.dataset import rebuilt
from harness.extensions.schedules.choices import Choices, Choose, choices, refuse_idle
from harness.extensions.schedules.learnt import INPUTS, Learnt, Network, Stated, Weights, inputs
from harness.runs.run_dataset import check_episodes
from harness.studies.replayed_run import ReplayedRun, counted, refuse_twice

UNITS = 12
ROUNDS = 6
STEPS = 1500
RATE, DECAY = 0.02, 1e-3  # of Adam; of the weights, per step and per row
WHILE_LEARNING = 0.02  # gain above which courses go on by asking
DIGITS = 4  # of a weight in a file
LEAST = 1e-3  # standard deviation of an input that varies
THRESHOLDS = (0.0, 0.005, 0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.07, 0.1)


def layouts(stored: ReplayedRun, wanted: Purpose, reported: Sequence[ReplayedRun] = ()) -> str:
    """Return in words what a run is of: its name, its dataset and the seeds of its layouts.

    Layouts are start situations, and their seeds say what they are for. `stored` is the run. Raises
    UserError unless all seeds are for the purpose `wanted`, such as `train`, the layouts are those
    that the seeds give, and none of them is in one of the `reported` runs, on which results are
    measured.
    """
    seeds = stored.dataset.forest.seeds
    first, count = int(seeds.min()), int(seeds.max() - seeds.min()) + 1
    if purposes(first, count) != [wanted]:
        raise UserError(
            f"{printable(stored.run.path)}: {seeds_text(first, count)}; give a run on {wanted} "
            "layouts, which `harness dataset build --seed` makes"
        )
    check_episodes(stored.run, stored.dataset)
    rebuilt.refuse(stored.dataset, [run.dataset for run in reported])
    return (
        f"{stored.name} on {stored.dataset.name}, {seeds_text(first, count)}, "
        f"{amount(len(seeds), 'layout')}"
    )


def gains(tree: Choices, point: OperatingPoint, choose: Choose) -> tuple[Floats, Floats]:
    """Return what a network learns whom to ask from: inputs (n, F), and gains (n,) to predict.

    A gain is success if one helper alone is asked, less success if nobody is, -1 to 1, averaged
    over the seeds of the channel. Each of the n rows is a helper that may be asked at a decision
    point, a situation in which the ego must act; the F inputs are numbers that the ego knows of it,
    named by `learnt.INPUTS`.

    Args:
        tree: the decision points, and what asking each set of helpers leads to.
        point: the operating point: settings of radio, asking and fusion.
        choose: the rule for whom the ego asks in the rest of the episode. It takes the N decision
            points of a step, and the success (S, N, K) and costs (S, N, K, C) to which each of K
            sets of helpers leads, and returns the index of the set to ask, (S, N), by S channel
            seeds.
    """
    alone = [tree.index(one_helper) for one_helper in np.eye(tree.sets.shape[1], dtype=bool)]
    rows, targets = [], []
    for level, ends, _, _ in tree.backwards(choose):
        facts = known_of(point, level.intents, level.draws)
        places = slice(0, len(level.at))  # what is known is the same under every seed
        gain = (ends[..., alone] - ends[..., :1]).mean(axis=0)
        there = facts.may_ask[places]
        rows.append(inputs(facts)[places][there])
        targets.append(gain[:, : there.shape[1]][there])
    return np.concatenate(rows), np.concatenate(targets)


def fit(x: Floats, y: Floats) -> Network:
    """Fit a network that predicts n gains `y`, (n,), from F inputs `x`, (n, F), by least squares.

    A gain is the success that asking a helper adds, -1 to 1. The optimiser is Adam, in each step on
    all rows, with weight decay.
    """
    draws = noise.generator("schedule", "weights")
    centre, scale = x.mean(axis=0), np.maximum(x.std(axis=0), LEAST)
    z, n = (x - centre) / scale, len(y)
    weights = [
        draws.normal(0, x.shape[1] ** -0.5, (x.shape[1], UNITS)),
        np.zeros(UNITS),
        draws.normal(0, 0.1, UNITS),
        np.array(y.mean()),
    ]
    means = [np.zeros_like(weight) for weight in weights]
    squares = [np.zeros_like(weight) for weight in weights]
    for step in range(1, STEPS + 1):
        into, bias, out, base = weights
        units = np.tanh(z @ into + bias)
        error = units @ out + base - y
        back = np.outer(error, out) * (1 - units**2)
        of_into, of_out = z.T @ back / n + DECAY * into, units.T @ error / n + DECAY * out
        slopes = (of_into, back.mean(axis=0), of_out, error.mean())
        means = [0.9 * m + 0.1 * s for m, s in zip(means, slopes, strict=True)]
        squares = [0.999 * q + 0.001 * s**2 for q, s in zip(squares, slopes, strict=True)]
        rate = RATE * (1 - step / STEPS)
        weights = [
            w - rate * (m / (1 - 0.9**step)) / (np.sqrt(q / (1 - 0.999**step)) + 1e-8)
            for w, m, q in zip(weights, means, squares, strict=True)
        ]
    parts = [np.round(part, DIGITS) for part in (centre, scale, *weights)]
    return Network(parts[0], parts[1], parts[2], parts[3], parts[4], float(parts[5]))


def learn(
    train: Sequence[ReplayedRun], point: OperatingPoint, progress: Callable[[int], None]
) -> Network:
    """Learn whom to ask: a network that predicts the gain in success from asking each helper.

    `train` are runs on layouts (start situations) that are for learning. `point` is the operating
    point (settings of radio, asking and fusion): its limit of helpers holds, and its schedule (its
    rule for whom to ask) decides in the rest of an episode in the first round, the network in later
    ones. `progress` is called with 1 for each step and round. Raises UserError if no helper can be
    asked anywhere.
    """
    trees = [choices(stored, point, stored.seeds, progress) for stored in train]
    network, rules = None, [tree.scheduled(point) for tree in trees]
    # it needs the outlook, as the network does
    with_outlook = point.changed(schedule="coverage", threshold=None)
    for _ in range(ROUNDS):
        rows, targets = list[Floats](), list[Floats]()
        for tree, rule in zip(trees, rules, strict=True):
            of_tree, gains_of_tree = gains(tree, with_outlook, rule)
            rows.append(of_tree)
            targets.append(gains_of_tree)
        every_row = np.concatenate(rows)
        if not len(every_row):
            raise UserError(
                f"--condition {printable(point.name)}: at no decision point of the train runs is a "
                "helper in reach, so nothing is learnt; give another condition or other runs"
            )
        network = fit(every_row, np.concatenate(targets))
        rules = [by_network(tree, with_outlook, network, WHILE_LEARNING) for tree in trees]
        progress(1)
    assert network is not None
    return network


def by_network(tree: Choices, point: OperatingPoint, network: Network, threshold: float) -> Choose:
    """Return the rule that asks the helpers whose predicted gain in success is above `threshold`.

    A decision point is a situation in which the ego must act. `network` predicts the gain of each
    helper alone, -1 to 1. The rule is for the decision points of `tree`, and asks as many helpers
    as the operating point `point` (settings of radio, asking and fusion) allows. It is a function
    that takes the N decision points of a step, and what each of K sets of helpers leads to, which
    it does not read, and returns the index of the set to ask, (S, N), for S channel seeds.
    """
    schedule = Learnt(network, threshold)
    worths = [schedule.worth(known_of(point, level.intents, level.draws)) for level in tree.levels]
    return tree.scheduled(point.changed(threshold=threshold), worths)


def tuned(
    network: Network,
    tune: Sequence[ReplayedRun],
    point: OperatingPoint,
    progress: Callable[[int], None],
) -> float:
    """Return the threshold of predicted gain that gives most success; of equal ones the highest.

    A helper is asked if the gain in success that `network` predicts is above the threshold, as far
    as the operating point `point` (settings of radio, asking and fusion) allows. `tune` are runs on
    layouts (start situations) that are for choosing settings. Success is averaged over runs.
    `progress` is called with 1 for each step of a run.
    """
    success = np.zeros(len(THRESHOLDS))
    with_outlook = point.changed(schedule="coverage", threshold=None)
    for stored, success_rule in counted(tune).items():
        tree = choices(stored, point, stored.seeds, progress)
        for n, threshold in enumerate(THRESHOLDS):
            of_episodes, _ = tree.played(by_network(tree, with_outlook, network, threshold))
            success[n] += success_rule.mean(of_episodes)
    return THRESHOLDS[int(np.flatnonzero(np.isclose(success, success.max()))[-1])]


def text(schedule: Stated) -> str:
    """Return the text of a schedule's file: TOML, whose strings and lists are written as in JSON.

    `schedule` is the file's content: a learnt rule of whom the ego asks.
    """
    fields = asdict(schedule)
    network = fields.pop("network")
    lines = [f"{name} = {json.dumps(value)}" for name, value in fields.items()]
    lines += ["", "[network]"]
    lines += [f"{name} = {json.dumps(value)}" for name, value in network.items()]
    return "\n".join([*lines, ""])


def run_learn(
    train: Sequence[ReplayedRun],
    tune: Sequence[ReplayedRun],
    point: OperatingPoint,
    out: Path,
    command: str,
    progress: Callable[[int], None],
) -> Stated:
    """Learn a schedule, choose its threshold, write its file `out`, and return the file's content.

    A schedule is a rule for whom the ego asks: here those whose predicted gain in success is above
    the threshold.

    Args:
        train: runs on train layouts (start situations), from which the network is learnt.
        tune: runs on tune layouts, on which the threshold is chosen.
        point: the operating point (settings of radio, asking and fusion): its limit of helpers, and
            the schedule of the first round.
        out: the TOML file to write.
        command: the command line that makes the file, which the file states.
        progress: called with 1 for each step and round.

    Raises:
        UserError: nobody can be asked; or a run is given twice, is on layouts for another purpose,
            or its decisions depend on more than who is heard: the model is asked again with
            messages, or fusion has a memory.
        Unanswered: too many questions got no answer.
    """
    refuse_idle(point)
    for runs in (train, tune):
        refuse_twice(runs)
    learnt_from = tuple(layouts(stored, "train") for stored in train)
    tuned_on = tuple(layouts(stored, "tune") for stored in tune)
    network = learn(train, point, progress)
    threshold = tuned(network, tune, point, progress)
    for stored in (*train, *tune):
        stored.settle()
    weights = {name: np.asarray(part).tolist() for name, part in asdict(network).items()}
    schedule = Stated(
        description=f"Learnt: the gain of asking a helper, under {point.name}.",
        command=command,
        learnt_from=learnt_from,
        tuned_on=tuned_on,
        condition=point.name,
        threshold=threshold,
        inputs=INPUTS,
        network=Weights(**weights),
    )
    write_whole(out, text(schedule))
    return schedule
