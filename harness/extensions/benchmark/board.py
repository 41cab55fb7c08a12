"""The board of an edition: its entries by success under one condition, with ties, on one page."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from markupsafe import Markup

from harness.backends.registry import reads_prompts
from harness.core.errors import UserError, printable
from harness.core.figures import amount
from harness.evaluate.of_run import sees_all
from harness.extensions.benchmark.edition import Edition
from harness.extensions.benchmark.rescore import Rescored
from harness.report.document import Section, Table, document, forest, reach
from harness.report.page import save
from harness.report.templating import visible
from harness.report.words import cell
from harness.runs import pinned
from harness.runs.headline import IN_WORDS, headline_of
from harness.runs.metric_names import BASELINE, GAINS
from harness.runs.records import Score
from harness.runs.success import Pairs
from harness.runs.suite import SuiteRun, plays


@dataclass(frozen=True)
class Line:
    """Hold one entry of a board, the page that ranks models on a release of the benchmark.

    That release is an edition. A condition is a named set of settings of radio, asking and fusion;
    success is the share of episodes in which the ego reaches its goal in time. None is not known.
    """

    entry: Rescored  # the file of results, computed again
    # one more than the number of ranked entries that are clearly better; None of one that sees what
    # no vehicle can see, which is no contestant
    rank: int | None
    # success by condition, a mean over families; the condition that ranks comes first
    success: Mapping[str, Score | None]
    # success under the first condition less that under `BASELINE`, an ego without a radio; None if
    # the edition has no such condition
    gain: Score | None
    file: str = ""  # the name of its file, where another entry is of the same models and prompts

    @property
    def name(self) -> str:
        """Return the entry's name on the board: its model, prompt, answer mode and other choices.

        For a rule, which reads no prompt, it is the model alone.
        """
        variant, manifest = self.entry.suite.variant, self.entry.suite.manifest
        file = f" · {self.file}" if self.file else ""
        if not reads_prompts(str(manifest.model["engine"])):
            return f"{variant.model} · a rule{file}"
        orders = " · cyclic letters" if manifest.letters == "cyclic" else ""
        return f"{variant}{' · thinking' if manifest.thinking else ''}{orders}{file}"


def lines(entries: Sequence[Rescored]) -> list[Line]:
    """Return the lines of the page that ranks a benchmark's entries, the best entry first.

    `entries` are files of results of one edition (a release of the benchmark), whose figures were
    computed again here. A line has an entry's rank, its success in each of the edition's conditions
    (settings of radio, asking and fusion), and its gain, the success with a radio less that
    without. Raises UserError if they are of several editions, or if there are none.
    """
    names = dict.fromkeys(entry.edition.name for entry in entries)
    if len(names) != 1:
        listed = ", ".join(printable(name) for name in names)
        raise UserError(
            f"a board is of one edition, and these files are of {len(names)}"
            f"{': ' * bool(names)}{listed}; give files of one"
        )
    edition = entries[0].edition
    metric = headline_of(*[entry.suite for entry in entries])
    conditions = dict.fromkeys((edition.ranked_by, *edition.condition))
    contestants = [entry.suite for entry in entries if not _privileged(entry.suite)]
    board = []
    for entry in entries:
        suite, rank = entry.suite, None
        if not _privileged(suite):
            rank = _rank(suite, contestants, edition, metric)
        success = {condition: suite.score(condition, metric) for condition in conditions}
        board.append(Line(entry, rank, success, _gain(suite, edition, metric)))
    return sorted(_apart(board), key=lambda line: -_value(line.success[edition.ranked_by]))


def _apart(board: Sequence[Line]) -> list[Line]:
    """Return the lines, each of another name: of its file where models and prompts are the same.

    Files whose names and folders are the same are numbered; a page names no other folder.
    """
    count, numbers, lines = Counter(line.name for line in board), Counter[str](), list[Line]()
    for line in board:
        named = replace(line, file=line.entry.file) if count[line.name] > 1 else line
        numbers[named.name] += 1
        number = numbers[named.name]
        lines.append(named if number == 1 else replace(named, file=f"{named.file} ({number})"))
    return lines


def _privileged(suite: SuiteRun) -> bool:
    """Return whether an entry sees what no vehicle can see."""
    return sees_all(suite.manifest.model)


def _value(score: Score | None) -> float:
    """Return a score's value, and -1 where there is none."""
    return -1.0 if score is None or score.value is None else score.value


