"""What a swarm is worth: every vehicle decides, with what they may hear of each other,
by scene and model.

    python benchmarks/agents.py [--only TEXT] [--layouts N] [--out reports/agents]
                                [--page benchmarks/measured/agents.md] [OPTIONS]

Drives each scene that has seats on report layouts: with all of its vehicles as agents, with the ego
alone, and with the first model also with a share of them, and beside it plans each layout for all
agents together. Further options, such as `--device cuda`, go to `harness drive`. What is finished
is read and not made again; a stopped one goes on with the same command, and several with a TEXT of
their own may run side by side. Then it writes the tables of the page, of all that is there, between
its marks.
"""

import json
from collections import defaultdict
from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pages import harness, markdown, options, write_tables

from harness.core.figures import DASH, interval_of
from harness.core.files import write_whole
from harness.core.seeds import FIRST
from harness.core.statistics import paired_difference, rate_interval
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
ALONE = {f"one ego, {name}": CONDITIONS[name] for name in ("nothing", "intents")}
FIGURES = {
    "arrived %": "arrived_rate",
    "met %": "met_rate",
    "stuck %": "time_out_rate",
    "lost, s": "agents_lost_s",
    "lost by one, s": "most_lost_s",
    "latency, ms": "latency_proxy_ms",
}
SHARES = (0.25, 0.5, 0.75)
# by layout seed, whether there is a joint plan in which everybody arrives
Plans = Mapping[int, bool]


class Driver(NamedTuple):
    """A model that drives, and how it is asked."""

    model: str
    prompt: str
    answer: str
    layouts: int  # report layouts of each scene


DRIVERS = (
    Driver("proxy", "v4", "json", 100),
    Driver("swarm-tiny-six-v2", "v4", "readout", 40),
    Driver("swarm-smol", "v9", "readout", 40),
    Driver("smollm2-135m", "v9", "readout", 40),
)


class Driven(NamedTuple):
    """A run of a scene in which a share of the vehicles decide; of 0 only the ego does."""

    driver: Driver
    scene: str
    share: float
    run: Run


def main() -> None:
    """Drive what is missing, and write the page's tables."""
    given, further = options(__doc__, "agents").parse_known_args()
    made, plans, ended = list[Driven](), dict[str, Plans](), dict[str, str]()
    for scene in (name for name in scenarios.names() if "agent_share" in scenarios.get(name).dials):
        for driver in DRIVERS:
            layouts = given.layouts or driver.layouts
            for share in (1, 0, *(SHARES if driver == DRIVERS[0] else ())):
                out = given.out / f"{driver.model}-{scene}-{share:g}"
                if given.only in out.name and not (out / "run.json").exists():
                    drive(driver, scene, share, layouts, out, further)
                if (out / "run.json").exists():
                    made.append(Driven(driver, scene, share, read(out)))
        file = given.out / f"joint-{scene}.json"
        if given.only in f"{DRIVERS[0].model}-{scene}-1" and not file.exists():
            write_whole(file, jointly(scene, given.layouts or DRIVERS[0].layouts))
        said = json.loads(file.read_bytes()) if file.exists() else None
        plans[scene] = solved(said) if said else {}
        ended[scene] = searched(said) if said else ""
    tables = (
        *overall(made, plans, ended),
        *by_halves(made),
        *details(made, plans),
        *by_share(made),
    )
    text = "\n\n".join(tables)
    print(text)
    if given.page:
        write_tables(given.page, text)


def drive(
    driver: Driver, scene: str, share: float, layouts: int, out: Path, further: Sequence[str]
) -> None:
    """Drive a scene's report layouts in which this share of the vehicles decide."""
    points = [word for name in conditions(share).values() for word in ("--condition", name)]
    who = ("--model", driver.model, "--prompt", driver.prompt, "--answer", driver.answer)
    where = ("--scenario", scene, "--agents", f"{share:g}", "--episodes", str(layouts))
    seeds = ("--first-seed", str(FIRST["report"]), "--out", str(out), "--quiet")
    harness("drive", *who, *where, *points, *seeds, *further)


def conditions(share: float) -> dict[str, str]:
    """Return the conditions that a run of this share has, by what is heard."""
    return CONDITIONS if share == 1 else ALONE


def jointly(scene: str, layouts: int) -> str:
    """Return what is said of the joint plans of a scene's report layouts."""
    where = ("--agents", "all", "--episodes", str(layouts), "--seed", str(FIRST["report"]))
    return harness("dataset", "scenario", "drive", scene, *where, "--json")


def solved(said: dict[str, Any]) -> Plans:
    """Return whether a joint plan brings everybody to its goal, by layout seed."""
    return {
        seed: seed not in said["unsolved"]
        for seed in range(said["seed"], said["seed"] + said["episodes"])
    }


def searched(said: dict[str, Any]) -> str:
    """Return in how many layouts the joint plan is the best, and what it is in the others."""
    n, open_n = said["episodes"], len(said["inexact"])
    return f" (best found; best in {n - open_n} of {n})" if open_n else f" (best in all {n})"


