"""`harness radio`: the radios that a condition can name, what each rests on, and how far it reaches."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from harness.cli import options
from harness.cli.estimates import echo_json, echo_wrong, table
from harness.core import resources
from harness.core.errors import UserError, printable, unknown
from harness.core.figures import Unit, as_mapping, known, shown

if TYPE_CHECKING:
    from harness.radio.channel import Channel


MOST_TRIPS = 100_000  # at each distance
Name = typer.Argument(
    help="Channel profile, or one with changed settings: `mode4:density_per_km=200`.", metavar="NAME"
)


def list_channels(as_json: options.Json = False) -> None:
    """List the channel profiles. Each name is also a condition that --condition takes."""
    from harness.radio.profiles import CHANNELS

    profiles = resources.each(CHANNELS, CHANNELS.profile)
    if as_json:
        echo_json([
            {"name": name, "error": str(profile)} if isinstance(profile, UserError)
            else {"name": name, **asdict(profile)}
            for name, profile in profiles.items()
        ])  # fmt: skip
        return
    for name, profile in profiles.items():
        if isinstance(profile, UserError):
            echo_wrong(name, profile)
            continue
        typer.echo(f"{printable(name)} · {printable(profile.model)} · {profile.status}")
        typer.echo(f"  {printable(profile.description, 78)}")


def show(name: str = Name, as_json: options.Json = False) -> None:
    """Print a profile, and its reception by distance.

    It names the profile's source, status and settings.

    Reception is the probability that one message arrives, averaged over shadowing.
    """
    import textwrap

    from harness.cli.docstrings import echo_fields
    from harness.radio.channel import Physical
    from harness.radio.profiles import CHANNELS, outside
    from harness.studies.reception import DISTANCES_M, by_sight

    profile_name, channel = _channel_of(name)
    profile, settings = CHANNELS.profile(profile_name), asdict(channel)
    beyond = outside(settings, profile.limits)
    curves: dict[str, list[float]] = {}
    busy = None
    if isinstance(channel, Physical):
        curves = {sight: curve.tolist() for sight, curve in by_sight(channel, DISTANCES_M).items()}
        busy = known(channel.busy_ratio())
    if as_json:
        about = {key: value for key, value in asdict(profile).items() if key != "parameters"}
        reception = {"distance_m": DISTANCES_M, **curves} if curves else None
        echo_json({
            "name": name, **about, "settings": settings, "outside": beyond, "reception": reception,
            "busy_ratio": busy,
        })  # fmt: skip
        return
    typer.echo(f"{printable(profile_name)} · {printable(profile.model)} · {profile.status}")
    for text in (profile.description, f"source: {profile.source}"):
        typer.echo(textwrap.fill(printable(text, 1000), 80, subsequent_indent="  "))
    typer.echo()
    echo_fields(channel)
    typer.echo()
    for line in beyond:
        typer.echo(textwrap.fill(line, 80, subsequent_indent="  "))
    if not curves:
        typer.echo("packet loss is the same at every distance and behind every obstacle")
        return
    heads = ["reception, %", "in sight", "behind a car", "behind a building"]
    shares = zip(DISTANCES_M, *curves.values(), strict=True)
    table(heads, [(f"{d} m", *(f"{100 * share:.1f}" for share in row)) for d, *row in shares])
    if busy is not None:
        typer.echo(f"channel busy ratio {busy:.3f} under the background load")


def check(
    name: str = Name,
    n: int = typer.Option(2000, "-n", help="Number of messages to simulate at each distance, 100 to 100000."),
    against: list[Path] | None = typer.Option(
        None,
        help="CSV file with published curves: columns distance_m, reception (0 to 1) and, where their "
        "settings differ from the profile's, configuration (such as rate_hz=10,power_dbm=20). Repeatable.",
    ),
    out: Path | None = typer.Option(None, help="Also draw a picture to this file: .svg, .pdf or .png."),
    as_json: options.Json = False,
) -> None:
    """Check a radio against simulation and published curves.

    Computed reception is compared with that of simulated messages, and with published curves.

    Messages are simulated as in a run, with sender and receiver in sight of each other; each message has its
    own shadowing. The waits are those from one received background packet of a vehicle to the next; they take
    a tenth as many samples. Each published curve is compared at its own settings.
    """
    import numpy as np

    from harness.radio.channel import Physical
    from harness.radio.profiles import CHANNELS, outside
    from harness.radio.transceiver import Transceiver
    from harness.studies.reception import DISTANCES_M, PACKETS, by_sight, compared, curves_of, drawn, gaps

    if not 100 <= n <= MOST_TRIPS:
        raise UserError(f"-n {n}: give 100 to {MOST_TRIPS} trips")
    profile, channel = _channel_of(name)
    if not isinstance(channel, Physical):
        raise UserError(
            f"{printable(name)} loses the same at every distance, so there is no curve to check; give a "
            "physical radio, such as mode4"
        )
    _picture(out)
    where = f"channel profile {profile}"
    messages = drawn(channel, DISTANCES_M, n)
    of_others = [compared(channel, curve, where) for path in against or () for curve in curves_of(path)]
    model = by_sight(channel, DISTANCES_M)["clear"].tolist()
    waits = (
        gaps(channel, DISTANCES_M, n // 10) if isinstance(channel, Transceiver) and channel.rate_hz else []
    )
    busy = channel.busy_ratio()
    beyond = outside(asdict(channel), CHANNELS.profile(profile).limits)
    if out:
        from harness.report.drawing.pictures import save
        from harness.studies.figures.lines import reception

        every = np.linspace(1, DISTANCES_M[-1], 250)
        save(reception(name, by_sight(channel, every), every, messages, of_others), out, out.suffix[1:])  # type: ignore[arg-type]
    if as_json:
        echo_json({
            "name": name, "n": n, "outside": beyond, "busy_ratio": known(busy),
            "waits": [
                {"distance_m": w.distance_m, "mean_s": as_mapping(w.mean_s), "p95_s": as_mapping(w.p95_s),
                 "independent_s": w.independent_s if np.isfinite(w.independent_s) else None}
                for w in waits
            ],
            "messages": [
                {"distance_m": m.distance_m, "model": share, "crossing": as_mapping(m.crossing),
                 "round_trip": as_mapping(m.round_trip), "delay_s": m.delay_s}
                for m, share in zip(messages, model, strict=True)
            ],
            "curves": [
                {"configuration": c.curve.configuration, "source": c.curve.source, "n": len(c.reception),
                 "mean_difference": c.mean_difference, "largest_difference": c.largest_difference}
                for c in of_others
            ],
        })  # fmt: skip
        return
    heads = ["in sight", "model %", "one message %", "round trip %", "delay ms"]
    table(
        heads,
        [
            (
                f"{m.distance_m:g} m",
                f"{100 * share:.1f}",
                shown(m.crossing),
                shown(m.round_trip),
                f"{1000 * m.delay_s:.1f}",
            )
            for m, share in zip(messages, model, strict=True)
        ],
    )
    typer.echo(f"n = {n} messages per distance, each with its own shadowing; 95 % intervals")
    if waits:
        typer.echo()
        table(
            ["next packet after, s", "mean", "95th percentile", "if independent"],
            [
                (
                    f"{w.distance_m:g} m",
                    shown(w.mean_s, Unit("s", 3)),
                    shown(w.p95_s, Unit("s", 2)),
                    f"{w.independent_s:.3f}",
                )
                for w in waits
            ],
        )
        typer.echo(f"n = {n // 10} trips a distance, {PACKETS} packets each; busy ratio {busy:.3f}")
    for line in beyond:
        typer.echo(line)
    if of_others:
        typer.echo()
        table(
            ["curve", "points", "mean apart", "largest"],
            [
                (
                    c.curve.configuration or c.curve.source,
                    str(len(c.reception)),
                    f"{100 * c.mean_difference:.1f}",
                    f"{100 * c.largest_difference:+z.1f}",
                )
                for c in of_others
            ],
        )
        mean = 100 * float(np.mean([c.mean_difference for c in of_others]))
        typer.echo(f"{len(of_others)} curves, {mean:.1f} points apart on average; model less theirs")
        sources = dict.fromkeys(c.curve.source for c in of_others)
        typer.echo(printable("; ".join(sources), 1000))
    if out:
        typer.echo(f"wrote {printable(out)}")


def crowd(
    names: list[str] | None = typer.Argument(
        None, help="Channel profiles. Default: all whose load can be set."
    ),
    distance_m: float = typer.Option(
        50.0, min=1.0, max=1000.0, help="Distance from sender to receiver, in m."
    ),
    radius_m: float = typer.Option(
        100.0, min=10.0, max=1000.0, help="Radius around the sender within which all vehicles are, in m."
    ),
    sight: str = typer.Option(
        "clear", help="What blocks the line of sight: clear (nothing), vehicle or building."
    ),
    out: Path | None = typer.Option(None, help="Also draw a picture to this file: .svg, .pdf or .png."),
    as_json: options.Json = False,
) -> None:
    """Show packet loss by swarm size, beside the paper's line.

    The road has the same density of vehicles everywhere as within the radius, and all of them send.
    """
    import numpy as np

    from harness.core.config import settable
    from harness.radio.channel import Physical
    from harness.radio.constant import density_coupled_loss
    from harness.radio.profiles import CHANNELS
    from harness.studies.reception import SIGHTS, crowded

    if sight not in SIGHTS:
        raise unknown("--sight", sight, SIGHTS)
    _picture(out)
    every = {name: _channel_of(name)[1] for name in names} if names else CHANNELS.usable()
    loaded = {
        name: channel for name, channel in every.items()
        if isinstance(channel, Physical) and "density_per_km" in settable(channel)
    }  # fmt: skip
    if lacks := [name for name in names or () if name not in loaded]:
        raise UserError(
            f"{printable(lacks[0])} has no density_per_km that a swarm could change; leave it out"
        )
    vehicles = (2, 4, 8, 16, 32, 64, 128)
    losses = {n: crowded(channel, vehicles, radius_m, distance_m, sight) for n, channel in loaded.items()}
    line = density_coupled_loss(np.array(vehicles))
    if out:
        from harness.report.drawing.pictures import save
        from harness.studies.figures.lines import crowds

        between = {"clear": "in sight", "vehicle": "behind a car", "building": "behind a building"}[sight]
        title = f"one transmission over {distance_m:g} m {between}, vehicles within {radius_m:g} m"
        save(crowds(vehicles, losses, line, title), out, out.suffix[1:])  # type: ignore[arg-type]
    if as_json:
        echo_json({
            "vehicles": vehicles, "distance_m": distance_m, "radius_m": radius_m, "sight": sight,
            "paper": line.tolist(), "loss": {name: loss.tolist() for name, loss in losses.items()},
        })  # fmt: skip
        return
    columns = {"paper": line, **losses}
    table(
        ["lost, %", *map(printable, columns)],
        [
            (f"{n} vehicles", *(f"{100 * column[place]:.1f}" for column in columns.values()))
            for place, n in enumerate(vehicles)
        ],
    )
    if out:
        typer.echo(f"wrote {printable(out)}")


def _picture(out: Path | None) -> None:
    if not out:
        return
    from harness.report.drawing.pictures import FORMATS

    if out.suffix[1:] not in FORMATS:
        raise unknown("--out, a file that ends in", out.suffix, [f".{known}" for known in FORMATS])


def _channel_of(text: str) -> "tuple[str, Channel]":
    """Return the profile that a condition's text names, and its channel with the text's settings."""
    from harness.coordination.operating_point import named_point
    from harness.radio.wrapped import innermost

    point = named_point(text)
    if point.radio.profile is None:
        raise UserError(f"{printable(text)} has no channel; `harness radio list` shows those there are")
    return point.radio.profile, innermost(point.channel)
