"""`harness prompt`: the versions at hand, what a model is sent, and whether it keeps its budget."""

import json
from pathlib import Path
from typing import Any

import typer

from harness.core import resources
from harness.core.errors import UserError, printable

app = typer.Typer(
    help="List prompt versions, show what a model is sent, check or release one.", no_args_is_help=True
)

DATASET = typer.Option(resources.DATASET, help="Shipped dataset, or a dataset's folder.")


@app.command("list")
def list_prompts(as_json: bool = typer.Option(False, "--json", help="Print as JSON.")) -> None:
    """List the prompt versions."""
    from harness.prompts import versions as prompts

    found = [prompts.load(name) for name in prompts.names()]
    rows = [
        {"version": p.version, "released": p.released, "sha256": p.sha256, "description": p.description,
         "changed": p.changed, "known_failures": p.known_failures}
        for p in found
    ]  # fmt: skip
    if as_json:
        typer.echo(json.dumps(rows, indent=1))
        return
    for row in rows:
        state = "released" if row["released"] else "draft"
        typer.echo(f"{row['version']:<12} {state:<9} {printable(row['description'], 57)}")


@app.command()
def show(
    version: str = typer.Argument(help="Prompt version."),
    scene: str = typer.Option(..., help="Scene id, such as 00003-2."),
    viewer: str | None = typer.Option(None, help="Vehicle id. Default: every viewer."),
    dataset: str = DATASET,
    as_json: bool = typer.Option(False, "--json", help="Print the chat messages as JSON."),
) -> None:
    """Print exactly what a model is sent for a scene (before its own chat template)."""
    from harness.core.errors import unknown
    from harness.dataset import load
    from harness.prompts import versions as prompts

    prompt, data = prompts.load(version), load.load(load.find(dataset))
    found = data.scene(scene)
    if viewer is not None and viewer not in found.viewers:
        raise unknown("viewer", viewer, found.viewers)
    sent = {
        v: prompt.render(found.record["graphs"][v], data.actions, words=data.scenario.words)
        for v in found.viewers
        if viewer in (None, v)
    }
    if as_json:
        typer.echo(json.dumps(sent, indent=1))
        return
    for v, messages in sent.items():
        for message in messages:
            typer.echo(f"--- {v} {message['role']}")
            typer.echo(message["content"])


@app.command()
def check(
    version: str = typer.Argument(help="Prompt version."),
    dataset: str = DATASET,
    tokenizer: Path | None = typer.Option(None, help="tokenizer.json, its folder, or a Qwen2 GGUF."),
    as_json: bool = typer.Option(False, "--json", help="Print the figures as JSON."),
) -> None:
    """Render every scene for every viewer; with a tokenizer, count tokens against the budget."""
    from harness.backends.tokens import counter, spread_of
    from harness.dataset import load
    from harness.prompts import versions as prompts

    prompt, data = prompts.load(version), load.load(load.find(dataset))
    count = counter(tokenizer)
    least, most = prompt.token_budget
    sizes: dict[str, list[int]] = {role: [] for role in prompts.ROLES}
    outside: list[dict[str, Any]] = []
    for scene in data.scenes:
        for v, graph in scene.record["graphs"].items():
            messages = prompt.render(graph, data.actions, words=data.scenario.words)
            if count:
                n = count(messages)
                sizes[graph["role"]].append(n)
                if not least <= n <= most:
                    outside.append({"scene": scene.id, "viewer": v, "tokens": n})
    stats = {role: spread_of(n) for role, n in sizes.items() if n}
    if as_json:
        typer.echo(
            json.dumps({"version": version, "budget": [least, most], "tokens": stats, "outside": outside})
        )
    else:
        typer.echo(
            f"{version}: renders for every viewer of {len(data.scenes)} scenes; "
            f"budget {least} to {most} tokens"
        )
        for role, s in stats.items():
            typer.echo(f"{role:<7} {s['least']} to {s['most']} tokens, mean {s['mean']}, n = {s['n']}")
        if not count:
            typer.echo(
                "tokens not counted: give --tokenizer (the model's tokenizer.json, its folder, or a GGUF)"
            )
        for o in outside[:10]:
            typer.echo(f"outside the budget: scene {o['scene']} viewer {o['viewer']}: {o['tokens']} tokens")
    if outside:
        raise typer.Exit(1)


@app.command()
def lock(version: str = typer.Argument(help="Prompt version to release.")) -> None:
    """Release a version: pin its digest, so that a changed text is an error."""
    from harness.prompts import versions as prompts

    if prompts.load(version).released:
        raise UserError(f"prompt {version} is released already; copy it to a new version to change it")
    typer.echo(f"released {version}, sha256 {prompts.lock(version)}")
