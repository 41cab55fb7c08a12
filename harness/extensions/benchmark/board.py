"""The board of an edition: its entries by success under one condition, with ties, on one page."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from harness.backends.registry import reads_prompts
from harness.core.errors import UserError, printable
from harness.core.figures import amount
from harness.extensions.benchmark.edition import Edition
from harness.extensions.benchmark.rescore import Rescored
from harness.report.document import Section, Table, document, forest, reach
from harness.report.page import save
from harness.report.templating import visible
from harness.report.words import cell
from harness.runs import pinned
from harness.runs.leading import IN_WORDS, lead_of
from harness.runs.metrics import BASELINE, GAINS
from harness.runs.records import Score
from harness.runs.success import Pairs
from harness.runs.suite import SuiteRun, plays


@dataclass(frozen=True)
class Line:
    """One entry."""

    entry: Rescored  # the file of results, computed again
    # one more than the number of ranked entries that are clearly better; None of one that sees what
    # no vehicle can see, which is no contestant
    rank: int | None
    success: Mapping[str, Score | None]  # by condition, means over families, that to rank by first
    gain: Score | None  # of that one over `BASELINE`

    @property
    def name(self) -> str:
        """The agents in words, with all that entries may choose; of a rule without the prompt."""
        variant, manifest = self.entry.suite.variant, self.entry.suite.manifest
        if not reads_prompts(str(manifest.model["engine"])):
            return f"{variant.model} · a rule"
        orders = " · cyclic letters" if manifest.letters == "cyclic" else ""
        return f"{variant}{' · thinking' if manifest.thinking else ''}{orders}"


def lines(entries: Sequence[Rescored]) -> list[Line]:
    """Return the entries of one edition, the best first.
    Raises UserError if they are of several, or none.
    """
    named = {entry.edition.name: entry.edition for entry in entries}
    if len(named) != 1:
        raise UserError(
            f"a board is of one edition, and these files are of {len(named)}"
            f"{': ' * bool(named)}{', '.join(map(printable, named))}; give files of one"
        )
    edition = entries[0].edition
    lead, by = lead_of(*(entry.suite for entry in entries)), edition.ranked_by
    ranked = [entry.suite for entry in entries if not _privileged(entry.suite)]
    of_each = [
        Line(
            entry,
            None if _privileged(entry.suite) else _rank(entry.suite, ranked, edition, lead),
            {
                name: entry.suite.score(name, lead)
                for name in dict.fromkeys((by, *edition.condition))
            },
            _gain(entry.suite, edition, lead),
        )
        for entry in entries
    ]
    return sorted(of_each, key=lambda line: -_value(line.success[by]))


def _privileged(suite: SuiteRun) -> bool:
    return bool(suite.manifest.model.get("privileged"))


def _value(score: Score | None) -> float:
    return -1.0 if score is None or score.value is None else score.value


def _rank(suite: SuiteRun, ranked: Sequence[SuiteRun], edition: Edition, lead: str) -> int:
    others = [other for other in ranked if other is not suite]
    differences = [
        edition.difference(_pairs(other, suite, edition.ranked_by, lead)) for other in others
    ]
    return 1 + sum(difference.low > 0 for difference in differences)


def _pairs(a: SuiteRun, b: SuiteRun, condition: str, lead: str) -> Pairs:
    """Return success of both under a condition, by family."""
    both = [plays([of.runs[family] for family in a.runs], lead).families for of in (a, b)]
    return [(rule, x[condition], y[condition]) for (rule, x), (_, y) in zip(*both, strict=True)]


def _gain(suite: SuiteRun, edition: Edition, lead: str) -> Score | None:
    by = edition.ranked_by
    if by == BASELINE or BASELINE not in edition.condition:
        return None
    gain = edition.difference(plays(suite.runs.values(), lead).pairs(by, BASELINE))
    return Score.of(by, GAINS[lead], gain, edition.gains)


def write(ordered: Sequence[Line], left_out: Collection[str], out: Path) -> Path:
    """Write the page; `left_out` says of other files why they are not on it."""
    save([render(ordered, left_out)], out, "--out")
    return out


def render(ordered: Sequence[Line], left_out: Collection[str]) -> str:
    """Return the page of a board's lines."""
    first = ordered[0].entry
    edition, suite = first.edition, first.suite
    by, lead = edition.ranked_by, IN_WORDS[lead_of(*(line.entry.suite for line in ordered))]
    others = [name for name in ordered[0].success if name != by]
    most = reach(score for line in ordered if (score := line.success[by]))[1]
    rows = [
        (
            Markup("{}<small>{}</small>").format(visible(line.name), visible(_by(line))),
            "–" if line.rank is None else str(line.rank),
            cell(line.success[by]),
            forest(score, 0.0, most) if (score := line.success[by]) else "",
            cell(line.gain),
            *(cell(line.success[name]) for name in others),
            _checked(line.entry),
        )
        for line in ordered
    ]
    heads = (
        "entry",
        "rank",
        by,
        "on one scale",
        f"gain over {BASELINE}",
        *others,
        "computed again here",
    )
    layouts = sum(len(run.grid.episodes) for run in suite.runs.values())
    about = (
        f"{edition.description}. {lead.capitalize()} in %, means over {len(suite.runs)} families, "
        f"{amount(layouts, 'layout')} × {amount(len(suite.manifest.seeds), 'channel seed')} in "
        f"all, with 95 % intervals over layouts. The edition's digest is {edition.digest}."
    )
    note = (
        f"Rank: one more than the number of entries that are clearly better under {by}, whose "
        "difference, paired by layout, has a 95 % interval above 0. Entries of one rank are not "
        "shown to be equal, and the intervals are not corrected for the number of pairs. A dash: "
        "it sees what no vehicle can see, and is no contestant. Who made a file is in their own "
        "words. Computed again here: whether the figures that the file states follow from the "
        "answers in it; this page has those that do. It does not show that the model named wrote "
        "the answers, nor that it never saw these layouts, whose seeds are public."
    )
    if edition.gains == pinned.KIND:
        note += (
            " Gains and ranks are by the intervals that this edition pins, in which each half of "
            "each family has one of its own: those of all layouts together, as in v2v-safety-1.1, "
            "are narrower."
        )
    table = Table(f"Entries by {lead} under {by}", heads, rows, note, left=True)
    caveats = [f"Left out: {visible(reason)}" for reason in left_out]
    return document([Section(edition.name, about=[about], caveats=caveats, tables=[table])])


def _by(line: Line) -> str:
    made_by = line.entry.contents.made_by
    return f"made by {made_by}" if made_by else "made by nobody named"


def _checked(entry: Rescored) -> Markup:
    differing = sum(map(len, entry.differences.values()))
    if differing:
        return Markup('<span class="worse">✗ {} figures differ</span>').format(differing)
    return Markup('<span class="better">✓ {} figures, all equal</span>').format(entry.compared)
