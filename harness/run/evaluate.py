"""`harness eval`: ask, score, write. A run killed at any moment goes on where it was."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from harness.backends.registry import open_backend
from harness.errors import UserError, printable
from harness.files import canonical_json, digest, write_whole
from harness.run import record
from harness.run.asking import ask_all
from harness.run.intents import intents
from harness.run.scoring import allowance_s, score, table
from harness.run.spec import FORMAT, Spec, versions
from harness.run.summary import summary
from harness.run.timing import inference_s, measure

WORK = ".work"


@dataclass(frozen=True)
class Evaluated:
    """A finished run: its folder, its manifest and its summary."""

    out: Path
    manifest: dict[str, Any]
    summary: pd.DataFrame


def evaluate(spec: Spec, out: Path, resume: bool, progress: Callable[[int], None]) -> Evaluated:
    """Evaluate a model with a prompt on a dataset and write the run's folder.

    Args:
        spec: what is evaluated.
        out: the run's folder.
        resume: go on with the run that a kill left there.
        progress: called with the number of answers just had, those kept from before included.

    Raises:
        UserError: the folder holds something else, or the model cannot be had. Nothing is written then.
    """
    if resume and (out / "run.json").is_file():
        return _finished(spec, out)
    _refuse(spec, out, resume)
    backend = open_backend(spec.card, device=spec.device, dtype=spec.dtype, batch_size=spec.batch_size)
    identity = backend.identity()
    work = _begin(spec, out, identity)
    latency = measure(spec, backend, work / "latency.json")
    by_id = ask_all(spec, backend, work / "answers.jsonl", progress)

    known, laid = intents(spec, by_id), table(spec)
    seconds = inference_s(latency, known.answers)
    # Where nobody was asked no time passes; a helper without an answer sends nothing anyway.
    runs = [
        score(spec, laid, known, np.nan_to_num(seconds), point, seed)
        for point in spec.points
        for seed in spec.seeds
    ]
    result = summary(spec, laid, known, runs)
    manifest = {
        "format": FORMAT,
        "name": out.name,
        "created": json.loads((work / "config.json").read_text())["created"],
        "command": spec.command(out),
        **spec.settings(),
        "identity": identity,
        "latency": latency,
        "delay_allowance_s": allowance_s(spec),
        "versions": versions(),
    }
    manifest["dataset"]["path"] = str(spec.dataset.path)
    write_whole(out / "rows.jsonl", "".join(record.rows(spec, laid, known, runs)))
    write_whole(out / "episodes.csv", record.episodes(spec, laid, runs).to_csv(index=False))
    write_whole(out / "summary.csv", result.to_csv(index=False))
    write_whole(out / "run.json", json.dumps(manifest, indent=1, allow_nan=False) + "\n")
    shutil.rmtree(work)
    return Evaluated(out, manifest, result)


def _finished(spec: Spec, out: Path) -> Evaluated:
    manifest = json.loads((out / "run.json").read_text())
    _same(spec.settings(), manifest, out)
    return Evaluated(out, manifest, pd.read_csv(out / "summary.csv"))


def _refuse(spec: Spec, out: Path, resume: bool) -> None:
    """Raise before anything is loaded or written, if the folder cannot be used."""
    shown = printable(out)
    if (out / "run.json").exists():
        raise UserError(f"--out {shown} already holds a finished run; choose another folder or delete it")
    if (out / WORK / "config.json").is_file():
        if not resume:
            raise UserError(f"--out {shown} holds an unfinished run; add --resume to go on, or delete it")
        _same(spec.settings(), json.loads((out / WORK / "config.json").read_text())["settings"], out)
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"--out {shown} exists and is no run; choose another folder")


def _same(settings: dict[str, Any], stored: dict[str, Any], out: Path) -> None:
    """Refuse to go on with other settings, naming those that differ."""
    other = [
        key for key, value in settings.items() if _stored(stored, key) != json.loads(canonical_json(value))
    ]
    if other:
        raise UserError(
            f"--resume: {printable(out)} was begun with another {', '.join(other)}; "
            "repeat its settings, or choose another --out"
        )


def _stored(stored: dict[str, Any], key: str) -> Any:
    value = stored.get(key)
    return {k: v for k, v in value.items() if k != "path"} if key == "dataset" and value else value


def _begin(spec: Spec, out: Path, identity: dict[str, Any]) -> Path:
    work = out / WORK
    config = work / "config.json"
    if config.is_file():
        if json.loads(config.read_text())["identity"] != digest(identity):
            raise UserError(
                f"--resume: the model behind {spec.card.name} is not the one this run was begun with; "
                "start a new run in another --out"
            )
        return work
    begun = {"created": datetime.now(UTC).isoformat(timespec="seconds"), "settings": spec.settings(),
             "identity": digest(identity)}  # fmt: skip
    write_whole(config, canonical_json(begun))
    return work