def overall(
    made: Sequence[Driven], plans: Mapping[str, Plans], ended: Mapping[str, str]
) -> Iterator[str]:
    """Yield a table of success, with a row for each scene and model."""
    rows = dict[tuple[str, str], dict[str, str]]()
    for each in (each for each in made if each.share in (0, 1)):
        success = {
            name: estimate(each.run, point, "success_rate")
            for name, point in conditions(each.share).items()
        }
        layouts = {"n": str(len(each.run.grid.episodes))}
        rows.setdefault((each.scene, each.driver.model), layouts).update(success)
    ways = ("n", *ALONE, *CONDITIONS)
    best = {
        scene: interval_of(rate_interval(np.array([*plan.values()], dtype=float))) + ended[scene]
        if plan
        else DASH
        for scene, plan in plans.items()
    }
    yield "**Success %**, of the ego where it alone decides, and else of all agents:"
    yield markdown(
        ("scene", "model", *ways, "joint plan"),
        [
            (scene, model, *(row.get(way, DASH) for way in ways), best[scene])
            for (scene, model), row in rows.items()
        ],
    )


def details(made: Sequence[Driven], plans: Mapping[str, Plans]) -> Iterator[str]:
    """Yield a table for each run in which all decide."""
    for each in (each for each in made if each.share == 1):
        run, n, seeds = each.run, len(each.run.grid.episodes), len(each.run.grid.seeds)
        silent = CONDITIONS["nothing"]
        yield f"**{each.scene}, {each.driver.model}**, n = {n} layouts × {seeds} channel seeds:"
        rows = [
            (
                name,
                estimate(run, point, "success_rate"),
                DASH if point == silent else more(success(run, point), success(run, silent)),
                more(success(run, point), plans[each.scene]),
                *(estimate(run, point, metric) for metric in FIGURES.values()),
            )
            for name, point in CONDITIONS.items()
        ]
        yield markdown(
            ("they hear", "success %", "above nothing", "above the plan", *FIGURES), rows
        )


def by_halves(made: Sequence[Driven]) -> Iterator[str]:
    """Yield a table of what the first model gains by what all hear, with a danger and without."""
    rows = []
    for each in (each for each in made if each.share == 1 and each.driver == DRIVERS[0]):
        dangers = {episode.layout_seed: episode.danger != "none" for episode in each.run.episodes}
        halves = [
            {layout for layout in dangers if dangers[layout] == half} for half in (True, False)
        ]
        silence = success(each.run, CONDITIONS["nothing"])
        row = {"scene": each.scene, "n": ", ".join(str(len(half)) for half in halves)}
        for name in list(CONDITIONS)[1:]:
            heard = success(each.run, CONDITIONS[name])
            row[name] = ", ".join(more(part(heard, half), silence) for half in halves)
        rows.append(row)
    if rows:
        yield (
            f"**Above nothing by halves**, {DRIVERS[0].model}: with a danger, without; *n* layouts "
            "of each:"
        )
        yield markdown(tuple(rows[0]), [tuple(row.values()) for row in rows])


def part(success_by_layout: Mapping[int, float], layouts: Container[int]) -> dict[int, float]:
    """Return the success in these layouts."""
    return {layout: value for layout, value in success_by_layout.items() if layout in layouts}


def by_share(made: Sequence[Driven]) -> Iterator[str]:
    """Yield a table of the first model's success by the share that decide."""
    rows = [
        (
            each.scene,
            f"{each.share:.0%}",
            *(estimate(each.run, point, "success_rate") for point in ALONE.values()),
        )
        for each in sorted(made, key=lambda each: each[:3])
        if each.driver == DRIVERS[0] and each.share
    ]
    if rows:
        yield (
            f"**How many decide**, {DRIVERS[0].model}: success of all agents, by the share that "
            "are agents:"
        )
        yield markdown(("scene", "agents", "nothing", "intents"), rows)


def estimate(run: Run, condition: str, metric: str) -> str:
    """Return an estimate over episodes with its interval."""
    for score in run.scores:
        if (score.condition, score.metric, score.interval) == (condition, metric, "episodes"):
            return interval_of(score.estimate, METRICS[metric].unit)
    return DASH


def success(run: Run, condition: str) -> dict[int, float]:
    """Return the share of channel seeds with which an episode succeeds, by layout seed."""
    seen = defaultdict[int, list[bool]](list)
    for episode in run.episodes:
        if episode.condition == condition:
            seen[episode.layout_seed].append(episode.success)
    return {layout: float(np.mean(each)) for layout, each in seen.items()}


def more(own: Mapping[int, float], other: Mapping[int, float]) -> str:
    """Return by how many points one success is above another, over the layouts that both have."""
    pair = np.array(
        [(own[layout], other[layout]) for layout in own if layout in other], dtype=float
    )
    return (
        interval_of(paired_difference([pair[:, 0] - pair[:, 1]]), sign="+") if len(pair) else DASH
    )


if __name__ == "__main__":
    main()
