"""The runs and studies in a folder, from their manifests and summaries alone."""

import csv
import json
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from harness.core.errors import UserError, printable
from harness.core.formats import CONFIG, FORMAT, READ_BY, SUITE, WORK

DEPTH = 2  # a sweep is in its run's folder, and a closed-loop study's run in the study's
KINDS = {"frozen": "eval", "closed-loop": "drive"}  # by world
STUDIES = {
    "sweep.json": "sweep",
    "grid.json": "grid",
    "repeats.json": "repeats",
    "trust.json": "trust",
    "schedule.json": "schedule",
    "study.json": "study",
    "closed-loop.json": "study",
    "fidelity.csv": "study",
}
SUCCESS, FAILED = "success_rate", "failed_rate_ego"
UNREAD = 0.5  # least share of failed answers of which a run's headline speaks
_BROKEN = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    RecursionError,
    OverflowError,
    csv.Error,
)


@dataclass(frozen=True)
class Listed:
    """One run or study.

    Attributes:
        name: its folder, from the folder that is listed.
        kind: `eval`, `drive`, `suite`, or of a study one of `STUDIES`; `run` where a broken one does not say.
        state: `finished`, `unfinished` or `broken`.
        date: when it began; of a suite, when the last of its runs did; of a study and a broken run, when
            it was last written.
        why: of an unfinished one, the option that continues it; of a broken one, the file at fault, and
            whose format it has where that is an older version's.
        model: name of its card; of a sweep, its sources.
        prompt: version; of a suite, those of its families.
        answer: answer mode.
        tags: words to find it by.
        condition: the one of the highest success rate; the first of several.
        success: that rate, 0 to 1, over episodes; of a suite, the mean over families.
        low: lower end of its 95 % interval; None where the data cannot bound it.
        high: upper end.
        unread: share of the ego's answers that could not be read.
    """

    name: str
    kind: str
    state: Literal["finished", "unfinished", "broken"]
    date: datetime
    why: str | None = None
    model: str | None = None
    prompt: str | None = None
    answer: str | None = None
    tags: tuple[str, ...] = ()
    condition: str | None = None
    success: float | None = None
    low: float | None = None
    high: float | None = None
    unread: float | None = None


def runs(folder: Path) -> list[Listed]:
    """The runs and studies in a folder, newest first. Links that lead out of it are skipped.

    Raises:
        UserError: there is no such folder.
    """
    if not os.path.isdir(folder):
        raise UserError(
            f"{printable(folder)} is no folder; give one that holds runs, or make a run with `harness eval`"
        )
    root = os.path.realpath(folder)
    return sorted(_below(root, root, 0), key=lambda one: (-one.date.timestamp(), one.name))


def _below(path: str, root: str, depth: int) -> Iterator[Listed]:
    found = _one(path, root)
    if found:
        yield replace(found, name=os.path.relpath(path, root))
    if depth < DEPTH:
        for name in sorted(os.listdir(path)) if os.access(path, os.R_OK | os.X_OK) else ():
            inner = os.path.join(path, name)
            if not name.startswith(".") and os.path.isdir(inner) and _within(inner, root):
                yield from _below(inner, root, depth + 1)


def _within(path: str, root: str) -> bool:
    return Path(os.path.realpath(path)).is_relative_to(root)


