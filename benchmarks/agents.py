"""What a swarm is worth: every vehicle decides, with what they may hear of each other, by scene and model.

    python benchmarks/agents.py [--only TEXT] [--layouts N] [--out reports/agents] [--page docs/agents.md]

Drives each scene that has seats on report layouts with all of its vehicles as agents, and with the first
model also with a share of them (`SHARES`). What is finished is read and not made again; a stopped one goes on
with the same command. It writes the tables of the page between its marks.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from pages import harness, markdown, options, write_tables

from harness.core.figures import shown
from harness.core.seeds import FIRST
from harness.runs.folder import Run, read
from harness.runs.metrics import METRICS
from harness.world import scenarios

SMALLEST = "--only proxy-all-way-crossing-1 --layouts 1"
EVERYBODY = "6g:schedule=always"
PLAN = f"{EVERYBODY},content=plan,consensus=yield-by-time"
CONDITIONS = {
    "nothing": "single-local",
    "intents": EVERYBODY,
    "objects": f"{EVERYBODY},content=objects",
    "plans": PLAN,
    "plans, two rounds": f"{PLAN},rounds=2",
}
COLUMNS = ("success_rate", "arrived_rate", "met_rate", "time_out_rate", "agents_lost_s", "most_lost_s")
HEADS = ("success %", "arrived %", "met %", "stuck %", "lost, s", "lost by one, s", "latency, ms")
SHARES = (0.25, 0.5, 0.75)


class Driver(NamedTuple):
    """A model that drives, and how it is asked."""

    model: str
    answer: str
    layouts: int  # report layouts of each scene


DRIVERS = (Driver("proxy", "json", 100), Driver("swarm-tiny-six-v2", "readout", 40))


def main() -> None:
    """Drive what is missing, and write the page's tables."""
    given = options(__doc__, "agents").parse_args()
    scenes = [name for name in scenarios.names() if "agent_share" in scenarios.get(name).dials]
    made = []
    for driver in DRIVERS:
        for scene in scenes:
            for share in (1, *(SHARES if driver == DRIVERS[0] else ())):
                out = given.out / f"{driver.model}-{scene}-{share:g}"
                if given.only in out.name and not (out / "run.json").exists():
                    drive(driver, scene, share, given.layouts or driver.layouts, out)
                if (out / "run.json").exists():
                    made.append((driver, scene, share, read(out)))
    text = "\n\n".join(tables(made))
    print(text)
    if given.page:
        write_tables(given.page, text)


def drive(driver: Driver, scene: str, share: float, layouts: int, out: Path) -> None:
    """Drive a scene's report layouts in which this share of the vehicles decide."""
    names = list(CONDITIONS.values()) if share == 1 else [CONDITIONS["nothing"], EVERYBODY]
    points = [word for name in names for word in ("--condition", name)]
    who = ("--model", driver.model, "--prompt", "v4", "--answer", driver.answer)
    where = ("--scenario", scene, "--agents", f"{share:g}", "--episodes", str(layouts))
    seeds = ("--first-seed", str(FIRST["report"]), "--out", str(out), "--quiet")
    harness("drive", *who, *where, *points, *seeds)


def tables(made: Sequence[tuple[Driver, str, float, Run]]) -> Iterator[str]:
    """Yield a table for each run in which all decide, and one over shares."""
    for driver, scene, share, run in made:
        if share == 1:
            n, seeds = len(run.grid.episodes), len(run.grid.seeds)
            rows = [[name, *cells(run, point)] for name, point in CONDITIONS.items()]
            yield f"**{scene}, {driver.model}**, n = {n} layouts × {seeds} channel seeds:"
            yield markdown(("they hear", *HEADS), rows)
    pair = [CONDITIONS["nothing"], EVERYBODY]
    shares = [
        [scene, f"{share:.0%}", *(estimate(run, point, "success_rate") for point in pair)]
        for driver, scene, share, run in sorted(made, key=lambda each: each[:3])
        if driver == DRIVERS[0]
    ]
    if shares:
        yield f"**How many decide**, {DRIVERS[0].model}: success of all agents, by the share that are agents:"
        yield markdown(("scene", "agents", "nothing", "intents"), shares)


def cells(run: Run, condition: str) -> list[str]:
    """Return a condition's figures."""
    return [estimate(run, condition, name) for name in (*COLUMNS, "latency_proxy_ms")]


def estimate(run: Run, condition: str, metric: str) -> str:
    """Return an estimate over episodes with its interval."""
    for score in run.scores:
        if (score.condition, score.metric, score.interval) == (condition, metric, "episodes"):
            return shown(score.estimate, METRICS[metric].unit)
    return "–"


if __name__ == "__main__":
    main()
