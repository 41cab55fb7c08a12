"""`harness parse`: what the harness makes of one answer. A failed verdict is data, so the exit code is 0."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from harness.core import errors

if TYPE_CHECKING:
    from harness.parsing.parse import Parsed

_FINISH_REASONS = ("stop", "length", "error")


def command(
    file: Annotated[str, typer.Argument(help="File with one raw completion; - reads standard input.")],
    scenario: Annotated[str, typer.Option(help="Scenario that names the actions.")] = "occluded-intersection",
    role: Annotated[str, typer.Option(help="Who answered: ego or helper.")] = "ego",
    thinking: Annotated[bool, typer.Option("--thinking", help="The model was asked to think first.")] = False,
    finish_reason: Annotated[
        str, typer.Option(help="Why the engine stopped: stop, length or error.")
    ] = "stop",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Parse one completion and say what was read, what was mended, or why it failed."""
    from harness.parsing.parse import parse
    from harness.world import scenarios

    if finish_reason not in _FINISH_REASONS:
        raise errors.unknown("finish reason", finish_reason, _FINISH_REASONS)
    actions = scenarios.get(scenario).actions
    text = _read(file)
    parsed = parse(text, role=role, actions=actions, thinking=thinking, finish_reason=finish_reason)
    typer.echo(_json(parsed, actions) if as_json else _table(parsed, actions))


def _read(file: str) -> str:
    """The text, line ends untouched. Bytes that are not UTF-8 become U+FFFD, and a note on stderr says so."""
    try:
        data = sys.stdin.buffer.read() if file == "-" else Path(file).read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        shown = errors.printable(file)
        raise errors.UserError(
            f"cannot read completion file {shown!r}: {reason}; give a text file, or - for standard input"
        ) from None
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        typer.echo(f"note: not UTF-8 from byte {error.start} on; such bytes are read as U+FFFD", err=True)
        return data.decode(errors="replace")


def _json(parsed: "Parsed", actions: tuple[str, ...]) -> str:
    import json

    return json.dumps(
        {
            "status": parsed.status,
            "verdict": parsed.verdict,
            "repairs": parsed.repairs,
            "intent": None if parsed.intent is None else dict(zip(actions, parsed.intent, strict=True)),
            "mass": parsed.mass,
            "message": parsed.message,
            "reasoning": parsed.reasoning,
            "detail": parsed.detail,
        }
    )


def _table(parsed: "Parsed", actions: tuple[str, ...]) -> str:
    rows = [("status", f"{parsed.status}: {parsed.status.meaning}")]
    rows += [("repair", f"{repair}: {repair.meaning}") for repair in parsed.repairs]
    if parsed.intent is not None:
        rows += [(action, f"{p:.4f}") for action, p in zip(actions, parsed.intent, strict=True)]
    if parsed.mass is not None:
        rows.append(("mass", f"{parsed.mass:.4f}"))
    for name, value in (parsed.message or {}).items():
        rows.append((name, "-" if value is None else errors.printable(value, 200)))
    if parsed.reasoning:
        rows.append(("reasoning", f"{len(parsed.reasoning)} characters"))
    rows.append(("detail", parsed.detail))
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)