def _one(path: str, root: str) -> Listed | None:
    """A folder as an entry; None if it is neither a run nor a study."""

    def has(*names: str) -> bool:
        file = os.path.join(path, *names)
        return os.path.isfile(file) and _within(file, root)

    written = datetime.fromtimestamp(os.stat(path).st_mtime, UTC)
    if has("run.json"):
        return _finished(path, has("summary.csv"), written)
    if has(WORK, CONFIG):
        try:
            begun = _json(path, WORK, CONFIG)
            kind = KINDS[begun["settings"]["world"]["kind"]]
            made = Listed("", kind, "unfinished", _date(begun["created"]), "the same command continues it")
            return _described(made, {**begun["settings"], "tags": begun["tags"]})
        except _BROKEN:
            return Listed("", "run", "broken", written, f"{WORK}/{CONFIG}")
    if has(SUITE):
        return _suite(path, root, has("summary.csv"), written)
    for name, kind in STUDIES.items():
        if has(name):
            written = datetime.fromtimestamp(os.stat(os.path.join(path, name)).st_mtime, UTC)
            try:
                sources = _json(path, name)["sources"] if kind != "study" else ()
                model = ", ".join(str(source["name"]) for source in sources if "name" in source)
                return Listed("", kind, "finished", written, model=model or None)
            except _BROKEN:
                return Listed("", kind, "broken", written, name)
    if has("answers.jsonl") or has("summary.csv"):  # the manifest is written last
        return Listed("", "run", "broken", written, "run.json")
    return None


def _finished(path: str, has_summary: bool, written: datetime) -> Listed:
    listed = Listed("", "run", "broken", written, "run.json")
    try:
        config = _json(path, "run.json")
        if config["format"] in READ_BY:
            return replace(listed, why=f"run.json: format of harness {READ_BY[config['format']]}")
        if config["format"] != FORMAT:
            return listed
        listed = replace(listed, kind=KINDS[config["world"]["kind"]], date=_date(config["created"]))
        listed = replace(_described(listed, config), why="summary.csv")
        return _summed(path, listed) if has_summary else listed
    except _BROKEN:
        return listed


def _suite(path: str, root: str, has_summary: bool, written: datetime) -> Listed:
    """A suite's folder: its runs say what it was made of, and its summary has the means."""
    listed = Listed("", "suite", "broken", written, SUITE)
    try:
        names = _json(path, SUITE)["families"].values()
        found = [_one(os.path.join(path, name), root) for name in names if own_name(name)]
        parts = [one for one in found if one and one.state == "finished"]
        if not 0 < len(parts) == len(names):
            return listed
        listed = replace(
            parts[0], kind="suite", state="broken", why="summary.csv", date=max(one.date for one in parts),
            prompt=" and ".join(dict.fromkeys(str(one.prompt) for one in parts)),
        )  # fmt: skip
        return _summed(path, listed) if has_summary else listed
    except _BROKEN:
        return listed


def own_name(name: str) -> bool:
    """Whether a name is that of a folder in another, and not hidden there."""
    return os.path.basename(name) == name and not name.startswith(".")


def _summed(path: str, listed: Listed) -> Listed:
    """The same, finished, with the best condition of its summary."""
    with open(os.path.join(path, "summary.csv"), encoding="utf-8") as file:
        # A summary may have a thousand rows, and a folder a thousand summaries.
        wanted = (f",{SUCCESS},", f",{FAILED},")
        head, *lines = [x for n, x in enumerate(file) if n == 0 or any(each in x for each in wanted)]
    table = list(csv.DictReader([head, *lines]))
    rows = [row for row in table if (row["metric"], row["interval"]) == (SUCCESS, "episodes")]
    best = max(rows, key=lambda row: _number(row["value"]) or 0.0)
    value, low, high = (_number(best[key]) for key in ("value", "ci_low", "ci_high"))
    unread = next((_number(row["value"]) for row in table if row["metric"] == FAILED), None)
    return replace(
        listed, state="finished", why=None, condition=best["condition"], success=value, low=low,
        high=high, unread=unread,
    )  # fmt: skip


def _described(made: Listed, config: dict[str, Any]) -> Listed:
    return replace(
        made,
        model=" + ".join(str(agent["model"]["name"]) for agent in (config, *config.get("helpers", ()))),
        prompt=str(config["prompt"]["version"]),
        answer=str(config["answer"]),
        tags=tuple(map(str, config["tags"])),
    )


def _json(*parts: str) -> Any:
    return json.loads(Path(*parts).read_text(encoding="utf-8"))


def _date(text: str) -> datetime:
    return datetime.fromisoformat(text).astimezone(UTC)


def _number(text: str) -> float | None:
    value = float(text or "nan")
    return value if math.isfinite(value) else None
