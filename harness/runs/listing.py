"""List the runs and studies in a folder, from their manifests and summaries alone."""

import csv
import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from io import TextIOWrapper
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

from harness.core.errors import UserError, printable, sayable
from harness.core.extensions import studies
from harness.core.files import BROKEN, opened, text_of
from harness.core.formats import CONFIG, SOURCES, SUITE, WORK
from harness.runs import formats
from harness.runs.doubts import OFF_LAG, doubted
from harness.runs.headline import ANY_TIME, BALANCED, SUCCESS, best_of, headline_metric

# how deep to look: a sweep lies in its run's folder, a closed-loop study's run in the study's
DEPTH = 2
KINDS = {"frozen": "eval", "closed-loop": "drive"}  # by world
FAILED = "failed_rate_ego"
UNREAD = 0.5  # share of failed answers from which a run's headline mentions them
Rows = Sequence[dict[str, str]]  # of a summary
_BROKEN = (*BROKEN, AttributeError, csv.Error)  # in what no type was given to


@dataclass(frozen=True)
class Listed:
    """Describe one run or study (several runs) in a list; None where a value is unknown.

    `name` is its folder, `kind` what made it (`eval`, `drive`, `suite`, or a study's word), and
    `tags` words by which to find it; `model`, `prompt` and `answer` name the model, prompt version
    and answer mode. `condition` is the condition (named set of settings of the radio, of asking
    helpers and of fusing their messages) with the highest success that no warning is about,
    `success` that success, 0 to 1, by the metric `metric`, and `low` and `high` the ends of its 95
    % interval. `unread` is the share of the ego's answers that could not be parsed. `state` says
    whether it is finished or broken, and `why` how an unfinished run goes on, or what is wrong with
    a broken one. `date` is when it began, or a study was last written.
    `pick` has the options that chose its episodes by anything but chance.
    """

    name: str  # its folder, relative to the folder that is listed
    # `eval`, `drive`, `suite`, a word of `STUDIES`, or `run` if it is broken and does not say
    kind: str
    # what it is; a run is broken if a file that says so much cannot be read
    state: Literal["finished", "unfinished", "broken"]
    # when it began. For a suite, when the last of its runs began; for a study or a broken run, when
    # it was last written.
    date: datetime
    # for an unfinished run, how to continue it; for a broken one, the file at fault, and the
    # version of the harness if the file has an older format
    why: str | None = None
    model: str | None = None  # name of its card; the sources of a sweep
    prompt: str | None = None  # the prompt version; those of all families for a suite
    answer: str | None = None  # the answer mode
    tags: tuple[str, ...] = ()  # words by which to find it
    # name of the condition with the highest success that no warning of its page is about
    condition: str | None = None
    # success in that condition, 0 to 1, over episodes; for a suite, the mean over families
    success: float | None = None
    low: float | None = None  # lower end of its 95 % interval; None if the data cannot bound it
    high: float | None = None  # its upper end
    unread: float | None = None  # share of the ego's answers that could not be parsed
    metric: str | None = None  # name of the metric that `success` is, balanced or plain success
    pick: str = ""  # options that chose its episodes by anything but chance; empty for none


def runs(folder: Path) -> list[Listed]:
    """Return the runs and studies in a folder, newest first; links out of it are skipped.

    Raises UserError if there is no such folder, or nothing can show its name.
    """
    sayable("folder", folder.name)
    if not os.path.isdir(folder):
        raise UserError(
            f"{printable(folder)} is no folder; give one that holds runs, or make a run with "
            "`harness eval`"
        )
    root = os.path.realpath(folder)
    return sorted(_entries(root, root, 0), key=lambda entry: (-entry.date.timestamp(), entry.name))


def _entries(path: str, root: str, depth: int) -> Iterator[Listed]:
    """Yield what is in a folder and, down to `DEPTH`, in those below it."""
    try:
        entry = _entry(path, root)
        names = sorted(os.listdir(path)) if os.access(path, os.R_OK | os.X_OK) else []
    except FileNotFoundError:  # somebody deletes it at this moment
        return
    if entry:
        yield replace(entry, name=os.path.relpath(path, root))
    if depth < DEPTH:
        for name in names:
            if name.startswith(".") or name == SOURCES:
                continue
            subfolder = os.path.join(path, name)
            if os.path.isdir(subfolder) and _within(subfolder, root):
                yield from _entries(subfolder, root, depth + 1)


def _marks() -> dict[str, str]:
    """Return what lists call a study, by the file that marks its folder."""
    marks = {f"{kind}.json": word for kind, word in studies().items()}
    marks["fidelity.csv"] = "study"
    return marks


