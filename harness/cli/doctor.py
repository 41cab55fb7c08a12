"""`harness doctor`: what is here to run with."""

import json
from textwrap import wrap

import typer

from harness.cli import options
from harness.core.errors import printable

WIDTH, MARGIN = 80, 10


def command(
    gpu: bool = typer.Option(False, "--gpu", help="Ask torch for GPUs too; it takes seconds to load."),
    as_json: options.Json = False,
) -> None:
    """Show what can run here: versions, machine, models, cache. Says what the other models lack."""
    from harness.cli.machine import look

    found = look(gpu)
    if as_json:
        typer.echo(json.dumps(found, indent=1))
        return
    of = dict(found["versions"])
    _line("harness", f"{of.pop('harness')}, Python {of.pop('python')}, {of.pop('platform')}")
    _line("packages", ", ".join(f"{name} {version}" for name, version in of.items()))
    memory = "unknown" if found["memory_gib"] is None else f"{found['memory_gib']:g} GiB"
    _line("machine", f"{found['cores']} cores, {memory} of memory")
    _line(
        "GPU", "; ".join(map(printable, found["gpu"])) or f"none that {'torch' if gpu else 'nvidia-smi'} sees"
    )
    size = f"{found['cache']['bytes'] / 1e6:.1f} MB" if found["cache"]["bytes"] else "empty"
    _line("cache", f"{printable(found['cache']['file'], 1000)}, {size}")
    _line("engines", ", ".join(engine for engine, lack in found["engines"].items() if lack is None))
    _lacking([(engine, lack) for engine, lack in found["engines"].items() if lack is not None])
    able = [model for model in found["models"] if model["missing"] is None]
    _line("models", ", ".join(model["name"] for model in able))
    _lacking([(model["name"], model["remedy"]) for model in found["models"] if model["missing"]])
    _lacking([(model["name"], model["remedy"]) for model in able if model["remedy"]])


def _line(head: str, text: str) -> None:
    for n, line in enumerate(wrap(text, WIDTH - MARGIN, break_on_hyphens=False) or ["none"]):
        typer.echo(f"{'' if n else head:<{MARGIN}}{line}")


def _lacking(remedies: list[tuple[str, str]]) -> None:
    for name, remedy in remedies:
        _line("", f"{printable(name)}: {remedy}")
