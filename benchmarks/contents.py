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
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from markupsafe import Markup

from harness.coordination.contents import CONTENTS
from harness.core.arrays import Floats
from harness.core.figures import shown
from harness.core.progress import Progress
from harness.core.resources import DATASET
from harness.dataset import suites
from harness.dataset.load import find, load
from harness.report.document import Table
from harness.runs.folder import read
from harness.runs.metrics import METRICS, SUCCESS, by_episode
from harness.studies.contents import BASE, NOTHING, Outcome, folders, models, panels_of, run_contents
from harness.studies.replayed_run import ReplayedRun
from harness.studies.study import Study, write_study

SUITE = "suite:v2v-safety"
PLAYED = {NOTHING: "single-local", **{name: f"{BASE},content={name}" for name in CONTENTS}}


class Row(NamedTuple):
    """A model, how it is asked, and on which scenes."""

    model: str
    prompt: str
    answer: str = "json"
    dataset: str = SUITE
    rule: bool = False  # whether it costs nothing to ask, so that no limit applies
    drives: bool = True  # whether it drives as well

    @property
    def name(self) -> str:
        """Its folder."""
        return f"{self.model}-{self.prompt}-{self.answer}"

    @property
    def datasets(self) -> Sequence[str]:
        """The datasets of its families."""
        named = suites.named(self.dataset)
        return named.datasets if named else (self.dataset,)


ROWS = (
    Row("proxy", "v4", rule=True),
    Row("swarm-tiny", "v2", "readout", DATASET),
    Row("swarm-tiny-six", "v4", "readout"),
    Row("smollm2-135m", "v10", "json", DATASET, drives=False),
)


def main() -> None:
    """Make what is missing, and write the page's tables."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--limit", type=int, help="layouts of a family that language models get")
    arguments.add_argument("--only", default="", help="only rows whose folder holds this text")
    arguments.add_argument("--out", type=Path, default=Path("reports/contents"))
    arguments.add_argument("--page", type=Path)
    given = arguments.parse_args()
    parts = []
    for row in ROWS:
        if given.only in row.name:
            here = given.out / row.name
            limit = None if row.rule else given.limit
            evaluate(row, here / "frozen", limit)
            study = play(row, here)
            driven = drive(row, here, limit) if row.drives else {}
            parts.append(written(row, study, driven))
    text = "\n\n".join(parts)
    print(text)
    if given.page:
        page = given.page.read_text("utf-8")
        page = re.sub(
            r"(<!-- tables -->\n).*(<!-- end -->)", lambda m: f"{m[1]}{text}\n{m[2]}", page, flags=re.S
        )
        given.page.write_text(page, "utf-8")


def harness(*words: str) -> None:
    """Run a command of the harness, and say which."""
    print(f"harness {' '.join(words)}", file=sys.stderr, flush=True)
    subprocess.run([sys.executable, "-m", "harness", *words, "--quiet"], check=True, stdout=sys.stderr)


def evaluate(row: Row, out: Path, limit: int | None) -> None:
    """Evaluate a model on frozen scenes, alone and with intents, unless it is done."""
    if not any((out / name).exists() for name in ("suite.json", "run.json")):
        few = () if limit is None else ("--limit", str(limit))
        who = ("--model", row.model, "--prompt", row.prompt, "--answer", row.answer)
        points = ("--condition", "single-local", "--condition", BASE)
        harness("eval", *who, "--dataset", row.dataset, *points, *few, "--out", str(out))


def play(row: Row, here: Path) -> Study:
    """Play every content on a model's runs, and write the study's page."""
    print(f"harness study contents {here / 'frozen'} --out {here / 'contents'}", file=sys.stderr, flush=True)
    runs = [ReplayedRun(run) for run in folders(here / "frozen")]
    panels = panels_of(runs, (), (), ())
    study = run_contents(models([runs], panels), panels, runs[0].seeds, here / "contents", Progress())
    write_study(study, here / "contents")
    return study


def drive(row: Row, here: Path, limit: int | None) -> dict[str, Outcome]:
    """Drive the layouts of a model's datasets with each content, and return the outcomes by content."""
    families: dict[str, dict[str, dict[str, Floats]]] = {content: {} for content in PLAYED}
    for name in row.datasets:
        dataset = load(find(name))
        scenario, out = dataset.scenario.name, here / "driven" / name
        layouts = min(limit or len(dataset.episodes), len(dataset.episodes))
        if not (out / "run.json").exists():
            who = ("--model", row.model, "--prompt", row.prompt, "--answer", row.answer)
            points = [word for point in PLAYED.values() for word in ("--condition", point)]
            where = ("--episodes", str(layouts), "--first-seed", str(dataset.seeds[0]))
            harness("drive", *who, "--scenario", scenario, *where, *points, "--out", str(out))
        run = read(out)
        [success] = by_episode([METRICS[SUCCESS]], run.grid, run.decisions, run.episodes).values()
        for content, point in PLAYED.items():
            families[content][scenario] = {SUCCESS: success[run.conditions.index(point)]}
    return {content: Outcome(of) for content, of in families.items()}


def written(row: Row, study: Study, driven: dict[str, Outcome]) -> str:
    """Return what the page says of a model: sentences and tables, and what it comes to driven."""
    tables = [table for table in study.tables if not table.folded]
    first = tables[0]
    if driven:
        heads = (*first.heads, "driven %", "driven, over intents")
        cells = [
            (
                *cells, shown(driven[cells[0]].estimate(SUCCESS)),
                "" if cells[0] == "intent" else shown(driven[cells[0]].over(driven["intent"]), sign="+"),
            )
            for cells in first.rows
        ]  # fmt: skip
        first = Table(first.title, heads, cells)
    counted = study.about[0].split(". ")[0]
    parts = [f"### {row.model} · {row.prompt} · {row.answer}", *study.headline, f"{counted}."]
    for table in (first, *tables[1:]):
        parts += [f"**{table.title}**", markdown(table)]
    return "\n\n".join(parts)


def markdown(table: Table) -> str:
    """Return a table of the study in Markdown."""

    def line(cells: Sequence[str]) -> str:
        plain = [cell.striptags() if isinstance(cell, Markup) else cell for cell in cells]
        return f"| {' | '.join(plain)} |"

    return "\n".join([line(table.heads), f"|---|{'--:|' * (len(table.heads) - 1)}", *map(line, table.rows)])


if __name__ == "__main__":
    main()
