"""What do the strongest lies leave of each consensus rule, over six families?

    python benchmarks/strongest_lies.py [--only TEXT] [--layouts N] [--out reports/strongest-lies]
                                        [--page benchmarks/measured/trust.md]

It evaluates `proxy` on the report layouts of a suite, or reads the runs in a folder, looks for the
strongest lies against each rule in each of them (`harness study trust`), and joins their episodes.
It ends with the CPU seconds of that. What is finished is read and not made again.
"""

import json
from pathlib import Path
from time import process_time

import numpy as np
from families import Row
from pages import markdown, options, write_tables

from harness.coordination.contents import INTENTS
from harness.coordination.rules import RULES, reads
from harness.core.progress import Progress
from harness.dataset import suites
from harness.extensions.trust.bench import Bench, Cell
from harness.extensions.trust.strongest_lies import StrongestLies
from harness.extensions.trust.study import CAPPED, run_bench
from harness.extensions.trust.worst_page import worst_tables
from harness.runs.success import Success
from harness.studies.replayed_run import ReplayedRun

SMALLEST = "--layouts 2 --only blind-merge"
PROXY = Row("proxy", "v4", "json")
SEEDS = "0:5"
SHARE = 1 / 3
OF_INTENTS = [rule for rule in RULES if INTENTS in reads(rule)]
RULES_PLAYED = (*OF_INTENTS, "linear:weight_cap=0.3", CAPPED)


def main() -> None:
    """Make what is missing, and print the tables of all families together."""
    parser = options(__doc__, "strongest-lies")
    parser.add_argument("--runs", type=Path, help="folder whose folders are runs, such as on tune")
    parser.add_argument("--rules", default=",".join(RULES_PLAYED), help="rules, by commas")
    given = parser.parse_args()
    row = PROXY.asked(layouts=given.layouts)
    run = given.out / row.name
    if given.runs is None:
        row.evaluate(run, "--condition", "single-local", "--condition", "6g", "--seeds", SEEDS)
        folders = [run / name for name in suites.datasets(row.dataset)]
    else:
        folders = sorted(folder.parent for folder in given.runs.glob("*/run.json"))
    benches, started = [], process_time()
    for folder in folders:
        if given.only in folder.name:
            replayed = ReplayedRun(folder)
            out, rules = given.out / "study" / folder.name, given.rules.split(",")
            seeds = replayed.seeds
            bench = run_bench(replayed, "6g", rules, (), (SHARE,), seeds, out, Progress())
            benches.append(bench)
    taken_s = process_time() - started
    bench = joined(benches)
    tables = []
    for table in worst_tables(bench):
        tables.append(f"**{table.title}**\n\n{markdown(table.heads, table.rows)}")

    text = "\n\n".join(tables)
    print(text)
    if given.page:
        write_tables(given.page, text)
    print(json.dumps({"cpu_s": round(taken_s, 1), "episodes": bench.alone.size}))


def joined(benches: list[Bench]) -> Bench:
    """Return a study whose episodes are those of several."""
    cells = {}
    for key in benches[0].cells:
        of_key = [bench.cells[key] for bench in benches]
        success = np.hstack([cell.success for cell in of_key])
        unsafe = np.hstack([cell.unsafe for cell in of_key])
        nats = np.hstack([cell.nats for cell in of_key])
        cells[key] = Cell(*key, success, unsafe, nats, flagged=None, first=[])
    lies = {}
    for rule in benches[0].strongest_lies:
        of_rule = [bench.strongest_lies[rule].values() for bench in benches]
        values = {name: np.hstack([each[name] for each in of_rule]) for name in of_rule[0]}
        lies[rule] = StrongestLies.of(values)
    dangerous = [bench.success_rule.dangerous for bench in benches]
    alone = np.hstack([bench.alone for bench in benches])
    success_rule = Success(np.concatenate(dangerous))
    first = benches[0]
    return Bench(
        first.name,
        "all",
        first.condition,
        first.seeds,
        cells,
        alone,
        success_rule,
        strongest_lies=lies,
    )


if __name__ == "__main__":
    main()