def _rank(suite: SuiteRun, contestants: Sequence[SuiteRun], edition: Edition, metric: str) -> int:
    """Return one more than the number of contestants that are clearly better."""
    rank = 1
    for other in contestants:
        if other is not suite:
            pairs = _pairs(other, suite, edition.ranked_by, metric)
            rank += edition.difference(pairs).low > 0
    return rank


def _pairs(a: SuiteRun, b: SuiteRun, condition: str, metric: str) -> Pairs:
    """Return success of both under a condition, by family."""
    families_a = plays([a.runs[family] for family in a.runs], metric).families
    families_b = plays([b.runs[family] for family in a.runs], metric).families
    pairs = []
    for (rule, success_a), (_, success_b) in zip(families_a, families_b, strict=True):
        pairs.append((rule, success_a[condition], success_b[condition]))
    return pairs


def _gain(suite: SuiteRun, edition: Edition, metric: str) -> Score | None:
    """Return what an entry gains over the baseline; None where the edition has none."""
    condition = edition.ranked_by
    if condition == BASELINE or BASELINE not in edition.condition:
        return None
    gain = edition.difference(plays(suite.runs.values(), metric).pairs(condition, BASELINE))
    return Score.of(condition, GAINS[metric], gain, edition.gains)


def write(ordered: Sequence[Line], left_out: Collection[str], out: Path) -> Path:
    """Write the HTML page that ranks a benchmark's entries to the file `out`, and return its path.

    `ordered` has a line for each entry (the results of one model), the best first: its rank, its
    success under each condition (settings of radio, asking and fusion), and its gain by the radio.
    `left_out` has a sentence for each file that is not on the board: which it is, and why.
    """
    save([render(ordered, left_out)], out, "--out")
    return out


def render(ordered: Sequence[Line], left_out: Collection[str]) -> str:
    """Return the HTML page that ranks a benchmark's entries, as text, to be saved or served.

    `ordered` has a line for each entry (the results of one model), the best first. `left_out` has a
    sentence for each file of results that is not on the board: which it is, and why.
    """
    first = ordered[0].entry
    edition, suite = first.edition, first.suite
    by = edition.ranked_by
    metric = IN_WORDS[headline_of(*[line.entry.suite for line in ordered])]
    others = [name for name in ordered[0].success if name != by]
    scores = [line.success[by] for line in ordered]
    _, most = reach([score for score in scores if score])
    rows = []
    for line, score in zip(ordered, scores, strict=True):
        name = Markup("{}<small>{}</small>").format(visible(line.name), visible(_by(line)))
        row = (
            name,
            "–" if line.rank is None else str(line.rank),
            cell(score),
            forest(score, 0.0, most) if score else "",
            cell(line.gain),
            *[cell(line.success[condition]) for condition in others],
            _checked(line.entry),
        )
        rows.append(row)
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
        f"{edition.description}. {metric.capitalize()} in %, means over "
        f"{len(suite.runs)} families, "
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
    table = Table(f"Entries by {metric} under {by}", heads, rows, note, left=True)
    caveats = [f"Left out: {visible(reason)}" for reason in left_out]
    return document([Section(edition.name, about=[about], caveats=caveats, tables=[table])])


def _by(line: Line) -> str:
    made_by = line.entry.contents.made_by
    return f"made by {made_by}" if made_by else "made by nobody named"


def _checked(entry: Rescored) -> Markup:
    """Return how many of an entry's figures differ when they are computed again."""
    differing = sum(len(differences) for differences in entry.differences.values())
    if differing:
        return Markup('<span class="worse">✗ {} figures differ</span>').format(differing)
    return Markup('<span class="better">✓ {} figures, all equal</span>').format(entry.compared)
