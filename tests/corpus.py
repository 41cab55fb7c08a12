"""The completions under `tests/completions`, with what each must give."""

import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from harness.parsing.status import Status

FOLDER = Path(__file__).parent / "completions"
ACTIONS = ("SLOWER", "IDLE", "FASTER")
ASKED = {
    "role", "form", "extension", "placeholders", "thinking", "reasons_first", "divides", "finish_reason",
    "error",
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    name: str
    text: str
    status: Status
    asked: dict[str, Any] = field(default_factory=dict)
    expected: dict[str, Any] = field(default_factory=dict)


def _status_of(name: str) -> Status:
    rest = name[2:]
    return max((s for s in Status if rest == s or rest.startswith(f"{s}_")), key=len)


def load() -> list[Case]:
    notes = tomllib.loads((FOLDER / "expectations.toml").read_text(encoding="utf-8"))
    cases = []
    for path in sorted(FOLDER.glob("*.txt")):
        note = notes.pop(path.stem, {})
        asked = {"role": "ego"} | {key: value for key, value in note.items() if key in ASKED}
        expected = {key: value for key, value in note.items() if key not in ASKED}
        text = path.read_bytes().decode("utf-8", errors="replace")
        cases.append(Case(path.stem, text, _status_of(path.stem), asked, expected))
    if notes:
        raise ValueError(f"expectations without a completion: {', '.join(notes)}")
    return cases


CASES = load()
