"""`harness radio`: the radios that a condition can name, what each rests on,
and how far it reaches.
"""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from harness.cli import options
from harness.cli.terminal import echo_each, echo_fields, echo_json, echo_text, table
from harness.core import resources
from harness.core.errors import UserError, in_range, printable, unknown
from harness.core.figures import Unit, interval_of, number_or_none

if TYPE_CHECKING:
    from harness.extensions.radio.reception import Check
    from harness.radio.channel import Channel
    from harness.radio.profiles import Profile

MOST_TRIPS = 100_000  # at each distance
Name = typer.Argument(
    help="Channel profile, or one with changed settings: `mode4:density_per_km=200`.",
    metavar="NAME",
)


def list_channels(as_json: options.Json = False) -> None:
    """List the channel profiles. Each name is also a condition that --condition takes."""
    from harness.radio.profiles import CHANNELS

    def show(name: str, profile: "Profile") -> None:
        typer.echo(f"{printable(name)} · {printable(profile.model)} · {profile.status}")
        typer.echo(f"  {printable(profile.description, 78)}")

    echo_each(resources.each(CHANNELS, CHANNELS.profile), as_json, asdict, show)


def show(name: str = Name, as_json: options.Json = False) -> None:
    """Print a profile, and its reception by distance.

    It names the profile's source, status and settings.

    Reception is the probability that one message arrives, averaged over shadowing. A table's
    latencies are shown if it has their percentiles.
    """
    from harness.extensions.radio.reception import DISTANCES_M, by_sight, latencies_ms
    from harness.radio.channel import Physical
    from harness.radio.limits import outside
    from harness.radio.profiles import CHANNELS
    from harness.radio.wrapped import busy_ratio

    profile_name, channel = channel_of(name)
    profile, settings = CHANNELS.profile(profile_name), asdict(channel)
    beyond = outside(settings, profile.limits)
    curves: dict[str, list[float]] = {}
    latencies, busy = latencies_ms(channel, DISTANCES_M), None
    if isinstance(channel, Physical):
        curves = {sight: curve.tolist() for sight, curve in by_sight(channel, DISTANCES_M).items()}
        busy = number_or_none(busy_ratio(channel))
    if as_json:
        about = asdict(profile)
        del about["parameters"]
        result = {
            "name": name,
            **about,
            "settings": settings,
            "outside": beyond,
            "reception": {"distance_m": DISTANCES_M, **curves} if curves else None,
            "busy_ratio": busy,
            "latency_ms": {"distance_m": DISTANCES_M, **latencies} if latencies else None,
        }
        echo_json(result)
        return
    typer.echo(f"{printable(profile_name)} · {printable(profile.model)} · {profile.status}")
    for text in (profile.description, f"source: {profile.source}"):
        echo_text(text)
    typer.echo()
    echo_fields(channel)
    typer.echo()
    for line in beyond:
        echo_text(line)
    if not curves:
        typer.echo("packet loss is the same at every distance and behind every obstacle")
        return
    sights = ["in sight", "behind a car", "behind a building"]
    rows = []
    for n, distance_m in enumerate(DISTANCES_M):
        rows.append((f"{distance_m} m", *(f"{100 * curve[n]:.1f}" for curve in curves.values())))
    table(["reception, %", *sights], rows)
    if latencies:
        typer.echo()
        rows = []
        for n, distance_m in enumerate(DISTANCES_M):
            cells = [f"{distance_m} m"]
            for percentiles in latencies.values():
                p50, p95 = (values[n] for values in percentiles.values())
                cells.append(f"{p50:.1f} / {p95:.1f}")
            rows.append(tuple(cells))
        table(["latency p50 / p95, ms", *sights], rows)
    if busy is not None:
        typer.echo(f"channel busy ratio {busy:.3f} under the background load")


