"""All that the golden runs know of the program:
how a command is typed, and how a run's folder is read.

What comes out has a form of its own, so that the goldens outlive every module's name and the
folder's format: only this file is mended when those change. A table is a list of rows, a row a
mapping of columns to text.
"""

import json
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import redirect_stdout
from io import StringIO
from operator import itemgetter
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from msgspec import structs

from harness.cli import main
from harness.coordination.part_settings import more_parts

Row = dict[str, str]
Table = list[Row]

# How a run came by its answers is not what it says: seconds are the machine's, batches the
# engine's.
NOT_HELD = ("seconds", "first_token_s", "token_s", "batch_size")
SETTINGS = (
    "actions", "conditions", "seeds", "answer", "thinking", "latency", "delay_allowance_s", "late_against",
    "engine_errors",
)  # fmt: skip


def typed(*arguments: str | Path) -> str:
    """What the command prints, typed in the current folder.
    Raises AssertionError unless it ends well.
    """
    command = ["harness", *map(str, arguments)]
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as printed:
        patch.setattr(sys, "argv", command)
        # pictures take longer than all else, and none is golden
        patch.setattr("harness.studies.study.DRAWN", ("svg",))
        with pytest.raises(SystemExit) as ended:
            main()
    assert not ended.value.code, f"`{' '.join(command)}` ended with {ended.value.code}"
    return printed.getvalue()


def tables_of(run: Path) -> dict[str, Table]:
    """What a finished run holds beside its `summary.csv` and `episodes.csv`,
    each table in the order of keys.

    Returns:
        `settings`: name, value, of the manifest's that decide or count something.
        `scenes`: a decision point, under a name of our own (`_numbered`);
            of a frozen run also what each action would lead to.
        `answers`: an answer, with what was read in it;
            its `id` is viewer, or ego and who was heard.
        `decisions`: a decision point, condition and seed.
        `messages`: the same and a helper that was asked.
    """
    manifest = json.loads((run / "run.json").read_text(encoding="utf-8"))
    actions = manifest["actions"]
    scenes = _numbered(_scenes_of(run, actions))
    latency, world = manifest["latency"], manifest["world"]
    # What no decision needs is declared all the same.
    needed = latency["source"] == "paper" or world["kind"] == "closed-loop" or any(
        condition["consensus"] == "ego-prompt" for condition in manifest["conditions"]
    )  # fmt: skip
    # A condition leaves out the settings of an extension that do nothing.
    idle = {
        key: value
        for kind in more_parts().values()
        for key, value in structs.asdict(kind()).items()
    }
    told = {
        **world, **manifest, "conditions": [{**idle, **condition} for condition in manifest["conditions"]],
        "latency": {
            "source": latency["source"], "basis": latency["basis"],
            "inference_s": {"ego": latency["ego_s"], "helper": latency["helper_s"]},
            **({"merge_s": latency["fusion_s"]} if needed else {}),
        },
    }  # fmt: skip
    held = {name: told[name] for name in SETTINGS if name in told}
    return {
        "settings": sorted(
            ({"name": name, "value": text(value)} for name, value in _flat(held, "")),
            key=itemgetter("name"),
        ),
        "scenes": [_cells(_scene(scene, actions)) for scene in scenes],
        "answers": [_cells(row) for scene in scenes for row in _answers(scene, actions)],
        "decisions": [_cells(_decision(scene, made, actions)) for scene, made in _made(scenes)],
        "messages": [
            _cells({**_key(scene, made), **message})
            for scene, made in _made(scenes)
            for message in sorted(made["messages"], key=lambda message: message["from"])
        ],
    }


def _scenes_of(run: Path, actions: list[str]) -> Iterator[dict[str, Any]]:
    """The decision points of a run, each with its answers and what was decided."""
    lines = (run / "answers.jsonl").read_text(encoding="utf-8").splitlines()
    answers: dict[str, dict[str, Any]] = {}
    for answer in map(json.loads, lines):
        key = "+".join((answer.pop("viewer"), *answer.pop("heard")))
        answers.setdefault(answer.pop("scene"), {})[key] = answer
    of_scenes: dict[str, list[dict[str, Any]]] = {}
    for row in pq.read_table(run / "decisions.parquet").to_pylist():
        of_scenes.setdefault(row["scene"], []).append(row)
    for name, rows in of_scenes.items():
        first = rows[0]
        outcomes = (
            {
                what: [first[f"{what}_{action}"] for action in actions]
                for what in ("safe", "delay_s")
            }
            if first["acted"] is None
            else {}
        )
        yield {
            **{key: first[key] for key in ("scene", "episode", "step", "danger")}, **outcomes,
            "answers": answers.get(name, {}), "decisions": [_made_of(row, actions) for row in rows],
        }  # fmt: skip


