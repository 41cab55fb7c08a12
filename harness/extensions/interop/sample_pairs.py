"""Two logs of the same samples, paired: what a scorer gives B more than A, and how sure that is."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from harness.core.arrays import Floats, Ints
from harness.core.errors import UserError, printable
from harness.core.figures import amount, some_of
from harness.core.multiplicity import holm, p_value
from harness.core.statistics import LEVEL, Estimate, episode_interval, paired_difference
from harness.report.compare.gate import Verdict, of_no_width

Key = tuple[int | str, int]  # a sample's id, and its epoch


@dataclass(frozen=True)
class SampleLog:
    """Hold what a log of another program says of its samples, each asked in one or more epochs.

    `inputs` has the digest of what each was asked and of its right answer, `errors` why some have
    no answer, and `scores` the number that each scorer gave; NaN for what is no number. `prompts`
    and `options` tell apart what may differ between logs that are compared.
    """

    path: Path  # the log's file
    task: str
    model: str
    dataset: str  # its name; empty if the log states none
    status: str  # `success` once all samples were asked
    inputs: Mapping[Key, str]  # hex SHA-256 of question and right answer, by sample and epoch
    errors: Mapping[Key, str]  # messages, by sample and epoch
    scores: Mapping[str, Mapping[Key, float]]  # by scorer, then by sample and epoch
    # hex SHA-256 of the prompt with its examples, by sample and epoch; empty if the log has none
    prompts: Mapping[Key, str] = field(default_factory=dict)
    # hex SHA-256 of what each scorer was set to, by its name; empty if the log does not say
    options: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ChangedSample:
    """Hold a sample whose score differs: its id, and its mean over paired epochs in A and B."""

    sample: int | str
    a: float
    b: float


@dataclass(frozen=True)
class ScorerDifference:
    """Hold how the scores of one scorer differ between logs A and B.

    `a` and `b` are means over the samples that both scored, of each one's mean over the epochs that
    both scored. `change` is B - A with a 95 % interval over samples. The p-values are of no
    difference: `p_value` as computed, and `p_corrected` for all scorers; None if there is no
    interval. `answers` counts the pairs of a sample and an epoch that both scored, `unscored` those
    in both logs without a number in one. `changed` has the samples that differ, losses first.
    """

    scorer: str
    a: float
    b: float
    change: Estimate
    p_value: float | None
    answers: int
    unscored: int
    changed: tuple[ChangedSample, ...]
    p_corrected: float | None = None  # by Holm's method, for all scorers of the comparison


@dataclass(frozen=True)
class SampleComparison:
    """Hold the comparison of two logs: `differences` has one entry for each scorer of both.

    `answers` are the samples and epochs that both logs have; `only_a` and `only_b` those that one
    alone has.
    """

    a: SampleLog
    b: SampleLog
    answers: tuple[Key, ...]
    only_a: tuple[Key, ...]
    only_b: tuple[Key, ...]
    differences: tuple[ScorerDifference, ...]

    @property
    def title(self) -> str:
        return f"{printable(self.b.path.name)} against {printable(self.a.path.name)}"

    @cached_property
    def changes(self) -> Mapping[str, Estimate]:
        """Return the difference B - A of each scorer that both logs have, by its name, for gates.

        Its interval has no width where two or more samples all changed alike.
        """
        changes = {}
        for each in self.differences:
            is_alike = each.p_value is None and each.change.n > 1
            changes[each.scorer] = of_no_width(each.change) if is_alike else each.change
        return changes

    @property
    def alone(self) -> Mapping[str, list[str]]:
        """Return the names of the scorers that only log `A` has, and of those that only `B` has."""
        a, b = self.a.scores, self.b.scores
        return {"A": [name for name in a if name not in b], "B": [n for n in b if n not in a]}

    @cached_property
    def other_prompts(self) -> int:
        """Return how many of the common answers had another prompt in each log, if both say it."""
        a, b = self.a.prompts, self.b.prompts
        return sum(a[key] != b[key] for key in self.answers if key in a and key in b)

    @cached_property
    def other_options(self) -> list[str]:
        """Return the names of the scorers that both logs have, with other options in each."""
        a, b = self.a.options, self.b.options
        return [name for name in a if name in b and a[name] != b[name]]

    @cached_property
    def unsure(self) -> str:
        """Return why gates have nothing sure to judge: unfinished logs, errors, or answers that
        have no number in one of them, as those that it lacks; else empty.
        """
        reasons, erring = list[str](), set[Key]()
        for log in (self.a, self.b):
            if log.status != "success":
                reasons.append(f"{printable(log.path.name)} has status {printable(log.status, 20)}")
            erring |= {key for key in self.answers if _has_failed(log, key)}
        if erring:
            reasons.append(f"{amount(len(erring), 'answer')} of A or B failed with an error")
        if alone := len(self.only_a) + len(self.only_b):
            reasons.append(f"one log alone has {amount(alone, 'answer')}")
        if unscored := max((each.unscored for each in self.differences), default=0) - len(erring):
            reasons.append(f"no number has {amount(unscored, 'answer')} of A or B")
        return " and ".join(reasons)

    def terminal(self, verdicts: Sequence[Verdict], most: int) -> str:
        from harness.extensions.interop import sample_text

        return sample_text.terminal(self, verdicts, most)

    def markdown(self, verdicts: Sequence[Verdict], most: int) -> str:
        from harness.extensions.interop import sample_text

        return sample_text.markdown(self, verdicts, most)

    def mapping(self, verdicts: Sequence[Verdict], most: int) -> dict[str, Any]:
        from harness.extensions.interop import sample_text

        return sample_text.mapping(self, verdicts, most)


def _has_failed(log: SampleLog, key: Key) -> bool:
    return key in log.errors and not any(key in scores for scores in log.scores.values())


def pair(a: SampleLog, b: SampleLog) -> SampleComparison:
    """Pair two logs by sample and epoch, and compare what their common scorers say.

    Raises UserError if they have no sample or no scorer in common, or if a sample that both have
    asks something else or has another right answer.
    """
    both = f"{printable(a.path)} and {printable(b.path)}"
    answers = _in_order(a.inputs.keys() & b.inputs.keys())
    if not answers:
        ids = " and ".join(printable(repr(next(iter(log.inputs))[0]), 30) for log in (a, b))
        raise UserError(
            f"{both} have no sample in common (ids such as {ids}); give two logs of one dataset"
        )
    otherwise = [key for key in answers if a.inputs[key] != b.inputs[key]]
    if otherwise:
        raise UserError(
            f"{both} ask different things: {len(otherwise)} of {amount(len(answers), 'answer')}, "
            f"such as that to sample {printable(repr(otherwise[0][0]), 30)}, have another "
            "input, choices or target; give two logs of one dataset"
        )
    scorers = [name for name in a.scores if name in b.scores]
    if not scorers:
        raise UserError(
            f"{both} have no scorer in common ({_scorers(a)} in A, {_scorers(b)} in B); score both "
            "by the same"
        )
    differences = _corrected([_difference(name, a, b, answers) for name in scorers])
    only_a = _in_order(a.inputs.keys() - b.inputs.keys())
    only_b = _in_order(b.inputs.keys() - a.inputs.keys())
    return SampleComparison(a, b, answers, only_a, only_b, differences)


def _scorers(log: SampleLog) -> str:
    return some_of([printable(name, 30) for name in log.scores] or ["none"])


def _in_order(keys: set[Key]) -> tuple[Key, ...]:
    """Return samples and epochs in order; ids that are numbers first, by their value."""
    return tuple(sorted(keys, key=lambda key: (*_rank(key[0]), key[1])))


def _rank(sample: int | str) -> tuple[bool, int, str]:
    is_text = isinstance(sample, str)
    return is_text, 0 if is_text else int(sample), str(sample)


def _difference(
    scorer: str, log_a: SampleLog, log_b: SampleLog, answers: Sequence[Key]
) -> ScorerDifference:
    nan = float("nan")
    a = np.array([log_a.scores[scorer].get(key, nan) for key in answers])
    b = np.array([log_b.scores[scorer].get(key, nan) for key in answers])
    samples = list(dict.fromkeys(sample for sample, _ in answers))
    places = {sample: place for place, sample in enumerate(samples)}
    place = np.array([places[sample] for sample, _ in answers])
    is_known = ~np.isnan(a) & ~np.isnan(b)
    means_a = _by_sample(a[is_known], place[is_known], len(samples))
    means_b = _by_sample(b[is_known], place[is_known], len(samples))
    change = means_b - means_a
    known_scores = np.concatenate([a[is_known], b[is_known]])
    is_share = bool(np.all((known_scores >= 0) & (known_scores <= 1)))

    def interval(level: float) -> Estimate:
        """Return the mean change: of shares as of two runs' success, of others by Student's t."""
        if is_share:
            return paired_difference([change], level)
        return episode_interval(change, level=level)

    return ScorerDifference(
        scorer=scorer,
        a=_mean(means_a),
        b=_mean(means_b),
        change=interval(LEVEL),
        p_value=p_value(interval),
        answers=int(is_known.sum()),
        unscored=int((~is_known).sum()),
        changed=_changed(samples, means_a, means_b),
    )


def _by_sample(values: Floats, place: Ints, samples: int) -> Floats:
    """Return each sample's mean over its answers (n,), of which `place` says the sample; or NaN."""
    count = np.bincount(place, minlength=samples)
    total = np.bincount(place, weights=values, minlength=samples)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _mean(values: Floats) -> float:
    is_known = ~np.isnan(values)
    return float(values[is_known].mean()) if is_known.any() else float("nan")


def _changed(samples: Sequence[int | str], a: Floats, b: Floats) -> tuple[ChangedSample, ...]:
    differ = np.flatnonzero(~np.isnan(a) & (a != b))
    order = differ[np.argsort((b - a)[differ], kind="stable")]
    return tuple(ChangedSample(samples[n], float(a[n]), float(b[n])) for n in order.tolist())


def _corrected(differences: Sequence[ScorerDifference]) -> tuple[ScorerDifference, ...]:
    p_values = [each.p_value for each in differences if each.p_value is not None]
    corrected = iter(holm(p_values))
    result = []
    for each in differences:
        p = None if each.p_value is None else next(corrected)
        result.append(replace(each, p_corrected=p))
    return tuple(result)