def check(
    name: str = Name,
    n: int = typer.Option(
        2000, "-n", help="Number of messages to simulate at each distance, 100 to 100000."
    ),
    against: list[Path] | None = typer.Option(
        None,
        help="CSV file with published curves: columns distance_m, reception (0 to 1) and, where "
        "their "
        "settings differ from the profile's, configuration (such as rate_hz=10,power_dbm=20). "
        "Repeatable.",
    ),
    out: Path | None = typer.Option(
        None, help="Also draw a picture to this file: .svg, .pdf or .png."
    ),
    as_json: options.Json = False,
) -> None:
    """Check a radio against simulation and published curves.

    Computed reception is compared with that of simulated messages, and with published curves.

    Messages are simulated as in a run, with sender and receiver in sight of each other; each
    message has its own shadowing. The waits are those from one received background packet of a
    vehicle to the next; they take a tenth as many samples. Each published curve is compared at its
    own settings.
    """
    from harness.extensions.radio.reception import PACKETS
    from harness.extensions.radio.reception import check as checked
    from harness.radio.channel import Physical
    from harness.radio.limits import outside
    from harness.radio.profiles import CHANNELS

    in_range("-n", n, 100, MOST_TRIPS)
    profile, channel = channel_of(name)
    if not isinstance(channel, Physical):
        raise UserError(
            f"{printable(name)} loses the same at every distance, so there is no curve to check; "
            "give a physical radio, such as mode4"
        )
    _refuse_format(out)
    result = checked(channel, n, against or (), f"channel profile {profile}")
    beyond = outside(asdict(channel), CHANNELS.profile(profile).limits)
    if out:
        from harness.extensions.radio.figures import reception
        from harness.report.drawing.pictures import save

        save(reception(name, channel, result.messages, result.curves), out, out.suffix[1:])  # type: ignore[arg-type]
    if as_json:
        curves = []
        for compared in result.curves:
            curve = {
                "configuration": compared.curve.configuration,
                "source": compared.curve.source,
                "n": len(compared.reception),
                "mean_difference": compared.mean_difference,
                "largest_difference": compared.largest_difference,
            }
            curves.append(curve)
        echo_json({"name": name, "outside": beyond, **vars(result), "curves": curves})
        return
    _messages_table(result)
    typer.echo(f"n = {n} messages per distance, each with its own shadowing; 95 % intervals")
    if result.waits:
        typer.echo()
        _waits_table(result)
        busy = f"busy ratio {result.busy_ratio:.3f}"
        typer.echo(f"n = {n // 10} trips a distance, {PACKETS} packets each; {busy}")
    for line in beyond:
        typer.echo(line)
    if result.curves:
        typer.echo()
        _curves_table(result)
        mean = f"{100 * result.mean_difference:.1f} points apart on average"
        typer.echo(f"{len(result.curves)} curves, {mean}; model less theirs")
        sources = dict.fromkeys(compared.curve.source for compared in result.curves)
        typer.echo(printable("; ".join(sources), 1000))
    if out:
        typer.echo(f"wrote {printable(out)}")


def _messages_table(result: "Check") -> None:
    """Print the reception of single messages, a row a distance."""
    rows = []
    for at in result.messages:
        rates = (f"{100 * at.model:.1f}", interval_of(at.crossing), interval_of(at.round_trip))
        rows.append((f"{at.distance_m:g} m", *rates, f"{1000 * at.delay_s:.1f}"))
    table(["in sight", "model %", "one message %", "round trip %", "delay ms"], rows)


def _waits_table(result: "Check") -> None:
    """Print how long after one packet the next arrives, a row a distance."""
    rows = []
    for wait in result.waits:
        mean, p95 = (
            interval_of(wait.mean_s, Unit("s", 3)),
            interval_of(wait.p95_s, Unit("s", 2)),
        )
        rows.append((f"{wait.distance_m:g} m", mean, p95, f"{wait.independent_s:.3f}"))
    table(["next packet after, s", "mean", "95th percentile", "if independent"], rows)


