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
    from collections.abc import Mapping, Sequence

    from harness.core.image import Image
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
    rows: list[dict[str, Any]] = []
    for name, prompt in resources.each(prompts.names(), prompts.load).items():
        if isinstance(prompt, UserError):
            rows.append({"version": name, "error": str(prompt)})
        else:
            rows.append({field: getattr(prompt, field) for field in fields})
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
    scenario = at.seat or data.scenario
    reader = pictures.picture_model(prompt, model)
    if reader is None and out:
        raise UserError(f"--out: prompt {version} shows no picture; leave it out")
    system = resolve(model).system if model else None
    chats: dict[str, Sequence[Mapping[str, Any]]] = {}  # by viewer
    images: dict[str, Image] = {}
    notes: dict[str, str] = {}
    for name in viewers:
        rendered = prompt.render(at.graphs[name], data.actions, words=scenario.prompt_words)
        chats[name] = with_system(rendered, system)
        if reader:
            images[name] = Sight(scenario, at.state, name, reader.vision.size_px)
            if out:
                notes[name] = pictures.write(images[name], out / f"{at.id}-{name}.png")
    if as_json:
        echo_json({name: _as_json(chat, reader, images.get(name)) for name, chat in chats.items()})
        return
    for name, chat in chats.items():
        for message in chat:
            typer.echo(f"--- {name} {message['role']}")
            if reader and "image" in message:
                typer.echo(f"picture: {reader.picture}, sha256 {images[name].sha256[:8]}")
                if not pictures.draw(images[name]) and not out:
                    typer.echo(
                        "not drawn: no terminal with colours here; --out FOLDER writes PNG files"
                    )
                if out:
                    typer.echo(notes[name])
            for line in message["content"].split("\n"):
                typer.echo(printable(line, len(line) * 10))


def _as_json(
    chat: "Sequence[Mapping[str, Any]]",
    reader: "pictures.PictureModel | None",
    image: "Image | None",
) -> list[dict[str, Any]]:
    """Return chat messages, with what a picture is in place of the picture."""
    messages = []
    for message in chat:
        plain = dict(message)
        if reader and image and "image" in message:
            plain["image"] = {**reader.as_mapping(), "sha256": image.sha256}
        messages.append(plain)
    return messages


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
    scenario = at.seat or data.scenario
    sent = difference.sent(before, after, at, scenario, counter(tokenizer))
    if as_json:
        fields = ("version", "sha256", "released")
        result = {
            "a": {name: getattr(before, name) for name in fields},
            "b": {name: getattr(after, name) for name in fields},
            **asdict(change),
            "scene": at.id,
            "sent": [asdict(message) for message in sent],
        }
        echo_json(result)
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
        sizes = []
        for unit, counts in (("words", message.words), ("tokens", message.tokens)):
            if counts is not None:
                n_before, n_after = counts
                sizes.append(f"{n_before} → {n_after} {unit} ({n_after - n_before:+d})")
        typer.echo(f"\n{message.viewer} {message.role}: {', '.join(sizes)}")
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
        pieces = [(piece, COLOURS[kind]) for kind, piece in marked(hunk)]
        console().print(Text.assemble(*pieces))


def release(version: Version) -> None:
    """Release a prompt version: any later change of it is an error."""
    from harness.prompts import versions as prompts

    if prompts.load(version).released:
        raise UserError(
            f"prompt {version} is released already; copy it to a new version to change it"
        )
    typer.echo(f"released {version}, sha256 {prompts.lock(version)}")