def _within(path: str, root: str) -> bool:
    return Path(os.path.realpath(path)).is_relative_to(root)


def _entry(path: str, root: str) -> Listed | None:
    """Return a folder's entry; None if it is neither a run nor a study."""

    def has(*names: str) -> bool:
        file = os.path.join(path, *names)
        return os.path.isfile(file) and _within(file, root)

    written = datetime.fromtimestamp(os.stat(path).st_mtime, UTC)
    if has("run.json"):
        return _finished_entry(path, has("summary.csv"), written)
    if has(WORK, CONFIG):
        try:
            config = _json(path, WORK, CONFIG)
            kind = KINDS[config["settings"]["world"]["kind"]]
            created, advice = _date(config["created"]), "the same command continues it"
            entry = Listed("", kind, "unfinished", created, advice)
            return _with_config(entry, {**config["settings"], "tags": config["tags"]})
        except _BROKEN:
            return Listed("", "run", "broken", written, f"{WORK}/{CONFIG}")
    if has(SUITE):
        return _suite_entry(path, root, has("summary.csv"), written)
    for name, kind in _marks().items():
        if has(name):
            return _other_entry(path, name, kind)
    if has("answers.jsonl") or has("summary.csv"):  # the manifest is written last
        linked = os.path.islink(os.path.join(path, "run.json"))
        why = "run.json is a link out of the folder" if linked else "run.json"
        return Listed("", "run", "broken", written, why)
    return None


def _other_entry(path: str, name: str, kind: str) -> Listed:
    """Return the entry of a study, a comparison or the like, whose record is the file `name`."""
    written = datetime.fromtimestamp(os.stat(os.path.join(path, name)).st_mtime, UTC)
    try:
        sources = _json(path, name).get("sources", ()) if kind != "study" else ()
        model = ", ".join(str(source["name"]) for source in sources if "name" in source)
    except _BROKEN:
        return Listed("", kind, "broken", written, name)
    return Listed("", kind, "finished", written, model=model or None)


def _finished_entry(path: str, has_summary: bool, written: datetime) -> Listed:
    """Return the entry of a run that has a record, which may be broken."""
    listed = Listed("", "run", "broken", written, "run.json")
    try:
        config = _json(path, "run.json")
        if config["format"] in formats.READ_BY:
            reader = formats.READ_BY[config["format"]]
            return replace(listed, why=f"run.json: format of harness {reader}")
        if config["format"] != formats.FORMAT:
            return listed
        listed = replace(listed, kind=KINDS[config["world"]["kind"]], date=_date(config["created"]))
        selection = config["world"].get("selection")
        chosen = _pick(selection) if selection else ""
        listed = replace(_with_config(listed, config), why="summary.csv", pick=chosen)
        if not has_summary:
            return listed
        rows = _rows(path)
        return _with_success(listed, rows, [(config, rows)])
    except _BROKEN:
        return listed


def _suite_entry(path: str, root: str, has_summary: bool, written: datetime) -> Listed:
    """Return the entry of a suite's folder: settings and figures from its runs."""
    listed = Listed("", "suite", "broken", written, SUITE)
    try:
        names = _json(path, SUITE)["families"].values()
        entries = [_entry(os.path.join(path, name), root) for name in names if own_name(name)]
        parts = [entry for entry in entries if entry and entry.state == "finished"]
        if not 0 < len(parts) == len(names):
            return listed
        listed = replace(
            parts[0],
            kind="suite",
            state="broken",
            why="summary.csv",
            date=max(entry.date for entry in parts),
            prompt=" and ".join(dict.fromkeys(str(entry.prompt) for entry in parts)),
        )
        if not has_summary:
            return listed
        folders = [os.path.join(path, name) for name in names]
        runs = [(_json(folder, "run.json"), _rows(folder)) for folder in folders]
        clusters = [_clusters(folder) for folder in folders]
        together = len(set[str]().union(*clusters)) < sum(map(len, clusters))
        return _with_success(listed, _means([rows for _, rows in runs], together), runs)
    except _BROKEN:
        return listed


def own_name(name: str) -> bool:
    """Return whether a text can be the name of a run's folder in a list: visible, and no path."""
    return os.path.basename(name) == name and not name.startswith(".") and name != ""


def _rows(path: str) -> Rows:
    """Return what a list has of a summary: a folder may hold a thousand of a thousand rows."""
    with (
        opened(os.path.join(path, "summary.csv"), "rows") as data,
        TextIOWrapper(data, "utf-8-sig") as file,
    ):
        markers = [f",{metric}," for metric in (BALANCED, SUCCESS, FAILED, OFF_LAG)]
        lines: list[str] = []
        for line in file:
            if not lines or any(marker in line for marker in markers):
                lines.append(line)
    if not lines:
        raise ValueError("summary.csv is empty")
    return list(csv.DictReader(lines))


