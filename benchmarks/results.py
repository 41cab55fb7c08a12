"""What models do in the paper's scenario:
prompts, answer modes and conditions, with n and intervals.

    python benchmarks/results.py [--limit N] [--layouts N] [--device D] [--only TEXT]
                                 [--out reports/results] [--page docs/results.md]
                                 [--details benchmarks/measured/results.md]
                                 [--picture docs/pictures/results.svg]

It evaluates each row of `ROWS` on the report layouts of `DATASET`, one run a row, and writes
success between the marks of the page, what the answers are like between those of the details, and
the picture. Finished runs are read and not made again; a stopped one goes on with the same command.
On a CPU, a published model takes seconds an answer: with `--limit` it is asked on fewer layouts,
and each row says on how many.
"""

import argparse
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure
from pages import harness, options, write_tables

from harness.core.figures import interval_of
from harness.extensions.checkups.prompt import ROLES, Answers, described
from harness.prompts import versions as prompts
from harness.report.drawing.colours import CONDITIONS, GREY
from harness.report.drawing.pictures import save, styled
from harness.runs.folder import Run, read
from harness.runs.records import Score

SMALLEST = "--only proxy --layouts 1"
DATASET = "occluded-intersection-v2"  # all rows are of it; published models take hours
CONDITIONS_SHOWN = ("single-local", "v2x", "6g", "6g:messages=shuffled")
HEADS = ("alone", "v2x", "6g", "6g, shuffled")
# every helper's answers are described
ARGUMENTS = ("--control", "shuffled-messages", "--ask", "all")


class Row(NamedTuple):
    """A run of the page: who answers what, and how."""

    model: str
    prompt: str = "v2"
    answer: str = "json"

    @property
    def name(self) -> str:
        """Its name in the tables; a rule reads no prompt."""
        return f"{self.model} · {self.prompt} · {self.answer}" if self in MODELS else self.model

    @property
    def folder(self) -> str:
        """Its run's folder."""
        return f"{self.model}-{self.prompt}-{self.answer}"


PUBLISHED = (
    Row("smollm2-135m", "v2", "json"),
    Row("smollm2-135m", "v9", "json"),
    Row("smollm2-135m", "v10", "json"),
    Row("smollm2-135m", "v10", "constrained"),
    Row("smollm2-135m", "v9", "readout"),
    Row("smollm2-135m", "v10", "readout"),
    Row("swarm-smol", "v9", "readout"),  # the same weights with an adapter, so as slow
)
OURS = (
    Row("swarm-tiny", "v2", "json"),
    Row("swarm-tiny", "v2", "readout"),
    Row("swarm-tiny-six", "v4", "json"),
    Row("swarm-tiny-six", "v4", "readout"),
)
RULES = tuple(
    Row(name) for name in ("proxy", "local-view", "constant", "uniform", "brake", "full-view")
)
MODELS = (*PUBLISHED, *OURS)
ROWS = (*MODELS, *RULES)


def main() -> None:
    """Make the runs that are missing, and write the page's tables and its picture."""
    arguments = options(__doc__, "results", picture=True)
    arguments.add_argument(
        "--details", type=Path, help="page to write to what the answers are like"
    )
    arguments.add_argument("--limit", type=int, help="layouts of each run of a published model")
    arguments.add_argument(
        "--answers", type=Path, help="folder of such runs, whose answers are scored again"
    )
    arguments.add_argument("--device", help="where published models run")
    arguments.add_argument("--batch-size", help="prompts of a published model in one batch")
    given = arguments.parse_args()
    for row in ROWS:
        if given.only in row.folder:
            make(row, given)
    runs = {
        row: read(path)
        for row in ROWS
        if (path := given.out / row.folder).joinpath("run.json").exists()
    }
    said = {row: list(of_roles(row, run)) for row, run in runs.items() if row in MODELS}
    details = f"{answers(runs, said)}\n\n{sentences(said)}"
    for page, text in ((given.page, success(runs)), (given.details, details)):
        print(text)
        if page:
            write_tables(page, text)
    if given.picture:
        save(drawn(runs), given.picture, "svg")


