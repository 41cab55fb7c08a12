"""`harness channel`: the radios that a condition can name, what each rests on, and how far it reaches."""

from dataclasses import asdict
from typing import TYPE_CHECKING

import typer

from harness.cli import options
from harness.cli.estimates import echo_json, table
from harness.core.errors import UserError, printable

if TYPE_CHECKING:
    from harness.radio.channel import Channel

app = typer.Typer(help="List radios, show one, or hold one against what is published.", no_args_is_help=True)

Name = typer.Argument(help="Profile, or a change of one: `mode4:density_per_km=200`.", metavar="NAME")


@app.command("list")
def list_channels(as_json: options.Json = False) -> None:
    """List the channel profiles. Each is a condition of its name."""
    from harness.radio.profiles import CHANNELS

    profiles = {name: CHANNELS.profile(name) for name in CHANNELS}
    if as_json:
        echo_json([{"name": name, **asdict(profile)} for name, profile in profiles.items()])
        return
    for name, profile in profiles.items():
        typer.echo(f"{printable(name)} · {printable(profile.model)} · {profile.status}")
        typer.echo(f"  {printable(profile.description, 78)}")


@app.command()
def show(name: str = Name, as_json: options.Json = False) -> None:
    """Print a profile: source, status, settings, and its reception against distance.

    Reception is of one message, averaged over shadowing.
    """
    import textwrap

    import numpy as np

    from harness.cli.docstrings import attributes
    from harness.radio.channel import Physical
    from harness.radio.profiles import CHANNELS, outside
    from harness.studies.reception import DISTANCES_M, SIGHTS

    profile_name, channel = _of(name)
    profile, meanings = CHANNELS.profile(profile_name), attributes(type(channel))
    settings = asdict(channel)
    beyond = outside(profile, channel)
    curves: dict[str, list[float]] = {}
    busy = None
    if isinstance(channel, Physical):
        distances = np.array(DISTANCES_M, dtype=float)
        curves = {sight: channel.reception(distances, code).tolist() for sight, code in SIGHTS.items()}
        busy = channel.busy_ratio()
    if as_json:
        about = {key: value for key, value in asdict(profile).items() if key != "parameters"}
        reception = {"distance_m": DISTANCES_M, **curves} if curves else None
        echo_json({
            "name": name, **about, "settings": settings, "outside": beyond, "reception": reception,
            "busy_ratio": None if busy is None or np.isnan(busy) else busy,
        })  # fmt: skip
        return
    typer.echo(f"{printable(profile_name)} · {printable(profile.model)} · {profile.status}")
    for text in (profile.description, f"source: {profile.source}"):
        typer.echo(textwrap.fill(printable(text, 1000), 80, subsequent_indent="  "))
    typer.echo()
    for key, value in settings.items():
        shown = f"{value:g}" if type(value) in (int, float) else printable(str(value).lower(), 60)
        typer.echo(f"{key} = {shown}")
        typer.echo(textwrap.fill(meanings.get(key, ""), 80, initial_indent="    ", subsequent_indent="    "))
    typer.echo()
    for line in beyond:
        typer.echo(textwrap.fill(f"outside its source's range: {line}", 80, subsequent_indent="  "))
    if not curves:
        typer.echo("its loss is the same at any distance, behind anything")
        return
    heads = ["reception, %", "in sight", "behind a car", "behind a building"]
    shares = zip(DISTANCES_M, *curves.values(), strict=True)
    table(heads, [(f"{d} m", *(f"{100 * share:.1f}" for share in row)) for d, *row in shares])
    if busy is not None and not np.isnan(busy):
        typer.echo(f"channel busy ratio {busy:.3f} under the background load")


def _of(text: str) -> "tuple[str, Channel]":
    """The profile that a condition's text names, and its channel with the text's settings."""
    from harness.coordination.operating_point import named_point

    point = named_point(text)
    if point.profile is None:
        raise UserError(f"{printable(text)} has no channel; `harness channel list` shows those there are")
    return point.profile, point.channel()
