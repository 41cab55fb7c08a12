"""Runs on disk: one made up, and any run changed by hand.
All are written by the harness's one writer.
"""

import csv
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from operator import itemgetter
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa

from harness.coordination.named_points import POINTS
from harness.coordination.operating_point import OperatingPoint
from harness.core.errors import UserError
from harness.core.files import sha256_file
from harness.core.statistics import cluster_numbers
from harness.core.versions import FIGURES
from harness.radio.profiles import CHANNELS
from harness.runs import folder, formats, writer
from harness.runs.answer_counts import counts
from harness.runs.answer_times import times
from harness.runs.decisions import Decisions, schema
from harness.runs.grid import Grid
from harness.runs.metric import World
from harness.runs.records import Answer, ClosedLoop, Episode, FrozenScenes, Latency, Manifest
from harness.runs.summary import Figures, counted

ACTIONS = ("SLOWER", "IDLE", "FASTER")
Row = dict[str, Any]
Change = Callable[[Row], object]
# What the machine adds to an answer.
UNTIMED: Row = {"seconds": None, "first_token_s": None, "token_s": None}

_FROZEN = FrozenScenes(
    name="made-up",
    sha256="0" * 64,
    nodes=0,
    episodes=0,
    limit=None,
    delay_allowance_s=1.0,
    decision_lag_s=0.145,
    path="nowhere",
)
_DRIVEN = ClosedLoop(
    scenario={"name": "made-up", "parameters": {}}, first_seed=0, episodes=0, late_against="nobody"
)


def made_up(
    out: Path,
    decision: Change = lambda row: None,
    episode: Change = lambda row: None,
    answer: Change = lambda row: None,
    closed_loop: bool = False,
    points: Sequence[OperatingPoint] = (POINTS["single-local"], POINTS["6g"]),
    seeds: Sequence[int] = (0, 1),
    episodes: int = 4,
    steps: int = 2,
    helpers: int = 3,
    **stated: Any,
) -> Path:
    """A run in which everybody is sure of IDLE, which is safe,
    and every ego asks under V2V and hears all.

    Args:
        out: its folder.
        decision: changes a row of decisions.parquet.
        episode: changes a row of episodes.csv.
        answer: changes a row of answers.jsonl.
        closed_loop: whether it was driven.
        points: its conditions.
        seeds: of the channel.
        episodes: how many.
        steps: decisions of each.
        helpers: v2, v3, ... of each decision point.
        stated: further fields of run.json.
    """
    scenes = [(f"{e:05d}-{step}", e, step) for e in range(episodes) for step in range(steps)]
    viewers = [f"v{n + 1}" for n in range(1 + helpers)]
    rows = [
        _changed(_decision(scene, e, step, point, seed, viewers, closed_loop), decision)
        for scene, e, step in scenes for point in points for seed in seeds
    ]  # fmt: skip
    ends = [
        _changed({"condition": p.name, "seed": s, "episode": e, "layout_seed": e, "danger": "none",
                  "success": True, "failure": "", "delay_s": 0.0}, episode)
        for p in points for s in seeds for e in range(episodes)
    ]  # fmt: skip
    said = [_changed(_answer(scene, viewer), answer) for scene, *_ in scenes for viewer in viewers]
    world = msgspec.structs.replace(_DRIVEN if closed_loop else _FROZEN, episodes=episodes)
    manifest = {
        "format": formats.FORMAT, "name": out.name, "created": "2026-01-01T00:00:00+00:00",
        "command": "harness eval",
        "tags": [], "model": {"name": "made-up", "engine": "proxy"},
        "prompt": {"version": "v2", "sha256": "0" * 64, "released": True},
        "world": msgspec.to_builtins(world), "actions": ACTIONS,
        "conditions": [point.record() for point in points],
        "channels": {name: CHANNELS.record(name) for p in points if (name := p.radio.profile)},
        "seeds": seeds, "thinking": False,
        "answer": "json", "batch_size": 8, "dtype": None, "latency_source": None,
        "latency": Latency("card", "made up", 0.145, 0.145, 0.145), "identity": {"engine": "proxy"},
        "cached_answers": 0, "engine_errors": 0, "versions": {"harness": "0", "figures": str(FIGURES)},
    }  # fmt: skip
    whole = formats.upgraded(msgspec.to_builtins({**manifest, **stated}))
    return _write(out, msgspec.convert(whole, Manifest), rows, ends, said)


