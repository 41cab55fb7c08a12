"""What each answer mode scores: decision, read-out, constrained and json of the same models.

    python benchmarks/answers.py [--only TEXT] [--layouts N] [--out reports/answers]
                                 [--page benchmarks/measured/answers.md]

It evaluates each of `ASKED` in each of its modes on report layouts, alone and with helpers under
`6g`, and writes the table of the page between its marks. What is finished is read and not made
again; a stopped one goes on with the same command.
"""

from collections.abc import Iterator, Mapping

from families import Families, Row
from pages import markdown, options, write_tables

from harness.core.figures import interval_of
from harness.core.statistics import Estimate
from harness.runs.headline import BALANCED
from harness.runs.metric_names import ALL, BASELINE, GAINS

SMALLEST = "--only constant-v2 --layouts 1"
MODES = ("json", "constrained", "readout", "decision")
ONE = "occluded-intersection-v3"
ASKED = {
    Row("swarm-tiny", "v2", "", ONE, 60): MODES,
    Row("swarm-tiny-six", "v4", "", limit=20): MODES,
    Row("smollm2-135m", "v9", "", ONE, 4): MODES,
    Row("sparrow-general", "v9", "", limit=60): ("decision",),
    Row("constant", "v4", "", limit=20): ("json",),
    Row("constant", "v2", "", ONE, 60): ("json",),
}
POINTS = ("--condition", BASELINE, "--condition", "6g")
RULES = ("constant",)


def main() -> None:
    """Make what is missing, and write the page's table."""
    given = options(__doc__, "answers").parse_args()
    wanted = {row.asked(given.layouts): modes for row, modes in ASKED.items()}
    for row in (asked._replace(answer=mode) for asked, modes in wanted.items() for mode in modes):
        if given.only in row.name:
            row.evaluate(given.out / row.name, *POINTS)
    lines: list[list[str]] = []
    for asked, modes in wanted.items():
        found = {m: Families.read(given.out / asked._replace(answer=m).name) for m in modes}
        lines += written(asked, {mode: runs for mode, runs in found.items() if runs})
    heads = (
        "model · prompt · mode",
        "n",
        "alone",
        "6g",
        "6g over alone",
        "over read-out, alone",
        "failed, ego",
        "on the letters",
    )
    text = markdown(heads, lines)
    print(text)
    if given.page:
        write_tables(given.page, text)


def written(asked: Row, found: Mapping[str, Families]) -> Iterator[list[str]]:
    """Yield a model's lines: balanced success, what helpers add,
    and what the text says of the mode.
    """
    for mode, runs in found.items():
        base = found.get("readout")
        beside: Estimate | None = runs.over(base, BASELINE) if base and mode != "readout" else None
        yield [
            asked.model if asked.model in RULES else str(asked._replace(answer=mode)),
            runs.counted,
            runs.shown(BASELINE, BALANCED),
            runs.shown("6g", BALANCED),
            runs.shown("6g", GAINS[BALANCED], "+"),
            interval_of(beside, sign="+") if beside else "",
            runs.shown(ALL, "failed_rate_ego"),
            runs.shown(ALL, "label_mass_ego"),
        ]


if __name__ == "__main__":
    main()
