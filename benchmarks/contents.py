"""Intent or objects? What each content of messages is worth to a planner and to models,
and at what cost.

    python benchmarks/contents.py [--limit N] [--layouts N] [--dataset D] [--only TEXT]
                                  [--out reports/contents]
                                  [--page benchmarks/measured/intent-or-objects.md]

For each row of `ROWS` it evaluates the model on report layouts of the shipped datasets, plays
`harness study contents` on the run, and drives the same layouts in closed loop, where the time of a
second inference counts. It writes the tables of the page between its marks. What is finished is
read and not made again; a stopped one goes on with the same command. With `--limit`, language
models are asked on fewer layouts of each family, and each table says on how many.
"""

import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

from families import Row, finished
from markupsafe import Markup
from pages import markdown, options, write_tables

from harness.core.arrays import Floats
from harness.core.figures import interval_of
from harness.core.progress import Progress
from harness.dataset import suites
from harness.extensions.contents.page import contents_study
from harness.extensions.contents.study import (
    BASE,
    NOTHING,
    PLAYED,
    Outcome,
    folders,
    models,
    panels_of,
    run_contents,
)
from harness.report.document import Table
from harness.runs.folder import read
from harness.runs.headline import BALANCED, SUCCESS
from harness.runs.metric_values import by_episode
from harness.runs.metrics import METRICS
from harness.runs.success import Success, alike
from harness.studies.replayed_run import ReplayedRun
from harness.studies.study import Study, write_study

SMALLEST = "--only proxy --layouts 1 --dataset blind-merge-v2"
CONDITIONS = {
    name: "single-local" if name == NOTHING else f"{BASE},content={name}" for name in PLAYED
}


class Asked(NamedTuple):
    """A row of the page."""

    row: Row
    rule: bool = False  # whether it costs nothing to ask, so that no limit applies
    drives: bool = True  # whether it drives as well
    # the conditions that are played as they are, instead of the usual points
    panels: Sequence[str] = ()

    @property
    def datasets(self) -> Sequence[str]:
        """The datasets of its families."""
        return suites.datasets(self.row.dataset)


ONE = "occluded-intersection-v3"
ROWS = (
    Asked(Row("proxy", "v4", "json"), rule=True),
    Asked(Row("swarm-tiny", "v2", "readout", ONE)),
    Asked(Row("swarm-tiny-six", "v4", "readout")),
    Asked(Row("swarm-tiny-six-v2", "v4", "readout")),
    Asked(Row("smollm2-135m", "v10", "readout", ONE), drives=False, panels=(BASE,)),
)


def main() -> None:
    """Make what is missing, and write the page's tables."""
    arguments = options(__doc__, "contents")
    arguments.add_argument("--limit", type=int, help="layouts of a family that language models get")
    arguments.add_argument("--dataset", help="instead of each row's own")
    given = arguments.parse_args()
    points = ("--condition", "single-local", "--condition", BASE)
    rows = [asked._replace(row=asked.row.asked(dataset=given.dataset)) for asked in ROWS]
    places = {asked: given.out / asked.row.name for asked in rows}
    for asked, here in places.items():
        if given.only in here.name:
            limit = given.layouts or (None if asked.rule else given.limit)
            asked.row._replace(limit=limit).evaluate(here / "frozen", *points)
            drive(asked, here, limit, play(asked, here))
    done = {asked: here for asked, here in places.items() if finished(here / "frozen")}
    studies = [(asked.row, play(asked, here), driven(asked, here)) for asked, here in done.items()]
    text = "\n\n".join(written(*each) for each in studies)
    print(text)
    if given.page:
        write_tables(given.page, text)


@cache
def play(asked: Asked, here: Path) -> Study:
    """Play every content on a model's runs, and write the study's page."""
    print(
        f"harness study contents {here / 'frozen'} --out {here / 'contents'}",
        file=sys.stderr,
        flush=True,
    )
    runs = [ReplayedRun(run) for run in folders(here / "frozen")]
    panels = panels_of(runs, asked.panels, (), ())
    results = run_contents(
        models([runs], panels), panels, runs[0].seeds, here / "contents", Progress()
    )
    study = contents_study(results, runs[0].seeds)
    write_study(study, here / "contents")
    return study


def drive(asked: Asked, here: Path, limit: int | None, study: Study) -> None:
    """Drive the layouts of a model's datasets with each content that it can play,
    unless it is done.
    """
    if not asked.drives:
        return
    conditions = [CONDITIONS[content] for content, *_ in study.tables[0].rows]
    points = [word for point in conditions for word in ("--condition", point)]
    asked.row._replace(limit=limit).drive(here / "driven", *points)


def driven(asked: Asked, here: Path) -> dict[str, Outcome]:
    """Return what a model comes to driven, by content; nothing unless all is done."""
    families: dict[str, dict[str, dict[str, Floats]]] = {}
    outs = {name: here / "driven" / name for name in asked.datasets}
    if not all((out / "run.json").exists() for out in outs.values()):
        return {}
    runs = {name: read(out) for name, out in outs.items()}
    rules = alike(
        [Success.of(run.episodes[: len(run.grid.episodes)], BALANCED) for run in runs.values()]
    )
    for name, run in runs.items():
        [success] = by_episode([METRICS[SUCCESS]], run.grid, run.decisions, run.episodes).values()
        for content, point in CONDITIONS.items():
            if point in run.conditions:
                at = run.conditions.index(point)
                families.setdefault(content, {})[name] = {SUCCESS: success[at]}
    counting = dict(zip(runs, rules, strict=True))
    return {content: Outcome(of, counting) for content, of in families.items()}


def written(row: Row, study: Study, driven: Mapping[str, Outcome]) -> str:
    """Return what the page says of a model: sentences and tables, and what it comes to driven."""
    tables = [table for table in study.tables if not table.folded]
    first = tables[0]
    if driven:
        heads = (*first.heads, "driven %", "driven, over intents")
        cells = [
            (
                *cells,
                interval_of(driven[cells[0]].success),
                ""
                if cells[0] == "intent"
                else interval_of(driven[cells[0]].over(driven["intent"]), sign="+"),
            )
            for cells in first.rows
        ]
        first = Table(first.title, heads, cells)
    counted = study.about[0].split(". ")[0]
    parts = [f"### {row}", *study.headline, f"{counted}."]
    for table in (first, *tables[1:]):
        parts += [f"**{table.title}**", in_markdown(table)]
    return "\n\n".join(parts)


def in_markdown(table: Table) -> str:
    """Return a table of the study in Markdown."""
    rows = (
        [cell.striptags() if isinstance(cell, Markup) else cell for cell in row]
        for row in table.rows
    )
    return markdown(table.heads, rows)


if __name__ == "__main__":
    main()
