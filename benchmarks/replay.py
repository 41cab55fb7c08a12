"""Can a replay be told by what messages hold? The best that detectors and an all-knowing one reach.

    python benchmarks/replay.py [--layouts N] [--only TEXT] [--out reports/replay]
                                [--page benchmarks/measured/replay.md]

It evaluates each model of `ROWS` where one helper of three says what the next one said at the last
decision (`replay`), and plays the same layouts without an attack. All that an ego then hears is
given to detectors, from a plain rule to a learnt one that has seen this very attack on other
layouts. The bound knows what every helper truly answered. It writes the page's tables between its
marks. What is finished is read and not made again.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from families import Families, Row
from pages import markdown, options, write_tables

from harness.coordination.named_points import named_point
from harness.coordination.parts import PLAIN
from harness.coordination.trust import divergence
from harness.core import noise
from harness.core.arrays import Bools, Floats, Ints
from harness.core.figures import interval_of
from harness.core.statistics import resampled, resampled_estimate
from harness.dataset.load import Scene
from harness.evaluate.requests import request_id
from harness.evaluate.walk import Decided
from harness.runs.headline import BALANCED
from harness.studies.axes import Setting
from harness.studies.play import WalkResult
from harness.studies.replayed_run import ReplayedRun

NEEDS = "sklearn"
SMALLEST = "--only proxy --layouts 2"
ROWS = (Row("proxy", "v4", "json"), Row("swarm-tiny-six-v2", "v4", "readout"))
SEEDS = "0:2"
PEACE, REPLAY = "6g:consensus=trust", "6g:consensus=trust,attack=replay"
POINTS = ("--condition", "6g", "--condition", PEACE, "--attack", "replay", "--attack", "absent")
SHARE = 1 / 3  # of the helpers attack
RISKS = {"low": 0.0, "medium": 1.0, "high": 2.0}
FALSE_ALARMS = 0.02  # most that a detector may give, under attack and in peace
FOLDS, RESAMPLES, THRESHOLDS = 5, 2000, 500
SUSPECTED = 0.5  # of trust; below it a helper is taken for an attacker


class Plays(NamedTuple):
    """What egos heard in P plays of a family: in T decisions, of H helpers, over A actions.

    A play is a layout with one seed of the channel. What was not heard is NaN.
    """

    layout: Ints  # number of each play's layout among those of all families, (P,)
    attacked: bool  # whether one helper of three attacks
    attackers: Bools  # (P, T, H)
    intents: Floats  # as they are sent, with two decimals, (P, T, H, A)
    answers: Floats  # what each helper truly answered, with two decimals, (P, T, H, A)
    own: Floats  # the ego's intent, (P, T, A)
    trust: Floats  # of the rule `trust`, (P, T, H)
    risk: Floats  # as the message states it, a number of `RISKS`, (P, T, H)
    words: Floats  # a number for each different text of evidence, (P, T, H)
    claims: Mapping[str, Floats]  # numbers of places and speeds by name, (P, T, H)

    @property
    def heard(self) -> Bools:
        """Whose message was heard, (P, T, H)."""
        return there(self.intents)


class Messages(NamedTuple):
    """All n messages that were heard, in columns (n,)."""

    layout: Ints
    attacked: Bools  # whether the message is of a play under attack
    by_attacker: Bools
    first: Bools  # whether it is of the first decision
    sender: Ints  # number of its sender's play and place
    columns: Mapping[str, Floats]

    def of(self, name: str) -> Floats:
        """Return a column."""
        return self.columns[name]


EQUAL = (
    *("step", "next_heard", "as_next", "as_itself", "as_other", "as_present"),
    *("as_next_so_far", "unlike_next_so_far", "new_as_next_so_far", "as_itself_so_far"),
    *("others_as_next", "others_unlike_next", "others_new_as_next"),
)
PLACED = (
    *("family", "first_share", "last_share", "largest_share", "ego_share"),
    *("from_nearest", "from_ego", "from_itself", "from_next", "from_next_now"),
    *("east_m", "south_m", "speed_mps", "to_zone_m", "range_m", "sensed_m"),
    *("ego_east_m", "ego_south_m"),
)
STATED = ("risk", "contradicts", "contradicts_so_far")
PLAIN_RULE = "a plain rule: it copies one helper all along"
BOUND = "bound: knows what each helper truly answers"
GUESSES = "the same, and guesses as often as it may"
UNITS = ("of all messages", "of messages from the second decision on", "of helpers in an episode")
HEADS = ("detector", "F1 %", "precision %", "recall %", "false alarms %", "in peace %")


def main() -> None:
    """Make what is missing, and write the page's tables."""
    given = options(__doc__, "replay").parse_args()
    tables: list[str] = []
    for row in ROWS:
        here = given.out / row.name
        if given.only in row.name:
            model = row.asked(layouts=given.layouts)
            model.evaluate(here, *POINTS, "--seeds", SEEDS, "--latency", "paper")
        if families := Families.read(here):
            tables += written(row, families)
    text = "\n\n".join(tables)
    print(text)
    if given.page:
        write_tables(given.page, text)