def change(
    run: Path,
    decision: Change = lambda row: None,
    episode: Change = lambda row: None,
    answer: Change = lambda row: None,
    **stated: Any,
) -> None:
    """Change each row of a run's tables and fields of run.json, and what follows from them.

    A row is a mapping by column, None where unknown.
    """
    read, rows, ends, said = _rows(run, decision, episode, answer)
    whole = restated(msgspec.to_builtins(read.manifest), stated)
    _write(run, msgspec.convert(formats.upgraded(whole), Manifest), rows, ends, said)


def damage(
    run: Path,
    decision: Change = lambda row: None,
    episode: Change = lambda row: None,
    answer: Change = lambda row: None,
) -> None:
    """Change each row of a run's tables, and nothing that follows from them;
    it need not be possible.
    """
    read, rows, ends, said = _rows(run, decision, episode, answer)
    decisions = _decisions(rows, read.actions, read.decisions.helpers)
    lines = writer.lines(_all(said, Answer))
    writer.write(run, read.manifest, decisions, _all(ends, Episode), [lines], read.scores)


def _rows(
    run: Path, decision: Change, episode: Change, answer: Change
) -> tuple[folder.Run, list[Row], list[Row], list[Row]]:
    read = folder.read(run)
    return (
        read,
        [_changed(row, decision) for row in read.decisions.table.to_pylist()],
        [_changed(msgspec.structs.asdict(one), episode) for one in read.episodes],
        [_changed(msgspec.structs.asdict(one), answer) for one in read.answers],
    )


def configure(run: Path, **values: object) -> None:
    """Change what run.json says, its digests of that, and who answered in the run's CSV files;
    it need not be possible.
    """
    stated = msgspec.json.decode((run / "run.json").read_bytes())
    (run / "run.json").write_bytes(msgspec.json.encode(restated(stated, values)))
    digested(run)
    name_answerers(run)


def name_answerers(run: Path) -> None:
    """State the model, prompt and answer mode of run.json in each row of a run's CSV files, if it
    can be read.
    """
    with suppress(UserError):
        names = msgspec.structs.asdict(folder.read(run).manifest.variant)
        for name in ("episodes.csv", "summary.csv"):
            with (run / name).open(newline="") as file:
                head, *rows = csv.reader(file)
            for row in rows:
                row[: len(names)] = names.values()
            with (run / name).open("w", newline="") as file:
                csv.writer(file, lineterminator="\n").writerows([head, *rows])


def digested(run: Path) -> None:
    """State the digests of what run.json states, as a forger can."""
    stated = msgspec.json.decode((run / "run.json").read_bytes())
    answers_sha256 = sha256_file(run / "answers.jsonl", "rows")
    (run / "run.json").write_bytes(writer.record_text(stated, answers_sha256))


def restated(manifest: Mapping[str, Any], changes: Mapping[str, object]) -> dict[str, Any]:
    """What run.json says, changed; without the table of settings,
    which would have to say the same.
    """
    return {**{name: value for name, value in manifest.items() if name != "settings"}, **changes}


def rows_of(run: Path, condition: str | None = None) -> list[Row]:
    """Decisions as mappings by column, None where unknown."""
    rows = folder.read(run).decisions.table.to_pylist()
    return [row for row in rows if condition in (None, row["condition"])]


def answers_of(run: Path) -> list[Answer]:
    """Answers, in the order of the file."""
    return list(folder.read(run).answers)