def _curves_table(result: "Check") -> None:
    """Print how far the model is from published curves, a row a curve."""
    rows = []
    for compared in result.curves:
        name = compared.curve.configuration or compared.curve.source
        mean = f"{100 * compared.mean_difference:.1f}"
        largest = f"{100 * compared.largest_difference:+z.1f}"
        rows.append((name, str(len(compared.reception)), mean, largest))
    table(["curve", "points", "mean apart", "largest"], rows)


def crowd(
    names: list[str] | None = typer.Argument(
        None, help="Channel profiles. Default: all whose load can be set."
    ),
    distance_m: float = typer.Option(
        50.0, min=1.0, max=1000.0, help="Distance from sender to receiver, in m."
    ),
    radius_m: float = typer.Option(
        100.0,
        min=10.0,
        max=1000.0,
        help="Radius around the sender within which all vehicles are, in m.",
    ),
    sight: str = typer.Option(
        "clear", help="What blocks the line of sight: clear (nothing), vehicle or building."
    ),
    out: Path | None = typer.Option(
        None, help="Also draw a picture to this file: .svg, .pdf or .png."
    ),
    as_json: options.Json = False,
) -> None:
    """Show packet loss by swarm size, beside the paper's line.

    The road has the same density of vehicles everywhere as within the radius, and all of them send.
    """
    from harness.core.config import settable
    from harness.extensions.radio.reception import VEHICLES, crowds
    from harness.extensions.radio.trace import SIGHTS
    from harness.radio.channel import Physical
    from harness.radio.profiles import CHANNELS

    if sight not in SIGHTS:
        raise unknown("--sight", sight, SIGHTS)
    _refuse_format(out)
    every = {name: channel_of(name)[1] for name in names} if names else CHANNELS.usable()
    loaded = {}
    for name, channel in every.items():
        if isinstance(channel, Physical) and "density_per_km" in settable(channel):
            loaded[name] = channel
    if lacks := [name for name in names or () if name not in loaded]:
        raise UserError(
            f"{printable(lacks[0])} has no density_per_km that a swarm could change; leave it out"
        )
    losses = crowds(loaded, radius_m, distance_m, sight)
    if out:
        from harness.extensions.radio.figures import crowds as draw
        from harness.report.drawing.pictures import save

        words = {"clear": "in sight", "vehicle": "behind a car", "building": "behind a building"}
        distance = f"{distance_m:g} m {words[sight]}"
        title = f"one transmission over {distance}, vehicles within {radius_m:g} m"
        save(draw(VEHICLES, losses, title), out, out.suffix[1:])  # type: ignore[arg-type]
    if as_json:
        paper = losses.pop("paper")
        result = {
            "vehicles": VEHICLES,
            "distance_m": distance_m,
            "radius_m": radius_m,
            "sight": sight,
            "paper": paper,
            "loss": losses,
        }
        echo_json(result)
        return
    heads = ["lost, %", *(printable(name) for name in losses)]
    rows = []
    for n, vehicles in enumerate(VEHICLES):
        cells = [f"{100 * curve[n]:.1f}" for curve in losses.values()]
        rows.append((f"{vehicles} vehicles", *cells))
    table(heads, rows)
    if out:
        typer.echo(f"wrote {printable(out)}")


def _refuse_format(out: Path | None) -> None:
    if not out:
        return
    from harness.report.drawing.pictures import FORMATS

    if out.suffix[1:] not in FORMATS:
        raise unknown("--out, a file that ends in", out.suffix, [f".{name}" for name in FORMATS])


def channel_of(text: str) -> "tuple[str, Channel]":
    """Return a radio's name and its channel, given how `--condition` names it, such as `mode4`.

    A radio, a channel profile, is one file of `channels/`. `text` may change its settings, such as
    `mode4:power_dbm=20`. Raises UserError if nothing has the name, or what has it has no channel.
    """
    from harness.coordination.named_points import named_point
    from harness.radio.wrapped import innermost

    point = named_point(text)
    if point.radio.profile is None:
        raise UserError(
            f"{printable(text)} has no channel; `harness radio list` shows those there are"
        )
    return point.radio.profile, innermost(point.channel)
