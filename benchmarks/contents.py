"""Intent or objects? What each content of messages is worth to a planner and to models, and at what cost.

    python benchmarks/contents.py [--limit N] [--only TEXT] [--out reports/contents]
                                  [--page docs/intent-or-objects.md]

For each row of `ROWS` it evaluates the model on report layouts of the shipped datasets, plays
`harness study contents` on the run, and drives the same layouts in closed loop, where the time of a second
inference counts. It writes the tables of the page between its marks. What is finished is read and not made
again; a stopped one goes on with the same command. With `--limit`, language models are
asked on fewer layouts of each family, and each table says on how many.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from markupsafe import Markup
from pages import harness, markdown, write_tables

from harness.coordination.contents import CONTENTS
from harness.core.arrays import Bools, Floats
from harness.core.figures import shown
from harness.core.progress import Progress
from harness.dataset import suites
from harness.dataset.load import find, load
from harness.report.document import Table
from harness.runs.folder import read
from harness.runs.metrics import METRICS, SUCCESS, by_episode
from harness.studies.contents import BASE, NOTHING, Outcome, folders, models, panels_of, run_contents
from harness.studies.contents_page import contents_study
from harness.studies.replayed_run import ReplayedRun
from harness.studies.study import Study, write_study
from harness.world import scenarios

SUITE = "suite:v2v-safety-2"
PLAYED = {NOTHING: "single-local", **{name: f"{BASE},content={name}" for name in CONTENTS}}


class Row(NamedTuple):
    """A model, how it is asked, and on which scenes."""

    model: str
    prompt: str
    answer: str = "json"
    dataset: str = SUITE
    rule: bool = False  # whether it costs nothing to ask, so that no limit applies
    drives: bool = True  # whether it drives as well
    panels: Sequence[str] = ()  # the conditions that are played as they are, instead of the usual points

    @property
    def name(self) -> str:
        """Its folder."""
        return f"{self.model}-{self.prompt}-{self.answer}"

    @property
    def who(self) -> Sequence[str]:
        """The options that name it."""
        return "--model", self.model, "--prompt", self.prompt, "--answer", self.answer

    @property
    def datasets(self) -> Sequence[str]:
        """The datasets of its families."""
        return suites.datasets(self.dataset)


ROWS = (
    Row("proxy", "v4", rule=True),
    Row("swarm-tiny", "v2", "readout", "occluded-intersection-v3"),
    Row("swarm-tiny-six", "v4", "readout"),
    Row("swarm-tiny-six-v2", "v4", "readout"),
    Row("smollm2-135m", "v10", "readout", "occluded-intersection-v3", drives=False, panels=(BASE,)),
)


def main() -> None:
    """Make what is missing, and write the page's tables."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--limit", type=int, help="layouts of a family that language models get")
    arguments.add_argument("--only", default="", help="only rows whose folder holds this text")
    arguments.add_argument("--out", type=Path, default=Path("reports/contents"))
    arguments.add_argument("--page", type=Path)
    given = arguments.parse_args()
    for row in ROWS:
        if given.only in row.name:
            limit = None if row.rule else given.limit
            evaluate(row, given.out / row.name, limit)
            drive(row, given.out / row.name, limit, play(row, given.out / row.name))
    done = [row for row in ROWS if finished(given.out / row.name / "frozen")]
    studies = [(row, play(row, given.out / row.name), driven(row, given.out / row.name)) for row in done]
    text = "\n\n".join(written(*each) for each in studies)
    print(text)
    if given.page:
        write_tables(given.page, text)


def finished(out: Path) -> bool:
    """Return whether a folder has a finished run or suite."""
    return any((out / name).exists() for name in ("suite.json", "run.json"))


def evaluate(row: Row, here: Path, limit: int | None) -> None:
    """Evaluate a model on frozen scenes, alone and with intents, unless it is done."""
    out = here / "frozen"
    if not finished(out):
        few = () if limit is None else ("--limit", str(limit))
        points = ("--condition", "single-local", "--condition", BASE)
        harness("eval", *row.who, "--dataset", row.dataset, *points, *few, "--out", str(out), "--quiet")


@cache
def play(row: Row, here: Path) -> Study:
    """Play every content on a model's runs, and write the study's page."""
    print(f"harness study contents {here / 'frozen'} --out {here / 'contents'}", file=sys.stderr, flush=True)
    runs = [ReplayedRun(run) for run in folders(here / "frozen")]
    panels = panels_of(runs, row.panels, (), ())
    results = run_contents(models([runs], panels), panels, runs[0].seeds, here / "contents", Progress())
    study = contents_study(results, runs[0].seeds)
    write_study(study, here / "contents")
    return study


def drive(row: Row, here: Path, limit: int | None, study: Study) -> None:
    """Drive the layouts of a model's datasets with each content that it can play, unless it is done."""
    conditions = [PLAYED[content] for content, *_ in study.tables[0].rows]
    for name in row.datasets if row.drives else ():
        dataset, out = load(find(name)), here / "driven" / name
        layouts = min(limit or len(dataset.episodes), len(dataset.episodes))
        if not (out / "run.json").exists():
            points = [word for point in conditions for word in ("--condition", point)]
            where = ("--episodes", str(layouts), "--first-seed", str(dataset.seeds[0]))
            scenario = ("--scenario", scenarios.argument(dataset.scenario))
            harness("drive", *row.who, *scenario, *where, *points, "--out", str(out), "--quiet")


def driven(row: Row, here: Path) -> dict[str, Outcome]:
    """Return what a model comes to driven, by content; nothing unless all is done."""
    families: dict[str, dict[str, dict[str, Floats]]] = {}
    dangerous: dict[str, Bools] = {}
    outs = {name: here / "driven" / name for name in row.datasets}
    if not all((out / "run.json").exists() for out in outs.values()):
        return {}
    for name, out in outs.items():
        run = read(out)
        [success] = by_episode([METRICS[SUCCESS]], run.grid, run.decisions, run.episodes).values()
        dangerous[name] = np.array([e.danger != "none" for e in run.episodes[: len(run.grid.episodes)]])
        for content, point in PLAYED.items():
            if point in run.conditions:
                at = run.conditions.index(point)
                families.setdefault(content, {})[name] = {SUCCESS: success[at]}
    return {content: Outcome(of, dangerous) for content, of in families.items()}


def written(row: Row, study: Study, driven: Mapping[str, Outcome]) -> str:
    """Return what the page says of a model: sentences and tables, and what it comes to driven."""
    tables = [table for table in study.tables if not table.folded]
    first = tables[0]
    if driven:
        heads = (*first.heads, "driven %", "driven, over intents")
        cells = [
            (
                *cells, shown(driven[cells[0]].leading),
                "" if cells[0] == "intent" else shown(driven[cells[0]].over(driven["intent"]), sign="+"),
            )
            for cells in first.rows
        ]  # fmt: skip
        first = Table(first.title, heads, cells)
    counted = study.about[0].split(". ")[0]
    parts = [f"### {row.model} · {row.prompt} · {row.answer}", *study.headline, f"{counted}."]
    for table in (first, *tables[1:]):
        parts += [f"**{table.title}**", in_markdown(table)]
    return "\n\n".join(parts)


def in_markdown(table: Table) -> str:
    """Return a table of the study in Markdown."""
    rows = ([cell.striptags() if isinstance(cell, Markup) else cell for cell in row] for row in table.rows)
    return markdown(table.heads, rows)


if __name__ == "__main__":
    main()