def _write(
    out: Path, manifest: Manifest, rows: Sequence[Row], ends: Sequence[Row], said: Sequence[Row]
) -> Path:
    _settle(rows, ends)
    helpers = max((int(name[7:]) for name in rows[0] if name.startswith("helper_")), default=0)
    decisions = _decisions(rows, manifest.actions, helpers)
    answers = _all(said, Answer)
    numbers = tuple(dict.fromkeys(end["episode"] for end in ends))
    grid = Grid(tuple(str(c["name"]) for c in manifest.conditions), manifest.seeds, numbers)
    episodes = counted(grid, decisions, _all(ends, Episode))
    world: World = "frozen" if isinstance(manifest.world, FrozenScenes) else "closed-loop"
    figures = Figures.of(world, grid, decisions, episodes, answers)
    summary, clusters = figures.scores(), cluster_numbers(figures.cluster_names)
    manifest = msgspec.structs.replace(
        manifest,
        answer_times=times(answers, grid.episodes, clusters),
        **counts(answers),
    )
    writer.write(out, manifest, decisions, episodes, [writer.lines(answers)], summary)
    return out


def _settle(rows: Sequence[Row], ends: Sequence[Row]) -> None:
    """Let the last decision of each episode leave what became of it,
    where frozen scenes say what is left.
    """
    success = {(end["condition"], end["seed"], end["episode"]): end["success"] for end in ends}
    last = {
        (row["condition"], row["seed"], row["episode"]): row
        for row in sorted(rows, key=itemgetter("step"))
    }
    for key, row in last.items():
        if row.get(f"safe_{row['action']}") is not None:
            row[f"safe_{row['action']}"] = success[key]


def _decisions(rows: Sequence[Row], actions: Sequence[str], helpers: int) -> Decisions:
    return Decisions(
        pa.Table.from_pylist(list(rows), schema(actions, helpers)), tuple(actions), helpers
    )


def _all(rows: Sequence[Row], kind: Any) -> Any:
    return [kind(**row) for row in rows]


def _changed(row: Row, change: Change) -> Row:
    change(row)
    return row


def _decision(
    scene: str, episode: int, step: int, point: OperatingPoint, seed: int, viewers: Sequence[str],
    closed_loop: bool,
) -> Row:  # fmt: skip
    asks = point.radio.profile is not None
    share = 1 / len(viewers) if asks else 1.0
    latency_ms = 145.0 + 75.0 * asks
    row: Row = {
        "scene": scene, "episode": episode, "step": step, "danger": None, "condition": point.name,
        "seed": seed, "action": "IDLE", "messages": len(viewers[1:]) * asks, "own_failed": False,
        "triggered": asks, "entropy_nats": 0.0, "normalised_entropy": 0.0, "own_weight": share,
        "latency_ms": latency_ms, "deadline_missed": False, "fusion_ms": 0.0 if asks else None,
        "effective_loss": 0.0 if asks else None, "observed_loss": 0.0 if asks else None,
        **{f"fused_{action}": float(action == "IDLE") for action in ACTIONS},
    }  # fmt: skip
    if closed_loop:
        row |= {"acts_at_s": step + latency_ms / 1000, "acted": True}
    else:
        row |= {"value": True, "safe": True, "regret": False, "delay_s": 0.0, "off_lag": False}
        row |= {f"safe_{action}": action == "IDLE" for action in ACTIONS}
        row |= {f"delay_s_{action}": 0.0 if action == "IDLE" else None for action in ACTIONS}
    for place, viewer in enumerate(viewers[1:], 1):
        sent = {
            "helper": viewer,
            "delivered": True,
            "on_time": True,
            "arrival_ms": 60.0,
            "weight": share,
        }
        row |= {f"{name}_{place}": value if asks else None for name, value in sent.items()}
    return row


def _answer(scene: str, viewer: str) -> Row:
    helper = viewer != "v1"
    return {
        "scene": scene, "viewer": viewer, "role": "helper" if helper else "ego", "raw": 
            '{"sure": '
            '"IDLE"}',
        "finish_reason": "stop", "error": None, "prompt_tokens": None, "completion_tokens": None,
        "seconds": None, "batch_size": 1, "label_mass": None, "retries": 0, "cached": False, "slow_s": 0.0,
        "prompt_sha256": "0" * 64, "status": "strict", "verdict": "strict", "repairs": (),
        "intent": (0.0, 1.0, 0.0), "mass": 1.0, "detail": "fits the schema",
        "message": {"evidence": "clear", "risk": "low"} if helper else None,
    }  # fmt: skip
