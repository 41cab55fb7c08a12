"""`harness prompt parse`: how one answer is parsed.
A failed verdict is data, so the exit code is 0.
"""

import os
import sys

import typer

from harness.cli import options
from harness.cli.terminal import echo_json
from harness.core import errors
from harness.core.files import LARGEST, bytes_of, canonical_json

HANDED_OVER = ("/dev/fd", "/proc/self/fd")  # folders of pipes that a shell opens for `<(command)`
FINISH_REASONS = ("stop", "length", "refusal", "error")


def command(
    file: str = typer.Argument(help="File with one raw completion; - means standard input."),
    scenario: str = typer.Option(
        "occluded-intersection", help="Scenario whose actions the answer is about."
    ),
    role: str = typer.Option("ego", help="Role that answered: ego or helper."),
    prompt: str | None = typer.Option(
        None,
        help="Prompt version that asked: its form of answer, what else it asks for, and whether "
        "reasons may "
        "come first. Default: any form.",
    ),
    thinking: bool = typer.Option(
        False, "--thinking", help="State that the model was asked to think first."
    ),
    reasons_first: bool = typer.Option(
        False, "--reasons-first", help="State that the prompt asked for reasons before the answer."
    ),
    finish_reason: str = typer.Option(
        "stop",
        help="Why the engine stopped: stop (it was done), length (token limit), refusal or error.",
    ),
    as_json: options.Json = False,
) -> None:
    """Parse one completion: print its intent, or why it failed.

    It names every repair that the text needed.
    """
    from harness.parsing.parse import parse
    from harness.prompts import versions
    from harness.prompts.answer_schema import Shape
    from harness.world import scenarios

    if finish_reason not in FINISH_REASONS:
        raise errors.unknown("finish reason", finish_reason, FINISH_REASONS)
    of = scenarios.get(options.typed_scenario(scenario))
    actions = of.actions
    shape = Shape(role, actions)
    if prompt is not None:
        version = versions.load(prompt)
        if reason := versions.unfit(version, of):
            raise errors.UserError(
                f"--prompt {errors.printable(version.version)} {reason}; give {of.prompt}"
            )
        shape, reasons_first = (
            version.shape(role, actions),
            reasons_first or role in version.reasons_first,
        )
    parsed = parse(
        _read(file),
        **shape._asdict(),
        thinking=thinking,
        reasons_first=reasons_first,
        finish_reason=finish_reason,
    )
    shares = None if parsed.intent is None else dict(zip(actions, parsed.intent, strict=True))
    if as_json:
        fields = (
            "status",
            "verdict",
            "repairs",
            "intent",
            "mass",
            "message",
            "extension",
            "reasoning",
            "detail",
        )
        echo_json(
            {**{name: getattr(parsed, name) for name in fields}, "intent": shares}, indent=None
        )
        return
    rows = [("status", f"{parsed.status}: {parsed.status.meaning}")]
    rows += [("repair", f"{repair}: {repair.meaning}") for repair in parsed.repairs]
    rows += [(action, f"{share:.4f}") for action, share in (shares or {}).items()]
    if parsed.mass is not None:
        rows.append(("mass", f"{parsed.mass:.4f}"))
    for name, value in (parsed.message or {}).items():
        rows.append((name, "-" if value is None else errors.printable(value, 200)))
    for name, value in (parsed.extension or {}).items():
        rows.append((name, errors.printable(canonical_json(value), 200)))
    if parsed.reasoning:
        rows.append(("reasoning", f"{len(parsed.reasoning)} characters"))
    rows.append(("detail", parsed.detail))
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        typer.echo(f"{name:<{width}}  {value}")


def _read(file: str) -> str:
    """The text, line ends untouched. Bytes that are not UTF-8 become U+FFFD,
    and a note on stderr says so.
    """
    try:
        if file == "-" or os.path.dirname(file) in HANDED_OVER:
            with sys.stdin.buffer if file == "-" else open(file, "rb") as source:
                data = source.read(LARGEST["text"] + 1)
            if len(data) > LARGEST["text"]:
                raise ValueError(f"it is larger than {LARGEST['text'] >> 20} MB, the limit")
        else:
            data = bytes_of(file, "text")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        name = errors.printable(file)
        raise errors.UserError(
            f"cannot read completion file {name!r}: {reason}; give a text file, or - for what is "
            "piped in"
        ) from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        typer.echo(
            f"note: not UTF-8 from byte {error.start} on; such bytes are read as U+FFFD", err=True
        )
        return data.decode("utf-8-sig", errors="replace")