def written(row: Row, families: Families) -> Iterator[str]:
    """Yield the tables of a model."""
    messages = messages_of(list(plays_of([run.path for run in families.runs.values()])))
    heard = f"{messages.attacked.sum()} messages heard under attack, {families.counted}"
    yield f"### {row}\n\n{heard}."
    yield f"**What messages hold**\n\n{contents_table(messages)}"
    found = detectors(messages)
    for unit in UNITS:
        rows = []
        for name, scores in found.items():
            rows.append((name, *rates(messages, unit, scores)))
        if unit == UNITS[0]:
            rows.append((GUESSES, *guessed(messages, found[BOUND])))
        yield f"**How attackers are told, {unit}**\n\n{markdown(HEADS, rows)}"
    yield f"**What it is worth**\n\n{success_table(families)}"


def plays_of(folders: Sequence[Path]) -> Iterator[Plays]:
    """Yield the plays of each family, in peace and under attack."""
    layouts = 0
    for folder in folders:
        run = ReplayedRun(folder)
        words: dict[str, int] = {}
        for point in (PEACE, REPLAY):
            attacked, read = point == REPLAY, partial(heard_in, run, words)
            setting = Setting(point, named_point(point), run.vehicles)
            [[result]] = run.walked([setting], run.seeds, read)
            yield arranged(result, attacked, layouts)
        layouts += run.episodes


def heard_in(run: ReplayedRun, words: dict[str, int], part: Decided[Scene]) -> dict[str, Floats]:
    """Return what the ego hears in n decisions, as columns, (n, ...)."""
    sent, on_time = part.said.intents, part.result.on_time
    claims = sent.claims
    assert claims is not None
    answers = sent.helpers
    if part.said.attackers.any():
        answers = run.whole(part.decision_points).helpers[part.due.at]
    risk, text = np.full((2, *on_time.shape), np.nan)
    for decision, helper in np.argwhere(on_time).tolist():
        scene = part.decision_points[part.due.at[decision]]
        answer = run.answers[request_id(scene, scene.viewers[1 + helper], PLAIN)]
        if answer.message:
            risk[decision, helper] = RISKS.get(str(answer.message.get("risk")), np.nan)
            evidence = str(answer.message.get("evidence"))
            text[decision, helper] = words.setdefault(evidence, len(words))
    width = on_time.shape[1]
    ego = np.repeat(claims.xy_m[:, :1], width, axis=1)
    return {
        "intents": np.where(on_time[..., None], sent.helpers, np.nan).reshape(len(on_time), -1),
        "answers": answers.reshape(len(on_time), -1),
        "attackers": part.said.attackers.astype(float),
        "own": part.result.own,
        "trust": part.result.trust,
        "risk": risk,
        "words": text,
        "east_m": claims.xy_m[:, 1:, 0],
        "south_m": claims.xy_m[:, 1:, 1],
        "speed_mps": claims.speed_mps,
        "sensed_m": claims.sensed_m,
        "to_zone_m": sent.distance_m[:, 1:],
        "range_m": sent.range_m,
        "ego_east_m": ego[..., 0],
        "ego_south_m": ego[..., 1],
    }


def arranged(result: WalkResult, attacked: bool, layouts: int) -> Plays:
    """Return the decisions of a walk by play and step; `layouts` were in earlier families."""
    order = np.argsort(result.places, kind="stable")
    play = result.places[order]
    step = np.arange(len(play)) - np.searchsorted(play, play)
    size = (play.max() + 1, step.max() + 1)

    def by_step(name: str) -> Floats:
        column = result.columns[name][order]
        cells = np.full((*size, column.shape[1]), np.nan)
        cells[play, step] = column
        return cells

    helpers = result.columns["attackers"].shape[1]
    own, claimed = by_step("own"), ("east_m", "south_m", "speed_mps", "sensed_m", "to_zone_m")
    shape = (*size, helpers, own.shape[-1])
    return Plays(
        layouts + np.arange(size[0]) % len(result.episodes),
        attacked,
        by_step("attackers") == 1,
        by_step("intents").reshape(shape).round(2),
        by_step("answers").reshape(shape).round(2),
        own,
        by_step("trust"),
        by_step("risk"),
        by_step("words"),
        {name: by_step(name) for name in (*claimed, "range_m", "ego_east_m", "ego_south_m")},
    )


