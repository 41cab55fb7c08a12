"""`harness prompt`: the versions, the text a model is sent, and its token budget."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from harness.cli import options, pictures
from harness.cli.terminal import console, echo_json
from harness.core import resources
from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from harness.prompts.difference import TextChange

NOT_COUNTED = "tokens not counted: give --tokenizer (tokenizer.json, its folder, or a GGUF)"
COLOURS = {"same": "", "removed": "red", "added": "green"}


Version = Annotated[str, typer.Argument(help="Prompt version; `harness prompt list` shows them.")]
Tokenizer = Annotated[
    Path | None,
    typer.Option(
        help="Tokenizer to count with: a tokenizer.json, its folder, or a GGUF file with the "
        "tokenizer of "
        "Qwen2."
    ),
]
Asked = Annotated[
    str | None,
    typer.Option(
        help="Model to ask; of an image prompt, the model whose picture size and picture tokens to "
        "use. "
        f"Default: nobody is asked, and {pictures.MODEL}'s pictures."
    ),
]


def list_prompts(as_json: options.Json = False) -> None:
    """List the prompt versions, released or draft. Exit code 2 if one of them cannot be used."""
    from harness.prompts import versions as prompts

    fields = ("version", "released", "sha256", "description", "changed", "known_failures")
    rows: list[dict[str, Any]] = [
        {"version": name, "error": str(each)}
        if isinstance(each, UserError)
        else {field: getattr(each, field) for field in fields}
        for name, each in resources.each(prompts.names(), prompts.load).items()
    ]
    if as_json:
        echo_json(rows)
    else:
        for row in rows:
            state = "wrong" if "error" in row else "released" if row["released"] else "draft"
            about = printable(row.get("description", "cannot be used: see below"), 57)
            typer.echo(f"{printable(row['version']):<12} {state:<9} {about}")
    if wrong := [row["error"] for row in rows if "error" in row]:
        raise UserError("; ".join(wrong))


def show(
    version: Version,
    scene: str | None = typer.Option(
        None, help="Scene to render, such as 00003-0. Default: the dataset's first."
    ),
    viewer: str | None = typer.Option(
        None, help="Vehicle that is asked, such as v1 (the ego). Default: every viewer."
    ),
    dataset: options.Dataset = resources.DATASET,
    model: str | None = typer.Option(
        None,
        help="Model that is sent it: its card says where the system text stands, and how large "
        "pictures are. "
        f"Default for pictures: {pictures.MODEL}.",
    ),
    out: Path | None = typer.Option(
        None, help="Image prompts only: folder to write the pictures to, as PNG files."
    ),
    as_json: options.Json = False,
) -> None:
    """Print exactly what a model is sent about a scene.

    Its chat template is not applied yet; the system text stands in the first user turn if the card
    of `--model` says so. Pictures are drawn if the terminal has colours.
    """
    from harness.backends.cards import resolve
    from harness.backends.chat_template import with_system
    from harness.dataset import load
    from harness.prompts import versions as prompts
    from harness.world.perception.camera import Sight

    prompt, data = prompts.load(version), load.load(load.find(dataset))
    at = data.scene(scene or next(iter(data.forest.place)))
    viewers = at.viewers if viewer is None else [at.viewer(viewer)]
    words = data.scenario.prompt_words
    reader = pictures.picture_model(prompt, model)
    if reader is None and out:
        raise UserError(f"--out: prompt {version} shows no picture; leave it out")
    system = resolve(model).system if model else None
    sent = {
        v: with_system(prompt.render(at.graphs[v], data.actions, words=words), system)
        for v in viewers
    }
    seen = {v: Sight(data.scenario, at.state, v, reader.vision.size_px) for v in viewers if reader}
    wrote = {v: pictures.write(image, out / f"{at.id}-{v}.png") for v, image in seen.items() if out}
    if as_json:
        images = {
            v: {**reader.as_mapping(), "sha256": image.sha256}
            for v, image in seen.items()
            if reader
        }
        echo_json(
            {
                v: [{**m, "image": images[v]} if "image" in m else m for m in messages]
                for v, messages in sent.items()
            }
        )
        return
    for v, messages in sent.items():
        for message in messages:
            typer.echo(f"--- {v} {message['role']}")
            if reader and "image" in message:
                typer.echo(f"picture: {reader.picture}, sha256 {seen[v].sha256[:8]}")
                if not pictures.draw(seen[v]) and not out:
                    typer.echo(
                        "not drawn: no terminal with colours here; --out FOLDER writes PNG files"
                    )
                if out:
                    typer.echo(wrote[v])
            for line in message["content"].split("\n"):
                typer.echo(printable(line, len(line) * 10))


def compare(
    a: str = typer.Argument(help="Prompt version to compare with.", metavar="A"),
    b: str = typer.Argument(help="Prompt version to compare.", metavar="B"),
    scene: str | None = typer.Option(
        None, help="Scene to render, such as 00003-0. Default: the dataset's first."
    ),
    dataset: options.Dataset = resources.DATASET,
    tokenizer: Tokenizer = None,
    as_json: options.Json = False,
) -> None:
    """Show what differs between two prompt versions, word by word.

    It compares their settings, their templates, and what a model is sent about one scene: as the
    ego, as its first helper, and as the ego with a message from every helper.
    """
    from harness.backends.tokens import counter
    from harness.dataset import load
    from harness.prompts import difference
    from harness.prompts import versions as prompts

    before, after, data = prompts.load(a), prompts.load(b), load.load(load.find(dataset))
    at = data.scene(scene or next(iter(data.forest.place)))
    change = difference.change(before, after)
    sent = difference.sent(before, after, at, data.scenario, counter(tokenizer))
    if as_json:
        about = ("version", "sha256", "released")
        sides = {
            key: {name: getattr(p, name) for name in about}
            for key, p in (("a", before), ("b", after))
        }
        echo_json(
            {
                **sides,
                **asdict(change),
                "scene": at.id,
                "sent": [asdict(message) for message in sent],
            }
        )
        return
    typer.echo(f"{a} → {b}: {'differ' if change else 'the same settings and texts'}")
    for name, *values in change.settings:
        typer.echo(f"  {name:<26}{' → '.join('none' if v is None else str(v) for v in values)}")
    for file, text in change.texts.items():
        _changed(file, text)
    typer.echo(f"\nsent in scene {at.id}")
    if sent[0].tokens is None:
        typer.echo(NOT_COUNTED)
    for message in sent:
        counts = {"words": message.words, "tokens": message.tokens}
        sizes = ", ".join(
            f"{n[0]} → {n[1]} {unit} ({n[1] - n[0]:+d})"
            for unit, n in counts.items()
            if n is not None
        )
        typer.echo(f"\n{message.viewer} {message.role}: {sizes}")
        for part, text in message.parts.items():
            _changed(part, text)


def _changed(what: str, text: "TextChange") -> None:
    """Print what differs between two texts, coloured in a terminal."""
    from rich.text import Text

    from harness.prompts.difference import marked

    if not text.hunks:
        typer.echo(f"{what}: the same")
        return
    typer.echo(f"{what}: {text.removed} words removed, {text.added} added")
    for hunk in text.hunks:
        typer.echo(f"@@ line {hunk.line_a} → {hunk.line_b}")
        console().print(Text.assemble(*((piece, COLOURS[kind]) for kind, piece in marked(hunk))))


def release(version: Version) -> None:
    """Release a prompt version: any later change of it is an error."""
    from harness.prompts import versions as prompts

    if prompts.load(version).released:
        raise UserError(
            f"prompt {version} is released already; copy it to a new version to change it"
        )
    typer.echo(f"released {version}, sha256 {prompts.lock(version)}")
