"""Asked for, or sent unasked? What each is worth and what it costs, radio by radio.

    python benchmarks/unasked.py [--layouts N] [--only TEXT] [--out reports/unasked]
                                 [--page benchmarks/measured/unasked.md]

For each row of `ROWS` it evaluates a model on report layouts, frozen, and drives the same layouts
where the row says so, in each of its contents over a radio. It writes the tables of the page
between its marks; costs, and differences to intents, are driven where it drives. What is finished
is read and not made again; a stopped one goes on with the same command.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from families import Families, Row
from pages import markdown, options, write_tables

from harness.core.figures import Unit, interval_of
from harness.dataset import suites
from harness.runs import folder
from harness.runs.headline import BALANCED
from harness.runs.metric_names import BASELINE, GAINS

SMALLEST = "--only proxy-v4-json/6g --layouts 1"
SEEDS = "0:2"
NEVER = "tau_nats=9"  # no entropy is as high, so nobody is asked
INTENTS = "intents, asked for"
CONTENTS = {
    INTENTS: "",
    "objects, asked for": "content=objects",
    "both, asked for": "content=both",
    "a stream": f"stream=cpm,{NEVER}",
    "a stream, every 0.2 s": f"stream=cpm,stream_interval_s=0.2,{NEVER}",
    "a stream, every 0.5 s": f"stream=cpm,stream_interval_s=0.5,{NEVER}",
    "a stream, every 1 s": f"stream=cpm,stream_interval_s=1,{NEVER}",
    "a stream, and intents": "stream=cpm",
}
CAMS = {
    INTENTS: "",
    "CAMs": f"stream=cam,{NEVER}",
    "CAMs, and intents": "stream=cam",
    "CAMs and CPMs": f"stream=cam+cpm,{NEVER}",
    "CAMs and CPMs, every 1 s": f"stream=cam+cpm,stream_interval_s=1,{NEVER}",
}
HEADS = (
    "what is sent", "balanced, %", "over nothing", "with a danger", "without",
    "driven, %", "driven, over nothing", "over intents", "kbit", "airtime, ms", "late, %",
)  # fmt: skip
HALVES = ("success_dangerous_rate", "success_harmless_rate")
KBIT, SHARE, MS = Unit("", 1, 1e-3), Unit("", 1, 100.0), Unit("", 2, 1.0)
COSTS = (("bits_per_episode", KBIT), ("airtime_ms", MS), ("deadline_miss_rate", SHARE))


class Asked(NamedTuple):
    """A table of the page: a model over a radio, with its settings."""

    row: Row
    radio: str
    drives: bool = False
    contents: Mapping[str, str] = CONTENTS

    def __str__(self) -> str:
        cams = ", CAMs for beacons" if self.contents is CAMS else ""
        return f"{self.row} over {self.radio}, {self.row.dataset}{cams}"

    @property
    def name(self) -> str:
        """Its folder."""
        cams = "-cams" if self.contents is CAMS else ""
        return f"{self.row.name}/{self.radio}-{self.row.dataset}{cams}".replace(":", "-")

    @property
    def conditions(self) -> dict[str, str]:
        """What is sent, and the condition in which it is."""
        points = {"nothing": BASELINE}
        for content, settings in self.contents.items():
            name, _, changed = self.radio.partition(":")
            parts = [part for part in (changed, "encoding=etsi", settings) if part]
            points[content] = f"{name}:{','.join(parts)}"
        return points

    @property
    def options(self) -> list[str]:
        """The conditions as options of a command, and the seeds."""
        points = [word for point in self.conditions.values() for word in ("--condition", point)]
        return [*points, "--seeds", SEEDS]


SMALL = Row("swarm-tiny-six-v2", "v4", "readout", limit=20)
RULE = Row("proxy", "v4", "json")
ROWS = (
    Asked(RULE, "6g", drives=True),
    Asked(RULE, "its-g5:density_per_km=120", drives=True),
    Asked(RULE, "its-g5:density_per_km=60"),
    Asked(RULE, "mode4:density_per_km=200", drives=True),
    Asked(RULE, "mode4:density_per_km=100", drives=True),
    Asked(RULE, "mode4:density_per_km=300", drives=True),
    Asked(RULE, "mode2:density_per_km=100", drives=True),
    Asked(RULE, "mode2:density_per_km=200", drives=True),
    Asked(RULE, "its-g5:density_per_km=120", drives=True, contents=CAMS),
    Asked(RULE, "mode4:density_per_km=200", drives=True, contents=CAMS),
    Asked(SMALL, "its-g5:density_per_km=120", drives=True),
    Asked(RULE._replace(dataset="sumo-crossing-v1"), "its-g5:density_per_km=120"),
    Asked(RULE._replace(dataset="sumo-merge-v1"), "its-g5:density_per_km=120"),
)


def main() -> None:
    """Make what is missing, and write the page's tables."""
    given = options(__doc__, "unasked").parse_args()
    tables = []
    for asked in ROWS:
        here, row = given.out / asked.name, asked.row.asked(layouts=given.layouts)
        if given.only in asked.name:
            row.evaluate(here / "frozen", *asked.options)
            if asked.drives:
                row.drive(here / "driven", *asked.options)
        if frozen := Families.read(here / "frozen"):
            tables.append(written(asked, frozen, driven(asked, here)))
    text = "\n\n".join(tables)
    print(text)
    if given.page:
        write_tables(given.page, text)


def driven(asked: Asked, here: Path) -> Families | None:
    """Return the driven runs by family; None unless all are done."""
    outs = {name: here / "driven" / name for name in suites.datasets(asked.row.dataset)}
    if not all((out / "run.json").exists() for out in outs.values()):
        return None
    return Families({name: folder.read(out) for name, out in outs.items()})


def written(asked: Asked, frozen: Families, drove: Families | None) -> str:
    """Return a table of the page, with its title."""
    heads = HEADS if drove else [head for head in HEADS if not head.startswith("driven")]
    rows = []
    for content, condition in asked.conditions.items():
        cells = [content, *successes(frozen, condition)]
        cells += [frozen.shown(condition, half) for half in HALVES]
        if drove:
            cells += successes(drove, condition)
        intents = asked.conditions[INTENTS]
        difference = (drove or frozen).difference(condition, intents)
        cells.append("" if condition == intents else interval_of(difference, sign="+"))
        for metric, unit in COSTS:
            estimate = (drove or frozen).estimate(condition, metric)
            cells.append(unit.number(estimate.value if estimate else None))
        rows.append(cells)
    counted = frozen.counted + (f"; driven {drove.counted}" if drove else "")
    return f"**{asked}**: {counted}\n\n{markdown(heads, rows)}"


def successes(runs: Families, condition: str) -> tuple[str, str]:
    """Return balanced success, and what it is more than without V2V, of a table's cells."""
    gain = "" if condition == BASELINE else runs.shown(condition, GAINS[BALANCED], "+")
    return runs.shown(condition, BALANCED), gain


if __name__ == "__main__":
    main()