def _clusters(path: str) -> set[str]:
    """Return the parts of what a run's layouts are cut from; a table without any is not read."""
    from harness.core.statistics import parts_of  # imported here because it is slow

    with (
        opened(os.path.join(path, "episodes.csv"), "rows") as data,
        TextIOWrapper(data, "utf-8-sig") as file,
    ):
        table = csv.DictReader(file)
        rows = table if "cluster" in (table.fieldnames or ()) else ()
        names = {row["cluster"] for row in rows if row["cluster"]}
    return {part for name in names for part in parts_of(name)}


def _means(summaries: Sequence[Rows], together: bool) -> Rows:
    """Return the means over families of the rows that each summary has.

    `together` says that families share a cluster, such as a recording.
    """
    from harness.core.statistics import Estimate, mean_of  # imported here because it is slow

    keys, ends = ("condition", "metric", "interval"), ("value", "ci_low", "ci_high")
    key_of = itemgetter(*keys)
    by_key = []
    for summary in summaries:
        by_key.append({key_of(row): row for row in summary})
    shared = set(by_key[0]).intersection(*by_key[1:])
    means = list[dict[str, str]]()
    for key in by_key[0]:
        if key not in shared:
            continue
        of_families = list[Estimate]()
        for rows in by_key:
            value, low, high = (float(rows[key][end] or "nan") for end in ends)
            of_families.append(Estimate(value, low, high, 0, 0))
        mean = mean_of(of_families, together)
        row = dict(zip(keys, key, strict=True))
        row |= {"value": repr(mean.value), "ci_low": repr(mean.low), "ci_high": repr(mean.high)}
        means.append(row)
    return means


def _with_success(
    listed: Listed, rows: Rows, runs: Sequence[tuple[dict[str, Any], Rows]]
) -> Listed:
    """Return an entry as finished, with the best condition of a summary;
    `runs` are those it is of.
    """
    metric = headline_metric({row["metric"] for row in rows})
    kinds = {row["interval"] for row in rows if row["metric"] == metric}
    kind = ANY_TIME if ANY_TIME in kinds else "episodes"
    of_metric = [row for row in rows if (row["metric"], row["interval"]) == (metric, kind)]
    radios = {c["name"] for c in runs[0][0]["conditions"] if c.get("profile") is not None}
    warned = {name for config, summary in runs for name in _doubted(config, summary)}
    success = {row["condition"]: _number(row["value"]) or 0.0 for row in of_metric}
    best = best_of(success, radios, warned)
    [best_row] = [row for row in of_metric if row["condition"] == best]
    unread = [_number(row["value"]) for row in rows if row["metric"] == FAILED]
    return replace(
        listed,
        state="finished",
        why=None,
        condition=best,
        success=_share(best_row["value"]),
        low=_share(best_row["ci_low"]),
        high=_share(best_row["ci_high"]),
        unread=unread[0] if unread else None,
        metric=metric,
    )


def _pick(selection: dict[str, Any]) -> str:
    from harness.dataset.select import pick  # imported here because it is slow

    return pick(selection)


def _doubted(config: dict[str, Any], rows: Rows) -> set[str]:
    """Return the conditions that a warning of a run's page is about."""
    records = config.get("channels", {}).items()
    channels = {name: (record["parameters"], record.get("limits", {})) for name, record in records}
    off_lag = {row["condition"]: _number(row["value"]) for row in rows if row["metric"] == OFF_LAG}
    return doubted(config["conditions"], channels, off_lag)


def _with_config(entry: Listed, config: dict[str, Any]) -> Listed:
    """Return an entry with the models, the prompt, the answer mode and the tags of a record."""
    agents = [config, *config.get("helpers", ())]
    return replace(
        entry,
        model=" + ".join(str(agent["model"]["name"]) for agent in agents),
        prompt=str(config["prompt"]["version"]),
        answer=str(config["answer"]),
        tags=tuple(str(tag) for tag in config["tags"]),
    )


def _json(*parts: str) -> Any:
    return json.loads(text_of(os.path.join(*parts), "record"))


def _date(text: str) -> datetime:
    return datetime.fromisoformat(text).astimezone(UTC)


def _share(text: str) -> float | None:
    share = _number(text)
    if share is not None and not 0 <= share <= 1:
        raise ValueError(f"{share} is no share")
    return share


def _number(text: str) -> float | None:
    value = float(text or "nan")
    return value if math.isfinite(value) else None