def messages_of(plays: Sequence[Plays]) -> Messages:
    """Return the messages of all plays."""
    parts: list[Messages] = []
    senders = 0
    for each in plays:
        cells = numbers(each)
        cells["family"] = np.full(each.heard.shape, len(parts) // 2)
        play, step, helper = np.nonzero(each.heard)
        at = play, step, helper
        columns = {name: values[at].astype(float) for name, values in cells.items()}
        sender = senders + play * each.heard.shape[2] + helper
        senders += each.heard.shape[0] * each.heard.shape[2]
        attacked = np.full(len(play), each.attacked)
        parts.append(
            Messages(each.layout[play], attacked, each.attackers[at], step == 0, sender, columns)
        )
    joint = {}
    for name in parts[0].columns:
        joint[name] = np.concatenate([part.columns[name] for part in parts])
    return Messages(
        np.concatenate([part.layout for part in parts]),
        np.concatenate([part.attacked for part in parts]),
        np.concatenate([part.by_attacker for part in parts]),
        np.concatenate([part.first for part in parts]),
        np.concatenate([part.sender for part in parts]),
        joint,
    )


def before(values: Floats) -> Floats:
    """Return what was one decision earlier; NaN before the first, (P, T, ...)."""
    earlier = np.full_like(values, np.nan)
    earlier[:, 1:] = values[:, :-1]
    return earlier


def there(intents: Floats) -> Bools:
    """Return which intents were heard, (P, T, H)."""
    return np.asarray(~np.isnan(intents).any(axis=-1))


def alike(a: Floats, b: Floats) -> Bools:
    """Return whether helper h says in `a` what helper j says in `b`, (P, T, H, H)."""
    return np.asarray((a[:, :, :, None] == b[:, :, None]).all(axis=-1))


def numbers(plays: Plays) -> dict[str, Floats]:
    """Return what may tell an attacker's message, by name, (P, T, H) each."""
    intents, heard = plays.intents, plays.heard
    others = ~np.eye(heard.shape[2], dtype=bool)
    last = before(intents)
    next_last = np.roll(last, -1, axis=2)
    as_last = alike(intents, last)
    as_itself = (as_last & ~others).any(axis=-1)
    as_present = (alike(intents, intents) & others).any(axis=-1)
    as_next = (intents == next_last).all(axis=-1)
    next_heard = heard & there(next_last)
    new_as_next = as_next & ~as_itself & ~as_present
    unlike_next = next_heard & ~as_next
    is_high = plays.risk == RISKS["high"]
    contradicts = ~np.isnan(plays.risk) & (is_high != (intents.argmax(axis=-1) == 0))
    changed = heard & (intents != plays.answers).any(axis=-1)
    other_words = alike(plays.words[..., None], before(plays.words)[..., None])
    nearest = divergence(intents[:, :, :, None], intents[:, :, None])
    ego = plays.own[:, :, None]
    so_far = {
        "as_next": as_next,
        "unlike_next": unlike_next,
        "new_as_next": new_as_next,
        "as_itself": as_itself,
        "contradicts": contradicts,
        "changed": changed,
    }
    sums = {name: np.cumsum(values, axis=1) for name, values in so_far.items()}
    of_others = {}
    for name in ("as_next", "unlike_next", "new_as_next"):
        here = np.where(heard, sums[name], 0)
        of_others[f"others_{name}"] = here.sum(axis=-1, keepdims=True) - here
    with np.errstate(invalid="ignore"):
        distances = {
            "from_nearest": np.nanmin(np.where(others, nearest, 1.0), axis=-1),
            "from_ego": divergence(intents, ego),
            "from_itself": divergence(intents, last),
            "from_next": divergence(intents, next_last),
            "from_next_now": divergence(intents, np.roll(intents, -1, axis=2)),
        }
    return {
        "step": np.broadcast_to(np.arange(heard.shape[1])[:, None], heard.shape),
        "next_heard": next_heard,
        "as_next": as_next,
        "as_itself": as_itself,
        "as_other": (as_last & others).any(axis=-1),
        "as_other_whole": (as_last & other_words & others).any(axis=-1),
        "as_present": as_present,
        "copies": copies(intents),
        "changed": changed,
        "trust": plays.trust,
        "first_share": intents[..., 0],
        "last_share": intents[..., -1],
        "largest_share": intents.max(axis=-1),
        "ego_share": np.broadcast_to(ego[..., 0], heard.shape),
        "risk": plays.risk,
        "contradicts": contradicts,
        **{f"{name}_so_far": values for name, values in sums.items()},
        **of_others,
        **distances,
        **plays.claims,
    }


def copies(intents: Floats) -> Bools:
    """Return whom a plain rule takes for a replayer by now, (P, T, H).

    Some other helper is its source: it once said anew what this one had said last, neither what it
    had said itself nor what another says now; and where it could, it never said anything else.
    """
    last = before(intents)
    others = ~np.eye(intents.shape[2], dtype=bool)
    equal = alike(intents, last)
    as_itself = np.any(equal & ~others, axis=-1)
    as_present = np.any(alike(intents, intents) & others, axis=-1)
    repeats = as_itself | as_present
    could = there(intents)[..., None] & there(last)[:, :, None]
    anew = equal & ~np.asarray(repeats)[..., None]
    once = np.cumsum(anew, axis=1) > 0
    otherwise = np.cumsum(could & ~equal, axis=1) > 0
    return np.asarray((once & ~otherwise & others).any(axis=-1))


def detectors(messages: Messages) -> dict[str, Floats]:
    """Return how much each detector suspects each message, (n,), by what it knows."""
    found = {
        "the rule `trust`": (messages.of("trust") < SUSPECTED).astype(float),
        "the message equals another's last": messages.of("as_other"),
        PLAIN_RULE: messages.of("copies"),
        "learnt: equal messages": learnt(messages, EQUAL),
        "learnt: these, intents, places, the ego's own": learnt(messages, (*EQUAL, *PLACED)),
    }
    if not np.isnan(messages.of("risk")).all():
        words = (*EQUAL, *PLACED, *STATED)
        found["learnt: these, and the risk stated"] = learnt(messages, words)
    found[BOUND] = (messages.of("changed_so_far") > 0).astype(float)
    return found


def learnt(messages: Messages, names: Sequence[str]) -> Floats:
    """Return the probability that each message is an attacker's, learnt on other layouts."""
    from sklearn.ensemble import HistGradientBoostingClassifier
    from sklearn.model_selection import GroupKFold

    table = np.stack([messages.of(name) for name in names], axis=1)
    table = table[:, ~np.isnan(table).all(axis=0)]
    scores = np.zeros(len(table))
    splits = GroupKFold(FOLDS).split(table, messages.by_attacker, messages.layout)
    for train, test in splits:
        trees = HistGradientBoostingClassifier(
            max_iter=250, learning_rate=0.06, early_stopping=False, random_state=0
        )
        trees.fit(table[train], messages.by_attacker[train])
        scores[test] = trees.predict_proba(table[test])[:, 1]
    return scores


class Counts(NamedTuple):
    """Numbers of suspected and other messages, or helpers, of each layout, (L,) each."""

    hits: Ints  # attackers' that are suspected
    misses: Ints  # attackers' that are not
    wrongs: Ints  # honest ones that are suspected, under attack
    rights: Ints
    peace_wrongs: Ints  # the same where nobody attacks
    peace_rights: Ints

    def rates(self) -> dict[str, Floats]:
        """Return F1 and the like of all layouts and of resamples, (1 + RESAMPLES,)."""
        layouts = len(self.hits)
        times = resampled(noise.generator("replay", "detection"), layouts, RESAMPLES)
        hits, misses, wrongs, rights, false, true = (times @ each for each in self)
        with np.errstate(invalid="ignore", divide="ignore"):
            return {
                "f1": 2 * hits / (2 * hits + wrongs + misses),
                "precision": hits / (hits + wrongs),
                "recall": hits / (hits + misses),
                "false_alarms": wrongs / (wrongs + rights),
                "in_peace": false / (false + true),
            }

    def allowed(self) -> bool:
        """Return whether false alarms are as few as they have to be."""
        wrongs, rights, false, true = (each.sum() for each in self[2:])
        return bool(
            wrongs <= FALSE_ALARMS * (wrongs + rights) and false <= FALSE_ALARMS * (false + true)
        )

    @property
    def f1(self) -> float:
        hits, wrong = self.hits.sum(), self.misses.sum() + self.wrongs.sum()
        return float(2 * hits / (2 * hits + wrong))


def counted(messages: Messages, unit: str, suspected: Bools) -> Counts:
    """Count suspected messages by layout; or helpers, each suspected if one message of it is."""
    layout, attacked, attacker = messages.layout, messages.attacked, messages.by_attacker
    layouts = layout.max() + 1
    if unit == UNITS[1]:
        later = ~messages.first
        layout, attacked, attacker = layout[later], attacked[later], attacker[later]
        suspected = suspected[later]
    if unit == UNITS[2]:
        _, place, helper = np.unique(messages.sender, return_index=True, return_inverse=True)
        suspected = np.bincount(helper, suspected) > 0
        layout, attacked, attacker = layout[place], attacked[place], attacker[place]
    counts = []
    for group in (attacker, attacked & ~attacker, ~attacked):
        for is_so in (suspected, ~suspected):
            counts.append(np.bincount(layout[group & is_so], minlength=layouts))
    return Counts(*counts)


def rates(messages: Messages, unit: str, scores: Floats) -> list[str]:
    """Return the cells of a detector, at the best threshold with few enough false alarms.

    A rule, which is sure, has none to choose.
    """
    if set(np.unique(scores)) <= {0.0, 1.0}:
        return shown(counted(messages, unit, scores > 0))
    every = np.unique(np.quantile(scores, np.linspace(0, 1, THRESHOLDS)))
    tried = [counted(messages, unit, scores > threshold) for threshold in every]
    return shown(max((counts for counts in tried if counts.allowed()), key=lambda each: each.f1))


def guessed(messages: Messages, bound: Floats) -> list[str]:
    """Return the cells of the bound if it also spends its false alarms in peace on guesses.

    Until an attacker's message differs, all is as in peace, and a third of what a detector suspects
    there is an attacker's under attack. No false alarm under attack is counted.
    """
    counts = counted(messages, UNITS[0], bound > 0)
    guesses = FALSE_ALARMS * SHARE * (counts.peace_wrongs + counts.peace_rights)
    joint = counts._replace(hits=counts.hits + guesses, misses=counts.misses - guesses)
    f1, _, recall, *_ = shown(joint)
    return [f1, "", recall, "", ""]


def shown(counts: Counts) -> list[str]:
    """Return rates in percent with intervals over layouts."""
    layouts = len(counts.hits)
    return [interval_of(resampled_estimate(values, layouts)) for values in counts.rates().values()]


def contents_table(messages: Messages) -> str:
    """Return the table of what messages are like, of attackers and of honest helpers."""
    new = (messages.of("as_other") > 0) & ~(messages.of("as_itself") > 0)
    shares = {
        "is of the first decision": messages.first,
        "differs from what the helper answered": messages.of("changed") > 0,
        "differs, or an earlier one of the episode did": messages.of("changed_so_far") > 0,
        "what the next helper said last was heard": messages.of("next_heard") > 0,
        "equals another's last": messages.of("as_other") > 0,
        "equals another's last, and not its own last": new,
    }
    if not np.isnan(messages.of("risk")).all():
        shares["has another's last intent and words"] = messages.of("as_other_whole") > 0
        shares["states a risk that its likeliest action contradicts"] = (
            messages.of("contradicts") > 0
        )
    groups = (
        messages.by_attacker,
        messages.attacked & ~messages.by_attacker,
        ~messages.attacked,
    )
    layouts = messages.layout.max() + 1
    times = resampled(noise.generator("replay", "detection"), layouts, RESAMPLES)
    rows = []
    for name, is_so in shares.items():
        cells = [name]
        for group in groups:
            count, every = (
                times @ np.bincount(messages.layout[mask], minlength=layouts)
                for mask in (group & is_so, group)
            )
            cells.append(interval_of(resampled_estimate(count / every, layouts)))
        rows.append(cells)
    heads = ("a message, %", "an attacker's", "an honest helper's", "in peace")
    return markdown(heads, rows)


def success_table(families: Families) -> str:
    """Return the table of balanced success, with the attack and without the attackers."""
    rows = []
    for rule, base in (("linear", "6g"), ("trust", PEACE)):
        joint = f"{base}," if ":" in base else f"{base}:"
        names = [base, f"{joint}attack=replay", f"{joint}attack=absent"]
        cells = [families.shown(name, BALANCED) for name in names]
        worth = interval_of(families.difference(names[2], names[1]), sign="+")
        rows.append((f"`{rule}`", *cells, worth))
    heads = ("balanced success %", "nobody", "`replay`", "attackers not heard", "less `replay`")
    return markdown(heads, rows)


if __name__ == "__main__":
    main()