def _made_of(row: dict[str, Any], actions: list[str]) -> dict[str, Any]:
    """A decision, its messages in a list."""
    spread = {f"{what}_{action}" for what in ("fused", "safe", "delay_s") for action in actions}
    of_messages = ("delivered", "on_time", "arrival_ms", "weight")
    messages = []
    for place in range(1, 1 + sum(name.startswith("helper_") for name in row)):
        spread |= {f"{what}_{place}" for what in ("helper", *of_messages)}
        if row[f"helper_{place}"] is not None:
            of_place = {what: row[f"{what}_{place}"] for what in of_messages}
            messages.append({"from": row[f"helper_{place}"], **of_place})
    plain = {name: value for name, value in row.items() if name not in spread}
    for name in ("scene", "episode", "step", "danger", "messages"):
        del plain[name]
    failed = plain.pop("fusion_failed")
    plain["merge_failed"] = None if failed is None else float(failed)
    fused = [row[f"fused_{action}"] for action in actions]
    return {**plain, "fused": fused, "messages": messages}


def place(row: Row) -> tuple[Any, ...]:
    """Where a line of `episodes.csv` or `summary.csv` stands,
    whatever order the program writes them in.
    """
    numbers = (int(row.get(name) or 0) for name in ("seed", "episode"))
    return row["condition"], row.get("metric", ""), row.get("interval", ""), *numbers


def text(value: Any) -> str:
    """A cell: nothing where nothing is known, JSON for what has parts."""
    if value is None:
        return ""
    return (
        value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, sort_keys=True)
    )


def _numbered(scenes: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Decision points in order, each named by episode, step and a number.

    The number tells apart the worlds into which an episode's conditions and seeds have parted, in
    the order of the first condition and seed in each, whatever the program calls them.
    """

    def place(scene: Mapping[str, Any]) -> tuple[Any, ...]:
        return (
            scene["episode"],
            scene["step"],
            min((m["condition"], m["seed"]) for m in scene["decisions"]),
        )

    counts: Counter[tuple[int, int]] = Counter()
    named = []
    for scene in sorted(scenes, key=place):
        at = scene["episode"], scene["step"]
        named.append({**scene, "scene": f"{at[0]}/{at[1]}/{counts[at]}"})
        counts[at] += 1
    return named


def _cells(row: Mapping[str, Any]) -> Row:
    return {name: text(value) for name, value in row.items()}


def _flat(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Leaves of a nested value, each with its path; a list of plain values is a leaf."""
    parts: Any = None
    if isinstance(value, dict):
        parts = value.items()
    elif isinstance(value, list) and any(isinstance(part, dict) for part in value):
        parts = enumerate(value)
    if parts is None:
        yield name, value
        return
    for key, part in parts:
        yield from _flat(part, f"{name}.{key}" if name else str(key))


def _by_action(name: str, values: Any, actions: list[str]) -> dict[str, Any]:
    """A column an action; empty where there are no values."""
    return {f"{name}.{a}": v for a, v in zip(actions, values or [None] * len(actions), strict=True)}


def _scene(scene: Mapping[str, Any], actions: list[str]) -> dict[str, Any]:
    row = {name: scene[name] for name in ("scene", "episode", "step", "danger")}
    for name in ("safe", "delay_s"):
        if name in scene:
            row |= _by_action(name, scene[name], actions)
    return row


def _answers(scene: Mapping[str, Any], actions: list[str]) -> Iterator[dict[str, Any]]:
    said = {**scene["answers"], **scene.get("merged", {})}
    for who, answer in sorted(said.items()):
        held = {
            name: value
            for name, value in sorted(answer.items())
            if name not in (*NOT_HELD, "intent")
        }
        intent = _by_action("intent", answer["intent"], actions)
        yield {"scene": scene["scene"], "id": who, **intent, **held}


def _made(scenes: list[dict[str, Any]]) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    for scene in scenes:
        for made in sorted(scene["decisions"], key=lambda made: (made["condition"], made["seed"])):
            yield scene, made


def _key(scene: Mapping[str, Any], made: Mapping[str, Any]) -> dict[str, Any]:
    return {"scene": scene["scene"], "condition": made["condition"], "seed": made["seed"]}


def _decision(
    scene: Mapping[str, Any], made: Mapping[str, Any], actions: list[str]
) -> dict[str, Any]:
    key = _key(scene, made)
    rest = {n: v for n, v in sorted(made.items()) if n not in (*key, "messages", "fused")}
    return {**key, **rest, **_by_action("fused", made["fused"], actions)}