def make(row: Row, given: argparse.Namespace) -> None:
    """Make a row's run, unless it is finished."""
    out = given.out / row.folder
    if (out / "run.json").exists():
        return
    old = given.answers / row.folder if given.answers else None
    model = f"replay:{old}" if old and old.exists() else row.model
    words = ["eval", "--model", model, "--dataset", DATASET, "--prompt", row.prompt]
    words += ["--answer", row.answer, "--out", str(out)]
    if model != row.model:
        words += ["--ties", "drawn"]  # else as it was in the run
    elif row in PUBLISHED:
        for option in ("limit", "device", "batch_size"):
            if value := getattr(given, option):
                words += [f"--{option.replace('_', '-')}", str(value)]
    if given.layouts:
        words += ["--limit", str(given.layouts)]
    harness(*words, *ARGUMENTS)


def success(runs: dict[Row, Run]) -> str:
    """Success of every run under every condition."""
    lines = [
        f"| who answers | n | {' | '.join(HEADS)} | gain, 6g over alone |",
        f"|---|--:|{'--:|' * (len(HEADS) + 1)}",
    ]
    for row, run in runs.items():
        cells = [percent(run.score(condition, "success_rate")) for condition in CONDITIONS_SHOWN]
        gain = percent(run.score("6g", "success_gain_over_single-local"))
        lines.append(f"| {row.name} | {len(run.grid.episodes)} | {' | '.join(cells)} | {gain} |")
    return "\n".join(lines)


def percent(score: Score | None) -> str:
    """A score in percent over its interval."""
    if score is None:
        return "–"
    return interval_of(score).replace(" [", "<br>[").replace(", ", ",&nbsp;")


def answers(runs: dict[Row, Run], said: dict[Row, list[Answers]]) -> str:
    """What the answers of every model are like, in both roles."""
    lines = [
        "| who answers | role | n | readable % | strict % | copies an example % | follows the "
        "letter % | distinct | commonest action % |",
        "|---|---|--:|--:|--:|--:|--:|--:|---|",
    ]
    for row, it in ((row, it) for row, roles in said.items() for it in roles):
        shares = [f"{100 * n / it.n:.1f}" for n in (it.readable, it.strict, it.example_copies)]
        common = f"{it.action} {100 * it.action_count / it.readable:.1f}" if it.readable else "–"
        letter = runs[row].score("all", f"follows_letter_{it.role}")
        shares.append("–" if letter is None else f"{100 * (letter.value or 0):.1f}")
        lines.append(
            f"| {' | '.join([row.name, it.role, str(it.n), *shares, str(it.distinct), common])} |"
        )
    return "\n".join(lines)


def sentences(said: dict[Row, list[Answers]]) -> str:
    """What each prompt did, in a sentence a role: the two things that are true of most answers."""
    return "\n".join(
        f"- **{row.name}**, {it.role}: {'; '.join(islice(it.sentences(), 2))}."
        for row, roles in said.items()
        for it in roles
    )


def of_roles(row: Row, run: Run) -> Iterator[Answers]:
    """What each role's answers are like."""
    prompt = prompts.load(row.prompt)
    for role in ROLES:
        of_role = [answer for answer in run.answers if answer.role == role]
        if of_role:
            yield described(prompt, role, run.actions, of_role)


@styled
def drawn(runs: dict[Row, Run]) -> Figure:
    """Success alone and under 6g, a line each row."""
    figure = Figure(figsize=(7.2, 0.28 * len(runs) + 0.7))
    axes = figure.subplots()
    rows: Sequence[Row] = list(runs)
    for shift, condition in ((-0.14, "single-local"), (0.14, "6g")):
        for place, row in enumerate(rows):
            score = runs[row].score(condition, "success_rate")
            if score is None or score.value is None or score.low is None or score.high is None:
                continue
            ends = [[100 * (score.value - score.low)], [100 * (score.high - score.value)]]
            axes.errorbar(
                100 * score.value,
                place + shift,
                xerr=ends,
                fmt="o" if condition == "6g" else "s",
                ms=4,
                color=CONDITIONS[condition],
                lw=1.2,
                label=condition if not place else None,
            )
    last = max((n for n, row in enumerate(rows) if row in PUBLISHED), default=-1)
    axes.axhline(last + 0.5, color=GREY, lw=0.6, ls=":")
    axes.set_yticks(
        range(len(rows)),
        [f"{row.name}  (n = {len(runs[row].grid.episodes)})" for row in rows],
        fontsize=7,
    )
    axes.set(xlim=(-2, 102), ylim=(len(rows) - 0.5, -0.5), xlabel="success %, with 95 % intervals")
    axes.legend(fontsize=7, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return figure


if __name__ == "__main__":
    main()
