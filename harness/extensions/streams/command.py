"""`harness radio congestion`: what vehicles send on a busy radio under congestion control."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import typer

from harness.cli import options
from harness.cli.terminal import echo_json, echo_text, table
from harness.core.errors import UserError, printable
from harness.core.figures import Unit

if TYPE_CHECKING:
    from harness.extensions.streams.congestion import Settled
    from harness.radio.channel import Channel

MS, ON_AIR, SHARE = Unit("ms", 1, 1000), Unit("ms", 3, 1000), Unit("", 3)


def command(
    name: str = typer.Argument(
        "its-g5",
        help="Channel profile, or one with changed settings: `its-g5:density_per_km=400`.",
        metavar="NAME",
    ),
    rule: list[str] | None = typer.Option(
        None, help="Rule to show: reactive or adaptive. Repeatable; default: both."
    ),
    as_json: options.Json = False,
) -> None:
    """Show what vehicles send under congestion control.

    All have rate_hz packets a second to send, and obey; the radio is then as busy as shown.

    The rules are those of ETSI TS 102 687 for ITS-G5: reactive, a table by the channel's busy ratio
    (the share of time that it is busy), and adaptive, LIMERIC.
    """
    from harness.extensions.streams.congestion import NONE, RULES, settled
    from harness.radio.limits import outside
    from harness.radio.profiles import CHANNELS

    profile, channel = _channel_of(name)
    rules = dict.fromkeys((NONE, *(rule or RULES)))
    results = [settled(channel, each, name) for each in rules]
    beyond = []
    for result in results:
        for phase in result.phases:
            settings = {**asdict(channel), "rate_hz": 1 / phase.interval_s}
            beyond += outside(settings, CHANNELS.profile(profile).limits)
    beyond = list(dict.fromkeys(beyond))
    if as_json:
        airtime_s = results[0].airtime_s
        plain = [_plain(result) for result in results]
        echo_json({"name": name, "airtime_s": airtime_s, "rules": plain, "outside": beyond})
        return
    rows = []
    for result in results:
        for phase in result.phases:
            allowed = "at any time" if result.rule == NONE else f"{MS.number(phase.allowed_s)}"
            cells = (phase.state, allowed, MS.number(phase.interval_s))
            rows.append((result.rule, *cells, SHARE.number(phase.busy_ratio)))
    table(["rule", "state", "allowed after, ms", "sent after, ms", "busy ratio"], rows)
    typer.echo(f"packets of {ON_AIR.text(results[0].airtime_s)} on air")
    for result in results:
        if len(result.phases) > 1:
            echo_text(
                f"{result.rule}: no state makes the channel as busy as its own bounds say, so it "
                f"swings between these two; on average {MS.text(result.interval_s)} and a busy "
                f"ratio of {SHARE.number(result.busy_ratio)}, if each lasts as long."
            )
    for line in beyond:
        echo_text(line)


def _plain(result: "Settled") -> dict[str, Any]:
    """Return what `--json` has of a rule: the means, and the phases that they are of."""
    phases = [phase._asdict() for phase in result.phases]
    means = {"interval_s": result.interval_s, "busy_ratio": result.busy_ratio}
    return {"rule": result.rule, **means, "phases": phases}


def _channel_of(text: str) -> "tuple[str, Channel]":
    """Return a radio's name and its channel, which nothing controls.

    `text` is how `--condition` names it, such as `mode4`.

    Raises UserError if nothing has the name, or what has it has no channel.
    """
    from harness.coordination.named_points import named_point
    from harness.extensions.streams.congestion import NONE
    from harness.radio.wrapped import innermost

    point = named_point(text)
    if point.radio.profile is None:
        raise UserError(
            f"{printable(text)} has no channel; `harness radio list` shows those there are"
        )
    return point.radio.profile, innermost(point.changed(congestion=NONE).channel)
